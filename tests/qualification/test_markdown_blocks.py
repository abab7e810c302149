from pathlib import Path

import pytest

from gripper_force.errors import DataError
from gripper_force.qualification.markdown_blocks import write_between


def test_text_between_the_lines_is_replaced(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Before\n<!-- here -->\nold\n<!-- end of here -->\nafter\n")
    for _ in range(2):
        write_between(page, "here", "| new |\n")
    assert page.read_text() == "# Before\n<!-- here -->\n\n| new |\n\n<!-- end of here -->\nafter\n"


def test_an_interruption_leaves_the_page_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "page.md"
    page.write_text(before := "<!-- here -->\nold\n<!-- end of here -->\nby hand\n")

    def write_half(path: Path, text: str, encoding: str) -> None:
        with path.open("w", encoding=encoding) as file:
            file.write(text[:20])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_text", write_half)
    with pytest.raises(KeyboardInterrupt):
        write_between(page, "here", "new")
    assert page.read_text() == before


@pytest.mark.parametrize("text", ["", "<!-- here -->", "<!-- end of here --> <!-- here -->"])
def test_a_page_without_the_lines_raises(text: str, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(DataError, match="it needs one line"):
        write_between(page, "here", "new")


def test_a_page_that_can_not_be_read_is_no_page_without_the_lines(tmp_path: Path) -> None:
    for path, reason in ((tmp_path / "none.md", "No such file or directory"), (tmp_path, "Is a directory")):
        with pytest.raises(DataError, match=rf"can't write into .*: {reason}; check the path"):
            write_between(path, "here", "new")
