import threading
import time
from collections import deque

import numpy as np
import pytest

from gripper_force.errors import DataError, UnfamiliarFrameError
from gripper_force.runtime.perception import LockstepPerception, ProcessedFrame, ThreadedPerception
from gripper_force.types import NS_PER_MS, ForceEstimate, Frame, Gray


class FakeEstimator:
    """Says how many frames it has seen, after its reference frames."""

    def __init__(self, error: Exception | None = None, at: int = 1, references: int = 1) -> None:
        self.count = 0
        self.references = references
        self.error = error
        self.at = at

    def update(self, gray: Gray) -> ForceEstimate | None:
        self.count += 1
        if self.error is not None and self.count == self.at:
            raise self.error
        return ForceEstimate(float(self.count), 0.5) if self.count > self.references else None

    def renew_reference(self) -> None:
        self.count = self.references

    def attention_map(self) -> np.ndarray | None:
        return np.array([[0.2, 0.4], [0.5, 0.7]], np.float32) + 0.001 * self.count


class Hand:
    """A clock that stands still."""

    now_ms = 0

    def now_ns(self) -> int:
        return self.now_ms * NS_PER_MS

    def sleep_until_ns(self, t_ns: int) -> None:
        self.now_ms = t_ns // NS_PER_MS


class Shutter:
    """A camera that has what it is given."""

    def __init__(self) -> None:
        self.frames: deque[Frame] = deque()

    def give(self, seq: int, t_ms: int = 0, level: int | None = None) -> None:
        t_ns = t_ms * NS_PER_MS
        self.frames.append(Frame(t_ns, t_ns, seq, np.full((2, 2), seq if level is None else level, np.uint8)))

    def newest(self) -> Frame | None:
        return self.frames.popleft() if self.frames else None

    def start(self) -> None: ...

    def close(self) -> None: ...

    def counts(self) -> dict[str, int]:
        return {}


def seqs(seen: list[ProcessedFrame]) -> list[int]:
    return [s.frame.seq for s in seen]


def test_a_reference_is_renewed_before_the_first_frame_after_the_request() -> None:
    clock, camera = Hand(), Shutter()
    perception = LockstepPerception(camera, FakeEstimator(references=0), clock, compute_ms=0.0)
    forces_n = []
    for seq in range(6):
        if seq == 3:  # frame 3 was captured at 60 ms, before the request
            perception.processor.renewal_ns = 65 * NS_PER_MS
        camera.give(seq, 20 * seq)
        clock.now_ms = 20 * seq + 10
        (seen,) = perception.poll()
        assert seen.visual is not None
        forces_n.append(seen.visual.force_n)
    assert forces_n == [1, 2, 3, 4, 1, 2]


def test_in_lockstep_an_estimate_is_there_after_its_time_and_not_before() -> None:
    clock, camera = Hand(), Shutter()
    perception = LockstepPerception(camera, FakeEstimator(), clock, compute_ms=12.0)
    for seq, t_ms in enumerate((0, 20)):
        camera.give(seq, t_ms)
        clock.now_ms = t_ms
        assert perception.poll() == []
        clock.now_ms += 11
        assert perception.poll() == []
        clock.now_ms += 1
        (seen,) = perception.poll()
        assert seen.frame.seq == seq
        assert perception.poll() == []
    assert seen.visual is not None
    assert (seen.visual.t_ns, seen.visual.ready_ns) == (20 * NS_PER_MS, 32 * NS_PER_MS)
    assert (seen.visual.seq, seen.visual.force_n, seen.visual.std_n) == (1, 2.0, 0.5)
    assert seen.visual.compute_ms >= 0
    assert seen.attention is not None
    assert (seen.attention.t_ns, seen.attention.received_ns, seen.attention.seq) == (
        seen.visual.t_ns,
        seen.visual.ready_ns,
        1,
    )
    assert seen.attention.gray.tolist() == [[0, 102], [153, 255]]  # to its own range


def test_in_lockstep_no_frame_is_taken_while_the_last_is_under_way() -> None:
    clock, camera, estimator = Hand(), Shutter(), FakeEstimator()
    perception = LockstepPerception(camera, estimator, clock, compute_ms=12.0)
    camera.give(0)
    perception.poll()
    camera.give(1)
    clock.now_ms = 11
    perception.poll()
    assert estimator.count == 1
    clock.now_ms = 12
    assert seqs(perception.poll()) == [0]
    assert estimator.count == 2


def test_without_an_estimator_frames_pass_at_once() -> None:
    clock, camera = Hand(), Shutter()
    perception = LockstepPerception(camera, None, clock, compute_ms=12.0)
    camera.give(3)
    assert [(s.frame.seq, s.visual) for s in perception.poll()] == [(3, None)]
    assert LockstepPerception(None, None, clock, 12.0).poll() == []


@pytest.mark.parametrize("at", [1, 2])
def test_in_lockstep_an_error_before_the_first_estimate_is_the_callers(at: int) -> None:
    camera = Shutter()
    perception = LockstepPerception(camera, FakeEstimator(DataError("no picture"), at), Hand(), 0.0)
    for _ in range(at - 1):
        camera.give(0)
        perception.poll()
    camera.give(1)
    with pytest.raises(DataError, match="no picture"):
        perception.poll()


