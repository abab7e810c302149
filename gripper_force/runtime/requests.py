"""Requests to a gripper: their order, their refusals, and the result that each caller waits for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

from gripper_force.errors import RequestError
from gripper_force.runtime.state import GraspResult, GripperState
from gripper_force.types import GRIPPING, Outcome, Phase, RequestKind

CLOSED: Final = "the gripper is closed; open it again with open_gripper"
_MAX_MAGNITUDE: Final = 1e9


def checked_number(value: Any, name: str) -> float:
    """Returns an argument as a float. Raises `RequestError` if it is no number, or too large to be plausible."""
    with suppress(TypeError, ValueError, OverflowError, RuntimeError):
        scalar = value.item() if hasattr(value, "item") else value  # NumPy, or a tensor, also on a GPU
        if not isinstance(scalar, str | bytes | bool) and abs(number := float(value)) <= _MAX_MAGNITUDE:
            return number
    raise RequestError(f"{name} of {value!r} is not a number of at most {_MAX_MAGNITUDE:g}; pass a float")


@dataclass(eq=False, slots=True)
class PendingRequest:
    """A request whose result is not known yet.

    Attributes:
        kind: What is requested.
        target_n: Target force of a grasp.
        width_m: Width of a move.
        new_object: True for a grasp of another object than in the grasps before.
        needs_object: True for a change of force, which must not close the jaws on nothing.
        is_awaited: True if a caller waits for the result.
        result: The result, or the `RequestError` of this request alone.
    """

    kind: RequestKind
    target_n: float = 0.0
    width_m: float = 0.0
    new_object: bool = False
    needs_object: bool = False
    is_awaited: bool = False
    result: Future[GraspResult] = field(default_factory=Future)

    def is_done(self, state: GripperState) -> bool:
        """Returns True if the cycle with this state has ended the request."""
        if self.kind == RequestKind.RELEASE:
            return state.phase != Phase.RELEASE or state.outcome == Outcome.BLOCKED
        return state.outcome != Outcome.NONE

    def is_like(self, other: PendingRequest) -> bool:
        """Returns True if the two requests differ only in force or width."""
        return (self.kind, self.needs_object) == (other.kind, other.needs_object)

    def fail(self, text: str) -> None:
        """Raises `RequestError` in the call that waits."""
        self.result.set_exception(RequestError(text))


class RequestQueue:
    """Requests of all threads, in the order in which the control cycle handles them.

    A newer request of another kind replaces the one that callers wait for, unless it is refused. A queued request that
    no caller waits for is dropped when a newer one of the same kind arrives. A stop overrides all older requests, which
    end with its outcome. Requests made after it are handled once it has taken effect.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()  # a signal handler may stop the gripper
        self._queued: list[PendingRequest] = []
        self._started: list[PendingRequest] = []  # only those that a caller waits for
        self._phase, self._fault_note = Phase.OPEN, ""
        self._is_closed = False

    def submit(self, request: PendingRequest) -> None:
        """Adds a request, unless it is known to be refused.

        Raises:
            RequestError: The gripper is closed or at fault, or no object is gripped.
        """
        with self._lock:
            if self._is_closed:
                raise RequestError(CLOSED)
            if request.kind != RequestKind.RELEASE and self._will_be_at_fault():
                raise RequestError(
                    f"the {request.kind} request was refused: stopped or in fault{self._fault_note}; call release first"
                )
            if request.needs_object and self._phase not in GRIPPING:
                raise RequestError(f"no object is gripped (phase {self._phase}); call grasp first")
            # Requests faster than the cycle would be handled later and later. The first may be handled now.
            if self._queued[1:] and not self._queued[-1].is_awaited and self._queued[-1].is_like(request):
                request.new_object |= self._queued.pop().new_object
            self._queued.append(request)

    def stop(self, stop_soon: Callable[[], None]) -> None:
        """Overrides all requests so far. ``stop_soon`` makes the next cycle a stop, before any later request."""
        with self._lock:
            self._queued.append(PendingRequest(RequestKind.STOP))
            stop_soon()

    def next(self) -> PendingRequest | None:
        """Returns the request of the next cycle: the newest stop, or else the oldest request."""
        with self._lock:
            stops = [request for request in self._queued if request.kind == RequestKind.STOP]
            return stops[-1] if stops else next(iter(self._queued), None)

    def is_waiting(self) -> bool:
        """Returns True if no cycle has begun a grasp or a move that was requested."""
        with self._lock:
            return any(request.kind in (RequestKind.GRASP, RequestKind.MOVE) for request in self._queued)

    def finish_cycle(
        self, request: PendingRequest | None, refusal: str, state: GripperState, result: GraspResult
    ) -> None:
        """Ends the requests that a cycle has refused, replaced or brought to a result.

        Args:
            request: The request that the cycle handled, from `next`.
            refusal: Reason why it was refused, or an empty text.
            state: State after the cycle.
            result: Result for the requests that end with this state.
        """
        with self._lock:
            self._phase = state.phase
            self._fault_note = f" ({state.reason})" if state.phase == Phase.FAULT else ""
            if request is not None and not self._is_closed:
                self._start(request, refusal)
            for started in self._started:
                if started.is_done(state):
                    started.result.set_result(result)
            self._started = [started for started in self._started if not started.result.done()]

    def close(self) -> None:
        """Ends every request. Later ones are refused."""
        with self._lock:
            self._is_closed = True
            for request in self._queued + self._started:
                request.fail(f"the gripper was closed before the {request.kind} request was done")
            self._queued, self._started = [], []

    def _will_be_at_fault(self) -> bool:
        kinds = [one.kind for one in self._queued if one.kind in (RequestKind.STOP, RequestKind.RELEASE)]
        return kinds[-1] == RequestKind.STOP if kinds else self._phase == Phase.FAULT

    def _start(self, request: PendingRequest, refusal: str) -> None:
        index = self._queued.index(request)
        overridden = self._queued[:index]  # none, unless the request is a stop
        del self._queued[: index + 1]
        self._started += [older for older in overridden if older.is_awaited]
        if refusal:
            request.fail(f"the {request.kind} request was refused: {refusal}")
        elif request.kind != RequestKind.STOP:
            self._replace(request)
            self._started += [request] if request.is_awaited else []

    def _replace(self, request: PendingRequest) -> None:
        for older in self._started:
            if older.kind != request.kind:
                older.fail(f"the {older.kind} request was replaced by a {request.kind} request")
        self._started = [older for older in self._started if older.kind == request.kind]
