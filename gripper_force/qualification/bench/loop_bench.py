"""The control loop in real time: how late its cycles begin with inference beside them, and without.

What is measured is what a real gripper runs: the session, the servo's driver, the camera's thread and the
log. A virtual servo answers from a process of its own, behind a pseudo-terminal, and the camera shows a
recording over and over: no physics is computed on this machine's account.
"""

import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, cast

import numpy as np

from gripper_force.config import Config, config_from_text, load_config
from gripper_force.interfaces import Devices, Servo
from gripper_force.jobs.grasp import run_grasp
from gripper_force.jobs.replay import resolve_replay, run_again
from gripper_force.qualification.bench.startup_bench import PATIENT
from gripper_force.runtime.backends import MonotonicClock, load_servo_class
from gripper_force.runtime.log import LogReader, LogWriter
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import open_session
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, RequestKind, ServoCommand, ServoState, VisualForce

_TURN_S: Final = 10.0
"""How long one of the two runs before the other has its turn."""

_REQUEST_S: Final = 2.0
"""The jaws close and open in turn, each for so long."""

_LATENCY_NS: Final = 10 * NS_PER_MS
_RECORDING: Final = (
    *("object=stapler", "seed=7", "sim.detail=coarse", "target_n=4"),
    *("vision.checkpoint=none", "control.feedback=current", "load_cell.backend=none", "clock=lockstep"),
)
"""What the camera shows."""


@dataclass(frozen=True, slots=True)
class LoopCost:
    """What a loop did.

    Attributes:
        beside: What was computed beside it: ``vision`` or ``nothing``.
        cycles: Cycles that were run.
        missed: Periods that were skipped, or whose cycle began a whole period late.
        lost_records: Records that the log lacks.
        late_p50_ms: How late cycles began, in the median.
        late_p99_ms: 99th percentile of it.
        late_max_ms: The latest.
        bus_p50_ms: What reading and writing the servo took within a cycle.
        bus_p99_ms: 99th percentile of it.
        cycle_p50_ms: What the whole cycle took.
        cycle_p99_ms: 99th percentile of it.
        estimator_p50_ms: What an estimate took; NaN without vision.
        estimator_p99_ms: 99th percentile of it.
        estimates_hz: Estimates a second.
    """

    beside: str
    cycles: int
    missed: int
    lost_records: int
    late_p50_ms: float
    late_p99_ms: float
    late_max_ms: float
    bus_p50_ms: float
    bus_p99_ms: float
    cycle_p50_ms: float
    cycle_p99_ms: float
    estimator_p50_ms: float
    estimator_p99_ms: float
    estimates_hz: float


@dataclass(frozen=True, slots=True)
class LogCost:
    """What a run's log takes.

    Attributes:
        run_mb_s: What the run above wrote a second, with vision.
        write_mb_s: The same records written as fast as can be.
        record_us: One of them, on the average of all kinds.
        replay_times: Estimator and controller on that log, over the time that the run took.
    """

    run_mb_s: float
    write_mb_s: float
    record_us: float
    replay_times: float


@dataclass(slots=True)
class _Seen:
    """What was seen of one loop so far."""

    late_ns: list[int] = field(default_factory=list)
    bus_ns: list[int] = field(default_factory=list)
    cycle_ns: list[int] = field(default_factory=list)
    compute_ms: list[float] = field(default_factory=list)
    skipped: int = 0
    lost: int = 0


