"""Files that appear under their names once they are complete."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gripper_force.errors import DataError


@contextmanager
def unfinished(path: Path) -> Iterator[Path]:
    """Gives a file to write beside ``path``, which gets that name at the end; after an error it stays where it is.

    One that an interrupted run left is removed first.

    Raises:
        DataError: Another process writes the file.
    """
    part = path.with_name(f".{path.name}.part")
    with _only_writer(path):
        part.unlink(missing_ok=True)
        yield part
        part.replace(path)


@contextmanager
def _only_writer(path: Path) -> Iterator[None]:
    """Locks a file for this process; without it, two would write and rename the same unfinished file."""
    lock = path.with_name(f".{path.name}.lock")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError:  # the writer meets it too, and says what it could not write
        yield
        return
    try:
        if not _locked(file):
            raise DataError(
                f"another process is writing {path}; wait until it has ended, or use another folder"
            )
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
    finally:
        os.close(file)


def _locked(file: int) -> bool:
    """Locks an open file. Returns False if another process holds the lock, or has just removed the file."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # not every file system has locks
        return True
    return os.fstat(file).st_nlink > 0
