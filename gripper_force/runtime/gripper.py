"""The public interface of a live gripper: `open_gripper` and `Gripper`."""

from __future__ import annotations

import atexit
import contextlib
import itertools
import math
import queue
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, NamedTuple, Self, overload

from gripper_force.config import Config, Overrides, load_config
from gripper_force.control.state_machine import Decision
from gripper_force.errors import ConfigError, DeviceTimeoutError, RequestError
from gripper_force.runtime.process import deferred_signals
from gripper_force.runtime.session import Session, open_run
from gripper_force.types import NS_PER_S, EstimateSource, Frame, LoadCellSample, Outcome, Phase, RequestKind

GRIPPING: Final = (Phase.CONTACT, Phase.RAMP, Phase.HOLD)
"""Phases in which the jaws press on an object."""

_NO_OBJECT: Final = "no object is gripped"

_RELEASE_S: Final = 6.0
"""Longest wait for open jaws: the controller's own limit of 5 s, and some slack."""

_JOIN_S: Final = 25.0
"""Longest wait for the end of the control thread, which may wait 20 s for a disk that does not answer."""


@dataclass(frozen=True, slots=True)
class GraspResult:
    """Result of a grasp or of a change of force.

    Attributes:
        outcome: ``held``, ``no_object``, ``slip``, ``timeout`` or ``fault`` (an `Outcome`).
        force_n: Estimated contact force when the outcome was reached, in newtons.
        std_n: Standard deviation of this estimate, in newtons.
        width_m: Distance between the jaws, in metres.
        vision_share: Share of the control cycles of the hold in which vision was used, 0 to 1.
        reason: The controller's reason for the outcome, one sentence.
    """

    outcome: Outcome
    force_n: float
    std_n: float
    width_m: float
    vision_share: float
    reason: str

    @property
    def held(self) -> bool:
        """True if the object is held with the requested force."""
        return self.outcome == Outcome.HELD


@dataclass(frozen=True, slots=True)
class GripperState:
    """State of the gripper after one control cycle.

    Attributes:
        t_ns: Time of the cycle on the run's clock, in nanoseconds.
        phase: What the controller is doing (a `Phase`).
        outcome: Result of the newest grasp or move; ``Outcome.NONE`` while it is under way.
        reason: Newest reason of a change of phase or outcome.
        reference_n: Force that the loop steers to in this cycle, in newtons.
        force_n: Estimated contact force, in newtons.
        std_n: Its standard deviation, in newtons.
        source: Sensors that the estimate rests on (an `EstimateSource`).
        width_m: Distance between the jaws, in metres.
        position_rad: Angle of the servo horn, in radians.
        current_a: Motor current, in amperes.
        temperature_c: Temperature of the servo, in degrees Celsius.
        voltage_v: Supply voltage, in volts.
        load_cell_n: Newest valid reading of the load cell, in newtons; None without one.
    """

    t_ns: int
    phase: Phase
    outcome: Outcome
    reason: str
    reference_n: float
    force_n: float
    std_n: float
    source: EstimateSource
    width_m: float
    position_rad: float
    current_a: float
    temperature_c: float
    voltage_v: float
    load_cell_n: float | None


class _Request(NamedTuple):
    kind: RequestKind
    number: int
    target_n: float = 0.0
    width_m: float = 0.0
    needs_object: bool = False


