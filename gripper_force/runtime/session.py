"""The control cycle of a run: devices, perception, the pure controller, and the log.

This module alone defines the order within a cycle. It runs in lockstep with a simulated clock, or in real
time; `gripper_force.jobs.replay` feeds the same controller from a log, in the order in which it was written.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from gripper_force.config import Config, dump_config
from gripper_force.control.state_machine import Decision, GraspController, is_open
from gripper_force.errors import DeviceError, DeviceTimeoutError, GripperError
from gripper_force.interfaces import Devices, SharedPort
from gripper_force.plugins import wrong_result
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log_codecs import UTC_NAME
from gripper_force.runtime.log_queue import LogQueue
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.runtime.monitors import CounterMonitor, LoadCellMonitor
from gripper_force.runtime.perception import Estimator, LockstepPerception, Perception, ThreadedPerception
from gripper_force.runtime.process import deferred_signals, keep_in_forks, real_time_settings
from gripper_force.runtime.reading import read_patiently
from gripper_force.runtime.resolve import ResolvedConfig, make_controller, make_estimator, resolve
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    Event,
    Frame,
    GraspStatus,
    LoadCellSample,
    Outcome,
    Phase,
    Record,
    Request,
    RequestKind,
    ServoState,
    VisualForce,
)

if TYPE_CHECKING:  # a run without vision imports none of it
    from gripper_force.vision.estimator import ForceEstimator

_VISION_WAIT_NS: Final = 5 * NS_PER_S
"""Longest wait for the first visual estimate, in addition to the time of its frames."""

_REFERENCE_NS: Final = NS_PER_S // 10
"""Every run starts with frames without contact, so that its log can be replayed with vision."""

_BLOCKED_SPARE_S: Final = 0.5
"""Wait for opening jaws beyond the time after which the controller says that they are blocked."""

_GAP_CYCLES: Final = 2.5
"""A gap between two readings that is longer than this many cycles is logged."""

NO_ESTIMATE: Final = "no estimate: "
"""Start of the text of an event that says why a frame gave no estimate."""

_NUMBER: Final = re.compile(r"[\d.]+")

_PACKAGES: Final = ("gripper-force", "dynamixel-sdk", "mujoco", "numpy", "torch")
_ENGINE_PACKAGES: Final = ("openvino", "onnxruntime")
"""Engines whose package has the engine's name."""


