from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from gripper_force.config import CameraConfig, LoadCellConfig
from gripper_force.errors import DataError, LogError
from gripper_force.interfaces import Camera, LoadCell
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import NS_PER_MS, Event, Frame, LoadCellSample
from gripper_hw.playback import PlaybackCamera, PlaybackLoadCell

FIRST_MS = 1000
"""Log time of the first record."""


class ManualClock:
    def __init__(self, t_ms: int) -> None:
        self.t_ms = t_ms

    def now_ns(self) -> int:
        return self.t_ms * NS_PER_MS

    def sleep_until_ns(self, t_ns: int) -> None:
        self.t_ms = t_ns // NS_PER_MS


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A sample every 5 ms, and a frame every 20 ms with a latency of 15 ms."""
    path = tmp_path / "run.mcap"
    with LogWriter(path, config="", metadata={}) as writer:
        for i in range(60):
            t_ns = (FIRST_MS + 5 * i) * NS_PER_MS
            writer.write(LoadCellSample(t_ns, 0.1 * i, 1.0 * i, valid=i % 7 != 0))
            if i % 4 == 3:
                writer.write(Frame(t_ns - 15 * NS_PER_MS, t_ns, i // 4, np.full((4, 4), i, np.uint8)))
    return path


def camera_of(
    path: Path, clock: ManualClock, speed: Literal["recorded", "full"] = "recorded"
) -> PlaybackCamera:
    return PlaybackCamera(CameraConfig(backend="playback", path=path, speed=speed), clock)


def load_cell_of(
    path: Path, clock: ManualClock, speed: Literal["recorded", "full"] = "recorded"
) -> PlaybackLoadCell:
    return PlaybackLoadCell(LoadCellConfig(backend="playback", path=path, speed=speed), clock)


def recorded_frames(path: Path) -> list[tuple[int, int, int]]:
    return [(f.t_ns, f.received_ns, f.seq) for f in LogReader(path).records(Frame)]


def test_recorded_speed_keeps_pace_and_shifts_times(log: Path) -> None:
    clock = ManualClock(50)
    camera: Camera = camera_of(log, clock)
    camera.start()
    shift_ns = (50 - FIRST_MS) * NS_PER_MS
    played = []
    for t_ms in range(50, 400):
        clock.t_ms = t_ms
        frame = camera.newest()
        if frame is not None:
            assert frame.received_ns == clock.now_ns()
            played.append((frame.t_ns - shift_ns, frame.received_ns - shift_ns, frame.seq))
    assert played == recorded_frames(log)


def test_full_speed_returns_every_frame_as_recorded(log: Path) -> None:
    camera = camera_of(log, ManualClock(7), "full")
    camera.start()
    played = []
    while not camera.finished:
        frame = camera.newest()
        assert frame is not None
        played.append((frame.t_ns, frame.received_ns, frame.seq))
    assert played == recorded_frames(log)
    assert camera.newest() is None


def test_playback_ends_after_last_record(log: Path) -> None:
    clock = ManualClock(0)
    camera, cell = camera_of(log, clock), load_cell_of(log, clock)
    camera.start()
    cell.start()
    clock.t_ms = 10_000
    frame = camera.newest()
    assert frame is not None
    assert frame.seq == 14
    assert len(cell.drain()) == 60
    assert camera.finished
    assert cell.finished
    assert camera.newest() is None
    assert cell.drain() == []


def test_samples_are_returned_once_at_recorded_pace(log: Path) -> None:
    clock = ManualClock(0)
    cell: LoadCell = load_cell_of(log, clock)
    cell.start()
    shift_ns = FIRST_MS * NS_PER_MS
    played = []
    for t_ms in range(0, 300, 17):
        clock.t_ms = t_ms
        batch = cell.drain()
        assert all(sample.t_ns <= clock.now_ns() for sample in batch)
        played += [(s.t_ns + shift_ns, s.force_n, s.raw, s.valid) for s in batch]
    clock.t_ms = 1000
    played += [(s.t_ns + shift_ns, s.force_n, s.raw, s.valid) for s in cell.drain()]
    recorded = LogReader(log).records(LoadCellSample)
    assert played == [(s.t_ns, s.force_n, s.raw, s.valid) for s in recorded]


def test_full_speed_returns_all_samples_at_once(log: Path) -> None:
    cell = load_cell_of(log, ManualClock(7), "full")
    cell.start()
    assert cell.drain() == list(LogReader(log).records(LoadCellSample))
    assert cell.drain() == []


def test_log_without_data_of_sensor_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path, config="", metadata={}) as writer:
        writer.write(Event(0, "session", "nothing else"))
    with pytest.raises(DataError, match="no camera frames"):
        camera_of(path, ManualClock(0))
    with pytest.raises(DataError, match="no load-cell samples"):
        load_cell_of(path, ManualClock(0))
    with pytest.raises(LogError, match="No such file"):
        camera_of(tmp_path / "missing.mcap", ManualClock(0))


@pytest.mark.parametrize(
    ("period_ms", "numbers", "rate"),
    [(20, (5, 5, 5), "0"), (20, (7, 6, 5), "-50"), (300_000, (5, 6, 7), "0.00333")],
)
def test_frames_without_a_rate_that_a_run_can_have_are_refused(
    tmp_path: Path, period_ms: int, numbers: tuple[int, ...], rate: str
) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path, config="", metadata={}) as writer:
        for i, number in enumerate(numbers):
            t_ns = (FIRST_MS + i * period_ms) * NS_PER_MS
            writer.write(Frame(t_ns, t_ns, number, np.zeros((4, 4), np.uint8)))
    with pytest.raises(DataError, match=rf"run\.mcap has {rate} frames/s; play a log"):
        PlaybackCamera.resolve(CameraConfig(backend="playback", path=path))