def open_gripper(
    config: Config | str | Path | None = None,
    *,
    log: str | Path | None = None,
    overrides: Overrides | None = None,
    background: bool | None = None,
) -> Gripper:
    """Opens the configured gripper, arms its servo, and waits for the first frames.

    Nothing moves before the first request. Use the result in a ``with`` block, or call `Gripper.close`.

    Example::

        with open_gripper("my.yaml", log="run.mcap") as gripper:
            result = gripper.grasp(4.0)
            gripper.set_force(2.0)
            gripper.release()

    Args:
        config: A configuration, or the path of its YAML file; None: the defaults, which are a simulated rig.
        log: MCAP file to write; it must not exist. None: no log.
        overrides: Configuration keys to change: ``{"control.rate_hz": 100}`` or ``["control.rate_hz=100"]``.
        background: True: a thread runs the control cycle. False: the caller does, with `Gripper.step`.
            None: True in real time, False in lockstep.

    Raises:
        ConfigError: A key, value, profile or backend is wrong, or ``background`` is True in lockstep.
        DeviceError: A device is missing, in use, or does not answer.
        SimulationError: The simulated scene cannot be built.
        LogError: The log cannot be written.
    """
    if isinstance(config, Config):
        if overrides:
            raise ConfigError("overrides need a file or the defaults; change the Config itself instead")
        settings = config
    else:
        settings = load_config(config, overrides)
    lockstep = settings.clock == "lockstep"
    if lockstep and background:
        raise ConfigError(
            "clock=lockstep runs in the caller's thread; leave background out, or set clock=realtime"
        )
    if background is None:
        background = not lockstep
    gripper = Gripper(settings, None if log is None else Path(log), background=background)
    gripper._open()
    return gripper


