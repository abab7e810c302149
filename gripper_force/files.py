"""Files that appear under their names once they are complete."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Final

from gripper_force.errors import DataError

_TRIES: Final = 1000
"""A writer that ends removes the lock file. Others that have opened it just before open a new one."""


@contextmanager
def unfinished(path: Path, *, wait: bool = False) -> Iterator[Path]:
    """Yields a file beside ``path`` to write, and renames it to ``path`` at the end; after an error it stays there.

    A file that an interrupted run left is removed first.

    Args:
        path: The file.
        wait: True to wait for another writer, if writing takes no time. What the block reads of the old file is then
            complete.

    Raises:
        DataError: Another process or thread writes the file.
    """
    part = path.with_name(f".{path.name}.part")
    with _only_writer(path, wait):
        part.unlink(missing_ok=True)
        yield part
        part.replace(path)


def make_folder_of(path: Path) -> None:
    """Creates the folder of a file. Raises `OSError` if the file can't be written there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with NamedTemporaryFile(prefix=f".{path.name}.", dir=path.parent):
        pass  # its name is no one else's, such as the unfinished file's of a writer


@contextmanager
def _only_writer(path: Path, wait: bool) -> Iterator[None]:
    """Locks a file for this writer; without it, two would write and rename the same unfinished file."""
    lock = path.with_name(f".{path.name}.lock")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = _locked(lock, wait)
    except OSError:  # the writer meets it too, and says what it could not write
        yield
        return
    if file is None:
        raise DataError(
            f"another process or thread is writing {path}; wait until it has ended, or use another folder"
        )
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(file)


def _locked(lock: Path, wait: bool) -> int | None:
    """Makes, opens and locks a file. Returns its descriptor; None if another writer holds the lock."""
    for _ in range(_TRIES):
        file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        is_free = True
        try:
            fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            is_free = False
        except OSError:  # not every file system has locks
            return file
        is_there = os.fstat(file).st_nlink > 0
        if is_free and is_there:
            return file
        os.close(file)
        if is_there:
            break
    return None
