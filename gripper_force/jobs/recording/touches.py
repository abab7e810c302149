"""Touches: press up to a force, and let go. The same procedure in a simulated rig and in a real one."""

from typing import Final, Protocol

from gripper_force.control.state_machine import Decision
from gripper_force.types import NS_PER_S, LoadCellSample, Outcome, Phase, RequestKind

_CLEAR_M: Final = 0.008
"""How much wider than the object the jaws open between two touches: with less of a run-up they don't come to
their speed, and a controller that has not seen them move takes long to believe in contact."""


class Toucher(Protocol):
    """What touches need of a `gripper_force.runtime.session.Session`."""

    @property
    def last_load_cell_sample(self) -> LoadCellSample | None:
        """The newest valid sample of the load cell."""
        ...

    def cycle(self, kind: RequestKind | None = None, target_n: float = 0.0) -> Decision:
        """The next control cycle."""
        ...


def touch(
    rig: Toucher, peak_n: float, hold_s: float, *, free_n: float, timeout_s: float, patience_s: float
) -> str:
    """Presses once, and opens until the object is free.

    Args:
        rig: A session that is open.
        peak_n: Force to press up to.
        hold_s: How long to keep it; what is felt comes after what is asked for.
        free_n: The most that the load cell may still feel of an object that is free.
        timeout_s: How long the way to the force may take.
        patience_s: How long the way back may take.

    Returns:
        Why it did not come to that, or an empty text.
    """
    touch_m = ramp(rig, peak_n, timeout_s)
    status = rig.cycle().status
    if status.phase != Phase.HOLD:
        outcome = status.outcome.replace("_", " ") or f"not within {timeout_s:g} s"
        return f"came to no force: {outcome}, in phase {status.phase}"
    wait(rig, hold_s)
    status = rig.cycle(RequestKind.RELEASE).status
    end_ns = status.t_ns + round(patience_s * NS_PER_S)
    clear_m = touch_m + _CLEAR_M
    while (status.width_m < clear_m and status.phase != Phase.OPEN) or _felt_n(rig) > free_n:
        if status.t_ns > end_ns:
            return f"caught on a pad: {_felt_n(rig):.2f} N are felt {patience_s:g} s after letting go"
        status = rig.cycle().status
    return ""


def ramp(rig: Toucher, target_n: float, timeout_s: float) -> float:
    """Presses until a force is reached, or can't be. Returns the width in metres where the object was met."""
    status = rig.cycle(RequestKind.GRASP, target_n).status
    touch_m = status.width_m
    end_ns = status.t_ns + round(timeout_s * NS_PER_S)
    while status.phase != Phase.HOLD and status.outcome == Outcome.NONE and status.t_ns < end_ns:
        if status.phase == Phase.APPROACH:
            touch_m = status.width_m
        status = rig.cycle().status
    return touch_m


def wait(rig: Toucher, duration_s: float) -> None:
    """Goes on as before for a time."""
    status = rig.cycle().status
    end_ns = status.t_ns + round(duration_s * NS_PER_S)
    while status.t_ns < end_ns:
        status = rig.cycle().status


def _felt_n(rig: Toucher) -> float:
    return 0.0 if rig.last_load_cell_sample is None else rig.last_load_cell_sample.force_n
