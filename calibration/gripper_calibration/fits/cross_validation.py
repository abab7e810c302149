"""Nested cross-validation of the corrections of one object, leaving out one touch at a time.

Among the candidates that are not worse than the best by more than one standard error, the simplest is selected (L.
Breiman et al., Classification and Regression Trees, 1984, section 3.4.3). Touches that contradict each other
therefore leave the network uncorrected, with a wide interval.

The errors that select a correction are too small for a statement about new touches. Each touch is therefore also
estimated by what the other touches alone select and fit (S. Varma and R. Simon, BMC Bioinformatics 7 (2006) 91,
doi:10.1186/1471-2105-7-91). The selection without one touch takes the errors of fits without two. Its coverage is
tested in the same way, by an interval of the other touches.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gripper_calibration.fits.candidates import CANDIDATES, LINE, Candidate, fit_candidates
from gripper_calibration.fits.interval_fit import MIN_TOUCHES, touch_interval
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

    Args:
        touches: At least `MIN_TOUCHES` touches.
        coverage: Coverage of the interval.
    """
    numbers = touches.numbers
    count = len(numbers)
    parts = [touches.only([number]) for number in numbers]
    # The estimates of touch i by fits without i and j, by (i, j); of touch i by fits without i, by (i, i).
    estimates_n: dict[tuple[int, int], Floats] = {}  # (candidates, N_i) each
    for i in range(count):
        estimates_n[i, i] = _estimates_n(touches.without([numbers[i]]), parts[i])
    nested = count > MIN_TOUCHES
    for i, j in combinations(range(count), 2) if nested else ():
        both_n = _estimates_n(touches.without([numbers[i], numbers[j]]), parts[i], parts[j])
        estimates_n[i, j], estimates_n[j, i] = np.split(both_n, [len(parts[i].touch)], axis=1)

    def errors_n(i: int, j: int) -> Floats:
        error_n: Floats = np.abs(estimates_n[i, j] - parts[i].force_n).mean(1)
        return error_n

    error_n = np.stack([errors_n(i, i) for i in range(count)])  # (K, candidates)
    result_n = np.empty(len(touches.touch))
    within = np.empty(len(touches.touch), bool)
    for k in range(count):
        others = [j for j in range(count) if j != k]
        chosen = CANDIDATES.index(LINE)
        if nested:
            chosen = select_simplest(np.stack([errors_n(j, k) for j in others]))
        own = touches.touch == numbers[k]
        result_n[own] = estimates_n[k, k][chosen]
        if nested:
            interval = touch_interval(
                np.concatenate([estimates_n[j, k][chosen] for j in others]),
                np.concatenate([parts[j].force_n for j in others]),
                np.concatenate([parts[j].touch for j in others]),
                coverage,
            )
            within[own] = np.abs(result_n[own] - parts[k].force_n) <= interval.half_width_n(result_n[own])
    return CrossValidation(
        selected=CANDIDATES[select_simplest(error_n)] if nested else LINE,
        errors_n={c.name: float(e) for c, e in zip(CANDIDATES, error_n.mean(0), strict=True)},
        estimates_n=result_n,
        within=within if nested else None,
    )


def coverages(touches: Touches, within: npt.NDArray[np.bool_]) -> tuple[Coverage, ...]:
    """Returns the coverage in contact, and of each force level that has frames.

    Args:
        touches: The touches.
        within: True for the frames within their interval, (N,).
    """
    ends = (*LEVELS_N[1:], None)
    levels = [(CONTACT_N, None), *zip(LEVELS_N, ends, strict=True)]
    rows = []
    for from_n, to_n in levels:
        level = (touches.force_n > from_n) & (touches.force_n <= (np.inf if to_n is None else to_n))
        shares = [
            within[level & (touches.touch == number)].mean() for number in np.unique(touches.touch[level])
        ]
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


def _estimates_n(others: Touches, *left_out: Touches) -> Floats:
    """Returns the estimates of all candidates, fitted to ``others``, for left-out touches, (candidates, N)."""
    fits = list(fit_candidates(others, CANDIDATES, _MAX_FRAMES))
    return np.stack([np.concatenate([fit.predict(part) for part in left_out]) for fit in fits])
