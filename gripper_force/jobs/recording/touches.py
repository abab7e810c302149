"""One touch: press up to a force, hold, and open. The same for a simulated and a real rig."""

from typing import Final, Protocol

from gripper_force.control.state_machine import Decision
from gripper_force.types import NS_PER_S, LoadCellSample, Outcome, Phase, RequestKind

_CLEAR_M: Final = 0.008
"""Distance by which the jaws open beyond the contact width between two touches. With less they do not reach
their speed, and the controller then detects contact late."""


class TouchSession(Protocol):
    """Part of a `gripper_force.runtime.session.Session` that touches use."""

    @property
    def last_load_cell_sample(self) -> LoadCellSample | None:
        """Newest valid sample of the load cell."""

    def cycle(self, kind: RequestKind | None = None, target_n: float = 0.0) -> Decision:
        """Runs the next control cycle, with a request or without."""


def touch(
    session: TouchSession,
    peak_n: float,
    hold_s: float,
    *,
    free_n: float,
    timeout_s: float,
    release_timeout_s: float,
) -> str:
    """Presses once, and opens until the object is free.

    Args:
        session: An open session.
        peak_n: Force to press up to.
        hold_s: Duration of the hold; the measured force follows the commanded force with a delay.
        free_n: Largest load-cell force of a free object.
        timeout_s: Longest time until the force is reached.
        release_timeout_s: Longest time until the object is free again.

    Returns:
        Reason of a failure, as a predicate; empty after a success.
    """
    contact_m = ramp(session, peak_n, timeout_s)
    status = session.cycle().status
    if status.phase != Phase.HOLD:
        outcome = status.outcome.replace("_", " ") or f"not within {timeout_s:g} s"
        return f"reached no force: {outcome}, in phase {status.phase}"
    wait(session, hold_s)
    status = session.cycle(RequestKind.RELEASE).status
    end_ns = status.t_ns + round(release_timeout_s * NS_PER_S)
    clear_m = contact_m + _CLEAR_M
    while (status.width_m < clear_m and status.phase != Phase.OPEN) or _load_cell_n(session) > free_n:
        if status.t_ns > end_ns:
            return f"caught on a pad: still {_load_cell_n(session):.2f} N after {release_timeout_s:g} s of opening"
        status = session.cycle().status
    return ""


def ramp(session: TouchSession, target_n: float, timeout_s: float) -> float:
    """Presses until the force is reached, the grasp fails or time is up. Returns the width in m at first contact."""
    status = session.cycle(RequestKind.GRASP, target_n).status
    contact_m = status.width_m
    end_ns = status.t_ns + round(timeout_s * NS_PER_S)
    while status.phase != Phase.HOLD and status.outcome == Outcome.NONE and status.t_ns < end_ns:
        if status.phase == Phase.APPROACH:
            contact_m = status.width_m
        status = session.cycle().status
    return contact_m


def wait(session: TouchSession, duration_s: float) -> None:
    """Runs cycles without a request for a time."""
    status = session.cycle().status
    end_ns = status.t_ns + round(duration_s * NS_PER_S)
    while status.t_ns < end_ns:
        status = session.cycle().status


def _load_cell_n(session: TouchSession) -> float:
    return 0.0 if session.last_load_cell_sample is None else session.last_load_cell_sample.force_n
