import json
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.qualification.numerics import suite as numerics
from gripper_force.qualification.numerics.numerical_case import NumericalCase
from gripper_force.qualification.numerics.suite import markdown, run

PAGE = Path(__file__).parents[3] / "docs/stability.md"


def good(_config: Config, _maps: Path | None) -> Iterator[NumericalCase]:
    yield NumericalCase("even", "by hand", 1.25, 2.0, "N")


def bad(_config: Config, maps: Path | None) -> Iterator[NumericalCase]:
    if maps is not None:
        maps.mkdir()
        (maps / "bad.png").touch()
    yield NumericalCase("odd", "by [hand]", math.nan, 2.0)


@pytest.fixture(autouse=True)
def parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numerics, "PARTS", {"good": good, "bad": bad})


@pytest.mark.parametrize(("figure", "ok"), [(1.0, True), (1.1, False), (math.nan, False), (math.inf, False)])
def test_a_case_is_ok_if_its_figure_is_within_the_bound(figure: float, ok: bool) -> None:
    assert NumericalCase("case", "detail", figure, 1.0).ok is ok


def test_parts_run_in_the_order_of_the_page() -> None:
    reports: list[tuple[str, int]] = []

    def progress(text: str, steps: int = 1) -> None:
        reports.append((text, steps))

    result = run(Config(), ["bad", "good"], progress=progress)
    assert list(result["parts"]) == ["good", "bad"]
    assert reports == [("good: even", 0), ("good", 1), ("bad: odd", 0), ("bad", 1)]
    assert result["ok"] is False
    assert run(Config(), ["good"])["ok"] is True


def test_unknown_part_raises() -> None:
    with pytest.raises(ConfigError, match="no part 'goood'; choose from good, bad"):
        run(Config(), ["goood"])


def test_markdown_marks_cases_that_exceed_their_bound() -> None:
    table = markdown(run(Config(), [])["parts"]["good"])
    assert table.splitlines()[-1] == "| even | by hand | 1.25 N | 2 N | ok |"
    assert "| nan | 2 | **exceeded** |" in markdown(run(Config(), [])["parts"]["bad"])


def test_write_puts_tables_and_maps_into_the_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A\n<!-- good -->\n<!-- end of good -->\nB\n<!-- bad -->\n<!-- end of bad -->\n")
    done = CliRunner().invoke(cli.app, ["stability", "numerics", "--json", "--write", str(page)])
    assert done.exit_code == 1
    result = json.loads(done.stdout)
    assert result["parts"]["good"][0]["figure"] == 1.25
    assert result["parts"]["bad"][0]["figure"] is None
    assert (tmp_path / "page/bad.png").exists()
    text = page.read_text()
    assert text.startswith("# A\n<!-- good -->\n\n| case |")
    assert "| even | by hand |" in text


def test_stability_numerics_prints_each_case() -> None:
    done = CliRunner().invoke(cli.app, ["stability", "numerics", "--part", "good"])
    assert done.exit_code == 0
    assert "1.25 N" in done.stdout
    shown = CliRunner().invoke(cli.app, ["stability", "numerics", "--part", "bad"])
    assert shown.exit_code == 1
    assert "by [hand]" in shown.stdout


def test_each_part_can_be_imported_and_has_a_place_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    text = PAGE.read_text(encoding="utf-8")
    for name, part in numerics.PARTS.items():
        assert isinstance(part(Config(), None), Iterator)
        assert f"<!-- {name} -->" in text
        assert f"<!-- end of {name} -->" in text
