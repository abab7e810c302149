"""Fit of the correction of one object from its touches, with model selection.

The candidates are, from the simplest: no correction, a line, curves, and a line with the last layer refitted.
They are compared by cross-validation, leaving out one touch at a time. Among the candidates that are not
worse than the best by more than one standard error, the simplest is selected (L. Breiman et al.,
Classification and Regression Trees, 1984, section 3.4.3). Touches that contradict each other therefore leave
the network uncorrected, with a wide interval.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from gripper_calibration.fits.interval_fit import MIN_TOUCHES, conformal_interval, model_interval
from gripper_calibration.fits.ood_fit import SUBSPACE_DIMENSIONS, fit_ood_limit
from gripper_calibration.fits.output_curve import BENDS, fit_curve, fit_line, identity
from gripper_calibration.fits.ridge import PENALTIES, Ridge
from gripper_calibration.fits.touches import Floats, Touches, check
from gripper_force.errors import DataError
from gripper_force.profiles.correction import ProfileArrays, curve_n
from gripper_force.profiles.object_profile import Interval, OutputCurve

COVERAGE: Final = 0.9
"""Coverage of the interval in a profile."""

_MAX_FRAMES: Final = 600
"""Frames for a fit of the last layer. Adjacent frames carry nearly the same data, and the cost is cubic."""

_MIN_GAIN: Final = 0.2


class Candidate(NamedTuple):
    """One kind of correction.

    Attributes:
        name: Name for a person; a key of the command's output.
        curve: Correction of the output: ``identity``, ``affine``, or one of `BENDS`.
        penalty: Penalty of the last layer's refit, one of `PENALTIES`; None for no refit.
    """

    name: str
    curve: str | float
    penalty: float | None


@dataclass(frozen=True, eq=False)
class ObjectFit:
    """A fitted correction with its errors.

    Attributes:
        output: Correction of the output.
        arrays: Correction of the last layer, and the subspace of the features.
        ood_limit: Out-of-distribution limit.
        interval: Prediction interval.
        candidate: Name of the selected candidate.
        cross_validated_n: Estimates of each touch, corrected by all other touches, (N,); NaN with fewer than
            three touches.
        errors_n: Cross-validated MAE of each candidate, by name; empty with fewer than three touches.
        before_n: MAE of the uncorrected network on all frames.
        after_n: MAE of `cross_validated_n`; None with fewer than three touches.
    """

    output: OutputCurve
    arrays: ProfileArrays
    ood_limit: float
    interval: Interval
    candidate: str
    cross_validated_n: Floats
    errors_n: dict[str, float]
    before_n: float
    after_n: float | None

    def predict(self, touches: Touches) -> Floats:
        """Returns the corrected forces, (N,)."""
        knots = np.array(self.output.estimate_n), np.array(self.output.force_n)
        return curve_n(*knots, touches.estimate_n) + self.arrays.head_n(touches.features)


class LearningCurvePoint(NamedTuple):
    """Result of a fit on some of the touches, tested on the others.

    Attributes:
        touches: Touches in the fit.
        mae_n: MAE on the other touches.
        covered: Share of their frames within the interval.
    """

    touches: int
    mae_n: float
    covered: float


def fit_correction(touches: Touches, coverage: float = COVERAGE) -> ObjectFit:
    """Fits the correction of an object.

    Args:
        touches: One or more touches.
        coverage: Coverage of the interval.

    Raises:
        DataError: The touches are not sufficient, or the fitted gain is implausibly small.
    """
    check(touches)
    line = fit_line(touches)
    if line.gain < _MIN_GAIN:
        raise DataError(
            f"the load cell measures {line.gain:.2f} N for each newton of the network's estimate, too far off "
            "for a correction; check load_cell.n_per_raw, vision.region and the checkpoint"
        )
    thin = touches.thinned(_MAX_FRAMES)
    ridge = Ridge(thin.features)
    numbers = touches.numbers
    if len(numbers) < MIN_TOUCHES:
        selected, errors_n, ood_scores = _AFFINE, {}, []
        cross_validated_n = np.full(len(touches.touch), np.nan)
    else:
        left_out = [_predict_left_out(touches.without(n), touches.only([n])) for n in numbers]
        error_n = np.stack([np.abs(out.forces_n - out.true_n).mean(1) for out in left_out])  # (K, candidates)
        selected = _CANDIDATES[_select_simplest(error_n)]
        errors_n = {c.name: float(e) for c, e in zip(_CANDIDATES, error_n.mean(0), strict=True)}
        cross_validated_n = np.empty(len(touches.touch))
        for number, out in zip(numbers, left_out, strict=True):
            cross_validated_n[touches.touch == number] = out.forces_n[_CANDIDATES.index(selected)]
        ood_scores = [out.ood_score for out in left_out]
    ((output, head, offset),) = _fit_candidates(touches, thin, ridge, [selected])
    if errors_n:
        interval = conformal_interval(cross_validated_n, touches.force_n, touches.touch, coverage)
    else:
        interval = model_interval(line, coverage)
    return ObjectFit(
        output=output,
        arrays=_arrays(ridge, head, offset),
        ood_limit=fit_ood_limit(ood_scores),
        interval=interval,
        candidate=selected.name,
        cross_validated_n=cross_validated_n,
        errors_n=errors_n,
        before_n=float(np.abs(touches.estimate_n - touches.force_n).mean()),
        after_n=float(np.abs(cross_validated_n - touches.force_n).mean()) if errors_n else None,
    )


def learning_curve(
    touches: Touches, coverage: float = COVERAGE, draws: int = 3
) -> Iterator[LearningCurvePoint]:
    """Fits on random subsets of 1, 2, 4, ... touches, and tests each fit on the other touches.

    Args:
        touches: All touches.
        coverage: Coverage of the interval.
        draws: Subsets of each size. A subset that is not sufficient for a fit gives no point.

    Yields:
        A point for each fit, by rising number of touches.
    """
    numbers = touches.numbers
    rng = np.random.default_rng(0)
    for count in (2**i for i in range(len(numbers).bit_length()) if 2**i < len(numbers)):
        for _ in range(draws):
            drawn = [int(number) for number in rng.choice(numbers, count, replace=False)]
            others = touches.only([number for number in numbers if number not in drawn])
            try:
                fit = fit_correction(touches.only(drawn), coverage)
            except DataError:  # all drawn touches may be weak
                continue
            predicted_n = fit.predict(others)
            error_n = np.abs(predicted_n - others.force_n)
            half_n = fit.interval.half_width_n(predicted_n)
            yield LearningCurvePoint(count, float(error_n.mean()), float((error_n <= half_n).mean()))


class _LeftOut(NamedTuple):
    forces_n: Floats  # (candidates, N)
    true_n: Floats  # (N,)
    ood_score: Floats  # (N,)


def _candidates() -> list[Candidate]:
    curves: list[tuple[str, str | float]] = [("a line", "affine")]
    curves += [(f"a curve (bend {bend:g})", bend) for bend in BENDS]
    alone = [Candidate("the network as it is", "identity", None), *(Candidate(n, c, None) for n, c in curves)]
    # The last layer corrects what is not linear, so it is combined with the line only.
    heads = [Candidate(f"a line, and the last layer ({p:.0e})", "affine", float(p)) for p in PENALTIES]
    return alone + heads


_CANDIDATES: Final = _candidates()
_AFFINE: Final = next(c for c in _CANDIDATES if c.curve == "affine" and c.penalty is None)


def _select_simplest(error_n: Floats) -> int:
    """Index of the first candidate within one standard error (of the difference) of the best.

    Args:
        error_n: MAE of each candidate on each left-out touch, (K, candidates).
    """
    best = int(error_n.mean(0).argmin())
    excess_n = error_n - error_n[:, [best]]  # (K, candidates)
    standard_error_n = excess_n.std(0, ddof=1) / np.sqrt(len(error_n))
    return int(np.argmax(excess_n.mean(0) <= standard_error_n))


def _predict_left_out(others: Touches, left_out: Touches) -> _LeftOut:
    thin = others.thinned(_MAX_FRAMES)
    ridge = Ridge(thin.features)
    forces_n = []
    for output, head, offset in _fit_candidates(others, thin, ridge, _CANDIDATES):
        base_n = curve_n(np.array(output.estimate_n), np.array(output.force_n), left_out.estimate_n)
        forces_n.append(base_n + (0.0 if head is None else left_out.features @ head + offset))
    subspace = _arrays(ridge, None, 0.0)
    return _LeftOut(np.stack(forces_n), left_out.force_n, subspace.ood_score(left_out.features))


def _fit_candidates(
    touches: Touches, thin: Touches, ridge: Ridge, candidates: Sequence[Candidate]
) -> Iterator[tuple[OutputCurve, Floats | None, float]]:
    """Yields for each candidate the output's curve, and weights (F,) and offset in N of the last layer."""
    line = fit_line(touches)
    max_estimate_n = float(touches.estimate_n.max())
    residual_n = thin.force_n - line.predict(thin.estimate_n)
    for candidate in candidates:
        if candidate.curve == "identity":
            output = identity(max_estimate_n)
        elif candidate.curve == "affine":
            output = line.curve(max_estimate_n)
        else:
            output = fit_curve(touches, line, float(candidate.curve))
        if candidate.penalty is None:
            yield output, None, 0.0
        else:
            yield output, *ridge.solve(residual_n, candidate.penalty)


def _arrays(ridge: Ridge, head: Floats | None, offset: float) -> ProfileArrays:
    return ProfileArrays(
        head=(np.zeros_like(ridge.mean) if head is None else head).astype(np.float32),
        offset=np.array([offset], np.float32),
        mean=ridge.mean.astype(np.float32),
        axes=ridge.axes(SUBSPACE_DIMENSIONS).astype(np.float32),
        spread=np.array([ridge.spread], np.float32),
    )