def test_a_later_error_costs_one_estimate_and_is_told() -> None:
    camera = Shutter()
    perception = LockstepPerception(camera, FakeEstimator(RuntimeError("no kernel"), at=4), Hand(), 0.0)
    seen = []
    for seq in range(6):
        camera.give(seq)
        seen += perception.poll()
    assert [s.visual is None for s in seen] == [True, False, False, True, False, False]
    assert [s.problem for s in seen] == ["", "", "", "RuntimeError: no kernel", "", ""]


def test_the_force_in_an_unfamiliar_frame_claims_nothing() -> None:
    camera = Shutter()
    error = UnfamiliarFrameError("unlike all", 3.0)
    perception = LockstepPerception(camera, FakeEstimator(error, at=3), Hand(), 0.0)
    seen = []
    for seq in range(3):
        camera.give(seq)
        seen += perception.poll()
    visual = seen[-1].visual
    assert visual is not None
    assert (visual.force_n, visual.std_n, visual.is_familiar) == (3.0, np.inf, False)
    assert seen[1].visual is not None
    assert seen[1].visual.is_familiar
    assert [s.problem for s in seen] == ["", "", "unlike all"]


def test_a_view_that_the_network_does_not_know_is_no_error_and_a_covered_one_is() -> None:
    for force_n in (3.0, np.nan):
        camera = Shutter()
        perception = LockstepPerception(
            camera, FakeEstimator(UnfamiliarFrameError("unlike all", force_n)), Hand(), 0.0
        )
        camera.give(0)
        if np.isnan(force_n):
            with pytest.raises(UnfamiliarFrameError):
                perception.poll()
            continue
        (seen,) = perception.poll()
        assert seen.problem == "unlike all"
        assert seen.visual is not None
        assert not seen.visual.is_familiar


def test_a_camera_that_hangs_gives_no_estimates() -> None:
    camera, estimator = Shutter(), FakeEstimator()
    perception = LockstepPerception(camera, estimator, Hand(), 0.0)
    seen = []
    for seq, level in enumerate((1, 2, 3, 3, 3, 4)):
        camera.give(seq, level=level)
        seen += perception.poll()
    assert ["hangs" in s.problem for s in seen] == [False, False, False, True, True, False]
    assert [s.visual is None for s in seen] == [True, False, False, True, True, False]
    assert estimator.count == 4


def test_one_picture_that_came_twice_at_the_start_excuses_no_camera_that_hangs() -> None:
    camera, estimator = Shutter(), FakeEstimator(references=3)
    perception = LockstepPerception(camera, estimator, Hand(), 0.0)
    seen = []
    for seq, level in enumerate((1, 1, 2, 3, 4, 5, 5, 5)):
        camera.give(seq, level=level)
        seen += perception.poll()
    assert ["hangs" in s.problem for s in seen] == [False] * 6 + [True] * 2


def test_a_recording_may_stand_still() -> None:
    camera, estimator = Shutter(), FakeEstimator()
    perception = LockstepPerception(camera, estimator, Hand(), 0.0)
    for seq in range(5):
        camera.give(seq, level=7)
        (seen,) = perception.poll()
        assert seen.problem == ""
    assert estimator.count == 5


def gather(perception: ThreadedPerception, count: int) -> list[ProcessedFrame]:
    seen: list[ProcessedFrame] = []
    until_s = time.monotonic() + 20
    while len(seen) < count and time.monotonic() < until_s:
        seen += perception.poll()
        time.sleep(0.001)
    return seen


@pytest.mark.parametrize("estimator", [FakeEstimator(), None])
def test_a_thread_sees_every_frame_it_is_handed(estimator: FakeEstimator | None) -> None:
    clock, camera = Hand(), Shutter()
    clock.now_ms = 30
    for seq in range(5):
        camera.give(seq, seq)
    perception = ThreadedPerception(camera, estimator, clock)
    perception.start()
    seen = gather(perception, 5)
    perception.close()
    perception.close()
    assert seqs(seen) == list(range(5))
    if estimator is None:
        assert all(s.visual is None for s in seen)
        return
    assert seen[0].visual is None
    assert [s.visual.force_n for s in seen[1:] if s.visual] == [2.0, 3.0, 4.0, 5.0]
    assert seen[4].visual is not None
    assert (seen[4].visual.t_ns, seen[4].visual.ready_ns) == (4 * NS_PER_MS, 30 * NS_PER_MS)


@pytest.mark.parametrize("error", [DataError("no picture"), RuntimeError("no kernel")])
def test_what_stops_the_thread_is_raised_by_poll(error: Exception) -> None:
    camera = Shutter()
    camera.give(0)
    perception = ThreadedPerception(camera, FakeEstimator(error), Hand())
    perception.start()
    with pytest.raises(type(error), match="no "):
        gather(perception, 1)
    perception.close()


def test_closing_leaves_no_thread_started_or_not() -> None:
    unused = ThreadedPerception(Shutter(), None, Hand())
    unused.close()
    blind = ThreadedPerception(None, None, Hand())
    blind.start()
    assert blind.poll() == []
    blind.close()
    perception = ThreadedPerception(Shutter(), None, Hand())
    perception.start()
    assert "perception" in {thread.name for thread in threading.enumerate()}
    perception.close()
    assert "perception" not in {thread.name for thread in threading.enumerate()}
