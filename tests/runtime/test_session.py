import dataclasses
import math
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import count, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from gripper_force.config import Config, config_from_text, load_config
from gripper_force.errors import DataError, DeviceError, DeviceTimeoutError, RequestError, SimulationError
from gripper_force.interfaces import Camera, Devices
from gripper_force.jobs.grasp import grasp_and_release, run_grasp
from gripper_force.runtime import session as session_module
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.process import SIGNALS
from gripper_force.runtime.resolve import ResolvedConfig, resolve
from gripper_force.runtime.session import Session, open_run, open_session
from gripper_force.types import (
    NS_PER_MS,
    AttentionMap,
    Event,
    Frame,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Outcome,
    Phase,
    Record,
    Request,
    RequestKind,
    ServoCommand,
    ServoState,
    VisualForce,
)
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.model_files import read_model
from gripper_hw.dynamixel import virtual
from gripper_hw.dynamixel.packets import Instruction, Parser
from gripper_hw.dynamixel.virtual import VirtualBus

TORQUE_ENABLE = 64
BUS_WATCHDOG = 98


class Guess(NamedTuple):
    force_n: float
    std_n: float


class Rig:
    """An open session on the simulated rig, and what its servo heard."""

    def __init__(self, devices: Devices, session: Session, bus: VirtualBus, heard: list[bytes]) -> None:
        self.devices, self.session, self.bus, self.heard = devices, session, bus, heard

    def register(self, name: str) -> int:
        return self.bus.servos[0].get(name)

    def grip(self, target_n: float = 3.0) -> None:
        """Goes on until the jaws press."""
        decision = self.session.cycle(RequestKind.GRASP, target_n)
        while decision.status.phase != Phase.RAMP:
            decision = self.session.cycle()
        assert self.register("torque_enable") == 1

    def go_on(self, cycles: int) -> None:
        for _ in range(cycles):
            self.session.cycle()

    def last_write_to(self, address: int) -> bytes | None:
        parser = Parser()
        writes = [
            packet.params[2:]
            for data in self.heard
            for packet in parser.feed(data)
            if packet.instruction == Instruction.WRITE
            and int.from_bytes(packet.params[:2], "little") == address
        ]
        return writes[-1] if writes else None

    def is_off(self) -> bool:
        """Torque is off, and because it was asked for over the wire."""
        return self.register("torque_enable") == 0 and self.last_write_to(TORQUE_ENABLE) == b"\0"


