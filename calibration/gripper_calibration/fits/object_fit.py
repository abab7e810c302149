"""The correction of one object from its touches: which one the touches can bear, and how good it is.

Candidates are tried from the simplest on: the network as it is, a line, curves, and a line with the last
layer refitted. Each touch is estimated from all others, and of the candidates that are no worse than the best
by more than one standard error the simplest is taken (L. Breiman et al., Classification and Regression Trees,
1984, section 3.4.3). So touches that contradict each other leave the network as it is, with a wide interval.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from gripper_calibration.fits import ood_fit
from gripper_calibration.fits.interval_fit import FEWEST, by_conformal, by_model
from gripper_calibration.fits.output_curve import BENDS, fit_curve, fit_line, identity
from gripper_calibration.fits.ridge import PENALTIES, Ridge
from gripper_calibration.fits.touches import Floats, Touches, check
from gripper_force.errors import DataError
from gripper_force.profiles.correction import ProfileArrays, curve_n
from gripper_force.profiles.object_profile import Interval, OutputCurve

COVERAGE: Final = 0.9

_FRAMES: Final = 600
"""Frames that a head is fitted on: neighbours tell nearly the same, and the cost goes with the cube."""

_LEAST_GAIN: Final = 0.2

Advance = Callable[[], None]


class Candidate(NamedTuple):
    """A way to correct.

    Attributes:
        name: In words.
        curve: Of the output: ``identity``, ``affine``, or one of `BENDS`.
        penalty: Of the last layer, of `PENALTIES`; None leaves it.
    """

    name: str
    curve: str | float
    penalty: float | None


@dataclass(frozen=True, eq=False)
class Fitted:
    """A correction and what is known of it.

    Attributes:
        output: Correction of the output.
        arrays: Correction of the last layer, and the gate's plane.
        ood_limit: The gate's limit.
        interval: How far off it is at most.
        candidate: Which one was taken, in words.
        left_out_n: What each touch was estimated at from all others, (N,); NaN with less than 3 touches.
        errors_n: MAE of each candidate on touches left out, by name.
        before_n: MAE of the network as it is, on all frames.
        after_n: MAE of `left_out_n`; None where there were too few touches.
    """

    output: OutputCurve
    arrays: ProfileArrays
    ood_limit: float
    interval: Interval
    candidate: str
    left_out_n: Floats
    errors_n: dict[str, float]
    before_n: float
    after_n: float | None

    def predict(self, touches: Touches) -> Floats:
        """Corrected forces, (N,)."""
        knots = np.array(self.output.estimate_n), np.array(self.output.force_n)
        return curve_n(*knots, touches.estimate_n) + self.arrays.head_n(touches.features)


def fit_correction(touches: Touches, coverage: float = COVERAGE, advance: Advance = lambda: None) -> Fitted:
    """Fits the correction of an object.

    Args:
        touches: One touch or more.
        coverage: What its interval is to promise.
        advance: Told of each touch that was left out and estimated.

    Raises:
        DataError: Nothing can be learnt from the touches.
    """
    check(touches)
    line = fit_line(touches)
    if line.gain < _LEAST_GAIN:
        raise DataError(
            f"the load cell feels {line.gain:.2f} N for each that the network sees; so far off it is no "
            "calibration: see load_cell.n_per_raw, vision.region and the checkpoint"
        )
    thin = touches.thinned(_FRAMES)
    ridge = Ridge(thin.features)
    numbers = touches.numbers
    if len(numbers) < FEWEST:
        chosen, left_out_n, errors_n, ood_score = _AFFINE, np.full(len(touches.touch), np.nan), {}, []
    else:
        left_out = []
        for number in numbers:
            left_out.append(_estimate(touches.without(number), touches.only([number])))
            advance()
        error_n = np.stack([np.abs(out.forces_n - out.felt_n).mean(1) for out in left_out])  # (K, candidates)
        chosen = _CANDIDATES[_simplest(error_n)]
        errors_n = {c.name: float(e) for c, e in zip(_CANDIDATES, error_n.mean(0), strict=True)}
        left_out_n = np.empty(len(touches.touch))
        for number, out in zip(numbers, left_out, strict=True):
            left_out_n[touches.touch == number] = out.forces_n[_CANDIDATES.index(chosen)]
        ood_score = [out.ood_score for out in left_out]
    ((output, head, offset),) = _fits(touches, thin, ridge, [chosen])
    if errors_n:
        interval = by_conformal(left_out_n, touches.force_n, touches.touch, coverage)
    else:
        interval = by_model(line, coverage)
    return Fitted(
        output=output,
        arrays=_arrays(ridge, head, offset),
        ood_limit=ood_fit.limit(ood_score),
        interval=interval,
        candidate=chosen.name,
        left_out_n=left_out_n,
        errors_n=errors_n,
        before_n=float(np.abs(touches.estimate_n - touches.force_n).mean()),
        after_n=float(np.abs(left_out_n - touches.force_n).mean()) if errors_n else None,
    )


def learning_curve(
    touches: Touches, coverage: float = COVERAGE, draws: int = 3, advance: Advance = lambda: None
) -> Iterator[tuple[int, float, float]]:
    """How many touches are enough: each number of them, drawn at random, against all that were not drawn.

    Yields:
        Number of touches, MAE of the others corrected by them, and the share of those within the interval.
    """
    numbers = touches.numbers
    rng = np.random.default_rng(0)
    for count in (2**i for i in range(len(numbers).bit_length()) if 2**i < len(numbers)):
        for _ in range(draws):
            drawn = [int(number) for number in rng.choice(numbers, count, replace=False)]
            rest = touches.only([number for number in numbers if number not in drawn])
            try:
                fitted = fit_correction(touches.only(drawn), coverage)
            except DataError:  # so few touches may all have been light ones
                continue
            predicted_n = fitted.predict(rest)
            error_n = np.abs(predicted_n - rest.force_n)
            half_n = fitted.interval.half_width_n(predicted_n)
            yield count, float(error_n.mean()), float((error_n <= half_n).mean())
        advance()


class _LeftOut(NamedTuple):
    forces_n: Floats  # (candidates, N)
    felt_n: Floats  # (N,)
    ood_score: Floats  # (N,)


def _candidates() -> list[Candidate]:
    curves: list[tuple[str, str | float]] = [("a line", "affine")]
    curves += [(f"a curve (bend {bend:g})", bend) for bend in BENDS]
    alone = [Candidate("the network as it is", "identity", None), *(Candidate(n, c, None) for n, c in curves)]
    # The last layer bends what a line leaves; a curve besides would do it twice.
    heads = [Candidate(f"a line, and the last layer ({p:.0e})", "affine", float(p)) for p in PENALTIES]
    return alone + heads


_CANDIDATES: Final = _candidates()
_AFFINE: Final = next(c for c in _CANDIDATES if c.curve == "affine" and c.penalty is None)


def _simplest(error_n: Floats) -> int:
    """The first candidate that is no worse than the best by more than a standard error of the difference."""
    best = int(error_n.mean(0).argmin())
    more_n = error_n - error_n[:, [best]]  # (K, candidates)
    allowed_n = more_n.std(0, ddof=1) / np.sqrt(len(error_n))
    return int(np.argmax(more_n.mean(0) <= allowed_n))


def _estimate(others: Touches, left: Touches) -> _LeftOut:
    thin = others.thinned(_FRAMES)
    ridge = Ridge(thin.features)
    forces_n = []
    for output, head, offset in _fits(others, thin, ridge, _CANDIDATES):
        base_n = curve_n(np.array(output.estimate_n), np.array(output.force_n), left.estimate_n)
        forces_n.append(base_n + (0.0 if head is None else left.features @ head + offset))
    plane = _arrays(ridge, None, 0.0)
    return _LeftOut(np.stack(forces_n), left.force_n, plane.ood_score(left.features))


def _fits(
    touches: Touches, thin: Touches, ridge: Ridge, candidates: Sequence[Candidate]
) -> Iterator[tuple[OutputCurve, Floats | None, float]]:
    line = fit_line(touches)
    reach_n = float(touches.estimate_n.max())
    missing_n = thin.force_n - line.predict(thin.estimate_n)
    for candidate in candidates:
        if candidate.curve == "identity":
            output = identity(reach_n)
        elif candidate.curve == "affine":
            output = line.curve(reach_n)
        else:
            output = fit_curve(touches, line, float(candidate.curve))
        if candidate.penalty is None:
            yield output, None, 0.0
        else:
            yield output, *ridge.solve(missing_n, candidate.penalty)


def _arrays(ridge: Ridge, head: Floats | None, offset: float) -> ProfileArrays:
    return ProfileArrays(
        head=(np.zeros_like(ridge.mean) if head is None else head).astype(np.float32),
        offset=np.array([offset], np.float32),
        mean=ridge.mean.astype(np.float32),
        axes=ridge.axes(ood_fit.AXES).astype(np.float32),
        spread=np.array([ridge.spread], np.float32),
    )