class Session:
    """One controller on one set of devices.

    Attributes:
        resolved: The resolved configuration.
        opening_s: Longest time in which the jaws open.
        timeout_s: Returns the time after which a grasp with a target force has timed out.
        has_vision: True once there was a visual estimate.
        failed: True if the run is at fault, so that it ends as ``control.on_fault`` says.
        reason: Newest reason of a change of phase or outcome.
        cycles: Number of cycles so far.
        frames: Number of frames so far.
        newest_frame: The newest frame, or None.
        servo_state: The newest reading of the servo, or None.
        last_load_cell_sample: The newest valid sample of the load cell, or None.
    """

    def __init__(
        self,
        resolved: ResolvedConfig,
        devices: Devices,
        controller: GraspController,
        perception: Perception,
        log_queue: LogQueue | None,
        raise_if_cancelled: Callable[[], None],
    ) -> None:
        self.resolved, self._devices = resolved, devices
        self._controller, self._perception, self._log_queue = controller, perception, log_queue
        self.opening_s, self.timeout_s = controller.opening_s, controller.timeout_s
        self._period_ns = round(NS_PER_S / resolved.config.control.rate_hz)
        self._due_ns = 0
        self._stop_requested = False
        self._raise_if_cancelled = raise_if_cancelled
        self._interrupted = False
        self._counter_monitors = {unit: CounterMonitor() for unit in ("servo", "camera", "load_cell")}
        self._load_cell_monitor = LoadCellMonitor()
        self._last_problem = ""
        self._error: BaseException | None = None
        self._armed = self._may_open = False
        self.failed = False
        self.reason = ""
        self.has_vision = False
        self.cycles = self.frames = 0
        self.newest_frame: Frame | None = None
        self.servo_state: ServoState | None = None
        self.last_load_cell_sample: LoadCellSample | None = None

    @property
    def lost_records(self) -> int:
        """Number of records missing from the log because the disk failed or was too slow."""
        return 0 if self._log_queue is None else self._log_queue.lost

    def start(self) -> None:
        """Starts the sensors and arms the servo, unless the run is interrupted or cancelled before.

        Raises:
            DeviceError: A device does not start, or the jaws are outside their travel.
        """
        for sensor in (self._devices.camera, self._devices.load_cell):
            self._raise_if_ended()
            if sensor is not None:
                sensor.start()
        self._raise_if_ended()
        state = self._devices.servo.start()  # if it raises, it has turned torque off itself
        self._armed = True
        if problem := wrong_result(state, "ServoState", self._devices.clock.now_ns):
            # A user's class returned it, and its torque is on. Only a session can turn it off as configured.
            name = self.resolved.config.servo.backend
            raise DeviceError(f"servo.backend={name}: start() returned {problem}; return a ServoState")
        if problem := self._controller.start_problem(state):
            raise DeviceError(problem)
        self._perception.start()
        self._due_ns = self._devices.clock.now_ns()

    def _raise_if_ended(self) -> None:
        self.raise_if_interrupted()
        self._raise_if_cancelled()

    def wait_for_reference(self) -> Decision:
        """Runs cycles until the reference frames are taken and, with vision, an estimate exists.

        Raises:
            DeviceTimeoutError: The camera gives too few frames. Later ones may show contact, so they are no reference.
        """
        decision = self.cycle()
        start_ns = last_ns = decision.status.t_ns
        frames = 0 if self.resolved.model is None else self.resolved.model.header.preprocess.lead_in + 1
        wait_ns = _VISION_WAIT_NS + round(frames / self.resolved.config.camera.rate_hz * NS_PER_S)
        while last_ns - start_ns < (wait_ns if frames and not self.has_vision else _REFERENCE_NS):
            self._raise_if_cancelled()
            decision = self.cycle()
            last_ns = decision.status.t_ns
        if frames and not self.has_vision:
            raise DeviceTimeoutError(
                f"no visual estimate after {wait_ns / NS_PER_S:.3g} s and {self.frames} frames; the network needs "
                f"{frames} before the first contact: check the camera and camera.rate_hz, or set vision.checkpoint=none"
            )
        return decision

    def stop_soon(self) -> None:
        """Makes the next cycle a stop, before any other request. Any thread or signal handler may call it."""
        self._stop_requested = True

    def interrupt(self, even_at_end: bool = True) -> None:
        """Makes the next cycle raise `KeyboardInterrupt` before it accesses the servo.

        Args:
            even_at_end: False: has no effect once the run is ending.

        Raises:
            KeyboardInterrupt: An earlier interrupt is still pending.
        """
        if self._interrupted and even_at_end:
            raise KeyboardInterrupt
        self._interrupted |= even_at_end or self._error is None

    def raise_if_interrupted(self) -> None:
        """Raises the pending `KeyboardInterrupt`, if there is one."""
        if self._interrupted:
            self._interrupted = False
            raise KeyboardInterrupt("the run was interrupted")

    def cycle(
        self,
        kind: RequestKind | None = None,
        target_n: float = 0.0,
        width_m: float = 0.0,
        *,
        new_object: bool = False,
    ) -> Decision:
        """Waits for the next cycle and runs it: read, estimate, decide, write, log.

        Args:
            kind: A new request, or None to go on as before.
            target_n: Target force of a grasp request.
            width_m: Width of a move request.
            new_object: True for the grasp of another object than in the grasps before.

        Raises:
            DeviceError: The servo is lost, or does not answer for as long as its watchdog waits.
            KeyboardInterrupt: See `interrupt`.
            GripperError: A sensor or the simulated world failed, or the first frames gave no estimate.
        """
        devices = self._devices
        devices.clock.sleep_until_ns(self._due_ns)
        self._due_ns = max(self._due_ns + self._period_ns, devices.clock.now_ns() - self._period_ns)
        self.raise_if_interrupted()
        devices.check()
        visual = self._poll_perception()
        self._may_open = False  # if this cycle fails from here on, nothing is known of the servo
        state = self.servo_state = self._read_servo()
        request = None if kind is None else Request(state.t_ns, kind, target_n, width_m, new_object)
        if self._stop_requested:
            self._stop_requested, request = False, Request(state.t_ns, RequestKind.STOP)
        decision = self._controller.step(state.t_ns, state, visual, request)
        # Before the write, as in a replay: the log has a frame that is processed meanwhile after this cycle.
        if request is not None and request.new_object and not decision.refusal:
            self._perception.processor.renewal_ns = state.t_ns
        devices.servo.write(decision.command)
        self.cycles += 1
        self.failed = decision.status.phase == Phase.FAULT
        self.reason = decision.status.reason or self.reason
        self._may_open = decision.status.phase != Phase.OPEN and not state.hardware_error
        inputs: tuple[Record, ...] = (state,) if request is None else (request, state)
        for record in (*inputs, decision.estimate, decision.command, decision.status, *decision.events):
            self._log(record)
        self._log_sensors(state.t_ns)
        return decision

    def _poll_perception(self) -> VisualForce | None:
        """Logs the frames that became ready, and returns the newest visual estimate, or None."""
        visual = None
        # A lost camera would raise again while the jaws open at the end.
        for processed in self._perception.poll() if self._error is None else ():
            self._log(processed.frame)
            self.frames += 1
            self.newest_frame = processed.frame
            if processed.visual is not None:
                visual = processed.visual
                self._log(visual)
                self.has_vision = True
            if processed.attention is not None:
                self._log(processed.attention)
            kind_of_problem = _NUMBER.sub("", processed.problem)  # one event, although its numbers change
            if kind_of_problem not in ("", self._last_problem):
                self._log(Event(processed.frame.received_ns, "vision", NO_ESTIMATE + processed.problem))
            self._last_problem = kind_of_problem
        return visual

    def _read_servo(self) -> ServoState:
        devices = self._devices
        state = read_patiently(
            devices.servo,
            devices.clock,
            self.servo_state,
            period_ns=self._period_ns,
            patience_ns=self.resolved.config.servo.bus_watchdog_ms * NS_PER_MS,
            before_retry=self.raise_if_interrupted,
        )
        if self.servo_state is not None:
            gap_ns = state.t_ns - self.servo_state.t_ns
            if gap_ns > _GAP_CYCLES * self._period_ns:
                self._log(Event(state.t_ns, "servo", f"no answer for {gap_ns / NS_PER_MS:.0f} ms"))
        return state

    def release(self) -> GraspStatus:
        """Opens the jaws. Returns the last status; its outcome is ``blocked`` if they did not open."""
        return self.wait_until_open(self.cycle(RequestKind.RELEASE).status)

    def wait_until_open(self, status: GraspStatus) -> GraspStatus:
        """Runs cycles until opening jaws are open or blocked, or for `opening_s`. Returns the last status."""
        open_width_m = self.resolved.config.gripper.open_width_m
        end_ns = status.t_ns + round((self.opening_s + _BLOCKED_SPARE_S) * NS_PER_S)
        while status.t_ns < end_ns and not is_open(open_width_m, status.width_m):
            status = self.cycle().status
            if status.outcome == Outcome.BLOCKED:
                break
        return status

    def fail(self, error: BaseException) -> None:
        """Logs the exception that ended the run. Only an `Exception` marks the run as failed."""
        self._error = error
        self.failed |= isinstance(error, Exception)
        self.log_event("session", f"{type(error).__name__}: {error}")

    @property
    def _end_action(self) -> str:
        """Value of ``control.on_fault`` or ``on_exit`` that applies to the end of this run."""
        config = self.resolved.config
        return config.control.on_fault if self.failed or self._stop_requested else config.on_exit

    def open_at_fault(self) -> None:
        """Opens the jaws at the end of a run, with ``control.on_fault=open`` after a fault, a stop or an exception.

        Not if the servo is lost or has switched off, nor if nothing was requested since the jaws were open. It takes
        `opening_s` at most.
        """
        if self._end_action == "open" and self._may_open:
            self.stop_soon()
            try:
                self.wait_until_open(self.cycle().status)
            except GripperError as error:
                self.log_event("session", f"the jaws did not open: {error}")

    def close(self) -> None:
        """Turns torque off, or holds, as configured, and logs the camera's settings and the last samples."""
        try:
            if self._armed:
                self._devices.servo.stop(hold=self._end_action == "hold")
        except DeviceError as error:
            cause, self._error = self._error, error
            if not isinstance(cause, GripperError):
                raise
            raise type(cause)(f"{cause}; and the servo could not be stopped: {error}") from cause
        finally:
            self._perception.close()
            self._log_sensors(self._devices.clock.now_ns(), at_end=True)

    def log_event(self, unit: str, text: str) -> None:
        """Logs one sentence about a unit, such as ``control``."""
        self._log(Event(self._devices.clock.now_ns(), unit, text))

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        """Adds a file to the log."""
        if self._log_queue is not None:
            self._log_queue.attach(name, data, media_type)

    def _log(self, record: Record) -> None:
        if self._log_queue is not None:
            self._log_queue.write(record)

    def _log_sensors(self, t_ns: int, *, at_end: bool = False) -> None:
        devices = self._devices
        # After an error, one of a sensor would end the opening of the jaws, or hide the first error.
        with nullcontext() if self._error is None else suppress(GripperError):
            if devices.load_cell is not None:
                samples = devices.load_cell.drain()
                for sample in samples:
                    self._log(sample)
                    if sample.valid:
                        self.last_load_cell_sample = sample
                if text := self._load_cell_monitor.update(t_ns, samples):
                    self._log(Event(t_ns, "load_cell", text))
            counts = {"servo": {"bus retries": devices.servo.stats.retries}}
            if devices.camera is not None:
                counts["camera"] = devices.camera.counts()
            if devices.load_cell is not None:
                counts["load_cell"] = devices.load_cell.counts()
            for unit, count in counts.items():
                if text := self._counter_monitors[unit].update(t_ns, count, at_end=at_end):
                    self._log(Event(t_ns, unit, text))
            if at_end and callable(settings := getattr(devices.camera, "settings", None)):
                text = json.dumps(
                    settings(), default=lambda v: getattr(v, "tolist", v.__repr__)(), skipkeys=True
                )
                self.attach("camera.json", text.encode(), "application/json")