class _Clock(MonotonicClock):
    """The host's time, and how late sleep ends. A wait for a time more than a period on is one that skips."""

    def __init__(self, period_ns: int, seen: _Seen) -> None:
        self._period_ns, self._seen = period_ns, seen
        self._last_ns = 0
        self.begun_ns = 0

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleeps until then; returns at once if it is past."""
        MonotonicClock.sleep_until_ns(self, t_ns)
        self.begun_ns = self.now_ns()
        self._seen.late_ns.append(self.begun_ns - t_ns)
        if self._last_ns:
            self._seen.skipped += (t_ns - self._last_ns) // self._period_ns - 1
        self._last_ns = t_ns


class _Servo:
    """A servo, and how long its bus takes in each cycle."""

    def __init__(self, servo: Servo, seen: _Seen) -> None:
        self._servo, self._seen = servo, seen

    def read(self) -> ServoState:
        begin_ns = time.monotonic_ns()
        state = self._servo.read()
        self._seen.bus_ns.append(time.monotonic_ns() - begin_ns)
        return state

    def write(self, command: ServoCommand) -> None:
        begin_ns = time.monotonic_ns()
        self._servo.write(command)
        self._seen.bus_ns[-1] += time.monotonic_ns() - begin_ns

    def __getattr__(self, name: str) -> Any:
        return getattr(self._servo, name)


class _Camera:
    """Shows frames over and over, forth and back, at the configured rate."""

    def __init__(self, frames: list[Frame], rate_hz: float) -> None:
        self._grays = [frame.gray for frame in (*frames, *reversed(frames[1:-1]))]
        self._period_ns = round(NS_PER_S / rate_hz)
        self._start_ns = self._shown = 0

    def start(self) -> None:
        self._start_ns = time.monotonic_ns()

    def newest(self) -> Frame | None:
        number = (time.monotonic_ns() - self._start_ns) // self._period_ns
        if number == self._shown:
            return None
        self._shown = number
        t_ns = self._start_ns + number * self._period_ns
        return Frame(t_ns - _LATENCY_NS, t_ns, number, self._grays[number % len(self._grays)])

    def counts(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        pass


def loop(
    seconds: float, overrides: list[str], path: Path | None = None
) -> tuple[tuple[LoopCost, ...], LogCost]:
    """Runs the loop with and without vision in parallel, in turns.

    Args:
        seconds: Duration of each of the two.
        overrides: Configuration keys, such as ``vision.threads=2``.
        path: Configuration file, or None.

    Raises:
        GripperError: The virtual servo did not answer, or the configuration is wrong.
    """
    loops = {"vision": _Seen(), "nothing": _Seen()}
    turns = max(1, round(seconds / _TURN_S))
    with TemporaryDirectory() as name, _virtual_servo() as port:
        folder = Path(name)
        run_grasp(load_config(path, [*overrides, *_RECORDING]), folder / "seen.mcap")
        frames = list(LogReader(folder / "seen.mcap").records(Frame))
        for turn in range(turns):
            for beside, seen in loops.items():
                blind = () if beside == "vision" else ("vision.checkpoint=none", "control.feedback=current")
                settings = [*PATIENT, *overrides, "clock=realtime", f"servo.port={port}", *blind]
                log_path = folder / f"{beside}{turn}.mcap"
                _run(load_config(path, settings), frames, seconds / turns, log_path, seen)
        log = _log_cost(folder / "vision0.mcap", folder / "again.mcap", seconds / turns)
    period_ns = round(NS_PER_S / load_config(path, overrides).control.rate_hz)
    return tuple(_cost(beside, seconds, period_ns, seen) for beside, seen in loops.items()), log


def _run(config: Config, frames: list[Frame], seconds: float, path: Path, seen: _Seen) -> None:
    """One turn: the jaws close and open."""
    run = resolve(config)
    config = run.config
    clock = _Clock(round(NS_PER_S / config.control.rate_hz), seen)
    with ExitStack() as stack:
        servo = load_servo_class(config)(config.servo, clock.now_ns)
        stack.callback(servo.close)
        devices = Devices(
            clock=clock,
            servo=cast(Servo, _Servo(servo, seen)),
            camera=_Camera(frames, config.camera.rate_hz),
            load_cell=None,
            lockstep=False,
            start_ns=clock.now_ns(),
            check=lambda: None,
        )
        session = stack.enter_context(open_session(run, devices, path))
        end_ns = clock.now_ns() + round(seconds * NS_PER_S)
        next_ns, kind = 0, RequestKind.RELEASE
        while (now_ns := clock.now_ns()) < end_ns:
            asked = None
            if now_ns >= next_ns:
                asked = kind = RequestKind.GRASP if kind == RequestKind.RELEASE else RequestKind.RELEASE
                next_ns = now_ns + round(_REQUEST_S * NS_PER_S)
            session.cycle(asked, config.target_n)
            seen.cycle_ns.append(clock.now_ns() - clock.begun_ns)
    seen.lost += session.lost_records
    seen.compute_ms += [visual.compute_ms for visual in LogReader(path).records(VisualForce)]


@contextmanager
def _virtual_servo() -> Iterator[str]:
    """The path of a servo that another process serves."""
    program = "from gripper_force.cli import main; main()"
    command = [sys.executable, "-c", program, "virtual-servo", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())["port"]
        finally:
            process.terminate()


def _cost(beside: str, seconds: float, period_ns: int, seen: _Seen) -> LoopCost:
    late_ns = np.array(seen.late_ns)
    late_ms = np.percentile(late_ns, (50, 99, 100)) / NS_PER_MS
    bus_ms, cycle_ms = (np.percentile(ns, (50, 99)) / NS_PER_MS for ns in (seen.bus_ns, seen.cycle_ns))
    compute_ms = np.percentile(seen.compute_ms or [math.nan], (50, 99))
    missed = seen.skipped + int((late_ns >= period_ns).sum())
    figures = np.concatenate([late_ms, bus_ms, cycle_ms, compute_ms, [len(seen.compute_ms) / seconds]])
    return LoopCost(beside, len(late_ns), missed, seen.lost, *figures.tolist())


def _log_cost(path: Path, again: Path, seconds: float) -> LogCost:
    """Writes a run's records once more, and replays them."""
    reader = LogReader(path)
    records = list(reader.records())
    begin_s = time.monotonic()
    with LogWriter(again, config=reader.config, metadata=dict(reader.metadata)) as log:
        for record in records:
            log.write(record)
    wrote_s = time.monotonic() - begin_s
    config = config_from_text(reader.config, str(path))
    run = resolve_replay(config)
    begin_s = time.monotonic()
    run_again(reader, run)
    replayed_s = time.monotonic() - begin_s
    return LogCost(
        run_mb_s=path.stat().st_size / 2**20 / seconds,
        write_mb_s=again.stat().st_size / 2**20 / wrote_s,
        record_us=1e6 * wrote_s / len(records),
        replay_times=seconds / replayed_s,
    )