@pytest.fixture
def heard(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """Every byte the virtual bus is sent."""
    data_sent: list[bytes] = []
    transact = VirtualBus.transact

    def listen(bus: VirtualBus, data: bytes) -> bytes:
        data_sent.append(data)
        return transact(bus, data)

    monkeypatch.setattr(VirtualBus, "transact", listen)
    return data_sent


OpenRig = Callable[..., Rig]


@pytest.fixture
def open_rig(quick: list[str], tmp_path: Path, heard: list[bytes]) -> Iterator[tuple[ExitStack, OpenRig]]:
    """A stack that stands for the run, and a way to begin it."""
    with ExitStack() as devices_stay, ExitStack() as run:

        def begin(*overrides: str, camera: Camera | None = None) -> Rig:
            settings = resolve(load_config(None, [*quick, *overrides]))
            devices = devices_stay.enter_context(open_devices(settings.config))
            devices.camera = camera
            bus = virtual.find_bus("rig")
            assert bus is not None
            session = run.enter_context(open_session(settings, devices, tmp_path / "run.mcap"))
            return Rig(devices, session, bus, heard)

        yield run, begin


def records(path: Path) -> list[Record]:
    """Everything but images and what is the host's own: how long an estimate took."""
    return [
        dataclasses.replace(r, compute_ms=0.0) if isinstance(r, VisualForce) else r
        for r in LogReader(path).records()
        if not isinstance(r, Frame | AttentionMap)
    ]


def events(path: Path) -> list[str]:
    return [event.text for event in LogReader(path).records(Event)]


# A whole grasp.


def test_a_grasp_goes_through_its_phases_and_is_held(current_log: Path) -> None:
    statuses = list(LogReader(current_log).records(GraspStatus))
    phases = [b.phase for a, b in pairwise(statuses) if a.phase != b.phase]
    assert phases == ["approach", "contact", "ramp", "hold", "release", "open"]
    assert statuses[-1].outcome == Outcome.HELD
    held_n = [s.force_n for s in LogReader(current_log).records(LoadCellSample)]
    assert max(held_n) == pytest.approx(3.0, abs=1.0)


def test_a_cycle_is_logged_in_its_order(current_log: Path) -> None:
    kinds = [type(r) for r in LogReader(current_log).records() if not isinstance(r, LoadCellSample | Event)]
    body = [kind for kind in kinds if kind is not Request]
    cycle = [ServoState, FusedForce, ServoCommand, GraspStatus]
    assert body == cycle * (len(body) // 4)
    requests = [i for i, kind in enumerate(kinds) if kind is Request]
    assert [kinds[i + 1] for i in requests] == [ServoState] * 2
    assert [r.kind for r in LogReader(current_log).records(Request)] == ["grasp", "release"]
    states = [s.t_ns for s in LogReader(current_log).records(ServoState)]
    assert set(np.diff(states)) == {5 * NS_PER_MS}


def test_frames_and_estimates_come_before_the_cycle_that_uses_them(fused_log: Path) -> None:
    order = list(LogReader(fused_log).records())
    frames = [i for i, r in enumerate(order) if isinstance(r, Frame)]
    visual = [i for i, r in enumerate(order) if isinstance(r, VisualForce)]
    assert len(visual) > 50
    for i in visual:
        frame, estimate = order[i - 1], order[i]
        assert isinstance(frame, Frame)
        assert isinstance(estimate, VisualForce)
        assert (frame.seq, frame.t_ns) == (estimate.seq, estimate.t_ns)
        assert estimate.ready_ns >= frame.received_ns
    state = next(r for r in order[visual[0] :] if isinstance(r, ServoState))
    first = order[visual[0]]
    assert isinstance(first, VisualForce)
    assert 0 <= state.t_ns - first.ready_ns <= 5 * NS_PER_MS
    assert len(frames) > len(visual)  # the reference


def test_a_seed_gives_one_log(current_log: Path, quick: list[str], tmp_path: Path) -> None:
    again, other = tmp_path / "again.mcap", tmp_path / "other.mcap"
    run_grasp(load_config(None, quick), again)
    assert records(again) == records(current_log)
    run_grasp(load_config(None, [*quick, "seed=1"]), other)
    assert records(other) != records(current_log)


def test_a_seed_gives_one_log_with_vision(fused_log: Path, quick_vision: list[str], tmp_path: Path) -> None:
    """Up to the ramp: each image takes long to render."""
    path = tmp_path / "again.mcap"
    with open_run(load_config(None, quick_vision), path) as session:
        session.wait_for_reference()
        status = session.cycle(RequestKind.GRASP, 3.0).status
        while status.phase != Phase.RAMP:
            status = session.cycle().status
    again = records(path)
    end = next(i for i, record in enumerate(again) if record == status)
    assert again[:end] == records(fused_log)[:end]
    log, whole = LogReader(path), LogReader(fused_log)
    pairs: list[tuple[Frame | AttentionMap, Frame | AttentionMap]] = [
        *zip(log.records(Frame), whole.records(Frame), strict=False),
        *zip(log.records(AttentionMap), whole.records(AttentionMap), strict=False),
    ]
    assert len(pairs) > 80
    assert all((a.seq, a.t_ns) == (b.seq, b.t_ns) and (a.gray == b.gray).all() for a, b in pairs)


def test_the_log_says_what_ran(fused_log: Path, tiny_checkpoint: Path) -> None:
    log = LogReader(fused_log)
    config = config_from_text(log.config, "the log")
    assert config.gripper.nm_per_a == pytest.approx(1.78, rel=0.05)
    assert config.gripper.current_step_a == pytest.approx(0.00269)
    assert log.metadata["object"] == "stapler"
    assert log.metadata["set"] == "stapler-0"
    assert log.metadata["clock"] == "lockstep"
    assert log.metadata["checkpoint"] == load_checkpoint(tiny_checkpoint).digest
    assert log.metadata["exposure_ms"] == "4.0"
    assert '"object": "stapler"' in log.metadata["scene"]
    assert log.metadata["version mujoco"].startswith("4.")
    assert log.attachments["reference.png"].startswith(b"\x89PNG")


def test_progress_tells_each_phase_once(quick: list[str], tmp_path: Path) -> None:
    told: list[str] = []
    run_grasp(load_config(None, quick), tmp_path / "run.mcap", lambda text, steps=1: told.append(text))
    assert [text.split()[2] for text in told] == ["approach", "contact", "ramp", "hold", "open"]


def test_a_target_over_the_limit_is_refused_before_anything_moves(quick: list[str], tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"a target of 13 N is too close to control\.force_limit_n 14 N"):
        run_grasp(load_config(None, [*quick, "target_n=13"]), tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())


# Every way out.


@pytest.mark.parametrize(
    "error", [DataError("no picture"), KeyboardInterrupt(), RuntimeError("a bug"), SystemExit(3)]
)
def test_torque_is_off_after_an_error_in_the_run(
    open_rig: tuple[ExitStack, OpenRig], tmp_path: Path, error: BaseException
) -> None:
    run, begin = open_rig
    rig = begin()
    rig.grip()
    with pytest.raises(type(error)), run:
        raise error
    assert rig.is_off()
    assert events(tmp_path / "run.mcap")[-1] == f"{type(error).__name__}: {error}"


def test_torque_is_off_after_the_devices_report_a_failure(open_rig: tuple[ExitStack, OpenRig]) -> None:
    run, begin = open_rig

    def fail() -> None:
        raise SimulationError("the world broke")

    rig = begin()
    rig.grip()
    rig.devices.check = fail
    with pytest.raises(SimulationError, match="the world broke"), run:
        rig.session.cycle()
    assert rig.is_off()


class Gray:
    """A camera that sees nothing but its own noise, once in four cycles."""

    def __init__(self) -> None:
        self.asked = 0

    def start(self) -> None: ...

    def close(self) -> None: ...

    def counts(self) -> dict[str, int]:
        return {}

    def newest(self) -> Frame | None:
        self.asked += 1
        t_ns = self.asked * 5 * NS_PER_MS
        gray = np.full((2, 2), self.asked % 251, np.uint8)
        return None if self.asked % 4 else Frame(t_ns, t_ns, self.asked // 4, gray)


@dataclasses.dataclass
class Opening:
    """A session whose cycles all give the same status."""

    status: GraspStatus
    opening_s: float = 2.0
    resolved: ResolvedConfig = dataclasses.field(default_factory=lambda: ResolvedConfig(Config()))

    def cycle(self) -> "Opening":
        self.status = dataclasses.replace(self.status, t_ns=self.status.t_ns + 5 * NS_PER_MS)
        return self


@pytest.mark.parametrize(
    ("width_m", "outcome", "waits_s"),
    [(0.09, Outcome.NONE, 0.0), (0.05, Outcome.BLOCKED, 0.005), (0.05, Outcome.FAULT, 2.5)],
)
def test_an_opening_is_waited_for_until_the_jaws_are_open_or_blocked_or_late(
    width_m: float, outcome: Outcome, waits_s: float
) -> None:
    begin = GraspStatus(0, Phase.RELEASE, outcome, 0.0, width_m)
    last = Session.wait_until_open(Opening(begin), begin)  # type: ignore[arg-type]
    assert last.t_ns / 1e9 == waits_s


class Failing:
    """An estimator that says nothing of use."""

    reference = None

    def __init__(self, force_n: float) -> None:
        self.force_n = force_n
        self.fails = False
        self.frames = 0

    def update(self, gray: object) -> Guess:
        if self.fails:
            self.frames += 1
            raise DataError(f"no picture, {self.frames / 10:.1f} times")
        return Guess(self.force_n, 0.1)

    def attention_map(self) -> None:
        return None


def test_the_grip_is_kept_on_motor_current_where_the_estimator_fails(
    open_rig: tuple[ExitStack, OpenRig], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    run, begin = open_rig
    estimator = Failing(2.0)
    monkeypatch.setattr(session_module, "make_estimator", lambda *_: estimator)
    rig = begin(camera=Gray())
    rig.grip()
    estimator.fails = True
    rig.go_on(100)
    assert rig.register("torque_enable") == 1
    assert rig.register("goal_current") > 0
    run.close()
    told = events(tmp_path / "run.mcap")
    assert [text for text in told if text.startswith("no estimate")] == ["no estimate: no picture, 0.1 times"]
    assert list(LogReader(tmp_path / "run.mcap").records(FusedForce))[-1].source == "current"


@pytest.mark.parametrize(
    ("force_n", "feedback"),
    [(math.nan, "fused"), (math.nan, "vision"), (math.inf, "fused"), (-math.inf, "vision")],
)
def test_an_estimate_that_is_no_number_never_reaches_the_servo(
    open_rig: tuple[ExitStack, OpenRig],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    force_n: float,
    feedback: str,
) -> None:
    run, begin = open_rig
    monkeypatch.setattr(session_module, "make_estimator", lambda *_: Failing(force_n))
    rig = begin(f"control.feedback={feedback}", camera=Gray())
    rig.grip()
    rig.go_on(100)
    run.close()
    log = LogReader(tmp_path / "run.mcap")
    commands = list(log.records(ServoCommand))
    assert all(math.isfinite(c.goal_current_a) and math.isfinite(c.goal_position_rad) for c in commands)
    assert any(not math.isfinite(v.force_n) for v in log.records(VisualForce))
    assert {f.source for f in log.records(FusedForce)} == {"current"}
    assert all(math.isfinite(f.force_n) for f in log.records(FusedForce))


@pytest.mark.parametrize("how", ["end", "error"])
def test_hold_keeps_the_grip_and_disarms_the_watchdog(open_rig: tuple[ExitStack, OpenRig], how: str) -> None:
    run, begin = open_rig
    rig = begin("on_exit=hold", "control.on_fault=hold")
    rig.grip()
    goal = rig.register("goal_current")
    assert rig.register("bus_watchdog") > 0
    if how == "end":
        run.close()
    else:
        with pytest.raises(DataError), run:
            raise DataError("no picture")
    assert rig.register("torque_enable") == 1
    assert rig.register("goal_current") == goal > 0
    assert rig.register("bus_watchdog") == 0
    assert rig.last_write_to(BUS_WATCHDOG) == b"\0"


@pytest.mark.parametrize("on_fault", ["limp", "hold", "open"])
def test_a_fault_ends_as_configured(quick: list[str], tmp_path: Path, on_fault: str) -> None:
    path = tmp_path / "run.mcap"
    settings = resolve(load_config(None, [*quick, f"control.on_fault={on_fault}"]))
    with open_devices(settings.config) as devices:
        bus = virtual.find_bus("rig")
        assert bus is not None
        with open_session(settings, devices, path) as session:

            def stop(text: str, steps: int = 1) -> None:
                if "hold" in text:
                    session.stop_soon()

            grasp_and_release(session, 3.0, stop)
        last = list(LogReader(path).records(GraspStatus))[-1]
        assert (last.phase, last.outcome) == (Phase.FAULT, Outcome.FAULT)
        assert bus.servos[0].get("torque_enable") == (on_fault == "hold")
        assert (last.width_m > 0.085) == (on_fault == "open")


def test_hold_does_not_release_at_the_end_of_a_grasp(quick: list[str], tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run_grasp(load_config(None, [*quick, "on_exit=hold"]), path)
    assert [r.kind for r in LogReader(path).records(Request)] == ["grasp"]
    assert list(LogReader(path).records(GraspStatus))[-1].phase == Phase.HOLD


@pytest.mark.parametrize("open_position_rad", [0.3, 0.7, -0.3])
def test_jaws_outside_their_travel_are_refused_before_anything_moves(
    quick: list[str], tmp_path: Path, open_position_rad: float
) -> None:
    believed = [*quick, f"gripper.open_position_rad={open_position_rad}"]
    if open_position_rad < 0:
        believed.append("gripper.closing_sign=-1")
    settings = resolve(load_config(None, quick))
    with open_devices(settings.config) as devices:
        bus = virtual.find_bus("rig")
        assert bus is not None
        run = resolve(load_config(None, believed))
        with (
            pytest.raises(DeviceError, match=r"outside their travel.*gripper\.open_position_rad"),
            open_session(run, devices, tmp_path / "run.mcap"),
        ):
            pass
        assert not bus.servos[0].get("torque_enable")
        assert bus.servos[0].get("goal_current") == 0
    assert not (tmp_path / "run.mcap").exists()


def test_a_servo_that_does_not_start_is_not_stopped_and_leaves_no_log(
    open_rig: tuple[ExitStack, OpenRig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, begin = open_rig
    calls: list[str] = []

    def start(_: object) -> None:
        raise DeviceTimeoutError("the servo is mute")

    monkeypatch.setattr("gripper_hw.dynamixel.servo.DynamixelServo.start", start)
    monkeypatch.setattr(
        "gripper_hw.dynamixel.servo.DynamixelServo.stop", lambda *_, **__: calls.append("stop")
    )
    with pytest.raises(DeviceTimeoutError, match="the servo is mute"), run:
        begin()
    assert calls == []
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.parametrize(
    ("first", "raised", "told"),
    [
        (None, DeviceError, "no valid reply"),
        (
            DataError("no picture"),
            DataError,
            "no picture; and the servo could not be stopped: no valid reply",
        ),
        (RuntimeError("a bug"), DeviceError, "no valid reply"),
    ],
)
def test_a_servo_that_can_not_be_stopped_is_told(
    open_rig: tuple[ExitStack, OpenRig], first: Exception | None, raised: type[Exception], told: str
) -> None:
    run, begin = open_rig
    rig = begin()
    rig.session.cycle()
    rig.bus.tamper = lambda _: None
    with pytest.raises(raised, match=told), run:
        if first is not None:
            raise first


@pytest.mark.parametrize("watchdog_ms", [40, 100])
def test_silence_within_the_watchdogs_time_keeps_the_grip(
    open_rig: tuple[ExitStack, OpenRig], tmp_path: Path, watchdog_ms: int
) -> None:
    run, begin = open_rig
    rig = begin(f"servo.bus_watchdog_ms={watchdog_ms}")
    rig.grip()
    before = rig.session.cycle()
    end_ns = before.status.t_ns + (watchdog_ms - 10) * 1_000_000
    rig.bus.tamper = lambda answer: answer if rig.devices.clock.now_ns() > end_ns else None
    after = rig.session.cycle()
    rig.bus.tamper = None
    assert after.status.t_ns > end_ns
    assert after.status.phase == before.status.phase
    assert after.command.goal_current_a == pytest.approx(before.command.goal_current_a, abs=0.01)
    run.close()
    assert any(re.fullmatch(r"no answer for \d+ ms", text) for text in events(tmp_path / "run.mcap"))


def test_longer_silence_ends_the_run(open_rig: tuple[ExitStack, OpenRig]) -> None:
    run, begin = open_rig
    rig = begin()
    rig.grip()
    start_ns = rig.session.cycle().status.t_ns
    rig.bus.tamper = lambda _: None
    with pytest.raises(DeviceTimeoutError, match="no valid reply"):
        rig.session.cycle()
    assert 30_000_000 <= rig.devices.clock.now_ns() - start_ns <= 45_000_000
    rig.bus.tamper = None
    run.close()
    assert rig.is_off()


def test_jaws_whose_servo_did_not_answer_are_not_opened_at_the_end(
    open_rig: tuple[ExitStack, OpenRig],
) -> None:
    run, begin = open_rig
    rig = begin("control.on_fault=open")
    rig.grip()
    cycles = rig.session.cycles
    with pytest.raises(DeviceTimeoutError), run:
        rig.bus.tamper = lambda _: None
        try:
            rig.session.cycle()
        finally:
            rig.bus.tamper = None
    assert rig.session.cycles == cycles
    assert rig.is_off()


def test_bus_retries_are_logged(open_rig: tuple[ExitStack, OpenRig], tmp_path: Path) -> None:
    run, begin = open_rig
    rig = begin()
    rig.session.cycle()
    lost = iter([True])
    rig.bus.tamper = lambda answer: None if next(lost, False) else answer
    rig.session.cycle()
    rig.session.cycle()
    run.close()
    assert events(tmp_path / "run.mcap") == ["1 bus retries"]


def test_what_goes_wrong_again_and_again_is_told_once_a_second(
    open_rig: tuple[ExitStack, OpenRig], tmp_path: Path
) -> None:
    run, begin = open_rig
    rig = begin()
    answers = count()
    rig.bus.tamper = lambda answer: None if next(answers) % 2 else answer  # every read needs two tries
    for _ in range(210):
        rig.session.cycle()
    rig.bus.tamper = None
    run.close()
    first, second, last = (int(text.removesuffix(" bus retries")) for text in events(tmp_path / "run.mcap"))
    assert (first, second) == (1, 200)
    assert last in (8, 9)


def test_a_load_cell_that_falls_silent_is_told(open_rig: tuple[ExitStack, OpenRig], tmp_path: Path) -> None:
    run, begin = open_rig
    begin("faults=[{unit: load_cell, kind: off, at_s: 0.2, for_s: 0.5}]").go_on(180)
    run.close()
    told = [e for e in LogReader(tmp_path / "run.mcap").records(Event) if e.unit == "load_cell"]
    assert [e.text for e in told] == ["no valid samples, so nothing to compare with", "valid samples again"]
    assert 0.2e9 < told[0].t_ns < 0.3e9
    assert told[1].t_ns < 0.8e9


def test_samples_that_are_rejected_are_told_with_their_causes(
    open_rig: tuple[ExitStack, OpenRig], tmp_path: Path
) -> None:
    run, begin = open_rig
    begin("faults=[{unit: load_cell, kind: wrong, at_s: 0.2, for_s: 0.5}]").go_on(180)
    run.close()
    log = LogReader(tmp_path / "run.mcap")
    told = " ".join(e.text for e in log.records(Event) if e.unit == "load_cell")
    rejected = sum(not sample.valid for sample in log.records(LoadCellSample))
    assert rejected >= 90
    counted = [int(n) for n in re.findall(r"(\d+) (?:saturated|stuck|not finite|spikes|doubtful)", told)]
    assert sum(counted) == rejected


# Stop and signals.


def test_stop_soon_leads_to_fault_within_a_cycle(open_rig: tuple[ExitStack, OpenRig]) -> None:
    _, begin = open_rig
    rig = begin()
    rig.grip()
    thread = threading.Thread(target=rig.session.stop_soon)
    thread.start()
    thread.join()
    decision = rig.session.cycle(RequestKind.GRASP, 3.0)
    assert decision.status.phase == Phase.FAULT
    before_a = decision.command.goal_current_a
    after = [rig.session.cycle() for _ in range(20)]
    assert all(d.status.phase == Phase.FAULT for d in after)
    assert all(d.command.goal_current_a <= before_a for d in after)


@pytest.mark.usefixtures("own_process")
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_waits_for_the_end_of_the_cycle(
    open_rig: tuple[ExitStack, OpenRig], tmp_path: Path, number: signal.Signals
) -> None:
    run, begin = open_rig
    handler = signal.getsignal(number)
    rig = begin()
    rig.grip()

    def interrupt(answer: bytes) -> bytes:
        rig.bus.tamper = None
        signal.raise_signal(number)
        return answer

    rig.bus.tamper = interrupt
    rig.session.cycle()
    cycles = rig.session.cycles
    with pytest.raises(KeyboardInterrupt), run:
        rig.session.cycle()
    assert rig.session.cycles == cycles
    assert rig.is_off()
    assert events(tmp_path / "run.mcap")[-1] == "KeyboardInterrupt: the run was interrupted"
    assert signal.getsignal(number) == handler


@pytest.mark.usefixtures("own_process")
def test_a_second_signal_does_not_wait_and_torque_still_goes_off(open_rig: tuple[ExitStack, OpenRig]) -> None:
    run, begin = open_rig
    rig = begin()
    rig.grip()

    def hang(_: bytes) -> bytes:
        rig.bus.tamper = None
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("it still waits")

    rig.bus.tamper = hang
    with pytest.raises(KeyboardInterrupt), run:
        rig.session.cycle()
    assert rig.is_off()


@pytest.mark.usefixtures("own_process")
def test_a_signal_while_torque_goes_off_waits_for_that(open_rig: tuple[ExitStack, OpenRig]) -> None:
    run, begin = open_rig
    rig = begin()
    rig.grip()

    def interrupt(answer: bytes) -> bytes:
        rig.bus.tamper = None
        signal.raise_signal(signal.SIGINT)
        return answer

    rig.bus.tamper = interrupt
    with pytest.raises(KeyboardInterrupt):
        run.close()
    assert rig.is_off()


@pytest.mark.usefixtures("own_process")
def test_a_session_in_another_thread_leaves_signals_alone(quick: list[str], tmp_path: Path) -> None:
    handler = signal.getsignal(signal.SIGINT)
    seen: list[object] = []

    def run() -> None:
        with open_run(load_config(None, quick), tmp_path / "run.mcap"):
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [handler]


GRASP = """
import gripper_hw.dynamixel.virtual as virtual
from gripper_force.cli import main

unregister = virtual.unregister_bus

def tell(name):
    bus = virtual.find_bus(name)
    if bus is not None:
        print("torque", bus.servos[0].get("torque_enable"), flush=True)
    unregister(name)

import gripper_hw.sim.simulated_rig as rig
rig.unregister_bus = tell
main()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_command_with_torque_off_and_a_whole_log(
    quick: list[str], tmp_path: Path, number: signal.Signals
) -> None:
    sets = [*quick, f"log.directory={tmp_path}", "control.hold_s=100000"]
    arguments = [part for assignment in sets for part in ("--set", assignment)]
    said = tmp_path / "stderr"
    with said.open("w") as err, (tmp_path / "stdout").open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-c", GRASP, "grasp", *arguments], stdout=out, stderr=err, text=True
        )
        while "hold" not in said.read_text() and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(number)
        assert process.wait(timeout=60) == 128 + number, said.read_text()
    assert said.read_text().splitlines()[-1] == "interrupted; the run was stopped as configured"
    assert "Traceback" not in said.read_text()
    assert (tmp_path / "stdout").read_text() == "torque 0\n"
    (path,) = tmp_path.glob("*.mcap")
    assert events(path)[-1] == "KeyboardInterrupt: the run was interrupted"
    assert list(LogReader(path).records(GraspStatus))[-1].phase == Phase.HOLD


LOGIN = """
import fcntl, termios

fcntl.ioctl(0, termios.TIOCSCTTY, 0)  # this terminal controls the session, as after a login
"""


@pytest.mark.parametrize(("on_exit", "torque"), [("release", 0), ("hold", 1)])
def test_a_lost_connection_ends_the_command_as_configured(
    quick: list[str], tmp_path: Path, on_exit: str, torque: int
) -> None:
    sets = [*quick, f"log.directory={tmp_path}", "control.hold_s=100000", f"on_exit={on_exit}"]
    arguments = [part for assignment in sets for part in ("--set", assignment)]
    master, slave = pty.openpty()
    with (tmp_path / "stdout").open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-c", LOGIN + GRASP, "grasp", *arguments],
            stdin=slave,
            stdout=out,
            stderr=slave,
            start_new_session=True,
        )
    os.close(slave)
    said = b""
    while b"hold" not in said:
        said += os.read(master, 4096)
    os.close(master)  # the kernel sends SIGHUP, and output to the terminal fails
    process.send_signal(signal.SIGHUP)  # so does the shell
    assert process.wait(timeout=60) == 128 + signal.SIGHUP
    assert (tmp_path / "stdout").read_text() == f"torque {torque}\n"
    (path,) = tmp_path.glob("*.mcap")
    assert events(path)[-1] == "KeyboardInterrupt: the run was interrupted"


FULL_DISK = """
import resource, signal
from gripper_force.cli import main

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
main()
"""


def test_a_full_disk_does_not_end_the_grasp_and_is_told_after_it(quick: list[str], tmp_path: Path) -> None:
    sets = [*quick, f"log.directory={tmp_path}", "control.hold_s=0.2", "log.report=false"]
    arguments = [part for assignment in sets for part in ("--set", assignment)]
    ended = subprocess.run(
        [sys.executable, "-c", FULL_DISK, "grasp", *arguments], capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 2, ended.stderr
    assert "Traceback" not in ended.stderr
    told = " ".join(ended.stderr.split())
    assert "File too large; the run went on, and its log lacks" in told
    assert told.index(" open held") < told.index("File too large")
    (path,) = tmp_path.glob("*.mcap")
    assert list(LogReader(path, recover=True).records(GraspStatus))


# Real time.


@pytest.mark.usefixtures("own_process")
def test_in_real_time_the_loop_runs_and_the_grasp_ends(
    quick: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # However busy the machine that tests it.
    monkeypatch.setattr("gripper_hw.sim.simulated_rig._REALTIME_MAX_LAG_NS", 10**12)
    real_time = ["clock=realtime", "servo.bus_watchdog_ms=2540", "control.timeout_s=2"]
    path = tmp_path / "run.mcap"
    interval = sys.getswitchinterval()
    begin_s = time.monotonic()
    run_grasp(load_config(None, [*quick, *real_time]), path)
    ran_s = time.monotonic() - begin_s
    states = list(LogReader(path).records(ServoState))
    outcomes = {s.outcome for s in LogReader(path).records(GraspStatus)}
    assert outcomes <= {"", Outcome.HELD, Outcome.TIMEOUT}
    assert len(outcomes) == 2
    assert 100 < len(states) <= ran_s * 200 + 10
    assert sys.getswitchinterval() == pytest.approx(interval)
    assert not {thread.name for thread in threading.enumerate()} & {"perception", "simulated-rig"}


def test_versions_are_those_of_installed_packages() -> None:
    devices = SimpleNamespace(notes={"serial": "7"}, clock=None, lockstep=True)
    about = session_module._metadata(ResolvedConfig(Config()), devices)  # type: ignore[arg-type]
    assert about["serial"] == "7"
    assert "set" not in about  # logs of real devices show one scene each, whatever the seed is
    assert about["checkpoint"] == ""
    assert about["version numpy"] == np.__version__
    assert "version openvino" not in about


def test_the_version_of_an_engine_of_its_own_is_in_the_log() -> None:
    openvino = pytest.importorskip("openvino")
    run = ResolvedConfig(load_config(None, ["vision.engine=openvino"]), read_model("small"))
    about = session_module._metadata(run, SimpleNamespace(notes={}, clock=None, lockstep=True))  # type: ignore[arg-type]
    assert openvino.__version__.startswith(about["version openvino"])
