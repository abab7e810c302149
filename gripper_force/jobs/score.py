"""How well a grasp was done, by the load cell."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gripper_force.errors import DataError
from gripper_force.types import NS_PER_S, GraspStatus, LoadCellSample, Phase

STEADY_S = 1.0
"""The last part of the hold whose mean counts."""

LONGEST_GAP_S = 0.25
"""Without a sound sample for longer in that part, there is nothing to compare with."""

_RAMPING = (Phase.RAMP, Phase.HOLD)
_GRASPING = (Phase.APPROACH, Phase.CONTACT, *_RAMPING)


@dataclass(frozen=True, slots=True)
class GraspScore:
    """One grasp against the load cell.

    Attributes:
        target_n: What was asked.
        steady_n: Mean over the last `STEADY_S` of the hold.
        steady_error_n: ``steady_n - target_n``.
        overshoot_n: Most the load cell read above the target, the first touch included; 0 where it never did.
        settle_s: Time from the start of the ramp until the force stays within 5 % or 0.1 N; NaN: never.
    """

    target_n: float
    steady_n: float
    steady_error_n: float
    overshoot_n: float
    settle_s: float


def score_grasp(
    samples: Sequence[LoadCellSample], statuses: Sequence[GraspStatus], target_n: float
) -> GraspScore:
    """Scores the last grasp of a run.

    Args:
        samples: Load cell readings in order of time; rejected ones are left out.
        statuses: The controller's states in order of time.
        target_n: What was asked.

    Raises:
        DataError: The force was never held, or the load cell said nothing meanwhile, or too little.
    """
    held_ns = [s.t_ns for s in statuses if s.phase == Phase.HOLD]
    if not held_ns:
        raise DataError("there is no hold to score in this run; the grasp ended before it reached its target")
    end_ns = held_ns[-1]
    ramp_ns = _start_of(_RAMPING, statuses, end_ns)
    touch_ns = _start_of(_GRASPING, statuses, end_ns)
    peak_n = max((s.force_n for s in samples if s.valid and touch_ns <= s.t_ns <= end_ns), default=0.0)
    cell = [(s.t_ns, s.force_n) for s in samples if s.valid and ramp_ns <= s.t_ns <= end_ns]
    if not cell or cell[-1][0] < held_ns[0]:
        raise DataError("the load cell has no valid sample during the hold; check it in the log")
    t_s = (np.array([t for t, _ in cell]) - ramp_ns) / NS_PER_S  # (N,)
    force_n = np.array([f for _, f in cell])  # (N,)
    held_s, end_s = (held_ns[0] - ramp_ns) / NS_PER_S, (end_ns - ramp_ns) / NS_PER_S
    begin_s = max(end_s - STEADY_S, held_s)
    last = t_s >= begin_s
    gap_s = float(np.diff([begin_s, *t_s[last], end_s]).max())
    if gap_s > LONGEST_GAP_S or not last.any():
        raise DataError(f"the load cell gave no sound sample for {gap_s:.2f} s of the hold; see the log")
    steady_n = float(force_n[last].mean())
    outside = np.flatnonzero(np.abs(force_n - target_n) > max(0.05 * target_n, 0.1))
    first_inside = int(outside[-1]) + 1 if outside.size else 0
    return GraspScore(
        target_n=target_n,
        steady_n=steady_n,
        steady_error_n=steady_n - target_n,
        overshoot_n=max(peak_n - target_n, 0.0),
        settle_s=float(t_s[first_inside]) if first_inside < len(t_s) else math.nan,
    )


def _start_of(phases: tuple[Phase, ...], statuses: Sequence[GraspStatus], end_ns: int) -> int:
    """When the unbroken run of these phases began that lasted to ``end_ns``."""
    start_ns = end_ns
    for status in reversed([s for s in statuses if s.t_ns <= end_ns]):
        if status.phase not in phases:
            break
        start_ns = status.t_ns
    return start_ns
