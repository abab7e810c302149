"""A run in time: devices, perception and the pure controller, cycle by cycle, into a log.

This module alone owns the order of things within a cycle. It runs in lockstep with a simulated clock, or in
real time; `gripper_force.jobs.replay` feeds the same controller from a log, in the order it was written.
"""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from gripper_force.config import Config, dump_config
from gripper_force.control.limits import largest_target_n
from gripper_force.control.state_machine import Decision, GraspController, is_open
from gripper_force.errors import ConfigError, DeviceError, GripperError
from gripper_force.fault_injection import Faults, FaultyEstimator, FaultyFile
from gripper_force.interfaces import Devices
from gripper_force.profiles.apply import check_target, correction_of, rig_mismatches
from gripper_force.runtime.assembly import checkpoint_of, make_controller, make_estimator, settled
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log import LogWriter
from gripper_force.runtime.log_queue import LogQueue
from gripper_force.runtime.monitors import CounterMonitor, LoadCellMonitor
from gripper_force.runtime.perception import Estimator, LockstepPerception, Perception, ThreadedPerception
from gripper_force.runtime.priority import real_time_priority
from gripper_force.types import (
    NS_PER_S,
    Event,
    GraspStatus,
    LoadCellSample,
    Outcome,
    Phase,
    Request,
    RequestKind,
)

if TYPE_CHECKING:  # a run without vision loads none of it
    from gripper_force.profiles.correction import Correction
    from gripper_force.vision.estimator import ForceEstimator
    from gripper_force.vision.header import Model

_VISION_PATIENCE_NS = 2 * NS_PER_S
_REFERENCE_NS = NS_PER_S // 10
"""Every run begins with frames that show no contact, so that its log can be replayed with vision."""

_OPENING_NS = 5 * NS_PER_S
"""How long jaws may take to open."""

_REALTIME_SWITCH_S = 2e-4
_PACKAGES = ("gripper-force", "dynamixel-sdk", "mujoco", "numpy", "torch")
_OWN_PACKAGE = ("openvino", "onnxruntime")
"""Engines that a package of their own name computes."""

Progress = Callable[[GraspStatus], None]


class Session:
    """One controller on one set of devices.

    Attributes:
        has_vision: Whether there was a visual estimate yet.
        failed: Whether the run is at fault, so that it is to end as ``control.on_fault`` says.
        cycles: Cycles run.
        frames: Frames logged.
        last_load_cell_sample: The newest valid sample of the load cell, or None.
    """

    def __init__(
        self,
        config: Config,
        devices: Devices,
        controller: GraspController,
        perception: Perception,
        log_queue: LogQueue,
    ) -> None:
        self._config, self._devices = config, devices
        self._controller, self._perception, self._log_queue = controller, perception, log_queue
        self._period_ns = round(NS_PER_S / config.control.rate_hz)
        self._due_ns = 0
        self._stop = threading.Event()
        self._interrupted = False
        self._counter_monitors = {unit: CounterMonitor() for unit in ("servo", "camera", "load_cell")}
        self._problem = ""
        self._load_cell_monitor = LoadCellMonitor()
        self._error: BaseException | None = None
        self._armed = False
        self.failed = False
        self.has_vision = False
        self.cycles = self.frames = 0
        self.last_load_cell_sample: LoadCellSample | None = None

    @property
    def lost_records(self) -> int:
        """Records that the log lacks, because the disk failed or was too slow."""
        return self._log_queue.lost

    def start(self) -> None:
        """Arms the servo and starts the sensors."""
        for sensor in (self._devices.camera, self._devices.load_cell):
            if sensor is not None:
                sensor.start()
        self._devices.servo.start()  # where this raises, it has turned torque off itself
        self._armed = True
        self._perception.start()
        self._due_ns = self._devices.clock.now_ns()

    def stop_soon(self) -> None:
        """Makes the next cycle a stop, whatever else was asked. Any thread or signal handler may call it."""
        self._stop.set()

    def interrupt(self) -> None:
        """Makes the next cycle raise `KeyboardInterrupt` before it talks to the servo.

        Raises:
            KeyboardInterrupt: The one asked for before has not come yet.
        """
        if self._interrupted:
            raise KeyboardInterrupt
        self._interrupted = True

    def end_if_interrupted(self) -> None:
        """Raises the `KeyboardInterrupt` that is due, if one is."""
        if self._interrupted:
            self._interrupted = False
            raise KeyboardInterrupt("the run was interrupted")

    def cycle(self, kind: RequestKind | None = None, target_n: float = 0.0) -> Decision:
        """Waits for the next cycle and runs it: read, see, decide, write, log.

        Args:
            kind: A new request, or None to go on as before.
            target_n: Wanted force of a grasp.

        Raises:
            DeviceError: The servo was lost or does not answer.
            KeyboardInterrupt: See `interrupt`.
            GripperError: A sensor or the simulated world failed, or the first frames gave no estimate.
        """
        devices, log = self._devices, self._log_queue.write
        devices.clock.sleep_until_ns(self._due_ns)
        self._due_ns = max(self._due_ns + self._period_ns, devices.clock.now_ns() - self._period_ns)
        self.end_if_interrupted()
        devices.check()
        visual = None
        for seen in self._perception.poll():
            log(seen.frame)
            self.frames += 1
            if seen.visual is not None:
                visual = seen.visual
                log(visual)
                self.has_vision = True
            if seen.problem not in ("", self._problem):
                log(Event(seen.frame.received_ns, "vision", f"no estimate: {seen.problem}"))
            self._problem = seen.problem
        state = devices.servo.read()
        request = self._request(state.t_ns, kind, target_n)
        decision = self._controller.step(state.t_ns, state, visual, request)
        devices.servo.write(decision.command)
        self.cycles += 1
        self.failed = decision.status.phase == Phase.FAULT
        if request is not None:
            log(request)
        log(state)
        log(decision.estimate)
        log(decision.command)
        log(decision.status)
        for event in decision.events:
            log(event)
        self._log_sensors(state.t_ns)
        return decision

    def fail(self, error: BaseException) -> None:
        """Takes note of what ends the run; Ctrl-C is no fault."""
        self._error = error
        self.failed |= isinstance(error, Exception)
        self._log_queue.write(
            Event(self._devices.clock.now_ns(), "session", f"{type(error).__name__}: {error}")
        )

    def close(self) -> None:
        """Torque off, or hold, as configured; the log keeps what the load cell still had to say."""
        hold = self._config.control.on_fault if self.failed else self._config.on_exit
        try:
            if self._armed:
                self._devices.servo.stop(hold=hold == "hold")
        except DeviceError as second:
            first = self._error
            if not isinstance(first, GripperError):
                raise
            raise type(first)(f"{first}; nor could it be stopped: {second}") from first
        finally:
            self._perception.close()
        self._log_sensors(self._devices.clock.now_ns(), at_end=True)

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        """Adds a file to the log."""
        self._log_queue.attach(name, data, media_type)

    def _request(self, t_ns: int, kind: RequestKind | None, target_n: float) -> Request | None:
        if self._stop.is_set():
            self._stop.clear()
            return Request(t_ns, RequestKind.STOP)
        return None if kind is None else Request(t_ns, kind, target_n)

    def _log_sensors(self, t_ns: int, *, at_end: bool = False) -> None:
        devices = self._devices
        if devices.load_cell is not None:
            samples = devices.load_cell.drain()
            for sample in samples:
                self._log_queue.write(sample)
                if sample.valid:
                    self.last_load_cell_sample = sample
            if text := self._load_cell_monitor.update(t_ns, samples):
                self._log_queue.write(Event(t_ns, "load_cell", text))
        counts = {"servo": {"bus retries": devices.servo.stats.retries}}
        if devices.camera is not None:
            counts["camera"] = devices.camera.counts()
        if devices.load_cell is not None:
            counts["load_cell"] = devices.load_cell.counts()
        for unit, count in counts.items():
            if text := self._counter_monitors[unit].update(t_ns, count, at_end=at_end):
                self._log_queue.write(Event(t_ns, unit, text))


