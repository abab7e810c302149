"""Score of a grasp, measured by the load cell, and the use of vision in its hold."""

import math
import re
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from gripper_force.config import Config
from gripper_force.control.fusion import NO_NEW_ESTIMATE, drop_out_reason
from gripper_force.errors import DataError
from gripper_force.runtime.session import NO_ESTIMATE
from gripper_force.types import (
    NS_PER_S,
    EstimateSource,
    Event,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Phase,
    VisualForce,
)

STEADY_S = 1.0
"""Last part of the hold, over which the force is averaged."""

MAX_GAP_S = 0.25
"""Longest gap between valid samples in that part; a grasp with a longer one has no score."""

_RAMP_PHASES = (Phase.RAMP, Phase.HOLD)
_GRASP_PHASES = (Phase.APPROACH, Phase.CONTACT, *_RAMP_PHASES)


@dataclass(frozen=True, slots=True)
class GraspScore:
    """One grasp compared with the load cell.

    Attributes:
        target_n: Target force.
        steady_n: Mean force over the last `STEADY_S` of the hold.
        steady_error_n: ``steady_n - target_n``.
        overshoot_n: Largest force above the target, from the approach on; 0 if it never was above.
        settle_s: Time from the start of the ramp until the force stays within 5 % of the target, or 0.1 N if that is
            more; NaN if never.
    """

    target_n: float
    steady_n: float
    steady_error_n: float
    overshoot_n: float
    settle_s: float


MIN_VISION_SHARE: Final = 0.5
"""A grasp that is configured to use vision fell back if a smaller share of its hold used it."""

_NUMBER: Final = re.compile(r"-?\d+(\.\d+)?")


@dataclass(frozen=True, slots=True)
class VisionLoss:
    """Reason why vision was not used in a part of the hold, and the duration of that part."""

    reason: str
    time_s: float

    def __str__(self) -> str:
        """Returns both for people. A number in the reason is that of the first estimate that was not used."""
        return f"for {self.time_s:.1f} s: {'at first ' if _NUMBER.search(self.reason) else ''}{self.reason}"


@dataclass(frozen=True, slots=True)
class HoldVision:
    """Use of vision in the hold.

    Attributes:
        share: Share of the control cycles of the hold in which vision was used, 0 to 1.
        losses: Parts of the hold without vision by reason, the longest first.
    """

    share: float
    losses: list[VisionLoss]


def score_grasp(
    samples: Sequence[LoadCellSample], statuses: Sequence[GraspStatus], target_n: float, begin_ns: int = 0
) -> GraspScore:
    """Scores the last grasp of a run.

    The overshoot of a force that was lowered begins where the new one is reached.

    Args:
        samples: Load-cell samples in order of time; rejected ones are ignored.
        statuses: States of the controller in order of time.
        target_n: Target force.
        begin_ns: Time of the request of this force. What was before it does not count.

    Raises:
        DataError: The target was never held, or the load cell has no or too few valid samples in the hold.
    """
    statuses = [s for s in statuses if s.t_ns >= begin_ns]
    held_ns = [s.t_ns for s in statuses if s.phase == Phase.HOLD]
    if not held_ns:
        raise DataError(
            "this run has no hold to score: the grasp ended before it reached its target; see its log"
        )
    end_ns = held_ns[-1]
    ramp_ns = _start_ns(_RAMP_PHASES, statuses, end_ns)
    touch_ns = _start_ns(_GRASP_PHASES, statuses, end_ns)
    gripped_n = [s.force_n for s in samples if s.valid and touch_ns <= s.t_ns <= end_ns]
    if begin_ns and statuses[0].phase in _RAMP_PHASES:  # a force was changed
        reached = next((i for i, force_n in enumerate(gripped_n) if force_n <= target_n), 0)
        gripped_n = gripped_n[reached:]
    peak_n = max(gripped_n, default=0.0)
    cell = [(s.t_ns, s.force_n) for s in samples if s.valid and ramp_ns <= s.t_ns <= end_ns]
    if not cell or cell[-1][0] < held_ns[0]:
        raise DataError("the load cell has no valid sample during the hold; check it in the log")
    t_s = (np.array([t for t, _ in cell]) - ramp_ns) / NS_PER_S  # (N,)
    force_n = np.array([f for _, f in cell])  # (N,)
    held_s, end_s = (held_ns[0] - ramp_ns) / NS_PER_S, (end_ns - ramp_ns) / NS_PER_S
    begin_s = max(end_s - STEADY_S, held_s)
    last = t_s >= begin_s
    gap_s = float(np.diff([begin_s, *t_s[last], end_s]).max())
    if gap_s > MAX_GAP_S or not last.any():
        raise DataError(
            f"the load cell has no valid sample for {gap_s:.2f} s of the hold; check it in the log"
        )
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


