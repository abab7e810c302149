"""Files that appear once they are complete: what an interruption and a second process leave."""

import fcntl
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gripper_force.errors import DataError
from gripper_force.files import unfinished
from gripper_force.jobs.profile_files import check_writable
from gripper_force.vision import checkpoint_writer

KILLED = """
import os, signal, sys
from pathlib import Path
from gripper_force.files import unfinished
with unfinished(Path(sys.argv[1])) as part:
    part.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_once_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.mcap"
    with unfinished(path) as part:
        part.write_text("whole")
        assert not path.exists()
    assert (names(path.parent), path.read_text()) == (["a.mcap"], "whole")


def test_an_error_leaves_the_old_file_and_the_unfinished_one(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("old")
    with pytest.raises(OSError, match="full"), unfinished(path) as part:
        part.write_text("half")
        raise OSError("full")
    assert (names(tmp_path), path.read_text()) == ([".a.mcap.part", "a.mcap"], "old")


def test_a_second_writer_is_refused_and_harms_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with unfinished(path) as part:
        part.write_text("first")
        with (
            pytest.raises(DataError, match=r"another process or thread is writing .*a\.mcap; wait"),
            unfinished(path),
        ):
            pass
        with unfinished(tmp_path / "b.mcap") as other:  # another file of the folder is free
            other.write_text("other")
    assert (names(tmp_path), path.read_text()) == (["a.mcap", "b.mcap"], "first")


@pytest.mark.parametrize("check", [check_writable, checkpoint_writer.check_writable])
def test_a_check_of_the_place_leaves_the_file_of_a_running_writer(
    tmp_path: Path, check: Callable[[Path], None]
) -> None:
    path = tmp_path / "a.safetensors"
    with unfinished(path) as part:
        part.write_text("first")
        before = names(tmp_path)
        check(path)
        assert names(tmp_path) == before
    assert path.read_text() == "first"


def test_a_killed_writer_locks_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    subprocess.run([sys.executable, "-c", KILLED, path], check=False)
    assert names(tmp_path) == [".a.mcap.lock", ".a.mcap.part"]
    with unfinished(path) as part:
        assert not part.exists()
        part.write_text("whole")
    assert names(tmp_path) == ["a.mcap"]


def test_a_writer_that_waits_is_not_refused_however_many_end_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, flock, ended = tmp_path / ".a.yaml.lock", fcntl.flock, list[int]()

    def late(file: int, operation: int) -> None:
        flock(file, operation)
        ended.append(file)
        if len(ended) < 50:
            lock.unlink()

    monkeypatch.setattr(fcntl, "flock", late)
    with unfinished(tmp_path / "a.yaml", wait=True) as part:
        part.write_text("whole")
    assert (names(tmp_path), len(ended)) == (["a.yaml"], 50)


@pytest.mark.parametrize("error", [None, BlockingIOError])
def test_a_writer_that_starts_as_another_ends_is_not_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception] | None
) -> None:
    """The other one has removed the lock file, and may still hold the lock, when this one locks what it opened."""
    lock, flock = tmp_path / ".a.mcap.lock", fcntl.flock

    def late(file: int, operation: int) -> None:
        monkeypatch.setattr(fcntl, "flock", flock)
        lock.unlink()
        if error is not None:
            raise error

    monkeypatch.setattr(fcntl, "flock", late)
    with unfinished(tmp_path / "a.mcap") as part:
        part.write_text("whole")
        assert lock.exists()
        with pytest.raises(DataError), unfinished(tmp_path / "a.mcap"):
            pass
    assert names(tmp_path) == ["a.mcap"]