class Gripper:
    """A gripper that holds objects with a requested force. Made by `open_gripper`.

    In real time a background thread runs the control cycle, and every method and attribute may be used from
    any thread. In lockstep, or with ``background=False``, the blocking methods run the cycle in the caller's
    thread; between them the caller runs it with `step` or `sleep`. In real time the servo's Bus Watchdog
    stops the servo if no cycle runs for ``servo.bus_watchdog_ms``.

    A newer request replaces an older one, and `stop` always wins. A refused request raises `RequestError`, a
    failed device `DeviceError`. However the gripper is closed, the servo ends as configured: as ``on_exit``
    says, or as ``control.on_fault`` says after a fault, a stop or an exception.

    In asyncio, call the blocking methods in a thread: ``await asyncio.to_thread(gripper.grasp, 4.0)``.

    Attributes:
        config: The complete configuration: profiles applied, every ``auto`` resolved.
        log: The log's path, or None.
    """

    def __init__(self, config: Config, log: Path | None, *, background: bool) -> None:
        self.config, self.log = config, log
        self._background = background
        self._requests: queue.SimpleQueue[_Request] = queue.SimpleQueue()
        self._numbers = itertools.count(1)
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._run, self._signals = contextlib.ExitStack(), contextlib.ExitStack()
        self._thread: threading.Thread | None = None
        self._session: Session | None = None
        # Written by the thread that runs the control cycle:
        self._state: GripperState | None = None
        self._result: GraspResult | None = None
        self._newest: _Request | None = None
        self._postponed: _Request | None = None
        self._stop_number = 0  # requests with a lower number are older than the newest stop
        self._ended = False  # the control thread
        self._refusal = ""
        self._hold_cycles = self._vision_cycles = 0
        self._error: BaseException | None = None
        # Written by the caller's thread:
        self._error_was_raised = self._closed = False
        self._end_error: BaseException | None = None

    # Requests.

    @overload
    def grasp(self, force_n: float) -> GraspResult: ...
    @overload
    def grasp(self, force_n: float, *, wait: Literal[True]) -> GraspResult: ...
    @overload
    def grasp(self, force_n: float, *, wait: Literal[False]) -> None: ...
    def grasp(self, force_n: float, *, wait: bool = True) -> GraspResult | None:
        """Closes the jaws on an object and holds it with a force. If an object is held, changes the force.

        Args:
            force_n: Target force, in newtons: more than 0 and at most 90 % of ``control.force_limit_n``, and
                at most what the profiles were calibrated with.
            wait: False returns at once; `state` shows the progress.

        Returns:
            The result once the outcome is known; None with ``wait=False``.

        Raises:
            RequestError: The force is out of range, or the gripper is at fault and needs a release first.
            DeviceError: A device failed.
        """
        return self._grip(force_n, wait=wait, needs_object=False)

    @overload
    def set_force(self, force_n: float) -> GraspResult: ...
    @overload
    def set_force(self, force_n: float, *, wait: Literal[True]) -> GraspResult: ...
    @overload
    def set_force(self, force_n: float, *, wait: Literal[False]) -> None: ...
    def set_force(self, force_n: float, *, wait: bool = True) -> GraspResult | None:
        """Raises or lowers the force on a gripped object, without letting go.

        Args:
            force_n: New target force, in newtons; limits as in `grasp`.
            wait: False returns at once.

        Returns:
            The result once the new force is held or the outcome is another; None with ``wait=False``.

        Raises:
            RequestError: No object is gripped, or the force is out of range.
            DeviceError: A device failed.
        """
        if self.state.phase not in GRIPPING:
            raise RequestError(f"{_NO_OBJECT} (phase {self.state.phase}); call grasp first")
        return self._grip(force_n, wait=wait, needs_object=True)

    def move(self, width_m: float, *, wait: bool = True) -> float:
        """Moves the jaws to a width, and lets go of an object if one is gripped.

        The jaws move with ``control.approach_speed_m_s`` and press on an obstacle with at most
        ``control.approach_force_n``.

        Args:
            width_m: Distance between the jaws, in metres: 0 to ``gripper.open_width_m``.
            wait: False returns at once.

        Returns:
            The width reached, in metres; the present width with ``wait=False``. `state` has the outcome:
            ``moved``, or ``blocked`` by an obstacle.

        Raises:
            RequestError: The width is out of range, or the gripper is at fault and needs a release first.
            DeviceError: A device failed.
        """
        request = self._submit(RequestKind.MOVE, width_m=width_m)
        if wait:
            self._wait(request, lambda state: state.outcome != Outcome.NONE)
        return self.width_m

    def release(self, *, wait: bool = True) -> float:
        """Opens the jaws. After a fault or a stop it also resets the fault, once its cause is gone.

        Args:
            wait: False returns at once.

        Returns:
            The width reached, in metres. An object that catches on the jaws can keep them from opening.

        Raises:
            RequestError: The cause of a fault persists.
            DeviceError: A device failed.
        """
        request = self._submit(RequestKind.RELEASE)
        if wait:
            self._wait(request, lambda state: state.phase != Phase.RELEASE, _RELEASE_S)
        return self.width_m

    def stop(self) -> None:
        """Stops the gripper within one control cycle, as ``control.on_fault`` says. Any thread may call it.

        The gripper is then at fault: a waiting `grasp` returns the outcome ``fault``, and only `release`
        resets it. With ``background=False`` the stop takes effect in the next `step`.
        """
        if self._session is not None:
            self._stop_number = next(self._numbers)
            self._session.stop_soon()

    # The control cycle in the caller's thread.

    def step(self) -> GripperState:
        """Runs one control cycle in the caller's thread, when it is due.

        Returns:
            The state after the cycle.

        Raises:
            RequestError: A background thread runs the cycle, or the gripper is closed.
            DeviceError: A device failed.
        """
        if self._background:
            raise RequestError("a background thread runs the control cycle; open with background=False")
        session = self._opened()
        try:
            return self._cycle(session)
        except BaseException as error:
            self._error, self._error_was_raised = error, True
            raise

    def sleep(self, seconds: float) -> None:
        """Lets the gripper work for a time: waits in real time, runs control cycles in lockstep.

        Args:
            seconds: Time on the run's clock.

        Raises:
            DeviceError: A device failed meanwhile.
        """
        if self._background:
            end_s = time.monotonic() + seconds
            with self._changed:
                while (left_s := end_s - time.monotonic()) > 0 and self._error is None and not self._ended:
                    self._changed.wait(left_s)
            self._raise_error()
            return
        end_ns = self.state.t_ns + round(seconds * NS_PER_S)
        while self.step().t_ns < end_ns:
            pass

    # Newest values. None of them blocks.

    @property
    def state(self) -> GripperState:
        """State after the newest control cycle."""
        assert self._state is not None  # `_open` runs the first cycle
        return self._state

    @property
    def force_n(self) -> float:
        """Estimated contact force, in newtons."""
        return self.state.force_n

    @property
    def width_m(self) -> float:
        """Distance between the jaws, in metres."""
        return self.state.width_m

    @property
    def frame(self) -> Frame | None:
        """The newest camera frame, (H, W) uint8 in its ``gray``; None without a camera."""
        return None if self._session is None else self._session.newest_frame

    @property
    def load_cell(self) -> LoadCellSample | None:
        """The newest valid load cell sample; None without a load cell."""
        return None if self._session is None else self._session.last_load_cell_sample

    # Opening and closing.

    def close(self) -> None:
        """Ends the run: the servo ends as configured, devices and log are closed. May be called twice.

        Raises:
            DeviceError: A device failed since the last call, or the servo could not be stopped.
            LogError: Records are missing from the log.
        """
        self._close(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close(error)

    def _open(self) -> None:
        atexit.register(self._close_at_exit)  # for a program that ends without closing the gripper
        try:
            if self._background:
                self._signals.enter_context(deferred_signals(_interrupt))
                self._thread = threading.Thread(target=self._run_thread, name="control", daemon=True)
                with self._changed:
                    self._thread.start()
                    self._changed.wait_for(lambda: self._state is not None or self._error is not None)
                self._raise_error()
            else:
                self._start(self._run.enter_context(open_run(self.config, self.log)))
        except BaseException as error:
            self._error, self._error_was_raised = error, True
            self._close(error)
            raise

    def _close_at_exit(self) -> None:
        """Closes a gripper that the program forgot. The exception that ended the program is the cause."""
        # An interactive interpreter keeps every exception there, also those that the user has handled.
        self._close(None if hasattr(sys, "ps1") else getattr(sys, "last_value", None))

    def _close(self, error: BaseException | None) -> None:
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self._close_at_exit)
        with self._signals:
            if self._thread is None:
                # An error of an earlier step ends the run as a fault even if the caller has handled it.
                cause = self._error if error is None else error
                if cause is None:
                    self._run.close()
                else:
                    self._run.__exit__(type(cause), cause, cause.__traceback__)
                return
            trace = None if error is None else error.__traceback__
            self._end_error = error
            self._closing.set()
            self._thread.join(_JOIN_S)
            if error is not None:
                error.with_traceback(trace)  # without the frames of the control thread
            if self._thread.is_alive():
                raise DeviceTimeoutError(
                    f"the control thread did not end within {_JOIN_S:g} s; if it did not stop the servo, the "
                    "servo's Bus Watchdog did; check cables and disk, and see what `gripper-force doctor` says"
                )
            if not self._error_was_raised:
                self._raise_error()

    # The control cycle.

    def _run_thread(self) -> None:
        try:
            with open_run(self.config, self.log) as session:
                self._start(session)
                while not self._closing.is_set():
                    self._cycle(session)
                if self._end_error is not None:  # the run ends with the caller's exception
                    raise self._end_error  # noqa: TRY301
        except BaseException as error:
            if error is not self._end_error:
                self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _start(self, session: Session) -> None:
        self.config = session.run.config
        self._session = session
        self._publish(session, session.wait_for_reference(), None)

    def _cycle(self, session: Session) -> GripperState:
        request, self._postponed = self._postponed or self._next_request(), None
        if request is not None and session.stop_is_pending and request.number > self._stop_number:
            self._postponed, request = request, None  # the stop came first
        if request is None:
            return self._publish(session, session.cycle(), None)
        if request.number < self._stop_number:  # the stop overrides it
            return self._publish(session, session.cycle(), request)
        if request.needs_object and self.state.phase not in GRIPPING:
            return self._publish(session, session.cycle(), request, _NO_OBJECT)
        self._hold_cycles = self._vision_cycles = 0
        decision = session.cycle(request.kind, request.target_n, request.width_m)
        return self._publish(session, decision, request)

    def _next_request(self) -> _Request | None:
        with contextlib.suppress(queue.Empty):
            return self._requests.get_nowait()
        return None

    def _publish(
        self, session: Session, decision: Decision, request: _Request | None, refusal: str = ""
    ) -> GripperState:
        """Makes the cycle's result visible to other threads, and wakes them if something changed."""
        status, estimate, servo = decision.status, decision.estimate, session.servo_state
        assert servo is not None  # the cycle has read it
        cell = session.last_load_cell_sample
        if status.phase == Phase.HOLD:
            self._hold_cycles += 1
            self._vision_cycles += estimate.source != EstimateSource.CURRENT
        before = self._state
        state = GripperState(
            t_ns=status.t_ns,
            phase=Phase(status.phase),
            outcome=Outcome(status.outcome),
            reason=status.reason or (before.reason if before is not None else ""),
            reference_n=status.reference_n,
            force_n=estimate.force_n,
            std_n=estimate.std_n,
            source=EstimateSource(estimate.source),
            width_m=status.width_m,
            position_rad=servo.position_rad,
            current_a=servo.current_a,
            temperature_c=servo.temperature_c,
            voltage_v=servo.voltage_v,
            load_cell_n=None if cell is None else cell.force_n,
        )
        self._state = state
        changed = before is None or (before.phase, before.outcome) != (state.phase, state.outcome)
        if changed or request is not None:
            with self._changed:
                if changed and state.outcome != Outcome.NONE:
                    self._result = self._result_of(state)
                if request is not None:
                    self._newest, self._refusal = request, refusal or decision.refusal
                self._changed.notify_all()
        return state

    def _result_of(self, state: GripperState) -> GraspResult:
        share = self._vision_cycles / self._hold_cycles if self._hold_cycles else 0.0
        return GraspResult(state.outcome, state.force_n, state.std_n, state.width_m, share, state.reason)

    # Requests and waiting.

    def _opened(self) -> Session:
        self._raise_error()
        if self._closed or self._session is None:
            raise RequestError("the gripper is closed; open it again with open_gripper")
        return self._session

    def _grip(self, force_n: float, *, wait: bool, needs_object: bool) -> GraspResult | None:
        self._opened().run.check_target(force_n)
        request = self._submit(RequestKind.GRASP, target_n=force_n, needs_object=needs_object)
        if not wait:
            return None
        self._wait(request, lambda state: state.outcome != Outcome.NONE)
        return self._result

    def _submit(
        self, kind: RequestKind, *, target_n: float = 0.0, width_m: float = 0.0, needs_object: bool = False
    ) -> _Request:
        self._opened()
        request = _Request(kind, next(self._numbers), target_n, width_m, needs_object)
        self._requests.put(request)
        return request

    def _wait(
        self, request: _Request, is_done: Callable[[GripperState], bool], timeout_s: float = math.inf
    ) -> None:
        """Waits until a request was handled and ``is_done``, or for a time on the run's clock."""
        end_ns = self.state.t_ns + timeout_s * NS_PER_S
        end_s = time.monotonic() + timeout_s
        while not self._is_finished(request, is_done):
            if not self._background:
                if self.step().t_ns > end_ns:
                    return
                continue
            with self._changed:
                if not self._ended and self._error is None and not self._is_finished(request, is_done):
                    left_s = end_s - time.monotonic()
                    if left_s <= 0:
                        return
                    self._changed.wait(None if left_s == math.inf else left_s)
            self._raise_error()
            if self._ended and not self._is_finished(request, is_done):
                raise RequestError(f"the gripper was closed before the {request.kind} request was done")

    def _is_finished(self, request: _Request, is_done: Callable[[GripperState], bool]) -> bool:
        newest = self._newest
        if newest is None or newest.number < request.number:
            return False
        if newest.number == request.number and self._refusal:
            raise RequestError(f"the {request.kind} request was refused: {self._refusal}")
        if newest.kind != request.kind:
            raise RequestError(f"the {request.kind} request was replaced by a {newest.kind} request")
        return is_done(self.state)

    def _raise_error(self) -> None:
        if self._error is not None:
            self._error_was_raised = True
            raise self._error


def _interrupt() -> None:
    raise KeyboardInterrupt
