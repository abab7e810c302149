"""Nested cross-validation of the corrections of one object, leaving out one touch at a time.

Among the candidates that are not worse than the best by more than one standard error, the simplest is selected (L.
Breiman et al., Classification and Regression Trees, 1984, section 3.4.3). Touches that contradict each other
therefore leave the network uncorrected, with a wide interval.

The errors that select a correction are too small for a statement about new touches. Each touch is therefore also
estimated by what the other touches alone select and fit (S. Varma and R. Simon, BMC Bioinformatics 7 (2006) 91,
doi:10.1186/1471-2105-7-91). The selection without one touch takes the errors of fits without two. Its coverage is
tested in the same way, by an interval of the other touches.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gripper_calibration.fits.candidates import AS_IT_IS, CANDIDATES, LINE, Candidate, fit_candidates
from gripper_calibration.fits.interval_fit import MIN_TOUCHES, touch_interval
from gripper_calibration.fits.output_curve import LineEvidence, line_evidence
from gripper_calibration.fits.touches import Floats, Touches
from gripper_force.jobs.dataset import CONTACT_N

LEVELS_N: Final = (CONTACT_N, 1.0, 2.0, 4.0, 8.0)
"""Lower ends of the force levels of a coverage."""

_MAX_FRAMES: Final = 300
"""Frames for a refit of the last layer. Adjacent frames carry nearly the same data, and the cost is cubic."""


class Coverage(NamedTuple):
    """Share of the frames of left-out touches within an interval that the other touches gave.

    Attributes:
        from_n: Lower end of the force level, by load cell.
        to_n: Upper end; None for all forces above.
        touches: Number of touches with frames there.
        covered: The share, with equal weight for each touch.
    """

    from_n: float
    to_n: float | None
    touches: int
    covered: float


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Results on left-out touches.

    Attributes:
        selected: The correction that all touches select; the line with three touches, which are too few to choose.
        errors_n: MAE of each candidate, by name.
        estimates_n: Estimates of each touch by the correction that the other touches select and fit, (N,).
        within: True where the interval from the other touches contains the force, (N,); None with fewer touches than
            a selection without one of them and an interval need, 4.
    """

    selected: Candidate
    errors_n: dict[str, float]
    estimates_n: Floats
    within: npt.NDArray[np.bool_] | None


def cross_validate(touches: Touches, coverage: float) -> CrossValidation:
    """Selects a correction, and estimates its error and the coverage of its interval.

    If the corrections of touches left out are worse than none, the network stays as it is.

    Args:
        touches: At least `MIN_TOUCHES` touches.
        coverage: Coverage of the interval.
    """
    numbers = touches.numbers
    count = len(numbers)
    parts = [touches.only([number]) for number in numbers]
    evidence = line_evidence(touches)  # the same in all fits
    # The estimates of touch i by fits without i and j, by (i, j); of touch i by fits without i, by (i, i).
    estimates_n: dict[tuple[int, int], Floats] = {}  # (candidates, N_i) each
    for i in range(count):
        estimates_n[i, i] = _estimates_n(touches.without([numbers[i]]), evidence, parts[i])
    nested = count > MIN_TOUCHES
    for i, j in combinations(range(count), 2) if nested else ():
        both_n = _estimates_n(touches.without([numbers[i], numbers[j]]), evidence, parts[i], parts[j])
        estimates_n[i, j], estimates_n[j, i] = np.split(both_n, [len(parts[i].touch)], axis=1)

    measured = [Measured(part.force_n, part.touch) for part in parts]
    error_n = np.concatenate([touch_errors_n(estimates_n[i, i], measured[i]) for i in range(count)])
    selected = CANDIDATES[select_simplest(error_n)] if nested else LINE
    by_touch_n, within = [estimates_n[k, k][CANDIDATES.index(LINE)] for k in range(count)], None
    if nested:
        by_touch_n, inside = estimate_left_out(estimates_n, measured, coverage)
        within = np.empty(len(touches.touch), bool)
    as_it_is_n = [estimates_n[k, k][CANDIDATES.index(AS_IT_IS)] for k in range(count)]
    if _sum_n(by_touch_n, measured) > _sum_n(as_it_is_n, measured):
        selected, by_touch_n = AS_IT_IS, as_it_is_n
        if nested:
            alone_n = {key: one[:1] for key, one in estimates_n.items()}
            by_touch_n, inside = estimate_left_out(alone_n, measured, coverage)
    result_n = np.empty(len(touches.touch))
    for k, number in enumerate(numbers):
        is_own = touches.touch == number
        result_n[is_own] = by_touch_n[k]
        if within is not None:
            within[is_own] = inside[k]
    return CrossValidation(
        selected=selected,
        errors_n={c.name: float(e) for c, e in zip(CANDIDATES, error_n.mean(0), strict=True)},
        estimates_n=result_n,
        within=within,
    )


