"""What a command measures, put into a page that is written by hand."""

from pathlib import Path

from gripper_force.errors import DataError


def write_between(page: Path, name: str, text: str) -> None:
    """Puts text into a page between its lines ``<!-- NAME -->`` and ``<!-- end of NAME -->``.

    Raises:
        DataError: The page is not there, or has no such lines.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    try:
        before, rest = page.read_text(encoding="utf-8").split(begin)
        _, after = rest.split(end)
        page.write_text(f"{before}{begin}\n\n{text}\n{end}{after}", encoding="utf-8")
    except (OSError, ValueError) as error:
        raise DataError(f"{page} has no lines {begin!r} and {end!r} to write between") from error
