from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.errors import RequestError
from gripper_force.runtime.requests import PendingRequest, RequestQueue, checked_number
from gripper_force.runtime.state import GraspResult, GripperState
from gripper_force.types import EstimateSource, Outcome, Phase, RequestKind

STATE = GripperState(
    t_ns=0,
    phase=Phase.OPEN,
    outcome=Outcome.NONE,
    reason="",
    reference_n=0.0,
    force_n=0.0,
    std_n=0.1,
    source=EstimateSource.CURRENT,
    width_m=0.09,
    position_rad=0.0,
    current_a=0.0,
    temperature_c=30.0,
    voltage_v=12.0,
    load_cell_n=None,
)


class Cycle:
    """The cycle of a queue: handles one request, and goes on from a given state."""

    def __init__(self) -> None:
        self.queue, self.state = RequestQueue(), STATE
        self.stops = 0

    def submit(
        self, kind: RequestKind, *, needs_object: bool = False, new_object: bool = False, wait: bool = True
    ) -> PendingRequest:
        request = PendingRequest(kind, needs_object=needs_object, new_object=new_object, is_awaited=wait)
        self.queue.submit(request)
        return request

    def stop(self) -> None:
        self.queue.stop(self.count_stop)

    def count_stop(self) -> None:
        self.stops += 1

    def run(
        self, phase: Phase, outcome: Outcome = Outcome.NONE, *, refusal: str = ""
    ) -> PendingRequest | None:
        request = self.queue.next()
        self.state = replace(self.state, t_ns=self.state.t_ns + 5_000_000, phase=phase, outcome=outcome)
        result = GraspResult(outcome, 3.0, 0.1, 0.05, 0.0, "")
        self.queue.finish_cycle(request, refusal, self.state, result)
        return request


@pytest.fixture
def cycle() -> Cycle:
    return Cycle()


def failure(request: PendingRequest) -> str:
    return str(request.result.exception(timeout=0))


def test_requests_are_handled_in_their_order(cycle: Cycle) -> None:
    kinds = [RequestKind.RELEASE, RequestKind.MOVE, RequestKind.GRASP]
    requests = [cycle.submit(kind) for kind in kinds]
    assert [cycle.run(Phase.MOVE) for _ in range(4)] == [*requests, None]


def test_a_refused_request_fails_alone(cycle: Cycle) -> None:
    grasp = cycle.submit(RequestKind.GRASP)
    cycle.run(Phase.APPROACH)
    move = cycle.submit(RequestKind.MOVE)
    cycle.run(Phase.APPROACH, refusal="too wide")
    assert failure(move) == "the move request was refused: too wide"
    assert not grasp.result.done()
    cycle.run(Phase.HOLD, Outcome.HELD)
    assert grasp.result.result(timeout=0).held


def test_the_request_that_replaces_a_grasp_of_a_new_object_is_one_too(cycle: Cycle) -> None:
    cycle.submit(RequestKind.RELEASE, wait=False)
    cycle.submit(RequestKind.GRASP, new_object=True, wait=False)
    last = cycle.submit(RequestKind.GRASP, wait=False)
    cycle.run(Phase.RELEASE)
    assert cycle.run(Phase.APPROACH) is last
    assert last.new_object


def test_callers_of_the_same_kind_get_the_same_result(cycle: Cycle) -> None:
    first = cycle.submit(RequestKind.GRASP)
    cycle.run(Phase.RAMP)
    second = cycle.submit(RequestKind.GRASP, needs_object=True)
    cycle.run(Phase.RAMP)
    cycle.run(Phase.HOLD, Outcome.HELD)
    assert first.result.result(timeout=0) is second.result.result(timeout=0)


def test_a_stop_overrides_older_requests_and_precedes_newer_ones(cycle: Cycle) -> None:
    grasp, release = cycle.submit(RequestKind.GRASP), cycle.submit(RequestKind.RELEASE)
    cycle.stop()
    newer = cycle.submit(RequestKind.RELEASE)
    stop = cycle.run(Phase.FAULT, Outcome.FAULT)
    assert stop is not None
    assert (stop.kind, cycle.stops) == (RequestKind.STOP, 1)
    assert grasp.result.result(timeout=0).outcome == Outcome.FAULT
    assert release.result.result(timeout=0).outcome == Outcome.FAULT
    assert cycle.run(Phase.RELEASE) is newer
    assert not newer.result.done()


def test_a_stop_during_a_cycle_overrides_in_the_next_one(cycle: Cycle) -> None:
    cycle.run(Phase.HOLD, Outcome.HELD)
    waiting = cycle.submit(RequestKind.RELEASE)
    in_flight = cycle.queue.next()
    queued = cycle.submit(RequestKind.GRASP)
    cycle.stop()
    cycle.queue.finish_cycle(
        in_flight,
        "",
        replace(STATE, phase=Phase.RELEASE, outcome=Outcome.HELD),
        GraspResult(*RESULT),
    )
    assert not queued.result.done()  # the state is older than the stop
    cycle.run(Phase.FAULT, Outcome.FAULT)
    assert waiting.result.result(timeout=0).outcome == Outcome.FAULT
    assert queued.result.result(timeout=0).outcome == Outcome.FAULT


RESULT = (Outcome.HELD, 3.0, 0.1, 0.05, 0.0, "")


