"""Fit of the correction of one object from its touches, with its interval and out-of-distribution limits."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from gripper_calibration.fits.candidates import LINE, fit_candidates
from gripper_calibration.fits.cross_validation import Coverage, Measured, coverages, cross_validate
from gripper_calibration.fits.interval_fit import MIN_TOUCHES, model_interval, touch_interval
from gripper_calibration.fits.object_ood_fit import fit_object_ood
from gripper_calibration.fits.output_curve import fit_line
from gripper_calibration.fits.touches import Floats, Touches, check_touches
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.profiles.correction import ProfileArrays
from gripper_force.profiles.object_profile import Interval, OutputCurve
from gripper_force.vision.header import OodModel

COVERAGE: Final = 0.9
"""Coverage of the interval in a profile."""

_MAX_FRAMES: Final = 600
"""Frames for a fit of the last layer. Adjacent frames carry nearly the same data, and the cost is cubic."""

_MIN_GAIN: Final = 0.2


@dataclass(frozen=True, eq=False)
class ObjectFit:
    """A fitted correction with its errors.

    Attributes:
        output: Correction of the output.
        arrays: Correction of the last layer, and the known frames.
        interval: Prediction interval.
        candidate: Name of the selected candidate.
        cross_validated_n: Estimates of each touch by what the other touches select and fit, (N,); NaN with fewer than
            three touches.
        errors_n: Cross-validated MAE of each candidate, by name; empty with fewer than three touches.
        before_n: MAE of the uncorrected network on all frames.
        after_n: MAE of `cross_validated_n`; None with fewer than three touches.
        coverages: Coverage of each touch by an interval from the others, in contact and by force level; empty with
            fewer than four touches.
    """

    output: OutputCurve
    arrays: ProfileArrays
    interval: Interval
    candidate: str
    cross_validated_n: Floats
    errors_n: dict[str, float]
    before_n: float
    after_n: float | None
    coverages: tuple[Coverage, ...]

    def predict(self, touches: Touches) -> Floats:
        """Returns the corrected forces, (N,)."""
        return self.output.at(touches.estimate_n) + self.arrays.head_n(touches.features)


class LearningCurvePoint(NamedTuple):
    """Result of a fit on some of the touches, tested on the others.

    Attributes:
        touches: Touches in the fit.
        mae_n: MAE on the other touches.
        covered: Share of their frames in contact within the interval.
    """

    touches: int
    mae_n: float
    covered: float


def fit_correction(touches: Touches, coverage: float = COVERAGE, ood: OodModel | None = None) -> ObjectFit:
    """Fits the correction of an object.

    Args:
        touches: One or more touches.
        coverage: Coverage of the interval.
        ood: Model of the network's out-of-distribution score; None for no limits.

    Raises:
        DataError: The touches are not sufficient, or the fitted gain is implausibly small.
    """
    check_touches(touches)
    line = fit_line(touches)
    if line.gain < _MIN_GAIN:
        raise DataError(
            f"the load cell measures {line.gain:.2f} N for each newton of the network's estimate, too far off "
            "for a correction; check load_cell.n_per_raw, vision.region and the checkpoint"
        )
    tested = cross_validate(touches, coverage) if len(touches.numbers) >= MIN_TOUCHES else None
    selected = LINE if tested is None else tested.selected
    (fitted,) = fit_candidates(touches, [selected], _MAX_FRAMES)
    head = np.zeros(touches.features.shape[1]) if fitted.head is None else fitted.head
    arrays = ProfileArrays(
        head=head.astype(np.float32),
        offset=np.array([fitted.offset_n], np.float32),
        known=None if ood is None else fit_object_ood(touches, ood),
    )
    before_n = float(np.abs(touches.estimate_n - touches.force_n).mean())
    if tested is None:
        unknown_n = np.full(len(touches.touch), np.nan)
        interval = model_interval(line, coverage)
        return ObjectFit(fitted.output, arrays, interval, selected.name, unknown_n, {}, before_n, None, ())
    return ObjectFit(
        output=fitted.output,
        arrays=arrays,
        interval=touch_interval(tested.estimates_n, touches.force_n, touches.touch, coverage),
        candidate=selected.name,
        cross_validated_n=tested.estimates_n,
        errors_n=tested.errors_n,
        before_n=before_n,
        after_n=float(np.abs(tested.estimates_n - touches.force_n).mean()),
        coverages=()
        if tested.within is None
        else coverages(Measured(touches.force_n, touches.touch), tested.within),
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
            others = touches.without(drawn)
            contact = others.force_n > CONTACT_N
            if not contact.any():
                continue
            try:
                fit = fit_correction(touches.only(drawn), coverage)
            except DataError:  # all drawn touches may be weak
                continue
            predicted_n = fit.predict(others)
            error_n = np.abs(predicted_n - others.force_n)
            within = (error_n <= fit.interval.half_width_n(predicted_n))[contact]
            yield LearningCurvePoint(count, float(error_n.mean()), float(within.mean()))