@contextmanager
def open_run(
    config: Config | ResolvedConfig,
    path: Path | None,
    *,
    vision: bool = True,
    raise_if_cancelled: Callable[[], None] = lambda: None,
    port: SharedPort | None = None,
) -> Iterator[Session]:
    """Resolves a configuration, opens its devices and opens a session on them.

    Args:
        config: The run, resolved or not.
        path: Log to write; None: no log.
        vision: False for a run that only records frames.
        raise_if_cancelled: See `open_session`.
        port: See `open_devices`.

    Raises:
        GripperError: Something is missing or inconsistent, or a device failed.
    """
    resolved = config if isinstance(config, ResolvedConfig) else resolve(config, vision=vision)
    with (
        open_devices(resolved.config, port) as devices,
        open_session(resolved, devices, path, raise_if_cancelled) as session,
    ):
        yield session


@contextmanager
def open_session(
    resolved: ResolvedConfig,
    devices: Devices,
    path: Path | None,
    raise_if_cancelled: Callable[[], None] = lambda: None,
) -> Iterator[Session]:
    """Opens a session, and at the end stops the servo as configured and closes the log.

    A session without a single cycle leaves no log.

    Args:
        resolved: The resolved configuration.
        devices: Its devices.
        path: Log to write; None: no log.
        raise_if_cancelled: Raises if the run is to end already. Called before each device starts, the servo
            last, and in each cycle of `Session.wait_for_reference`.

    Raises:
        GripperError: A device failed.
        LogError: After the run: records are missing from the log.
    """
    controller = make_controller(resolved.config)
    estimator = make_estimator(resolved)
    with ExitStack() as stack:
        log_queue = None if path is None else _open_log(resolved, devices, path)
        perception = _perception(resolved.config, devices, estimator)
        session = Session(resolved, devices, controller, perception, log_queue, raise_if_cancelled)
        if path is not None and log_queue is not None:
            stack.callback(_discard_unused, session, path)
            stack.callback(log_queue.close)
            for unit, text in resolved.notes:
                log_queue.write(Event(devices.start_ns, unit, text))
        if not devices.lockstep and (refusal := stack.enter_context(real_time_settings())):
            session._log(Event(devices.start_ns, "session", refusal))
        stack.callback(_attach_reference, session, estimator)
        stack.enter_context(_interruptible(session))
        stack.callback(session.close)
        stack.callback(session.open_at_fault)
        stack.push(lambda _kind, error, _trace: None if error is None else session.fail(error))
        keep_in_forks(stack)
        session.start()
        yield session
    if log_queue is not None:
        log_queue.raise_losses()