def test_closing_ends_every_call_and_refuses_later_ones(cycle: Cycle) -> None:
    started = cycle.submit(RequestKind.GRASP)
    cycle.run(Phase.APPROACH)
    queued = cycle.submit(RequestKind.MOVE)
    cycle.queue.close()
    assert failure(started) == "the gripper was closed before the grasp request was done"
    assert failure(queued) == "the gripper was closed before the move request was done"
    with pytest.raises(RequestError, match="the gripper is closed"):
        cycle.submit(RequestKind.RELEASE)
    cycle.queue.close()


def test_a_gripper_that_is_closed_during_a_cycle_ends_the_request_of_the_cycle_once(cycle: Cycle) -> None:
    grasp = cycle.submit(RequestKind.GRASP)
    in_flight = cycle.queue.next()
    cycle.queue.close()
    cycle.queue.finish_cycle(in_flight, "", replace(STATE, outcome=Outcome.HELD), GraspResult(*RESULT))
    assert failure(grasp) == "the gripper was closed before the grasp request was done"


@pytest.mark.parametrize("kind", list(RequestKind))
def test_only_a_grasp_or_a_move_that_waits_hides_the_last_outcome(cycle: Cycle, kind: RequestKind) -> None:
    cycle.stop() if kind == RequestKind.STOP else cycle.submit(kind)
    assert cycle.queue.is_waiting() == (kind in (RequestKind.GRASP, RequestKind.MOVE))


def test_requests_that_nobody_waits_for_are_not_kept(cycle: Cycle) -> None:
    for _ in range(10):
        cycle.submit(RequestKind.GRASP, wait=False)
        cycle.run(Phase.APPROACH)
    assert cycle.queue._started == []


ACTIONS: dict[str, Callable[[Cycle], object]] = {
    "grasp": lambda cycle: cycle.submit(RequestKind.GRASP),
    "set_force": lambda cycle: cycle.submit(RequestKind.GRASP, needs_object=True),
    "move": lambda cycle: cycle.submit(RequestKind.MOVE),
    "release": lambda cycle: cycle.submit(RequestKind.RELEASE),
    "stop": lambda cycle: cycle.stop(),
    "hold": lambda cycle: cycle.run(Phase.HOLD),
    "held": lambda cycle: cycle.run(Phase.HOLD, Outcome.HELD),
    "refuse": lambda cycle: cycle.run(cycle.state.phase, refusal="refused"),
    "fault": lambda cycle: cycle.run(Phase.FAULT, Outcome.FAULT),
}


@given(st.lists(st.sampled_from(sorted(ACTIONS)), max_size=40))
def test_every_request_ends_once_and_none_after_the_stop_that_overrides_it(names: list[str]) -> None:
    cycle = Cycle()
    requests: list[PendingRequest] = []
    older_than_a_stop: list[PendingRequest] = []
    for name in names:
        if name == "stop":
            older_than_a_stop = list(requests)
        try:
            made = ACTIONS[name](cycle)
        except RequestError:
            continue
        if isinstance(made, PendingRequest) and name in ("grasp", "set_force", "move", "release"):
            requests.append(made)
        elif isinstance(made, PendingRequest):
            assert made not in older_than_a_stop
    cycle.queue.close()
    assert all(request.result.done() for request in requests)


def test_of_requests_faster_than_the_cycle_the_newest_counts(cycle: Cycle) -> None:
    cycle.run(Phase.HOLD)
    requests = [cycle.submit(RequestKind.GRASP, needs_object=True, wait=False) for _ in range(9)]
    handled = cycle.queue.next()  # a cycle begins
    newest = cycle.submit(RequestKind.GRASP, needs_object=True, wait=False)
    assert handled is requests[0]
    assert cycle.run(Phase.HOLD) is handled
    assert cycle.run(Phase.HOLD) is newest
    assert cycle.queue.next() is None


@pytest.mark.parametrize(
    ("kind", "needs_object", "wait"),
    [
        (RequestKind.GRASP, True, False),  # may be refused
        (RequestKind.GRASP, False, True),  # a caller waits for it
        (RequestKind.MOVE, False, False),
    ],
)
def test_other_requests_are_all_handled(
    cycle: Cycle, kind: RequestKind, needs_object: bool, wait: bool
) -> None:
    cycle.run(Phase.HOLD)
    first = cycle.submit(RequestKind.RELEASE, wait=False)
    second = cycle.submit(kind, needs_object=needs_object, wait=wait)
    third = cycle.submit(RequestKind.GRASP, wait=False)
    assert [cycle.run(Phase.HOLD) for _ in range(4)] == [first, second, third, None]


@pytest.mark.parametrize(
    "value", [True, np.True_, np.array(True), "3", b"3", np.array("3"), None, [1, [2]], 1e10, -1e10, np.nan]
)
def test_what_is_no_number_is_refused(value: Any) -> None:
    with pytest.raises(RequestError, match=r"a force of .* is not a number of at most 1e"):
        checked_number(value, "a force")


class OnGpu:
    """A tensor that NumPy can't read, but Python can."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def item(self) -> float:
        return 3.0

    def __float__(self) -> float:
        return 3.0


@pytest.mark.parametrize(
    "value", [3, 3.0, np.float32(3), np.int8(3), np.array(3), Fraction(3), Decimal(3), OnGpu()]
)
def test_numbers_of_any_kind_are_accepted(value: Any) -> None:
    assert checked_number(value, "a force") == 3.0
