import threading
from pathlib import Path

import numpy as np
import pytest

from gripper_force.errors import LogError
from gripper_force.runtime import log_queue as recorder_module
from gripper_force.runtime.log import LogReader, LogWriter
from gripper_force.runtime.log_queue import Recorder
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
    recorder = Recorder(gate, lockstep=lockstep)  # type: ignore[arg-type]
    for event in events(1000):
        recorder.write(event)
    recorder.attach("note.txt", b"well", "text/plain")
    recorder.close()
    recorder.close()
    recorder.raise_losses()
    reader = LogReader(path)
    assert list(reader.records(Event)) == events(1000)
    assert reader.attachments["note.txt"] == b"well"


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_disk_that_fails_is_told_at_the_end(gate: Gate, path: Path, lockstep: bool) -> None:
    recorder = Recorder(gate, lockstep=lockstep)  # type: ignore[arg-type]
    recorder.write(events(1)[0])
    if not lockstep:
        while recorder._queue.qsize():
            pass
    gate.fails = True
    for event in events(5):
        recorder.write(event)
    recorder.close()
    assert recorder.lost == 5
    with pytest.raises(LogError, match="no space; the run went on, and its log lacks 5 records"):
        recorder.raise_losses()


def test_a_slow_disk_keeps_nobody_waiting(gate: Gate, path: Path) -> None:
    gate.opened.clear()
    recorder = Recorder(gate, lockstep=False)  # type: ignore[arg-type]
    for event in events(recorder_module.ROOM + 100):
        recorder.write(event)  # returns, though the disk does not
    assert 99 <= recorder.lost <= 100
    gate.opened.set()
    recorder.close()
    with pytest.raises(LogError, match="the disk is too slow"):
        recorder.raise_losses()
    written = list(LogReader(path).records(Event))
    sent = events(recorder_module.ROOM + 100)
    # The thread holds one record beyond the queue's room, and may have taken it at any time meanwhile.
    assert written[: recorder_module.ROOM] == sent[: recorder_module.ROOM]
    assert all(event in sent[recorder_module.ROOM :] for event in written[recorder_module.ROOM :])
    assert len(written) + recorder.lost == recorder_module.ROOM + 100


@pytest.mark.parametrize("count", [1, recorder_module.ROOM + 100])
def test_a_disk_that_hangs_does_not_keep_the_run_from_ending(
    gate: Gate, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    monkeypatch.setattr(recorder_module, "_PATIENCE_S", 0.05)
    gate.opened.clear()
    recorder = Recorder(gate, lockstep=False)  # type: ignore[arg-type]
    for event in events(count):
        recorder.write(event)
    recorder.close()
    with pytest.raises(LogError, match="has not taken the last records"):
        recorder.raise_losses()
    gate.opened.set()
    recorder.close()


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_record_that_does_not_fit_is_lost_alone(path: Path, lockstep: bool) -> None:
    recorder = Recorder(LogWriter(path, config="", metadata={}), lockstep=lockstep)
    sound = events(12)
    for record in (*sound[:10], Event(-1, "test", "before all time"), *sound[10:]):
        recorder.write(record)
    recorder.write(Frame(5, 5, 2**32, np.zeros((2, 2), np.uint8)))
    recorder.write(Event(13, "test", "after"))
    recorder.close()
    assert recorder.lost == 2
    assert list(LogReader(path).records(Event)) == [*sound, Event(13, "test", "after")]


def test_records_of_a_chunk_that_is_not_written_count_as_lost(path: Path) -> None:
    class Full:
        def __init__(self, file: object) -> None:
            self.file, self.is_full = file, False

        def write(self, data: bytes) -> int:
            if self.is_full:
                raise OSError(28, "No space left on device")
            return self.file.write(data)  # type: ignore[attr-defined, no-any-return]

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

    files: list[Full] = []
    log = LogWriter(path, config="", metadata={}, through=lambda f: files.append(Full(f)) or files[0])  # type: ignore[arg-type, func-returns-value]
    recorder = Recorder(log, lockstep=True)
    for i in range(10):
        recorder.write(Event(i, "test", "kept"))
    recorder.write(Event(200_000_000, "test", "closes the chunk"))
    files[0].is_full = True
    for i in range(7):
        recorder.write(Event(300_000_000 + i, "test", "lost"))
    recorder.write(Event(500_000_000, "test", "would close the chunk"))
    recorder.write(Event(500_000_001, "test", "too late"))
    recorder.close()
    kept = list(LogReader(path, recover=True).records(Event))
    assert len(kept) == 11
    assert recorder.lost >= 9
