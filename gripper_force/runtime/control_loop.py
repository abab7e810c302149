"""The control loop of a live gripper: its session, its thread, and the requests it handles."""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import threading
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import Final

from gripper_force.config import Config
from gripper_force.control.state_machine import Decision
from gripper_force.errors import DeviceTimeoutError, GripperError, RequestError
from gripper_force.interfaces import SharedPort
from gripper_force.runtime.process import deferred_signals
from gripper_force.runtime.requests import CLOSED, PendingRequest, RequestQueue, checked_number
from gripper_force.runtime.resolve import ResolvedConfig, resolve
from gripper_force.runtime.session import Session, open_run
from gripper_force.runtime.state import GraspResult, GripperState, StateTracker
from gripper_force.types import GRIPPING, NS_PER_S, Outcome, RequestKind

_END_S: Final = 25.0
"""Longest wait for the end of the control thread, in addition to the opening of the jaws. A disk that does not answer
takes 20 s of it."""

_cycles: Final[ContextVar[tuple[ControlLoop, ...]]] = ContextVar("_cycles", default=())
"""Loops of which this thread runs a cycle now: several, if a device of one gripper steps another one."""


class ControlLoop:
    """Runs one session from its opening to its end, in a background thread or in the caller's thread.

    The caller's thread resolves the configuration. The thread of the control cycle then opens the devices,
    unless the loop was closed meanwhile: a servo is not armed after that.

    Attributes:
        session: The session.
        state: State after the newest control cycle.
        owner: Returns the program's object, None if the program has lost it. The thread then ends the run.
    """

    def __init__(
        self, config: Config, log: Path | None, *, background: bool, port: SharedPort | None = None
    ) -> None:
        self._config, self._log, self._port = config, log, port
        self._process = os.getpid()
        self._background = background
        self._requests, self._tracker = RequestQueue(), StateTracker()
        self._resources = contextlib.ExitStack()  # of the caller's thread
        self._thread: threading.Thread | None = None
        self.owner: Callable[[], object] = lambda: True
        self._cycle_lock = threading.RLock()  # of the thread that runs the cycle with background=False
        # Written by the thread that runs the control cycle; the first two exist once the loop is open:
        self.session: Session
        self.state: GripperState
        self._error: BaseException | None = None
        self._opened, self._ended = threading.Event(), threading.Event()
        # Written by the caller's thread:
        self._closing = threading.Event()
        self._end_error: BaseException | None = None
        self._error_was_raised = False

    def open(self) -> None:
        """Resolves the configuration, opens the session, and runs its first cycles."""
        atexit.register(self._close_at_exit)  # for a program that ends without closing the gripper
        try:
            if self._background:
                self._open_thread()
            else:
                run = open_run(resolve(self._config), self._log, port=self._port)
                self._start(self._resources.enter_context(run))
                self._resources.enter_context(deferred_signals(self._interrupt))
                self.session.raise_if_interrupted()  # in the last cycle of the start; a later one may never come
        except BaseException as error:
            self._error, self._error_was_raised = error, True
            self.close(error)
            raise

    def request(self, request: PendingRequest) -> GraspResult | None:
        """Submits a request. Returns the result of an awaited one; where no thread runs the cycle, it does."""
        self._raise_error()
        with self._exclusive_cycle() if request.is_awaited else contextlib.nullcontext():
            self._requests.submit(request)
            if not request.is_awaited:
                return None
            try:
                while not (self._background or request.result.done()):
                    self.step()
                request.result.exception()  # waits
            except BaseException:
                # An interrupt: jaws that close must not go on; an object that they grip stays.
                with contextlib.suppress(GripperError):
                    if not (request.kind == RequestKind.RELEASE or self.state.phase in GRIPPING):
                        self.stop()
                raise
        self._raise_error()
        return request.result.result()

    def stop(self) -> None:
        """Stops the gripper in the next cycle that reads the servo, before any other request.

        Raises:
            GripperError: The run has ended, see `live_session`.
        """
        self._requests.stop(self.live_session().stop_soon)

    def step(self) -> GripperState:
        """Runs one cycle in the caller's thread."""
        if self._background:
            raise RequestError("a background thread runs the control cycle; open with background=False")
        with self._exclusive_cycle():
            session = self.live_session()
            try:
                token = _cycles.set((*_cycles.get(), self))
                try:
                    self._cycle(session)
                finally:
                    _cycles.reset(token)
                session.raise_if_interrupted()  # a later cycle may never come
            except BaseException as error:
                self._error, self._error_was_raised = error, True
                raise
            finally:
                if self._closing.is_set() and not self._ended.is_set():  # a device closed it in this cycle
                    self.close(self._end_error)
            return self.state

    def shown_state(self) -> GripperState:
        """Returns the newest state, without an outcome if a grasp or a move was requested after it.

        Raises:
            GripperError: The run has ended, see `live_session`. A program that polls would wait for ever.
        """
        self.live_session()
        is_waiting = self._requests.is_waiting()  # first: a cycle sets the state, then ends the request
        return replace(self.state, outcome=Outcome.NONE) if is_waiting else self.state

    def live_session(self) -> Session:
        """The session of a run that goes on.

        Raises:
            RequestError: The gripper was closed.
            GripperError: The error that ended the run.
        """
        has_ended = self._ended.is_set()  # first: the control thread sets its error, then this
        self._raise_error()
        if has_ended:
            raise RequestError(CLOSED)
        return self.session

    def sleep(self, seconds: float) -> None:
        """Waits for a time on the run's clock, and runs the cycle where no thread does."""
        if (seconds := checked_number(seconds, "a time")) < 0:
            raise RequestError(f"a time of {seconds:g} s is negative; pass 0 or more")
        if self._background:
            self._ended.wait(seconds)
            self.live_session()
            return
        with self._exclusive_cycle():
            end_ns = self.state.t_ns + round(seconds * NS_PER_S)
            while self.step().t_ns < end_ns:
                pass

    def close(self, error: BaseException | None) -> None:
        """Ends the session, with the exception of the caller's code if there is one. May be called again.

        A call from a device, in a control cycle, ends the run after this cycle. One in a forked process does nothing.
        """
        if os.getpid() != self._process:
            return
        if not self._closing.is_set():
            self._end_error = error
            self._closing.set()
        if self in _cycles.get():
            return
        if self._thread is None:
            self._ended.set()
            self._requests.close()
            atexit.unregister(self._close_at_exit)
            with self._cycle_lock:  # a cycle of another thread, which is its last one, uses the devices
                # An error of an earlier step ends the run as a fault even if the caller has handled it.
                cause = self._error if error is None else error
                exc_info = (None, None, None) if cause is None else (type(cause), cause, cause.__traceback__)
                self._resources.__exit__(*exc_info)
            return
        with self._resources:
            trace = None if error is None else error.__traceback__
            end_s = _END_S + (self.session.opening_s if hasattr(self, "session") else 0.0)
            if not self._ended.wait(end_s):
                raise DeviceTimeoutError(
                    f"the control thread did not end within {end_s:.3g} s; if it did not stop the servo, the "
                    "servo's Bus Watchdog did; check cables and disk, and see what `gripper-force doctor` says"
                )
            self._thread.join()
            atexit.unregister(self._close_at_exit)
            if error is not None:
                error.with_traceback(trace)  # without the frames of the control thread
            if not self._error_was_raised:
                self._raise_error()

    def lose(self, _owner: object) -> None:
        """Restores the signal handlers once the program has lost its object; the control thread then ends the run."""
        if self._background:  # otherwise these resources are those of the run, too
            self._resources.close()

    def _interrupt(self, even_at_end: bool) -> None:
        """Interrupts the program's own code at once, but a cycle in this thread, of any gripper, at its end."""
        if cycles := _cycles.get():
            cycles[-1].session.interrupt(even_at_end)
        elif even_at_end or not self._closing.is_set():
            raise KeyboardInterrupt

    def _exclusive_cycle(self) -> contextlib.ExitStack:
        """Lets only this thread run the control cycle: a second one would use the servo's port at the same time."""
        if self in _cycles.get():
            raise RequestError("a device can't wait for the control cycle that calls it; pass wait=False")
        if self._background:
            return contextlib.ExitStack()
        if not self._cycle_lock.acquire(blocking=False):
            raise RequestError(
                "another thread runs the control cycle; pass wait=False, or use background=True"
            )
        stack = contextlib.ExitStack()
        stack.callback(self._cycle_lock.release)
        return stack

    def _close_at_exit(self) -> None:
        """Closes a gripper that the program forgot. The exception that ended the program is the cause."""
        # An interactive interpreter keeps every exception there, also those that the user has handled.
        self.close(None if hasattr(sys, "ps1") else getattr(sys, "last_value", None))

    def _raise_error(self) -> None:
        if os.getpid() != self._process:
            raise RequestError(
                "the gripper belongs to the process that opened it; use it there, not in a fork"
            )
        if self._error is not None:
            if self._error_was_raised and not isinstance(self._error, Exception):
                raise RequestError("an interrupt has ended the run; close the gripper, and open it again")
            self._error_was_raised = True
            raise self._error

    # The background thread.

    def _open_thread(self) -> None:
        self._resources.enter_context(deferred_signals(self._interrupt))
        resolved = resolve(self._config)
        self._thread = threading.Thread(target=self._run_thread, args=[resolved], name="control", daemon=True)
        self._thread.start()
        self._opened.wait()
        self._raise_error()
        if self._end_error is not None:
            raise self._end_error

    def _run_thread(self, resolved: ResolvedConfig) -> None:
        try:
            with open_run(
                resolved, self._log, raise_if_cancelled=self._raise_if_closing, port=self._port
            ) as session:
                try:
                    _cycles.set((self,))
                    self._start(session)
                    while not self._closing.is_set() and self.owner() is not None:
                        self._cycle(session)
                except BaseException as error:
                    self._error = error  # before the end of the session, which may open the jaws first
                    raise
                if self._end_error is not None:  # the run ends with the caller's exception
                    raise self._end_error  # noqa: TRY301
        except BaseException as error:
            if error is not self._end_error:
                self._error = error
        finally:
            if self.owner() is None:  # nobody else will, and Python would keep a lost gripper until its end
                atexit.unregister(self._close_at_exit)
            self._requests.close()
            self._opened.set()
            self._ended.set()

    def _raise_if_closing(self) -> None:
        if self._closing.is_set():
            if self._end_error is None:
                self._end_error = RequestError("the gripper was closed while it was being opened")
            raise self._end_error

    # The control cycle.

    def _start(self, session: Session) -> None:
        self._publish(session, session.wait_for_reference())
        self.session = session
        self._opened.set()

    def _cycle(self, session: Session) -> GripperState:
        request = self._requests.next()
        if request is None or request.kind == RequestKind.STOP:  # the session was told to stop
            return self._publish(session, session.cycle(), request)
        if request.needs_object and self.state.phase not in GRIPPING:
            refusal = "no object is gripped"
            session.log_event("control", f"refused 'grasp': {refusal}")
            return self._publish(session, session.cycle(), request, refusal)
        decision = session.cycle(
            request.kind, request.target_n, request.width_m, new_object=request.new_object
        )
        return self._publish(session, decision, request, decision.refusal)

    def _publish(
        self, session: Session, decision: Decision, request: PendingRequest | None = None, refusal: str = ""
    ) -> GripperState:
        """Makes the cycle's result visible to other threads, and ends the calls that waited for it."""
        assert session.servo_state is not None  # the cycle has read it
        is_start = request is not None and request.kind != RequestKind.STOP and not refusal
        self.state, result = self._tracker.update(
            decision,
            session.servo_state,
            session.last_load_cell_sample,
            reason=session.reason,
            restart=is_start,
        )
        self._requests.finish_cycle(request, refusal, self.state, result)
        return self.state