def controls_with_vision(config: Config) -> bool:
    """Returns True if the force loop of a run is to use visual estimates."""
    return config.uses_vision and config.control.feedback != "current"


def vision_in_hold(
    statuses: Sequence[GraspStatus],
    estimates: Sequence[FusedForce],
    visuals: Sequence[VisualForce],
    events: Sequence[Event],
) -> HoldVision | None:
    """Computes the use of vision in the hold of the last grasp of a run; None without a hold.

    Reasons that differ in their numbers only count as one, with the numbers of the longest.

    Args:
        statuses: States of the controller in order of time.
        estimates: Fused estimates, one per cycle.
        visuals: Visual estimates of familiar frames.
        events: Events of the run.
    """
    held_ns = [s.t_ns for s in statuses if s.phase == Phase.HOLD]
    if not held_ns:
        return None
    start_ns = _start_ns(_GRASP_PHASES, statuses, held_ns[-1])
    sources = {estimate.t_ns: estimate.source for estimate in estimates}
    reasons = drop_out_reasons(visuals, events)
    cycles = used = 0
    lost_s: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for status, after in pairwise([*statuses, statuses[-1]]):
        if status.phase != Phase.HOLD or status.t_ns < start_ns:
            continue
        cycles += 1
        if sources.get(status.t_ns, EstimateSource.CURRENT) != EstimateSource.CURRENT:
            used += 1
            continue
        index = bisect_right(reasons, status.t_ns, key=lambda entry: entry[0])
        reason = reasons[index - 1][1] if index else "no estimate was used"
        lost_s[_NUMBER.sub("", reason)][reason] += (after.t_ns - status.t_ns) / NS_PER_S
    losses = [VisionLoss(max(times, key=times.__getitem__), sum(times.values())) for times in lost_s.values()]
    return HoldVision(used / cycles, sorted(losses, key=lambda loss: -loss.time_s))


def drop_out_reasons(visuals: Sequence[VisualForce], events: Sequence[Event]) -> list[tuple[int, str]]:
    """Returns time and reason of each time at which vision dropped out, in order of time."""
    ready_ns = sorted(visual.ready_ns for visual in visuals)
    reasons, problem_ns, problem = [], 0, ""
    for event in sorted(events, key=lambda event: event.t_ns):
        if event.text.startswith(NO_ESTIMATE):
            problem_ns, problem = event.t_ns, event.text.removeprefix(NO_ESTIMATE)
            if not bisect_right(ready_ns, problem_ns):  # vision was never in use, so it can't drop out
                reasons.append((problem_ns, problem))
        elif (reason := drop_out_reason(event.text)) is not None:
            # The controller does not know why a frame gave no estimate; the session does.
            recovered = bisect_right(ready_ns, event.t_ns) > bisect_right(ready_ns, problem_ns)
            if reason == NO_NEW_ESTIMATE and problem and not recovered:
                reason = problem
            reasons.append((event.t_ns, reason))
    return reasons


def _start_ns(phases: tuple[Phase, ...], statuses: Sequence[GraspStatus], end_ns: int) -> int:
    """Returns the start of the continuous run of these phases that lasts to ``end_ns``."""
    start_ns = end_ns
    for status in reversed([s for s in statuses if s.t_ns <= end_ns]):
        if status.phase not in phases:
            break
        start_ns = status.t_ns
    return start_ns