@contextmanager
def _interruptible(session: Session) -> Iterator[None]:
    with deferred_signals(session.interrupt):
        yield
    session.raise_if_interrupted()


def _open_log(resolved: ResolvedConfig, devices: Devices, path: Path) -> LogQueue:
    config, metadata = dump_config(resolved.config), _metadata(resolved, devices)
    log = LogWriter(path, config=config, metadata=metadata, wrap_file=devices.wrap_file)
    return LogQueue(log, lockstep=devices.lockstep)


def _perception(config: Config, devices: Devices, estimator: Estimator | None) -> Perception:
    if estimator is not None and devices.wrap_estimator is not None:
        estimator = devices.wrap_estimator(estimator)
    if devices.lockstep:
        return LockstepPerception(devices.camera, estimator, devices.clock, config.vision.lockstep_compute_ms)
    return ThreadedPerception(devices.camera, estimator, devices.clock)


def _metadata(resolved: ResolvedConfig, devices: Devices) -> dict[str, str]:
    config, clock = resolved.config, devices.clock
    utc = {} if devices.lockstep else {UTC_NAME: str(time.time_ns() - clock.now_ns())}
    engine = config.vision.engine if resolved.model else ""
    packages = (*_PACKAGES, engine) if engine in _ENGINE_PACKAGES else _PACKAGES
    profile = {} if resolved.correction is None else {"profile": resolved.correction.profile.weights}
    return {
        "object": config.object,
        "clock": config.clock,
        "checkpoint": resolved.model.digest if resolved.model else "",
        "choices": "\n".join(resolved.choices),
        "python": sys.version.split()[0],
        **{f"version {name}": d.version for name in packages for d in metadata.distributions(name=name)},
        **devices.notes,
        **profile,
        **utc,
    }


def _discard_unused(session: Session, path: Path) -> None:
    if session.cycles == 0:
        path.unlink(missing_ok=True)


def _attach_reference(session: Session, estimator: ForceEstimator | None) -> None:
    if estimator is not None and (reference := estimator.reference) is not None:
        import cv2

        png: Any = cv2.imencode(".png", reference)[1]
        session.attach("reference.png", png.tobytes(), "image/png")
