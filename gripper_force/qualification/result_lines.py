"""Files that take one result a line, so that an interrupted measurement can be continued."""

from pathlib import Path


def whole_lines(file: Path) -> list[str]:
    """Returns the lines of a file, none if it does not exist. A last line that an interruption cut is removed from it.

    Raises:
        OSError: The file can't be read or written.
        ValueError: It is no text.
    """
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        file.write_text(whole, encoding="utf-8")
    return whole.splitlines()
