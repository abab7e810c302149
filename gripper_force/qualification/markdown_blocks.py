"""Writes generated tables into a Markdown page that is otherwise written by hand."""

from pathlib import Path

from gripper_force.errors import DataError
from gripper_force.files import unfinished


def write_between(page: Path, name: str, text: str) -> None:
    """Replaces the text between the lines ``<!-- NAME -->`` and ``<!-- end of NAME -->`` of a page.

    Raises:
        DataError: The page can't be read or written, or does not have these lines once each.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    try:
        before, rest = page.read_text(encoding="utf-8").split(begin)
        _, after = rest.split(end)
        with unfinished(
            page
        ) as part:  # an interruption must not leave half of a page that is written by hand
            part.write_text(f"{before}{begin}\n\n{text}\n{end}{after}", encoding="utf-8")
    except OSError as error:
        raise DataError(f"can't write into {page}: {error.strerror}; check the path of --write") from error
    except ValueError as error:
        raise DataError(
            f"can't write into {page}: it needs one line {begin!r} and after it one line {end!r}"
        ) from error