class Measured(NamedTuple):
    """Labels of one part of the touches, which is left out at once.

    Attributes:
        force_n: Load-cell forces, (N,).
        touch: Number of the touch of each frame, (N,); no touch is in two parts.
    """

    force_n: Floats
    touch: npt.NDArray[np.int64]


def _sum_n(estimates_n: Sequence[Floats], parts: Sequence[Measured]) -> float:
    """Returns the sum of the absolute errors."""
    return sum(float(np.abs(one - part.force_n).sum()) for one, part in zip(estimates_n, parts, strict=True))


def estimate_left_out(
    estimates_n: Mapping[tuple[int, int], Floats], parts: Sequence[Measured], coverage: float
) -> tuple[list[Floats], list[npt.NDArray[np.bool_]]]:
    """Estimates each part by the candidate that the other parts select, and tests their interval on this part.

    Args:
        estimates_n: Estimates of all candidates for part i by fits without the parts i and j, by (i, j), and by fits
            without part i alone, by (i, i); (candidates, N_i) each.
        parts: The parts.
        coverage: Coverage of the interval.

    Returns:
        The estimates of each part, (N,) each, and where the interval contains the force, (N,) each.
    """
    result_n, within = [], []
    for k, part in enumerate(parts):
        others = [(j, other) for j, other in enumerate(parts) if j != k]
        errors_n = [touch_errors_n(estimates_n[j, k], other) for j, other in others]
        chosen = select_simplest(np.concatenate(errors_n))
        interval = touch_interval(
            np.concatenate([estimates_n[j, k][chosen] for j, _ in others]),
            np.concatenate([other.force_n for _, other in others]),
            np.concatenate([other.touch for _, other in others]),
            coverage,
        )
        own_n = estimates_n[k, k][chosen]
        result_n.append(own_n)
        within.append(np.abs(own_n - part.force_n) <= interval.half_width_n(own_n))
    return result_n, within


def touch_errors_n(estimates_n: Floats, part: Measured) -> Floats:
    """Returns the MAE of each candidate on each touch, (touches, candidates), for estimates (candidates, N)."""
    error_n = np.abs(estimates_n - part.force_n)
    return np.stack([error_n[:, part.touch == number].mean(1) for number in np.unique(part.touch)])


def coverages(measured: Measured, within: npt.NDArray[np.bool_]) -> tuple[Coverage, ...]:
    """Returns the coverage in contact, and of each force level that has frames.

    Args:
        measured: Forces and touches of the frames.
        within: True for the frames within their interval, (N,).
    """
    force_n, touch = measured
    ends = (*LEVELS_N[1:], None)
    levels = [(CONTACT_N, None), *zip(LEVELS_N, ends, strict=True)]
    rows = []
    for from_n, to_n in levels:
        level = (force_n > from_n) & (force_n <= (np.inf if to_n is None else to_n))
        shares = [within[level & (touch == number)].mean() for number in np.unique(touch[level])]
        if shares:
            rows.append(Coverage(from_n, to_n, len(shares), float(np.mean(shares))))
    return tuple(rows)


def select_simplest(error_n: Floats) -> int:
    """Returns the index of the first candidate within one standard error (of the difference) of the best.

    Args:
        error_n: MAE of each candidate on each left-out touch, (K, candidates).
    """
    best = int(error_n.mean(0).argmin())
    excess_n = error_n - error_n[:, [best]]  # (K, candidates)
    standard_error_n = excess_n.std(0, ddof=1) / np.sqrt(len(error_n))
    return int(np.argmax(excess_n.mean(0) <= standard_error_n))


def _estimates_n(others: Touches, evidence: Mapping[int, LineEvidence], *left_out: Touches) -> Floats:
    """Returns the estimates of all candidates, fitted to ``others``, for left-out touches, (candidates, N)."""
    fits = list(fit_candidates(others, CANDIDATES, _MAX_FRAMES, evidence))
    return np.stack([np.concatenate([fit.predict(part) for part in left_out]) for fit in fits])
