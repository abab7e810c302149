"""Files that appear under their names once they are complete."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def unfinished(path: Path) -> Iterator[Path]:
    """Gives a file to write beside ``path``, which gets that name at the end; after an error it stays where it is.

    One that an interrupted run left is removed first.
    """
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    yield part
    part.replace(path)
