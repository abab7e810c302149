import math
import time
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest

from gripper_force.fault_config import FAULTS, FaultConfig
from gripper_force.interfaces import Clock
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, LoadCellSample
from gripper_hw.fault_injection import Faults
from gripper_hw.sim.rig_faults import FaultyCamera, FaultyClock, FaultyLoadCell

FRAME_NS = NS_PER_S // 50
SAMPLE_NS = NS_PER_S // 200
BEGIN_NS, END_NS = NS_PER_S, 2 * NS_PER_S


@dataclass
class Source:
    """A camera and a load cell without faults; all images and readings differ."""

    clock: Clock
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    seq: int = 0
    closed: int = 0

    def start(self) -> None:
        self.seq = 0

    def newest(self) -> Frame:
        self.seq += 1
        gray = self.rng.integers(60, 120, (8, 8), np.uint8)
        return Frame(self.clock.now_ns() - 15 * NS_PER_MS, self.clock.now_ns(), self.seq, gray)

    def drain(self) -> list[LoadCellSample]:
        force_n = 3.0 + float(self.rng.normal(0, 0.01))
        return [LoadCellSample(self.clock.now_ns(), force_n, force_n)]

    def close(self) -> None:
        self.closed += 1

    def counts(self) -> dict[str, int]:
        return {}


def faults(unit: str, kind: str) -> Faults:
    return Faults([FaultConfig.model_validate({"unit": unit, "kind": kind, "at_s": 1.0, "for_s": 1.0})])


def frames_of(kind: str, clock: Clock) -> list[tuple[int, Frame]]:
    """Three seconds of frames with the time at which each was returned."""
    camera = FaultyCamera(Source(clock), faults("camera", kind), clock, seed=1)
    camera.start()
    given = []
    while clock.now_ns() < 3 * NS_PER_S:
        clock.sleep_until_ns(clock.now_ns() + FRAME_NS)
        if (frame := camera.newest()) is not None:
            given.append((clock.now_ns(), frame))
    camera.close()
    camera.close()
    return given


@pytest.mark.parametrize("kind", FAULTS["camera"])
def test_camera_fails_as_configured_and_recovers(kind: str, clock: Clock) -> None:
    given = frames_of(kind, clock)
    during = [frame for t_ns, frame in given if BEGIN_NS <= t_ns < END_NS]
    before = [frame for t_ns, frame in given if t_ns < BEGIN_NS]
    assert len(before) == 49
    assert sum(t_ns >= END_NS for t_ns, _ in given) == 51
    match kind:
        case "off":
            assert during == []
        case "stuck":
            assert len(during) == 50
            assert all(np.array_equal(frame.gray, before[-1].gray) for frame in during)
        case "garbage":
            assert min(frame.gray.min() for frame in during) < 20
        case "wrong":
            assert min(frame.gray.mean() for frame in during) > 1.8 * before[-1].gray.mean()
        case "slow":
            assert len(during) == 5
        case "delayed":
            assert len(during) == 35
            assert all(frame.received_ns - frame.t_ns == 315 * NS_PER_MS for frame in during)
        case "intermittent":
            assert 2 <= len(during) <= 22


def samples_of(kind: str, clock: Clock) -> list[LoadCellSample]:
    cell = FaultyLoadCell(Source(clock), faults("load_cell", kind), clock, seed=1)
    cell.start()
    taken = []
    while clock.now_ns() < 4 * NS_PER_S:
        clock.sleep_until_ns(clock.now_ns() + SAMPLE_NS)
        taken += cell.drain()
    cell.close()
    return taken


@pytest.mark.parametrize("kind", FAULTS["load_cell"])
def test_load_cell_fails_as_configured_and_recovers(kind: str, clock: Clock) -> None:
    samples = samples_of(kind, clock)
    assert all(a.t_ns < b.t_ns for a, b in pairwise(samples))
    during = [s for s in samples if BEGIN_NS <= s.t_ns < END_NS]
    accepted = [s for s in during if s.valid]
    assert all(s.valid for s in samples if s.t_ns < BEGIN_NS - 20 * SAMPLE_NS)
    assert all(s.valid for s in samples if s.t_ns > END_NS + NS_PER_S)
    assert all(abs(s.force_n - 3.0) < 0.1 for s in samples if s.valid and s.t_ns > END_NS + NS_PER_S)
    match kind:
        case "off":
            assert during == []
        case "stuck":
            assert len({s.raw for s in during}) == 1
            assert len(accepted) <= 12
        case "garbage":
            assert any(not math.isfinite(s.raw) for s in during)
            assert len(accepted) < 20
        case "wrong":
            assert accepted == []
        case "slow":
            assert len(during) == 2
        case "delayed":
            assert len(during) == 100
        case "intermittent":
            assert 70 <= len(during) <= 130


@pytest.mark.parametrize("kind", FAULTS["clock"])
def test_clock_fails_as_configured(kind: str, clock: Clock) -> None:
    real_time = time.time
    faulty = FaultyClock(clock, faults("clock", kind))
    faulty.sleep_until_ns(BEGIN_NS - 1)
    assert faulty.now_ns() == BEGIN_NS - 1
    assert time.time is real_time
    faulty.sleep_until_ns(BEGIN_NS + 1)
    match kind:
        case "stuck":
            assert faulty.now_ns() == END_NS
        case "slow":
            assert faulty.now_ns() == BEGIN_NS + 1 + 15 * NS_PER_MS
        case "wrong":
            assert faulty.now_ns() == BEGIN_NS + 1
            assert real_time() - time.time() > 80_000
    faulty.sleep_until_ns(END_NS + 1)
    assert time.time is real_time


def test_close_restores_the_wall_clock(clock: Clock) -> None:
    real_time = time.time
    faulty = FaultyClock(clock, faults("clock", "wrong"))
    faulty.sleep_until_ns(BEGIN_NS + 1)
    assert time.time is not real_time
    faulty.close()
    faulty.close()
    assert time.time is real_time