@contextmanager
def open_session(
    config: Config, devices: Devices, path: Path, checkpoint: "Model | None"
) -> Iterator[Session]:
    """A session that runs, and on every way out stops the servo as configured and closes its log.

    A session that never came to a cycle leaves no log.
    """
    config, why = settled(config) if checkpoint is not None else (config, "")
    config, controller = make_controller(config, devices)
    correction = correction_of(config, checkpoint)
    estimator = make_estimator(config, checkpoint, correction)
    with ExitStack() as stack:
        log_queue = _recorder(config, devices, path, checkpoint, correction)
        for unit, text in (("vision", why), ("simulation", devices.notes.get("detail"))):
            if text:
                log_queue.write(Event(devices.start_ns, unit, text))
        session = Session(config, devices, controller, _perception(config, devices, estimator), log_queue)
        stack.callback(_discard_unused, session, path)
        stack.callback(log_queue.close)
        if not devices.lockstep:
            # Python's default lets a thread that computes keep the control thread waiting for 5 ms.
            stack.callback(sys.setswitchinterval, sys.getswitchinterval())
            sys.setswitchinterval(_REALTIME_SWITCH_S)
            if refusal := stack.enter_context(real_time_priority()):
                log_queue.write(Event(devices.start_ns, "session", refusal))
        stack.callback(_attach_reference, session, estimator)
        stack.enter_context(_signals_wait(session))
        stack.callback(session.close)
        try:
            session.start()
            yield session
        except BaseException as error:
            session.fail(error)
            raise
    log_queue.raise_losses()


@contextmanager
def _signals_wait(session: Session) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the run between two cycles, as one within a bus transaction would leave it torn.

    A second one, while the first still waits, ends it at once.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers, and only there do they raise
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: session.interrupt()) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
    session.end_if_interrupted()


def run_grasp(config: Config, path: Path, progress: Progress | None = None) -> None:
    """Grasps, holds, releases and writes the log.

    Args:
        config: The run.
        path: Log to write.
        progress: Called after each change of phase.

    Raises:
        ConfigError: The target is over the force limit, or more than a profile was calibrated with.
        GripperError: Something failed. The servo was stopped as configured, and the log holds what was seen.
    """
    _check_target(config)
    checkpoint = checkpoint_of(config)
    with open_devices(config) as devices, open_session(config, devices, path, checkpoint) as session:
        grasp_in(session, config, checkpoint is not None, progress)


