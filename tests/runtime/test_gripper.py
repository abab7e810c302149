import asyncio
import dataclasses
import gc
import math
import re
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gripper_force as gf
from gripper_force.control import state_machine
from gripper_force.control.limits import largest_target_n
from gripper_force.jobs.evaluate import _evaluate_log
from gripper_force.jobs.replay import replay
from gripper_force.runtime import control_loop, process, session
from gripper_force.runtime.control_loop import ControlLoop
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.session import Session
from gripper_force.types import VisualForce
from gripper_force.vision.model_files import read_model
from gripper_hw.dynamixel.packets import Instruction, Parser
from gripper_hw.dynamixel.pty_server import PtyServer
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus, unregister_bus
from gripper_hw.sim import simulated_rig as rig

Open = Callable[..., gf.Gripper]


@contextmanager
def opener(keys: list[str]) -> Iterator[Open]:
    """Gives a function that opens grippers with these and further overrides, and closes them at the end."""
    with ExitStack() as opened:
        yield lambda *overrides, **options: opened.enter_context(
            closing(gf.open_gripper(overrides=[*keys, *overrides], **options))
        )


@pytest.fixture
def simulated(quick: list[str]) -> Iterator[Open]:
    """Opens grippers on the simulated rig in lockstep; closes them at the end."""
    with opener(quick) as make:
        yield make


def served_by(server: PtyServer) -> list[str]:
    """Overrides for a run in real time on a virtual servo, however busy the machine is."""
    return [
        "clock=realtime",
        f"servo.port={server.device_path}",
        "load_cell.backend=none",
        "servo.bus_watchdog_ms=2540",
        "servo.reply_margin_ms=500",
    ]


@pytest.fixture
def real_time(quick: list[str], server: PtyServer) -> Iterator[Open]:
    """Opens grippers in real time on a virtual servo behind a pseudo-terminal, without an object."""
    with opener([*quick, *served_by(server)]) as make:
        yield make


def bus() -> VirtualBus:
    found = find_bus("rig")
    assert found is not None
    return found


def torque(served: PtyServer | None = None) -> int:
    return (bus() if served is None else served.bus).servos[0].get("torque_enable")


# In lockstep.


def test_grasp_changes_of_force_and_release(simulated: Open) -> None:
    gripper = simulated()
    assert gripper.state.phase == gf.Phase.OPEN
    result = gripper.grasp(3.0)
    assert (result.outcome, result.held) == (gf.Outcome.HELD, True)
    assert result.force_n == pytest.approx(3.0, rel=0.1)
    assert 0.03 < result.width_m < 0.08
    assert result.std_n > 0
    assert result.vision_share == 0
    assert "N for" in result.reason
    raised = gripper.set_force(5.0)
    assert raised.held
    assert raised.force_n == pytest.approx(5.0, rel=0.1)
    assert gripper.state.load_cell_n == pytest.approx(5.0, abs=1.5)
    assert gripper.release() > 0.085
    assert gripper.state.phase == gf.Phase.OPEN


@pytest.mark.parametrize("profile", ["null", "stapler"])
def test_the_largest_force_is_the_largest_that_is_accepted(simulated: Open, profile: str) -> None:
    gripper = simulated("object=none", f"calibration.object={profile}")
    largest_n = gripper.largest_force_n
    gripper.grasp(largest_n, wait=False)
    with pytest.raises(gf.RequestError, match="profile" if profile == "stapler" else "force_limit_n"):
        gripper.grasp(math.nextafter(largest_n, math.inf), wait=False)


def test_wait_false_returns_at_once_and_steps_go_on(simulated: Open) -> None:
    gripper = simulated()
    assert gripper.grasp(3.0, wait=False) is None
    assert gripper.state.outcome == gf.Outcome.NONE
    before = gripper.state
    phases = {gripper.step().phase for _ in range(300)}
    assert gripper.state.t_ns - before.t_ns == 300 * 5_000_000
    assert {gf.Phase.APPROACH, gf.Phase.CONTACT} <= phases


def test_sleep_runs_the_simulated_time(simulated: Open) -> None:
    gripper = simulated()
    before_ns = gripper.state.t_ns
    gripper.sleep(0.5)
    assert gripper.state.t_ns - before_ns == pytest.approx(0.5e9, abs=5e6)


def test_move_positions_the_jaws_and_names_an_obstacle(simulated: Open) -> None:
    gripper = simulated()
    assert gripper.move(0.08) == pytest.approx(0.08, abs=0.001)
    assert gripper.state.outcome == gf.Outcome.MOVED
    assert gripper.move(0.01) > 0.03
    blocked = gripper.state
    assert blocked.outcome == gf.Outcome.BLOCKED
    assert gripper.force_n < 1.5
    assert gripper.grasp(3.0).held


def test_a_release_that_does_not_open_the_jaws_in_its_time_is_blocked(
    simulated: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_machine, "_OPENING_SPARE_S", -1.7)
    gripper = simulated()
    gripper.move(0.05)
    assert gripper.release() < 0.08
    assert gripper.state.outcome == gf.Outcome.BLOCKED
    assert "not opened within 0.1 s" in gripper.state.reason
    gripper.sleep(2.0)
    assert gripper.state.phase == gf.Phase.OPEN  # it has gone on


