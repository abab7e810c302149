"""The control loop in real time: lateness of its cycles with and without inference, and a viewer, in parallel.

It runs the code of a real gripper: the session, the servo driver, the camera thread and the log. A virtual
servo answers from another process over a pseudo-terminal, and the camera repeats a recording, so no physics
is computed during the measurement.
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
from gripper_force.errors import GripperError
from gripper_force.interfaces import Devices, Servo
from gripper_force.jobs.grasp import run_grasp
from gripper_force.jobs.replay.feed import resolve_replay, run_again
from gripper_force.jobs.view import beside_run, require
from gripper_force.qualification.bench import foxglove_client
from gripper_force.qualification.bench.startup_bench import LONG_TIMEOUTS
from gripper_force.runtime.backends import MonotonicClock, load_servo_class
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import open_session
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, RequestKind, ServoCommand, ServoState, VisualForce

_TURN_S: Final = 10.0
"""Duration of one of the two loops before the other's turn."""

_REQUEST_S: Final = 2.0
"""Time for which the jaws close, and then open."""

_LATENCY_NS: Final = 10 * NS_PER_MS
"""Latency of the camera."""

_RECORDING: Final = (
    *("object=stapler", "seed=7", "sim.detail=coarse", "target_n=4"),
    *("vision.checkpoint=none", "control.feedback=current", "load_cell.backend=none", "clock=lockstep"),
)
"""Configuration of the grasp that the camera repeats."""


@dataclass(frozen=True, slots=True)
class LoopCost:
    """Timing of a loop.

    Attributes:
        beside: Load in parallel: ``vision``, ``nothing``, or vision with a viewer, such as ``vision, rerun``.
        cycles: Cycles run.
        missed: Periods that were skipped, or whose cycle began a whole period late.
        lost_records: Records that the log lacks.
        late_p50_ms: Median lateness of a cycle's begin.
        late_p99_ms: 99th percentile of the lateness.
        late_max_ms: Largest lateness.
        bus_p50_ms: Median time of reading and writing the servo in a cycle.
        bus_p99_ms: 99th percentile of the bus time.
        cycle_p50_ms: Median time of a whole cycle.
        cycle_p99_ms: 99th percentile of the cycle time.
        estimator_p50_ms: Median time of an estimate; NaN without vision.
        estimator_p99_ms: 99th percentile of the estimate's time.
        estimates_hz: Estimates per second.
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
    """Cost of a run's log.

    Attributes:
        run_mb_s: MB per second written by the run with vision.
        write_mb_s: MB per second when the same records are written as fast as possible.
        record_us: Mean time of writing a record.
        replay_times: Duration of the run over the time of replaying estimator and controller on its log.
    """

    run_mb_s: float
    write_mb_s: float
    record_us: float
    replay_times: float


@dataclass(slots=True)
class _Measured:
    """Measurements of one loop so far."""

    late_ns: list[int] = field(default_factory=list)
    bus_ns: list[int] = field(default_factory=list)
    cycle_ns: list[int] = field(default_factory=list)
    compute_ms: list[float] = field(default_factory=list)
    skipped: int = 0
    lost: int = 0


class _Clock(MonotonicClock):
    """Host clock that records how late a sleep ends. A wait over more than a period counts skipped periods."""

    def __init__(self, period_ns: int, measured: _Measured) -> None:
        self._period_ns, self._measured = period_ns, measured
        self._last_ns = 0
        self.begun_ns = 0

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleeps until a time; returns at once if it is past."""
        MonotonicClock.sleep_until_ns(self, t_ns)
        self.begun_ns = self.now_ns()
        self._measured.late_ns.append(self.begun_ns - t_ns)
        if self._last_ns:
            self._measured.skipped += (t_ns - self._last_ns) // self._period_ns - 1
        self._last_ns = t_ns


class _Servo:
    """Servo that records the bus time of each cycle."""

    def __init__(self, servo: Servo, measured: _Measured) -> None:
        self._servo, self._measured = servo, measured

    def read(self) -> ServoState:
        begin_ns = time.monotonic_ns()
        state = self._servo.read()
        self._measured.bus_ns.append(time.monotonic_ns() - begin_ns)
        return state

    def write(self, command: ServoCommand) -> None:
        begin_ns = time.monotonic_ns()
        self._servo.write(command)
        self._measured.bus_ns[-1] += time.monotonic_ns() - begin_ns

    def __getattr__(self, name: str) -> Any:
        return getattr(self._servo, name)


class _Camera:
    """Camera that repeats frames forward and backward, at the configured rate."""

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
    seconds: float, overrides: list[str], path: Path | None = None, viewer: str | None = None
) -> tuple[tuple[LoopCost, ...], LogCost]:
    """Runs the loop with and without vision in parallel, in turns.

    Args:
        seconds: Duration of each of the two, or three.
        overrides: Configuration keys, such as ``vision.threads=2``.
        path: Configuration file, or None.
        viewer: Viewer to measure as well, with vision; one of `gripper_force.jobs.view.VIEWERS`. Rerun writes a
            file then, because a window's cost depends on the graphics. Foxglove has a client that shows nothing.

    Raises:
        GripperError: The virtual servo did not start, or the configuration is wrong.
    """
    loops = {"vision": _Measured(), "nothing": _Measured()}
    if viewer is not None:
        require(viewer)
        loops[f"vision, {viewer}"] = _Measured()
    turns = max(1, round(seconds / _TURN_S))
    with TemporaryDirectory() as name, _virtual_servo() as port:
        folder = Path(name)
        run_grasp(load_config(path, [*overrides, *_RECORDING]), folder / "recording.mcap")
        frames = list(LogReader(folder / "recording.mcap").records(Frame))
        for turn in range(turns):
            for beside, measured in loops.items():
                no_vision = (
                    ("vision.checkpoint=none", "control.feedback=current") if beside == "nothing" else ()
                )
                settings = [*LONG_TIMEOUTS, *overrides, "clock=realtime", f"servo.port={port}", *no_vision]
                log_path = folder / f"{beside}{turn}.mcap"
                with _viewer(viewer if beside == f"vision, {viewer}" else None, log_path):
                    _run(load_config(path, settings), frames, seconds / turns, log_path, measured)
        log = _log_cost(folder / "vision0.mcap", folder / "again.mcap", seconds / turns)
    period_ns = round(NS_PER_S / load_config(path, overrides).control.rate_hz)
    return tuple(_cost(beside, seconds, period_ns, measured) for beside, measured in loops.items()), log


