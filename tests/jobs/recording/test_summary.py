from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import load_config
from gripper_force.errors import DataError
from gripper_force.jobs.recording import summary as module
from gripper_force.jobs.recording.record import RecordingPlan, record
from gripper_force.jobs.recording.summary import summarise_recording
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import NS_PER_MS, Frame, LoadCellSample, Record

Change = Callable[[Iterator[Record]], Iterable[Record]]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of a viscous object: force leads the images by more than 20 ms."""
    overrides = ["object=stapler", "seed=31", "sim.detail=coarse", "camera.rate_hz=30", "control.ramp_n_s=30"]
    folder = tmp_path_factory.mktemp("recorded")
    (path,) = record(load_config(None, overrides), RecordingPlan(1, 3), folder)
    return path


def changed(log: Path, path: Path, change: Change) -> Path:
    reader = LogReader(log)
    with LogWriter(path, config=reader.config, metadata=reader.metadata) as writer:
        for one in change(reader.records()):
            writer.write(one)
    return path


def test_set_without_lag(log: Path) -> None:
    result = summarise_recording([log, log])
    one, overall = result.sets[0], result.overall
    assert (one.object, one.set, one.touches) == ("stapler", "stapler-01", 3)
    assert one.camera_hz == pytest.approx(30, rel=0.02)
    assert (one.frames_lost, one.samples_rejected) == (0, 0)
    assert one.load_cell_hz == pytest.approx(200, 0.02)
    assert sum(one.histogram.values()) == one.frames
    assert max(one.histogram) == int(one.peak_n)
    assert overall.histogram == {n: 2 * count for n, count in one.histogram.items()}
    assert (overall.frames, overall.touches) == (2 * one.frames, 6)
    assert overall.lag_ms is not None
    assert overall.lag_spread_ms is not None
    assert abs(overall.lag_ms) < 6
    assert overall.lag_spread_ms < 6
    assert result.warnings == []


def test_late_camera_timestamps_are_detected(log: Path, tmp_path: Path) -> None:
    def late(records: Iterator[Record]) -> Iterator[Record]:
        for one in records:
            yield replace(one, t_ns=one.t_ns + 20 * NS_PER_MS) if isinstance(one, Frame) else one

    before = summarise_recording([log]).overall
    result = summarise_recording([changed(log, tmp_path / "late.mcap", late)])
    assert before.lag_ms is not None
    assert result.overall.lag_ms is not None
    assert result.overall.lag_ms - before.lag_ms == pytest.approx(20, abs=2)
    assert before.camera_lag_ms is not None
    assert result.overall.camera_lag_ms is not None
    assert result.overall.camera_lag_ms - before.camera_lag_ms == pytest.approx(20, abs=2)
    (warning,) = result.warnings
    assert "ms late against the load cell's, more than half a frame (17 ms)" in warning


def test_late_load_cell_timestamps_are_detected(log: Path, tmp_path: Path) -> None:
    def late(records: Iterator[Record]) -> Iterator[Record]:
        for one in records:
            yield replace(one, t_ns=one.t_ns + 30 * NS_PER_MS) if isinstance(one, LoadCellSample) else one

    result = summarise_recording([changed(log, tmp_path / "late.mcap", late)])
    assert result.overall.lag_ms == pytest.approx(-30, abs=6)
    assert result.overall.load_cell_lag_ms == pytest.approx(30, abs=6)
    assert "ms early against the load cell's" in result.warnings[0]


def test_lost_frames_and_rejected_samples_are_counted(log: Path, tmp_path: Path) -> None:
    def thin_out(records: Iterator[Record]) -> Iterator[Record]:
        for i, one in enumerate(records):
            if isinstance(one, Frame) and one.seq % 10 == 5 and one.seq < 150:  # not the last one
                continue
            if isinstance(one, LoadCellSample) and i % 50 == 0:
                one = replace(one, valid=False)
            yield one

    def unnumbered(records: Iterator[Record]) -> Iterator[Record]:
        seq = 0
        for one in thin_out(records):
            seq += isinstance(one, Frame)
            yield replace(one, seq=seq) if isinstance(one, Frame) else one

    whole = summarise_recording([log]).sets[0]
    one = summarise_recording([changed(log, tmp_path / "thin.mcap", thin_out)])
    two = summarise_recording([changed(log, tmp_path / "unnumbered.mcap", unnumbered)])
    assert one.sets[0].samples_rejected > 0
    assert one.sets[0].frames_lost == whole.frames - one.sets[0].frames > 10
    assert two.sets[0].frames_lost == one.sets[0].frames_lost
    assert "frames/s instead of 30" in one.warnings[0]
    assert one.warnings[1] == f"{one.overall.frames_lost} of {whole.frames} frames were lost"


def test_jitter_is_not_counted_as_loss() -> None:
    t_ns = (np.arange(500) / 180 // 0.0025 * 2.5e6).astype(np.int64)  # stamped on a grid of 2.5 ms
    assert module._lost(t_ns, np.arange(500)) == 0
    assert module._lost(np.delete(t_ns, [50, 100, 101]), np.arange(497)) == 3


def test_slow_load_cell_gives_a_warning(log: Path, tmp_path: Path) -> None:
    def slow(records: Iterator[Record]) -> Iterable[Record]:
        return (one for i, one in enumerate(records) if not isinstance(one, LoadCellSample) or i % 16 == 0)

    result = summarise_recording([changed(log, tmp_path / "slow.mcap", slow)])
    assert "below 50 the lag is unreliable" in result.warnings[0]


def test_log_without_frames_raises(log: Path, tmp_path: Path) -> None:
    def blind(records: Iterator[Record]) -> Iterable[Record]:
        return (one for one in records if not isinstance(one, Frame))

    with pytest.raises(DataError, match=r"blind\.mcap holds no camera frames"):
        summarise_recording([changed(log, tmp_path / "blind.mcap", blind)])


def test_lag_without_touches_is_none(log: Path, tmp_path: Path) -> None:
    def at_rest(records: Iterator[Record]) -> Iterable[Record]:
        return (one for i, one in enumerate(records) if i < 300)

    result = summarise_recording([changed(log, tmp_path / "rest.mcap", at_rest)])
    assert (result.overall.touches, result.overall.lag_ms) == (0, None)
    assert "no touch was clear enough" in result.warnings[-1]