def test_no_log_is_written_without_a_path(
    simulated: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    gripper = simulated()
    gripper.grasp(2.0)
    gripper.close()
    assert list(tmp_path.rglob("*")) == []


def test_a_log_can_be_replayed(simulated: Open, tmp_path: Path) -> None:
    gripper = simulated(log=tmp_path / "run.mcap")
    gripper.grasp(3.0)
    gripper.set_force(4.0)
    gripper.move(0.09)
    gripper.release()
    gripper.close()
    assert [r.kind for r in LogReader(tmp_path / "run.mcap").records(gf.Request)] == [
        "grasp",
        "grasp",
        "move",
        "release",
    ]
    assert gf.replay(tmp_path / "run.mcap").identical is True


class NoiseCamera:
    """A camera of 50 frames per second, of which no two are equal."""

    supports_lockstep = True

    def __init__(self, config: gf.CameraConfig, clock: gf.Clock) -> None:
        self._clock, self._seq = clock, 0

    def start(self) -> None:
        pass

    def newest(self) -> gf.Frame | None:
        now_ns = self._clock.now_ns()
        if now_ns < 20_000_000 * self._seq:
            return None
        self._seq += 1
        return gf.Frame(now_ns, now_ns, self._seq, np.full((2, 2), self._seq % 251, np.uint8))

    def counts(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        pass


class LoadCellEstimator:
    """An estimator that sees a share of the force on the load cell."""

    reference = None

    def __init__(self, share: float) -> None:
        self.share = share
        self.gripper: gf.Gripper | None = None  # once it is open

    def update(self, gray: object) -> gf.ForceEstimate:
        force_n = None if self.gripper is None else self.gripper.state.load_cell_n
        return gf.ForceEstimate(self.share * (force_n or 0.0), 0.1)

    def renew_reference(self) -> None: ...

    def attention_map(self) -> None:
        return None


@pytest.fixture
def open_seeing(simulated: Open, monkeypatch: pytest.MonkeyPatch) -> Callable[[float], gf.Gripper]:
    """Opens a gripper in lockstep whose visual estimates are a share of the true force."""

    def make(share: float) -> gf.Gripper:
        estimator = LoadCellEstimator(share)
        monkeypatch.setattr(session, "make_estimator", lambda _: estimator)
        estimator.gripper = simulated(
            f"camera.backend={__name__}:NoiseCamera", "control.feedback=fused", "control.settle_s=0.8"
        )
        return estimator.gripper

    return make


def test_vision_share_counts_the_hold(open_seeing: Callable[[float], gf.Gripper]) -> None:
    gripper = open_seeing(1.0)
    assert gripper.frame is not None
    assert gripper.frame.gray.dtype == "uint8"
    assert gripper.grasp(3.0).vision_share > 0.9
    assert gripper.config.gripper.nm_per_a is not None  # the resolved configuration


def test_a_new_object_begins_without_the_gain_of_the_one_before(
    open_seeing: Callable[[float], gf.Gripper],
) -> None:
    gripper = open_seeing(0.7)
    first = gripper.grasp(3.0)
    assert first.vision_share == 0  # it contradicts the motor current
    assert first.object_gain == pytest.approx(1 / 0.7, rel=0.1)
    with pytest.raises(gf.RequestError, match="an object is held"):
        gripper.grasp(3.0, new_object=True)
    gripper.release()
    assert gripper.grasp(3.0).vision_share > 0.9
    gripper.release()
    assert gripper.grasp(3.0, new_object=True).vision_share == 0


def test_an_object_that_the_network_does_not_know_is_held_by_motor_current(
    quick: list[str], tmp_path: Path
) -> None:
    seeing = ["object=peg", "camera.backend=simulated", "vision.checkpoint=small", "control.feedback=fused"]
    log = tmp_path / "peg.mcap"
    with gf.open_gripper(overrides=[*quick, *seeing], log=log) as gripper:
        result = gripper.grasp(3.0)
    assert result.vision_share == 0
    assert result.force_n == pytest.approx(3.0, abs=0.2)
    events = [event.text for event in LogReader(log).records(gf.Event)]
    assert any("does not know the view before" in text for text in events)
    assert replay(log).identical


@pytest.mark.parametrize("new_object", [False, True])
def test_vision_takes_a_new_reference_with_a_new_object(
    quick: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, new_object: bool
) -> None:
    """Between two grasps an arm has moved the camera: the image is shifted by three pixels."""
    moved = False
    newest = rig.SimulatedCamera.newest

    def shifted(self: rig.SimulatedCamera) -> gf.Frame | None:
        frame = newest(self)
        if frame is None or not moved:
            return frame
        return dataclasses.replace(frame, gray=np.roll(frame.gray, 3, axis=1))

    monkeypatch.setattr(rig.SimulatedCamera, "newest", shifted)
    seeing = [
        "camera.backend=simulated",
        "vision.checkpoint=small",
        "control.feedback=fused",
    ]
    log = tmp_path / "two.mcap"
    with gf.open_gripper(overrides=[*quick, *seeing], log=log) as gripper:
        assert gripper.grasp(3.0).vision_share > 0.9
        gripper.release()
        moved = True
        gripper.sleep(0.2)
        share = gripper.grasp(3.0, new_object=new_object).vision_share
    assert share > 0.9 if new_object else share == 0
    assert replay(log).identical
    seen_n = {visual.seq: visual.force_n for visual in LogReader(log).records(VisualForce)}
    frames = [frame.seq for frame in LogReader(log).records(gf.Frame)]
    model, settings_ = read_model("small"), gf.Config().model_dump(mode="json")
    evaluated = _evaluate_log(
        log,
        checkpoint=(model.path, model.digest),
        config=settings_,
        objects=(),
        include_contact_starts=False,
    )
    assert evaluated is not None
    assert evaluated.forces_n is not None
    compared = [
        (seen_n[seq], force_n)
        for seq, force_n in zip(frames, evaluated.forces_n, strict=True)
        if seq in seen_n and math.isfinite(seen_n[seq])
    ]
    run_n, evaluated_n = np.array(compared).T
    assert len(compared) > 100
    np.testing.assert_allclose(evaluated_n, run_n, atol=1e-3)


def test_a_camera_without_reference_frames_is_an_error_before_the_first_motion(
    quick_vision: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames that come later may show contact, so they are no reference."""
    monkeypatch.setattr(session, "_VISION_WAIT_NS", 500_000_000)
    fault = "faults=[{unit: camera, kind: 'off', at_s: 0.03, for_s: 30}]"
    error = r"no visual estimate after 0.567 s and \d frames; the network needs 4 before the first contact"
    with pytest.raises(gf.DeviceTimeoutError, match=error):
        gf.open_gripper(overrides=[*quick_vision, fault])
    late = "faults=[{unit: camera, kind: 'off', at_s: 0.03, for_s: 0.3}]"
    with gf.open_gripper(overrides=[*quick_vision, late]) as gripper:
        assert gripper.state.t_ns > 0.3e9


@pytest.mark.parametrize("target_n", [0.0, -1.0, 9.1, math.nan, math.inf])
def test_a_force_out_of_range_is_refused(simulated: Open, target_n: float) -> None:
    gripper = simulated()
    for wait in (True, False):
        with pytest.raises(gf.RequestError, match="target of"):
            gripper.grasp(target_n, wait=wait)
    assert gripper.step().phase == gf.Phase.OPEN


@pytest.mark.parametrize("width_m", [-0.001, 0.2, math.nan, math.inf])
def test_a_width_out_of_range_is_refused(simulated: Open, width_m: float) -> None:
    gripper = simulated()
    for wait in (True, False):
        with pytest.raises(gf.RequestError, match=r"a width of .* is (outside 0 to 92 mm|not a number)"):
            gripper.move(width_m, wait=wait)
    assert gripper.step().phase == gf.Phase.OPEN


@pytest.mark.parametrize("value", ["4", math.nan])
def test_what_is_no_number_is_refused(simulated: Open, value: Any) -> None:
    gripper = simulated()
    for call in (gripper.grasp, gripper.set_force, gripper.move, gripper.sleep):
        with pytest.raises(gf.RequestError, match="is not a number of at most 1e"):
            call(value)


def test_a_negative_time_is_refused(simulated: Open, real_time: Open) -> None:
    for gripper in (simulated(), real_time()):
        with pytest.raises(gf.RequestError, match=r"^a time of -1 s is negative; pass 0 or more$"):
            gripper.sleep(-1)
        gripper.sleep(0)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"config": {"control": {}}}, "the configuration must be a path, not"),
        ({"config": 5}, "the configuration must be a path, not 5"),
        ({"log": "a\0b"}, "the log must be a path, not 'a"),
        ({"log": 5}, "the log must be a path, not 5"),
        ({"overrides": 5}, "overrides are a list of assignments, or a mapping"),
        ({"overrides": [5]}, "overrides are a list of assignments, or a mapping"),
    ],
)
def test_an_argument_of_another_type_is_a_configuration_error(
    arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(gf.ConfigError, match=sentence):
        gf.open_gripper(**arguments)


@pytest.mark.parametrize("wait", [True, False])
def test_a_program_may_decide_at_run_time_whether_it_waits(simulated: Open, wait: bool) -> None:
    """The type of ``wait`` is bool here, which a type checker must accept, too."""
    gripper = simulated()
    first: gf.GraspResult | None = gripper.grasp(2.0, wait=wait)
    while not gripper.state.outcome:
        gripper.step()
    second: gf.GraspResult | None = gripper.set_force(2.5, wait=wait)
    assert [result is not None and result.held for result in (first, second)] == [wait, wait]


def test_force_is_only_set_on_a_gripped_object(simulated: Open) -> None:
    with pytest.raises(gf.RequestError, match=r"no object is gripped .*call grasp first"):
        simulated().set_force(2.0)


def test_a_stop_ends_the_grasp_and_a_release_resets_it(simulated: Open) -> None:
    gripper = simulated()
    gripper.grasp(3.0)
    gripper.stop()
    state = gripper.step()
    assert (state.phase, state.outcome, state.reason) == (gf.Phase.FAULT, gf.Outcome.FAULT, "stop requested")
    with pytest.raises(gf.RequestError, match="release"):
        gripper.grasp(2.0)
    gripper.release()
    assert gripper.grasp(2.0).held


def test_a_closed_gripper_refuses(simulated: Open) -> None:
    gripper = simulated()
    gripper.close()
    gripper.close()
    calls: list[Callable[[], object]] = [
        gripper.step,
        gripper.release,
        lambda: gripper.grasp(2.0),
        lambda: gripper.move(0.05),
        lambda: gripper.move(0.05, wait=False),
        lambda: gripper.grasp(2.0, wait=False),
        gripper.stop,
        lambda: gripper.state,
        lambda: gripper.force_n,
        lambda: gripper.width_m,
        lambda: gripper.load_cell,
    ]
    for call in calls:
        with pytest.raises(gf.RequestError, match="closed"):
            call()


def test_lockstep_has_no_background_thread(quick: list[str]) -> None:
    with pytest.raises(gf.ConfigError, match="clock=lockstep runs in the caller's thread"):
        gf.open_gripper(overrides=quick, background=True)


def test_overrides_do_not_go_with_a_config(quick: list[str]) -> None:
    config = gf.load_config(None, quick)
    with pytest.raises(gf.ConfigError, match="pass them to load_config"):
        gf.open_gripper(config, overrides=["seed=1"])
    with gf.open_gripper(config) as gripper:
        assert gripper.config.object == "stapler"


# The servo at the end, on the bus.


@pytest.mark.parametrize(("on_exit", "after"), [("release", 0), ("hold", 1)])
def test_the_servo_ends_as_configured(quick: list[str], on_exit: str, after: int) -> None:
    ended: list[int] = []
    with closing(Recorded(ended)), gf.open_gripper(overrides=[*quick, f"on_exit={on_exit}"]) as gripper:
        gripper.grasp(3.0)
        assert torque() == 1
    assert ended == [after]


@pytest.mark.parametrize(("on_fault", "after"), [("limp", 0), ("hold", 1)])
@pytest.mark.parametrize("error", [ValueError("the caller's"), gf.DataError("no picture")])
def test_an_exception_in_the_callers_code_is_a_fault(
    quick: list[str], on_fault: str, after: int, error: Exception
) -> None:
    ended: list[int] = []
    with (
        closing(Recorded(ended)),
        pytest.raises(type(error)),
        gf.open_gripper(overrides=[*quick, f"control.on_fault={on_fault}"]) as gripper,
    ):
        gripper.grasp(3.0)
        raise error
    assert ended == [after]


@pytest.mark.parametrize(
    "end", ["exception", "stop", "stop and cycle", "lost camera", "lost servo", "interrupt"]
)
def test_the_jaws_open_at_a_fault_if_configured(
    quick: list[str], end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They stay as they are after Ctrl-C, which is no fault, and if the servo does not answer."""
    ended: list[float] = []

    def note(name: str) -> None:
        servo = bus().servos[0]
        ended.extend([servo.get("torque_enable"), servo.get("present_position")])
        unregister_bus(name)

    monkeypatch.setattr(rig, "unregister_bus", note)
    settings = ["control.on_fault=open", "control.settle_s=0.2"]
    expected = suppress(ValueError, gf.DeviceError, KeyboardInterrupt)
    with expected, gf.open_gripper(overrides=[*quick, *settings]) as gripper:
        gripper.step()
        opened = bus().servos[0].get("present_position")
        gripper.grasp(3.0)
        gripped = bus().servos[0].get("present_position")
        if "stop" in end:
            gripper.stop()
        match end:
            case "exception":
                raise ValueError
            case "interrupt":
                raise KeyboardInterrupt
            case "stop and cycle":
                gripper.step()
            case "lost camera":
                monkeypatch.setattr(gripper._loop.session._perception, "poll", raise_lost)
                gripper.step()
            case "lost servo":
                bus().tamper = lambda _: None
                gripper.step()
    torque_on, position = ended
    assert torque_on == 0 or end == "lost servo"
    is_open = end not in ("lost servo", "interrupt")
    assert abs(position - (opened if is_open else gripped)) < 100
    assert abs(opened - gripped) > 200


def raise_lost() -> None:
    raise gf.DeviceLostError("the camera is gone")


def test_ctrl_c_is_no_fault(quick: list[str]) -> None:
    ended: list[int] = []
    with (
        closing(Recorded(ended)),
        pytest.raises(KeyboardInterrupt),
        gf.open_gripper(overrides=[*quick, "on_exit=hold", "control.on_fault=limp"]) as gripper,
    ):
        gripper.grasp(3.0)
        raise KeyboardInterrupt
    assert ended == [1]


def test_an_interrupt_within_a_bus_transaction_leaves_no_torque(quick: list[str]) -> None:
    ended: list[int] = []

    def interrupt(answer: bytes) -> bytes:
        raise KeyboardInterrupt

    with (
        closing(Recorded(ended)),
        pytest.raises(KeyboardInterrupt),
        gf.open_gripper(overrides=quick) as gripper,
    ):
        gripper.grasp(3.0)
        bus().tamper = interrupt
        try:
            gripper.step()
        finally:
            bus().tamper = None
    assert ended == [0]


def test_an_error_that_the_caller_handled_still_ends_as_a_fault(quick: list[str]) -> None:
    ended: list[int] = []
    with closing(Recorded(ended)), pytest.raises(gf.DeviceError):
        with gf.open_gripper(overrides=[*quick, "on_exit=hold"]) as gripper:
            gripper.grasp(3.0)
            bus().tamper = lambda _: None
            with pytest.raises(gf.DeviceTimeoutError):
                gripper.step()
            bus().tamper = None
            for wait in (True, False):  # a failed run stays failed
                with pytest.raises(gf.DeviceTimeoutError):
                    gripper.grasp(2.0, wait=wait)
        raise gf.DeviceError("reached: closing raised nothing")
    assert ended == [0]


class Recorded:
    """Keeps the torque of the rig's servo at the moment its bus is taken away."""

    def __init__(self, ended: list[int]) -> None:
        import gripper_hw.sim.simulated_rig as rig

        self._patch = pytest.MonkeyPatch()

        def unregister(name: str) -> None:
            if (found := find_bus(name)) is not None:
                ended.append(found.servos[0].get("torque_enable"))
            unregister_bus(name)

        self._patch.setattr(rig, "unregister_bus", unregister)

    def close(self) -> None:
        self._patch.undo()


@settings(max_examples=6)
@given(
    calls=st.lists(
        st.one_of(
            st.tuples(st.just("grasp"), st.floats(-1, 11)),
            st.tuples(st.just("set_force"), st.floats(-1, 11)),
            st.tuples(st.just("move"), st.floats(-0.01, 0.1)),
            st.tuples(st.just("stop"), st.none()),
            st.tuples(st.just("release"), st.none()),
        ),
        max_size=8,
    )
)
def test_any_sequence_of_requests_keeps_the_limit_and_ends_without_torque(
    quick: list[str], calls: list[tuple[str, float | None]]
) -> None:
    ended: list[int] = []
    with closing(Recorded(ended)), gf.open_gripper(overrides=quick) as gripper:
        limit_n = gripper.config.control.force_limit_n
        for name, value in calls:
            options: dict[str, Any] = {} if name == "stop" else {"wait": False}
            try:
                getattr(gripper, name)(*([] if value is None else [value]), **options)
            except gf.RequestError:
                continue
            for _ in range(150):
                state = gripper.step()
                assert state.load_cell_n is None or state.load_cell_n < limit_n * 1.05
                assert state.reference_n <= largest_target_n(limit_n, gripper.config.gripper.gain_bound)
    assert ended == [0]


# In real time.


NARROW = ("control.approach_speed_m_s=0.05", "gripper.open_width_m=0.03")
"""Jaws that soon have closed without an object."""


def test_the_background_thread_runs_the_cycle(real_time: Open, server: PtyServer) -> None:
    gripper = real_time(*NARROW)
    assert torque(server) == 1
    assert "control" in {thread.name for thread in threading.enumerate()}
    assert gripper.grasp(3.0).outcome == gf.Outcome.NO_OBJECT
    assert gripper.release() > 0.026
    with pytest.raises(gf.RequestError, match="open with background=False"):
        gripper.step()
    gripper.sleep(0.01)
    gripper.close()
    with pytest.raises(gf.RequestError, match="closed"):
        gripper.sleep(0.01)
    assert torque(server) == 0
    assert "control" not in {thread.name for thread in threading.enumerate()}


def test_steps_of_the_caller_move_the_jaws(real_time: Open, server: PtyServer) -> None:
    gripper = real_time(background=False)
    gripper.move(0.06, wait=False)
    states = [gripper.step() for _ in range(40)]
    assert states[-1].phase == gf.Phase.MOVE
    assert {b.t_ns > a.t_ns for a, b in pairwise(states)} == {True}
    gripper.close()
    assert torque(server) == 0


def in_thread(call: Callable[[], object]) -> BaseException | None:
    """Returns what a call in another thread raises."""
    with ThreadPoolExecutor() as pool:
        return pool.submit(call).exception()


def test_one_thread_at_a_time_runs_the_cycle(simulated: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    gripper = simulated()
    cycle = Session.cycle
    raised: list[BaseException | None] = []

    def meddled(session: Session, *request: Any, **options: Any) -> Any:
        if not raised:
            calls: list[Callable[[], object]] = [lambda: gripper.grasp(2.0), gripper.step]
            raised.extend(in_thread(call) for call in [*calls, lambda: gripper.sleep(0.1)])
            assert in_thread(lambda: gripper.set_force(2.0, wait=False)) is None
        return cycle(session, *request, **options)

    gripper.grasp(3.0)
    monkeypatch.setattr(Session, "cycle", meddled)
    gripper.step()
    assert [type(error) for error in raised] == 3 * [gf.RequestError]
    assert "another thread runs the control cycle; pass wait=False" in str(raised[0])
    gripper.sleep(2.0)
    assert gripper.state.reference_n == 2.0  # that of wait=False, and not of a refused request
    assert in_thread(gripper.step) is None  # the cycle is free again


def test_closing_waits_for_the_cycle_of_another_thread(simulated: Open) -> None:
    gripper = simulated()
    errors: list[BaseException | None] = []
    thread = threading.Thread(target=lambda: errors.append(in_thread(lambda: gripper.sleep(1e6))))
    thread.start()
    start_ns = gripper.state.t_ns
    while gripper.state.t_ns == start_ns:
        time.sleep(0.001)
    gripper.close()
    thread.join(20.0)
    assert "the gripper is closed" in str(errors[0])


def test_another_thread_stops_a_waiting_call(real_time: Open) -> None:
    gripper = real_time("control.approach_speed_m_s=0.005")
    timer = threading.Timer(0.2, gripper.stop)
    timer.start()
    result = gripper.grasp(3.0)
    timer.join()
    assert (result.outcome, result.reason) == (gf.Outcome.FAULT, "stop requested")


def test_a_newer_request_replaces_a_waiting_one(real_time: Open) -> None:
    gripper = real_time("control.approach_speed_m_s=0.005")
    timer = threading.Timer(0.2, lambda: gripper.release(wait=False))
    timer.start()
    with pytest.raises(gf.RequestError, match="replaced by a release request"):
        gripper.grasp(3.0)
    timer.join()


def test_numpy_numbers_become_floats(simulated: Open, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    numbers: list[Any] = [np.float32(3.3), np.array(2.0), np.float32(0.07)]
    with simulated(log=path) as gripper:
        gripper.grasp(numbers[0])
        assert type(gripper.state.reference_n) is float
        gripper.set_force(numbers[1])
        assert type(gripper.state.reference_n) is float
        gripper.move(numbers[2])
    requests = list(gf.LogReader(str(path)).records(gf.Request))
    assert [(r.kind, r.target_n or r.width_m) for r in requests] == [
        ("grasp", float(numbers[0])),
        ("grasp", 2.0),
        ("move", float(numbers[2])),
    ]


def test_a_move_in_a_thread_leaves_asyncio_free(real_time: Open) -> None:
    gripper = real_time()

    async def main() -> tuple[float, int]:
        moving = asyncio.create_task(asyncio.to_thread(gripper.move, 0.07))
        reads = 0
        while not moving.done():
            assert gripper.state.t_ns > 0
            reads += 1
            await asyncio.sleep(0.02)
        return await moving, reads

    width_m, reads = asyncio.run(main())
    assert width_m == pytest.approx(0.07, abs=0.001)
    assert reads > 5


def test_a_lost_device_is_raised_in_the_waiting_call(real_time: Open, server: PtyServer) -> None:
    gripper = real_time("control.approach_speed_m_s=0.005")
    timer = threading.Timer(0.2, server.unplug)
    timer.start()
    with pytest.raises(gf.DeviceLostError):
        gripper.grasp(3.0)
    timer.join()
    with pytest.raises(gf.DeviceLostError):
        gripper.sleep(1.0)


def test_a_lost_device_is_raised_by_the_state_that_a_program_polls(
    real_time: Open, server: PtyServer
) -> None:
    gripper = real_time("control.approach_speed_m_s=0.005")
    gripper.grasp(3.0, wait=False)
    server.unplug()
    with pytest.raises(gf.DeviceLostError):
        while not gripper.state.outcome:
            time.sleep(0.01)
    values: list[Callable[[], object]] = [gripper.stop, lambda: gripper.force_n, lambda: gripper.frame]
    values.append(lambda: gripper.release(wait=False))
    for value in values:
        with pytest.raises(gf.DeviceLostError):
            value()
    gripper.close()  # which raises only what no call has raised


def test_a_device_lost_meanwhile_is_raised_when_the_gripper_is_closed(
    real_time: Open, server: PtyServer
) -> None:
    gripper = real_time()
    server.unplug()
    while "control" in {thread.name for thread in threading.enumerate()}:
        time.sleep(0.01)
    with pytest.raises(gf.DeviceLostError):
        gripper.close()


def test_a_missing_port_is_raised_when_the_gripper_is_opened(quick: list[str]) -> None:
    sets = [*quick, "clock=realtime", "servo.port=/dev/ttyNONE", "load_cell.backend=none"]
    with pytest.raises(gf.DeviceNotFoundError, match="/dev/ttyNONE"):
        gf.open_gripper(overrides=sets)
    assert "control" not in {thread.name for thread in threading.enumerate()}


def test_the_callers_exception_ends_the_run_and_keeps_its_traceback(
    real_time: Open, server: PtyServer
) -> None:
    with pytest.raises(ValueError, match="mine") as caught, real_time("on_exit=hold") as gripper:
        gripper.move(0.085)
        raise ValueError("mine")
    assert torque(server) == 0
    assert [entry.name for entry in caught.traceback][-1] == (
        "test_the_callers_exception_ends_the_run_and_keeps_its_traceback"
    )


def test_close_ends_a_call_that_waits(real_time: Open) -> None:
    gripper = real_time("control.approach_speed_m_s=0.005")
    raised: list[BaseException] = []

    def grasp() -> None:
        try:
            gripper.grasp(3.0)
        except gf.RequestError as error:
            raised.append(error)

    waiting = threading.Thread(target=grasp)
    waiting.start()
    while gripper.state.phase != gf.Phase.APPROACH:
        gripper.sleep(0.01)
    gripper.close()
    waiting.join(20.0)
    assert not waiting.is_alive()
    assert "closed before the grasp request was done" in str(raised[0])


@pytest.mark.parametrize("background", [True, False])
def test_a_stop_just_before_the_end_counts(real_time: Open, server: PtyServer, background: bool) -> None:
    gripper = real_time("on_exit=hold", background=background)
    gripper.move(0.085)
    gripper.stop()
    gripper.close()
    assert torque(server) == 0


def test_a_control_thread_that_hangs_is_an_error(real_time: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    gripper = real_time()
    monkeypatch.setattr(control_loop, "_END_S", -math.inf)  # does not wait
    monkeypatch.setattr(gripper._loop._closing, "is_set", lambda: False)
    with pytest.raises(gf.DeviceTimeoutError, match="control thread did not end"):
        gripper.close()
    monkeypatch.undo()
    gripper.close()


PROGRAM = """
import sys, time
import gripper_force as gf

gripper = gf.open_gripper(overrides=sys.argv[2:])
gripper.move(0.085)
print("ready", flush=True)
if sys.argv[1] == "wait":
    gripper.sleep(60)
elif sys.argv[1] == "raise":
    raise ValueError("the caller's")
"""


@pytest.mark.parametrize(
    ("ending", "number", "code"), [("wait", signal.SIGINT, -2), ("raise", None, 1), ("end", None, 0)]
)
def test_a_program_that_forgets_to_close_leaves_no_torque(
    quick: list[str], server: PtyServer, ending: str, number: signal.Signals | None, code: int
) -> None:
    sets = [*quick, *served_by(server)]
    if ending == "raise":
        sets += ["on_exit=hold"]  # which is not for exceptions
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, ending, *sets],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        if number is not None:
            process.send_signal(number)
        _, said = process.communicate(timeout=60)
    assert process.returncode == code, said
    assert torque(server) == 0
    assert server.bus.servos[0].get("hardware_error_status") == 0


def test_a_program_that_forgets_to_close_a_rendered_rig_ends_in_silence() -> None:
    program = "import sys, gripper_force as gf; gripper = gf.open_gripper(overrides=sys.argv[1:]); gripper.sleep(0.1)"
    sets = ["sim.detail=coarse", "vision.checkpoint=none", "control.feedback=current"]
    ended = subprocess.run(
        [sys.executable, "-c", program, *sets], capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")


# The order of requests.


def phases(gripper: gf.Gripper, steps: int = 20) -> set[gf.Phase]:
    return {gripper.step().phase for _ in range(steps)}


def test_a_stop_overrides_every_older_request(simulated: Open) -> None:
    gripper = simulated()
    gripper.grasp(3.0, wait=False)
    gripper.release(wait=False)
    gripper.grasp(5.0, wait=False)
    gripper.stop()
    assert phases(gripper) == {gf.Phase.FAULT}


def test_a_refused_move_leaves_the_waiting_grasp_alone(real_time: Open) -> None:
    gripper = real_time("control.approach_speed_m_s=0.05", "gripper.open_width_m=0.06")
    results: list[gf.GraspResult] = []
    waiting = threading.Thread(target=lambda: results.append(gripper.grasp(3.0)))
    waiting.start()
    while gripper.state.phase != gf.Phase.APPROACH:
        gripper.sleep(0.01)
    with pytest.raises(gf.RequestError, match="a width of 1000 mm is outside"):
        gripper.move(1.0)
    waiting.join()
    assert [result.outcome for result in results] == [gf.Outcome.NO_OBJECT]


def test_what_a_stop_refuses_raises_at_once(simulated: Open) -> None:
    gripper = simulated()
    gripper.stop()
    before = gripper.state
    calls: list[Callable[..., object]] = [gripper.grasp, gripper.set_force, gripper.move]
    for call in calls:
        with pytest.raises(gf.RequestError, match="refused: stopped or in fault; call release first"):
            call(0.05, wait=False)
    assert gripper.state is before
    gripper.release(wait=False)
    gripper.grasp(3.0, wait=False)  # which the release makes possible
    assert gf.Phase.APPROACH in phases(gripper)


def test_a_fault_whose_cause_persists_refuses_each_request_on_its_own(simulated: Open) -> None:
    gripper = simulated()
    bus().servos[0].set_conditions(temperature_c=78)
    assert gripper.step().phase == gf.Phase.FAULT
    gripper.release(wait=False)
    with pytest.raises(gf.RequestError, match="the grasp request was refused: stopped or in fault"):
        gripper.grasp(3.0)
    with pytest.raises(gf.RequestError, match="the release request was refused: the servo is at 78 C"):
        gripper.release()
    bus().servos[0].set_conditions(temperature_c=30)
    gripper.release()
    assert gripper.grasp(3.0).held


def test_a_gripper_that_is_at_fault_when_it_opens_says_why(simulated: Open) -> None:
    gripper = simulated("control.warm_c=10", "control.temperature_limit_c=20")
    why = r"the servo is at \d+ C; control\.temperature_limit_c is 20"
    assert gripper.state.phase == gf.Phase.FAULT
    assert re.fullmatch(why, gripper.state.reason)
    with pytest.raises(gf.RequestError, match=rf"stopped or in fault \({why}\); call release first"):
        gripper.grasp(3.0)


def test_a_later_refusal_is_in_the_log(simulated: Open, tmp_path: Path) -> None:
    gripper = simulated(log=tmp_path / "run.mcap")
    gripper.grasp(3.0)
    gripper.release(wait=False)
    gripper.set_force(2.0, wait=False)
    assert phases(gripper) <= {gf.Phase.RELEASE, gf.Phase.OPEN}
    gripper.close()
    events = [event.text for event in LogReader(tmp_path / "run.mcap").records(gf.Event)]
    assert "refused 'grasp': no object is gripped" in events


# The end of a run that is still being opened.


class SlowCamera:
    """A camera whose start takes until the program ends the run, as that of a camera that boots."""

    supports_lockstep = True
    end: Callable[[], None]  # ends the run while the camera starts

    def __init__(self, config: gf.CameraConfig, clock: gf.Clock) -> None:
        pass

    def start(self) -> None:
        SlowCamera.end()

    def newest(self) -> gf.Frame | None:
        return None

    def counts(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        pass


SLOW_CAMERA = f"camera.backend={__name__}:SlowCamera"


@pytest.fixture
def opening(monkeypatch: pytest.MonkeyPatch) -> list[ControlLoop]:
    """The control loops that are being opened. A program gets the gripper once it is open."""
    found: list[ControlLoop] = []
    open_loop = ControlLoop.open

    def register(loop: ControlLoop) -> None:
        found.append(loop)
        open_loop(loop)

    monkeypatch.setattr(ControlLoop, "open", register)
    return found


@pytest.fixture
def armed(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The writes to a servo's Torque Enable that turn torque on."""
    writes: list[bytes] = []
    transact = VirtualBus.transact

    def listen(served: VirtualBus, data: bytes) -> bytes:
        writes.extend(
            packet.params
            for packet in Parser().feed(data)
            if packet.instruction == Instruction.WRITE and packet.params == b"\x40\x00\x01"
        )
        return transact(served, data)

    monkeypatch.setattr(VirtualBus, "transact", listen)
    return writes


def ctrl_c(number: signal.Signals = signal.SIGINT) -> None:
    """Sends a signal to the main thread, as the kernel does."""
    main = threading.main_thread().ident
    assert main is not None
    signal.pthread_kill(main, number)


def wait_until_closing(opening: list[ControlLoop]) -> None:
    while not opening[0]._closing.is_set():
        time.sleep(0.001)


@pytest.mark.parametrize("permission", ["library_process", "own_process"])
def test_ctrl_c_while_the_gripper_is_opened_leaves_torque_off(
    real_time: Open,
    opening: list[ControlLoop],
    armed: list[bytes],
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
    permission: str,
) -> None:
    request.getfixturevalue(permission)

    def end() -> None:
        ctrl_c()
        wait_until_closing(opening)

    monkeypatch.setattr(SlowCamera, "end", end, raising=False)
    with pytest.raises(KeyboardInterrupt):
        real_time(SLOW_CAMERA)
    assert "control" not in {thread.name for thread in threading.enumerate()}
    assert armed == []
    real_time()
    assert len(armed) == 1


def test_closing_in_another_thread_while_the_gripper_is_opened_leaves_torque_off(
    real_time: Open, opening: list[ControlLoop], armed: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    closing: list[threading.Thread] = []

    def end() -> None:
        closing.append(threading.Thread(target=opening[0].close, args=(None,)))
        closing[0].start()
        wait_until_closing(opening)

    monkeypatch.setattr(SlowCamera, "end", end, raising=False)
    with pytest.raises(gf.RequestError, match="closed while it was being opened"):
        real_time(SLOW_CAMERA)
    closing[0].join()
    assert armed == []


@pytest.mark.usefixtures("own_process")
def test_a_signal_before_the_servo_starts_leaves_torque_off(
    simulated: Open, armed: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SlowCamera, "end", lambda: signal.raise_signal(signal.SIGTERM), raising=False)
    with pytest.raises(KeyboardInterrupt, match="the run was interrupted"):
        simulated(SLOW_CAMERA)
    assert armed == []


def test_ctrl_c_during_the_first_frames_ends_the_run(
    real_time: Open, server: PtyServer, opening: list[ControlLoop], tmp_path: Path
) -> None:
    def end(answer: bytes) -> bytes:
        if torque(server):
            server.bus.tamper = None
            ctrl_c()
            wait_until_closing(opening)
        return answer

    server.bus.tamper = end
    with pytest.raises(KeyboardInterrupt):
        real_time(log=tmp_path / "run.mcap")
    assert torque(server) == 0
    assert len(list(LogReader(tmp_path / "run.mcap").records(gf.GraspStatus))) <= 1


@contextmanager
def interrupted_in(phase: gf.Phase, gripper: gf.Gripper) -> Iterator[None]:
    """Presses Ctrl-C once the gripper is in a phase."""

    def interrupt() -> None:
        while gripper.state.phase != phase:
            time.sleep(0.001)
        ctrl_c()

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        yield
    thread.join()


def test_ctrl_c_in_a_call_that_waits_leaves_jaws_that_grip(
    real_time: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_loop, "GRIPPING", (gf.Phase.APPROACH,))  # this rig has no object
    gripper = real_time("control.timeout_s=60", "control.approach_speed_m_s=0.001")
    with interrupted_in(gf.Phase.APPROACH, gripper):
        gripper.grasp(2.0)
    time.sleep(0.1)
    assert gripper.state.phase == gf.Phase.APPROACH


def test_an_interrupt_stops_a_grasp_that_waits_and_no_release(
    real_time: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    gripper, stops = real_time(), list[str]()
    for call, expected in ((gripper.release, []), (lambda: gripper.grasp(2.0), ["stop"])):
        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(Future, "exception", interrupt)
            patched.setattr(gripper._loop, "stop", lambda: stops.append("stop"))
            call()
        assert stops == expected


@pytest.mark.parametrize("permission", ["library_process", "own_process"])
def test_ctrl_c_in_a_call_that_waits_stops_jaws_that_close(
    real_time: Open, request: pytest.FixtureRequest, permission: str
) -> None:
    request.getfixturevalue(permission)
    gripper = real_time("control.timeout_s=60", "control.approach_speed_m_s=0.001")
    with interrupted_in(gf.Phase.APPROACH, gripper):
        gripper.grasp(2.0)
    with pytest.raises(gf.RequestError, match=r"stopped or in fault.*call release first"):
        gripper.grasp(2.0)
    gripper.release()


@pytest.mark.usefixtures("own_process")
def test_a_gripper_that_is_lost_is_closed(
    quick: list[str], server: PtyServer, opening: list[ControlLoop]
) -> None:
    before = signal.getsignal(signal.SIGINT)
    sets = [*quick, *served_by(server)]
    gripper = gf.open_gripper(overrides=sets)
    assert torque(server) == 1
    assert signal.getsignal(signal.SIGINT) != before
    del gripper
    assert (process._interrupts, signal.getsignal(signal.SIGINT)) == ([], before)
    assert opening[0]._ended.wait(60)
    assert torque(server) == 0
    assert opening[0]._thread is not None
    opening[0]._thread.join()
    kept = weakref.ref(opening.pop())
    gc.collect()
    assert kept() is None
    with gf.open_gripper(overrides=sets) as again:  # the port is free
        assert again.state.phase == gf.Phase.OPEN


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"control": {"on_fault": "nothing"}}, "control.on_fault"),
        ({"control": {"force_limit_n": 1e4}}, "control.force_limit_n"),
        ({"seed": "three"}, "seed"),
    ],
)
def test_a_copy_of_a_configuration_with_wrong_values_is_refused(
    quick: list[str], values: dict[str, Any], key: str
) -> None:
    config = gf.load_config(overrides=quick).with_values(**values)
    with pytest.raises(gf.ConfigError, match=rf"configuration key '{key}' \(from open_gripper\)"):
        gf.open_gripper(config)


# Nothing of the process is changed without permission.


def test_the_process_stays_as_it_is(real_time: Open) -> None:
    import torch

    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    before = sys.getswitchinterval(), torch.get_num_threads()
    gripper = real_time()
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
    gripper.move(0.08)
    assert (sys.getswitchinterval(), torch.get_num_threads()) == before


@pytest.mark.usefixtures("own_process")
def test_a_program_may_ask_for_signals_and_timing(real_time: Open) -> None:
    before, handler = sys.getswitchinterval(), signal.getsignal(signal.SIGTERM)
    gripper = real_time("control.approach_speed_m_s=0.005")
    assert sys.getswitchinterval() < before
    timer = threading.Timer(0.2, ctrl_c, [signal.SIGTERM])
    timer.start()
    with pytest.raises(KeyboardInterrupt), gripper:
        gripper.grasp(3.0)
        pytest.fail("the signal did not end the call that waits")
    timer.join()
    assert sys.getswitchinterval() == pytest.approx(before)
    assert signal.getsignal(signal.SIGTERM) == handler


@pytest.mark.usefixtures("own_process")
@pytest.mark.parametrize("first", [0, 1])
def test_the_switch_interval_stays_short_until_the_last_gripper_is_closed(first: int) -> None:
    gf.own_process(real_time_priority=False)  # which is a thread's, and each gripper has its own thread
    before = sys.getswitchinterval()
    runs = [ExitStack(), ExitStack()]
    for run in runs:
        run.enter_context(process.real_time_settings())
    runs[first].close()
    assert sys.getswitchinterval() == pytest.approx(process.SWITCH_INTERVAL_S, rel=0.01)
    runs[1 - first].close()
    assert sys.getswitchinterval() == pytest.approx(before)


CLOSED_IN_A_THREAD = """
import signal, sys, threading
import gripper_force as gf

gf.own_process()
gripper = gf.open_gripper(overrides=sys.argv[2:])
thread = threading.Thread(target=gripper.close)
thread.start()
thread.join()
try:
    signal.raise_signal(signal.Signals(int(sys.argv[1])))
finally:
    print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""


def test_a_handled_interrupt_is_raised_once(simulated: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    gripper = simulated()
    with monkeypatch.context() as patch:
        patch.setattr(ControlLoop, "_cycle", lambda *_: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            gripper.sleep(1.0)
    for call in (gripper.release, lambda: gripper.grasp(2.0), gripper.step):
        with pytest.raises(gf.RequestError, match="an interrupt has ended the run; close the gripper"):
            call()
    gripper.close()


@pytest.mark.usefixtures("own_process")
def test_a_signal_between_cycles_ends_a_program_that_may_run_no_other(simulated: Open) -> None:
    simulated()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.usefixtures("own_process")
def test_a_signal_in_the_last_cycle_is_raised_at_its_end(
    simulated: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    gripper, cycle, cycles = simulated(), ControlLoop._cycle, list[gf.GripperState]()

    def with_signal(loop: ControlLoop, session: Session) -> gf.GripperState:
        cycles.append(cycle(loop, session))
        signal.raise_signal(signal.SIGTERM)
        return cycles[-1]

    monkeypatch.setattr(ControlLoop, "_cycle", with_signal)
    with pytest.raises(KeyboardInterrupt):
        gripper.step()
    assert [state.phase for state in cycles] == [gf.Phase.OPEN]


@pytest.mark.usefixtures("own_process")
def test_a_signal_does_not_break_the_cycle_of_a_gripper_that_is_not_the_newest(
    simulated: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    gripper, _newest = simulated(), simulated("servo.port=virtual:second")
    cycle, ended = ControlLoop._cycle, list[bool]()

    def with_signal(loop: ControlLoop, session: Session) -> None:
        cycle(loop, session)
        signal.raise_signal(signal.SIGTERM)
        ended.append(True)

    monkeypatch.setattr(ControlLoop, "_cycle", with_signal)
    with pytest.raises(KeyboardInterrupt):
        gripper.step()
    assert ended == [True]


@pytest.mark.usefixtures("own_process")
def test_a_signal_between_the_cycles_of_a_call_stops_jaws_that_close(
    simulated: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    gripper, step = simulated(), ControlLoop.step

    def with_signal(loop: ControlLoop) -> gf.GripperState:
        if step(loop).phase == gf.Phase.APPROACH:
            signal.raise_signal(signal.SIGTERM)
        return loop.state

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(ControlLoop, "step", with_signal)
        gripper.grasp(2.0)
    assert gripper.step().phase == gf.Phase.FAULT


@pytest.mark.usefixtures("own_process")
def test_a_signal_in_the_last_cycle_of_the_start_ends_it(
    simulated: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = ControlLoop._start

    def with_signal(loop: ControlLoop, session: Session) -> None:
        start(loop, session)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(ControlLoop, "_start", with_signal)
    with pytest.raises(KeyboardInterrupt):
        simulated()


@pytest.mark.parametrize(("number", "background"), [(signal.SIGINT, True), (signal.SIGTERM, False)])
def test_signals_work_as_before_once_another_thread_has_closed_the_gripper(
    quick: list[str], server: PtyServer, number: signal.Signals, background: bool
) -> None:
    sets = [*quick, *(served_by(server) if background else [])]
    done = subprocess.run(
        [sys.executable, "-c", CLOSED_IN_A_THREAD, str(int(number)), *sets],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == -number, done.stderr
    assert done.stdout == ("True\n" if number == signal.SIGINT else "")


@pytest.mark.usefixtures("own_process")
def test_sigterm_after_a_handled_ctrl_c_ends_a_program(
    simulated: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "_TOGETHER_S", -1.0)
    simulated()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGTERM):
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)


@pytest.mark.usefixtures("own_process")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_only_ctrl_c_interrupts_the_end_of_a_run(
    quick: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, number: signal.Signals
) -> None:
    monkeypatch.setattr(process, "_TOGETHER_S", -1.0)
    opening = Session.wait_until_open

    def with_signal(session: Session, status: gf.GraspStatus) -> gf.GraspStatus:
        signal.raise_signal(number)
        return opening(session, status)

    path = tmp_path / "run.mcap"
    with (
        pytest.raises(KeyboardInterrupt if number == signal.SIGINT else ZeroDivisionError),
        gf.open_gripper(overrides=[*quick, "control.on_fault=open"], log=path) as gripper,
    ):
        gripper.grasp(2.0)
        monkeypatch.setattr(Session, "wait_until_open", with_signal)
        raise ZeroDivisionError
    is_opened = list(LogReader(path).records(gf.GraspStatus))[-1].width_m > 0.08
    assert is_opened == (number == signal.SIGTERM)


FORKED = """
import os, sys
import gripper_force as gf

gripper = gf.open_gripper(overrides=sys.argv[3:], background=sys.argv[1] == "True", log=sys.argv[2])
if os.fork() == 0:
    try:
        gripper.release()
    except gf.RequestError as error:
        print(error)
    with gripper:
        sys.exit(0)
print(os.wait()[1], flush=True)
input()
gripper.stop()
gripper.close()
"""


@pytest.mark.parametrize("background", [True, False])
def test_a_forked_process_leaves_servo_and_log_alone(
    quick: list[str], server: PtyServer, background: bool, tmp_path: Path
) -> None:
    sets = [*quick, *served_by(server), "control.on_fault=limp"]
    command = [sys.executable, "-c", FORKED, str(background), str(tmp_path / "run.mcap"), *sets]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdin is not None
        assert program.stdout is not None
        assert program.stdout.readline().startswith(
            "the gripper belongs to the process that opened it; use it"
        )
        assert program.stdout.readline() == "0\n"
        assert torque(server) == 1
        program.communicate("\n")
    assert (program.returncode, torque(server)) == (0, 0)
    assert LogReader(tmp_path / "run.mcap").complete


def test_a_device_may_step_and_close_another_gripper(
    simulated: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    gripper, other = simulated(), simulated("servo.port=virtual:second")
    calls: list[Callable[[], object]] = [other.close, other.step]
    cycle = Session.cycle

    def with_call(session: Session, *request: Any, **named: Any) -> Any:
        if session is gripper._loop.session:
            calls.pop()()
        return cycle(session, *request, **named)

    monkeypatch.setattr(Session, "cycle", with_call)
    for _ in range(2):
        assert gripper.step().phase == gf.Phase.OPEN
    with pytest.raises(gf.RequestError, match="the gripper is closed"):
        other.step()


@pytest.mark.parametrize("error", [None, ZeroDivisionError])
def test_a_device_that_closes_its_own_gripper_ends_the_run_after_the_cycle(
    simulated: Open, monkeypatch: pytest.MonkeyPatch, error: type[Exception] | None
) -> None:
    gripper, other = simulated(), simulated("servo.port=virtual:second")
    cycle, ended = Session.cycle, list[bool]()

    def with_close(session: Session, *request: Any, **named: Any) -> Any:
        (gripper.close if session is other._loop.session else other.step)()
        decision = cycle(session, *request, **named)
        ended.append(bool(torque()))
        if error is not None and session is gripper._loop.session:
            raise error
        return decision

    monkeypatch.setattr(Session, "cycle", with_close)
    with pytest.raises(gf.RequestError if error is None else error):
        gripper.grasp(2.0)
    assert ended == [True, True]
    assert find_bus("rig") is None


@pytest.mark.parametrize("background", [False, True])
def test_a_device_can_not_wait_for_its_own_cycle(
    simulated: Open, real_time: Open, monkeypatch: pytest.MonkeyPatch, background: bool
) -> None:
    gripper, cycle = real_time() if background else simulated(), Session.cycle

    def with_grasp(session: Session, *request: Any, **named: Any) -> Any:
        gripper.grasp(2.0)
        return cycle(session, *request, **named)

    monkeypatch.setattr(Session, "cycle", with_grasp)
    with pytest.raises(
        gf.RequestError, match=r"can't wait for the control cycle that calls it; pass wait=False$"
    ):
        gripper.sleep(20.0)


def test_the_control_thread_may_close_its_gripper(
    real_time: Open, server: PtyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    gripper, cycle, ended = real_time(), Session.cycle, list[bool]()

    def with_close(session: Session, *request: Any, **named: Any) -> Any:
        gripper.close()
        ended.append(True)
        return cycle(session, *request, **named)

    monkeypatch.setattr(Session, "cycle", with_close)
    with pytest.raises(gf.RequestError, match="closed"):
        gripper.sleep(20.0)
    assert (ended, torque(server)) == ([True], 0)