def _run(config: Config, frames: list[Frame], seconds: float, path: Path, measured: _Measured) -> None:
    """Runs one turn, in which the jaws close and open."""
    resolved = resolve(config)
    config = resolved.config
    clock = _Clock(round(NS_PER_S / config.control.rate_hz), measured)
    with ExitStack() as stack:
        servo = load_servo_class(config)(config.servo, clock.now_ns)
        stack.callback(servo.close)
        devices = Devices(
            clock=clock,
            servo=cast(Servo, _Servo(servo, measured)),
            camera=_Camera(frames, config.camera.rate_hz),
            load_cell=None,
            lockstep=False,
            start_ns=clock.now_ns(),
            check=lambda: None,
        )
        session = stack.enter_context(open_session(resolved, devices, path))
        end_ns = clock.now_ns() + round(seconds * NS_PER_S)
        next_ns, kind = 0, RequestKind.RELEASE
        while (now_ns := clock.now_ns()) < end_ns:
            request = None
            if now_ns >= next_ns:
                request = kind = RequestKind.GRASP if kind == RequestKind.RELEASE else RequestKind.RELEASE
                next_ns = now_ns + round(_REQUEST_S * NS_PER_S)
            session.cycle(request, config.target_n)
            measured.cycle_ns.append(clock.now_ns() - clock.begun_ns)
    measured.lost += session.lost_records
    measured.compute_ms += [visual.compute_ms for visual in LogReader(path).records(VisualForce)]


@contextmanager
def _viewer(viewer: str | None, log_path: Path) -> Iterator[None]:
    """Opens a viewer beside a run, and for Foxglove a client: nobody need open the app."""
    if viewer is None:
        yield
        return
    save = log_path.with_suffix(".rrd") if viewer == "rerun" else None
    clients: list[subprocess.Popen[str]] = []
    try:
        with beside_run(log_path, viewer, _tell, save, lambda url: clients.append(_foxglove_client(url))):
            yield
    finally:
        for client in clients:
            with client:
                client.terminate()


def _tell(text: str) -> None:
    print(text, file=sys.stderr)  # noqa: T201


def _foxglove_client(url: str) -> "subprocess.Popen[str]":
    """Starts a client in a process of its own, and waits until it has subscribed."""
    command = [sys.executable, "-m", foxglove_client.__name__, url]
    client = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert client.stdout is not None
    if not client.stdout.readline():
        problem = client.communicate()[1].strip().rpartition("\n")[2]
        raise GripperError(f"the client could not use the Foxglove server at {url}: {problem}; run it again")
    return client


@contextmanager
def _virtual_servo() -> Iterator[str]:
    """Yields the path of a virtual servo in another process."""
    program = "from gripper_force.cli import main; main()"
    command = [sys.executable, "-c", program, "virtual-servo", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            if not (line := process.stdout.readline()):
                raise GripperError(
                    "the virtual servo did not start; run gripper-force virtual-servo, which says why"
                )
            yield json.loads(line)["port"]
        finally:
            process.terminate()


def _cost(beside: str, seconds: float, period_ns: int, measured: _Measured) -> LoopCost:
    late_ns = np.array(measured.late_ns)
    late_ms = np.percentile(late_ns, (50, 99, 100)) / NS_PER_MS
    bus_ms, cycle_ms = (
        np.percentile(ns, (50, 99)) / NS_PER_MS for ns in (measured.bus_ns, measured.cycle_ns)
    )
    compute_ms = np.percentile(measured.compute_ms or [math.nan], (50, 99))
    missed = measured.skipped + int((late_ns >= period_ns).sum())
    figures = np.concatenate([late_ms, bus_ms, cycle_ms, compute_ms, [len(measured.compute_ms) / seconds]])
    return LoopCost(beside, len(late_ns), missed, measured.lost, *figures.tolist())


def _log_cost(path: Path, again: Path, seconds: float) -> LogCost:
    """Measures writing a run's records again, and replaying them."""
    reader = LogReader(path)
    records = list(reader.records())
    begin_s = time.monotonic()
    with LogWriter(again, config=reader.config, metadata=dict(reader.metadata)) as log:
        for record in records:
            log.write(record)
    writing_s = time.monotonic() - begin_s
    config = config_from_text(reader.config, str(path))
    resolved = resolve_replay(config)
    begin_s = time.monotonic()
    run_again(reader, resolved)
    replaying_s = time.monotonic() - begin_s
    return LogCost(
        run_mb_s=path.stat().st_size / 2**20 / seconds,
        write_mb_s=again.stat().st_size / 2**20 / writing_s,
        record_us=1e6 * writing_s / len(records),
        replay_times=seconds / replaying_s,
    )