def _check_target(config: Config) -> None:
    limit_n = config.control.force_limit_n
    if config.target_n > largest_target_n(limit_n):
        raise ConfigError(
            f"target_n {config.target_n:g} N is too near to control.force_limit_n {limit_n:g} N; ask for at "
            f"most {largest_target_n(limit_n):g} N, or raise the limit"
        )
    check_target(config)


def grasp_in(session: Session, config: Config, has_vision: bool, progress: Progress | None = None) -> str:
    """Grasps, holds and releases in a session that is open; see `run_grasp`. Returns the outcome."""
    decision = session.cycle()
    start_ns = last_ns = decision.status.t_ns
    while last_ns - start_ns < (
        _VISION_PATIENCE_NS if has_vision and not session.has_vision else _REFERENCE_NS
    ):
        last_ns = session.cycle().status.t_ns
    decision = session.cycle(RequestKind.GRASP, config.target_n)
    phase = ""
    ended_ns: int | None = None
    while True:
        status = decision.status
        if progress is not None and status.phase != phase:
            progress(status)
        phase = status.phase
        if status.outcome != Outcome.NONE and ended_ns is None:
            ended_ns = status.t_ns
        if ended_ns is not None:
            keep_s = config.control.hold_s if status.outcome == Outcome.HELD else 0.0
            if status.t_ns - ended_ns >= keep_s * NS_PER_S:
                break
        decision = session.cycle()
    if status.outcome == Outcome.FAULT:
        if config.control.on_fault == "open":
            let_open(session, config, status)
        return status.outcome  # otherwise nothing moves until somebody has looked
    if config.on_exit == "hold":
        return status.outcome
    status = release(session, config)
    if progress is not None:
        progress(status)
    return status.outcome


def release(session: Session, config: Config) -> GraspStatus:
    """Opens the jaws and returns how far that came: an object that catches on them can keep them closed."""
    return let_open(session, config, session.cycle(RequestKind.RELEASE).status)


def let_open(session: Session, config: Config, status: GraspStatus) -> GraspStatus:
    """Goes on until jaws that are opening are open, or have had their time. Returns how far that came."""
    end_ns = status.t_ns + _OPENING_NS
    while status.t_ns < end_ns and not is_open(config.gripper.open_width_m, status.width_m):
        status = session.cycle().status
    return status


def _recorder(
    config: Config,
    devices: Devices,
    path: Path,
    checkpoint: "Model | None",
    correction: "Correction | None",
) -> LogQueue:
    about = _metadata(config, devices, checkpoint)
    if correction is not None:
        about["profile"] = correction.profile.weights
    faults, clock, lockstep = Faults(config.faults, devices.start_ns), devices.clock, devices.lockstep

    def wrap_file(file: BinaryIO) -> BinaryIO:
        return (
            cast(BinaryIO, FaultyFile(file, faults, clock, lockstep=lockstep)) if faults.has("disk") else file
        )

    differ = {
        "object profile": () if correction is None else correction.differs,
        "rig profile": rig_mismatches(config),
    }
    log = LogWriter(path, config=dump_config(config), metadata=about, wrap_file=wrap_file)
    log_queue = LogQueue(log, lockstep=lockstep)
    for profile, found in differ.items():
        if found:
            log_queue.write(Event(devices.start_ns, "session", f"the {profile} is of {'; '.join(found)}"))
    return log_queue


def _perception(config: Config, devices: Devices, estimator: Estimator | None) -> Perception:
    faults = Faults(config.faults, devices.start_ns)
    if estimator is not None and faults.has("estimator"):
        estimator = FaultyEstimator(estimator, faults, devices.clock, lockstep=devices.lockstep)
    if devices.lockstep:
        return LockstepPerception(devices.camera, estimator, devices.clock, config.vision.lockstep_compute_ms)
    return ThreadedPerception(devices.camera, estimator, devices.clock)


def _metadata(config: Config, devices: Devices, checkpoint: "Model | None") -> dict[str, str]:
    engine = config.vision.engine if checkpoint else ""
    packages = (*_PACKAGES, engine) if engine in _OWN_PACKAGE else _PACKAGES
    versions = {f"version {name}": metadata.version(name) for name in packages}
    return {
        "object": config.object,
        "set": f"{config.object}-{config.seed}",
        "clock": config.clock,
        "checkpoint": checkpoint.digest if checkpoint else "",
        "python": sys.version.split()[0],
        **versions,
        **devices.notes,
    }


def _discard_unused(session: Session, path: Path) -> None:
    if session.cycles == 0:
        path.unlink(missing_ok=True)


def _attach_reference(session: Session, estimator: "ForceEstimator | None") -> None:
    if estimator is not None and (reference := estimator.reference) is not None:
        import cv2

        png: Any = cv2.imencode(".png", reference)[1]
        session.attach("reference.png", png.tobytes(), "image/png")
