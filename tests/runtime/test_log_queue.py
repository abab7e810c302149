import threading
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from gripper_force.errors import LogError
from gripper_force.runtime import log_queue as recorder_module
from gripper_force.runtime.log_queue import LogQueue
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import Event, Frame, Record


class Gate:
    """A log whose disk can be made to wait or to fail."""

    def __init__(self, log: LogWriter) -> None:
        self.log, self.waiting, self.failed = log, 0, False
        self.opened = threading.Event()
        self.opened.set()
        self.fails = False

    def write(self, record: Record) -> None:
        self.opened.wait()
        if self.fails:
            raise LogError("can't write the log: no space")
        self.log.write(record)

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        self.log.attach(name, data, media_type)

    def close(self) -> None:
        self.log.close()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


@pytest.fixture
def gate(path: Path) -> Gate:
    return Gate(LogWriter(path, config="", metadata={}))


def events(count: int) -> list[Event]:
    return [Event(i, "test", str(i)) for i in range(count)]


@pytest.mark.parametrize("lockstep", [True, False])
def test_all_is_written_in_order(gate: Gate, path: Path, lockstep: bool) -> None:
    log_queue = LogQueue(gate, lockstep=lockstep)  # type: ignore[arg-type]
    for event in events(1000):
        log_queue.write(event)
    log_queue.attach("note.txt", b"well", "text/plain")
    log_queue.close()
    log_queue.close()
    log_queue.raise_losses()
    reader = LogReader(path)
    assert list(reader.records(Event)) == events(1000)
    assert reader.attachments["note.txt"] == b"well"


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_disk_that_fails_is_told_at_the_end(gate: Gate, lockstep: bool) -> None:
    log_queue = LogQueue(gate, lockstep=lockstep)  # type: ignore[arg-type]
    log_queue.write(events(1)[0])
    if not lockstep:
        while log_queue._queue.qsize():
            pass
    gate.fails = True
    for event in events(5):
        log_queue.write(event)
    log_queue.close()
    assert log_queue.lost == 5
    with pytest.raises(LogError, match="no space; the run went on, and its log lacks 5 records"):
        log_queue.raise_losses()


def test_a_slow_disk_keeps_nobody_waiting(gate: Gate, path: Path) -> None:
    gate.opened.clear()
    log_queue = LogQueue(gate, lockstep=False)  # type: ignore[arg-type]
    for event in events(recorder_module.CAPACITY + 100):
        log_queue.write(event)  # returns, though the disk does not
    assert 99 <= log_queue.lost <= 100
    gate.opened.set()
    log_queue.close()
    with pytest.raises(LogError, match="the disk is too slow"):
        log_queue.raise_losses()
    written = list(LogReader(path).records(Event))
    sent = events(recorder_module.CAPACITY + 100)
    # The thread holds one record beyond the queue's room, and may have taken it at any time meanwhile.
    assert written[: recorder_module.CAPACITY] == sent[: recorder_module.CAPACITY]
    assert all(event in sent[recorder_module.CAPACITY :] for event in written[recorder_module.CAPACITY :])
    assert len(written) + log_queue.lost == recorder_module.CAPACITY + 100


@pytest.mark.parametrize("count", [1, recorder_module.CAPACITY + 100])
def test_a_disk_that_hangs_does_not_keep_the_run_from_ending(
    gate: Gate, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    monkeypatch.setattr(recorder_module, "_TIMEOUT_S", 0.05)
    gate.opened.clear()
    log_queue = LogQueue(gate, lockstep=False)  # type: ignore[arg-type]
    for event in events(count):
        log_queue.write(event)
    log_queue.close()
    with pytest.raises(LogError, match="did not take the last records"):
        log_queue.raise_losses()
    gate.opened.set()
    monkeypatch.undo()
    log_queue.close()


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_record_that_does_not_fit_is_lost_alone(path: Path, lockstep: bool) -> None:
    log_queue = LogQueue(LogWriter(path, config="", metadata={}), lockstep=lockstep)
    sound = events(12)
    for record in (*sound[:10], Event(-1, "test", "before all time"), *sound[10:]):
        log_queue.write(record)
    log_queue.write(Frame(5, 5, 2**32, np.zeros((2, 2), np.uint8)))
    log_queue.write(Event(13, "test", "after"))
    log_queue.close()
    assert log_queue.lost == 2
    assert list(LogReader(path).records(Event)) == [*sound, Event(13, "test", "after")]


def test_records_of_a_chunk_that_is_not_written_count_as_lost(path: Path) -> None:
    class Full:
        def __init__(self, file: BinaryIO) -> None:
            self.file, self.is_full = file, False

        def write(self, data: bytes) -> int:
            if self.is_full:
                raise OSError(28, "No space left on device")
            return self.file.write(data)

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

    files: list[Full] = []

    def wrap(file: BinaryIO) -> BinaryIO:
        files.append(Full(file))
        return files[0]  # type: ignore[return-value]

    log = LogWriter(path, config="", metadata={}, wrap_file=wrap)
    log_queue = LogQueue(log, lockstep=True)
    for i in range(10):
        log_queue.write(Event(i, "test", "kept"))
    log_queue.write(Event(200_000_000, "test", "closes the chunk"))
    files[0].is_full = True
    for i in range(7):
        log_queue.write(Event(300_000_000 + i, "test", "lost"))
    log_queue.write(Event(500_000_000, "test", "would close the chunk"))
    log_queue.write(Event(500_000_001, "test", "too late"))
    log_queue.close()
    kept = list(LogReader(path, recover=True).records(Event))
    assert len(kept) == 11
    assert log_queue.lost >= 9


def test_records_that_do_not_fit_are_blamed_on_their_device(path: Path) -> None:
    log_queue = LogQueue(LogWriter(path, config="", metadata={}), lockstep=True)
    log_queue.write(Event(-5, "test", "before the beginning"))
    log_queue.close()
    with pytest.raises(
        LogError, match=r"its time is -5 ns; .* lacks 1 records: correct the class of the device"
    ):
        log_queue.raise_losses()
