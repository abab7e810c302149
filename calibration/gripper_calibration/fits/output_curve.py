"""Correction of the network's output: a line with few touches, otherwise a monotone curve.

*The line.* Each touch has its own line, because the object's position between the jaws changes the image by
some percent. A touch therefore determines the object's line only up to that scatter, no matter how many frames
it has: a random-effects model as in meta-analysis (R. DerSimonian and N. Laird, Controlled Clinical Trials 7
(1986) 177-188, doi:10.1016/0197-2456(86)90046-2), with a prior centred on the uncorrected network. The prior
has the tails of Student's t (K. L. Lange et al., JASA 84 (1989) 881, doi:10.1080/01621459.1989.10478852), so
that it does not hold back the correction of a kind of object that the network was not trained on. Huber's
weights limit the effect of load-cell spikes (P. J. Huber, Annals of Mathematical Statistics 35 (1964) 73,
doi:10.1214/aoms/1177703732).

*The curve.* Piecewise linear with positive slopes. A penalty on the difference between its slopes and the
line's slope draws it to the line.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from gripper_calibration.fits.touches import Floats, Touches
from gripper_force.profiles.object_profile import OutputCurve

GAIN_STD: Final = 0.25
OFFSET_STD_N: Final = 0.1
"""Prior standard deviations of the errors of the network's gain and offset for an object."""

_GAIN_PRIOR_DOF: Final = 2.0
"""Degrees of freedom of the gain's prior: the fewer, the more probable are large gain errors."""

_TOUCH_GAIN_STD: Final = 0.05
_TOUCH_OFFSET_STD_N: Final = 0.05
_TOUCH_PRIOR_WEIGHT: Final = 2.0
"""Prior standard deviations between touches of one object (gain: as a share of it), and the prior's weight in
touches."""

_FRAMES_PER_DRAW: Final = 20
"""Correlated frames that count as one independent frame: the network's window."""

_MIN_STD_N: Final = 0.03
_HUBER_WIDTH: Final = 1.345
"""Huber's width in standard deviations: 95 % efficiency for normal errors."""
_ITERATIONS: Final = 10

_SEGMENT_N: Final = 1.5
_MAX_SEGMENTS: Final = 8
BENDS: Final = (0.03, 0.1, 0.3)
"""Prior standard deviations of a curve's slopes about the slope of its line."""

_MIN_SLOPE: Final = 1e-3


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Line ``force = gain * estimate + offset_n`` of an object, and the scatter of its touches.

    Attributes:
        gain: Newtons per newton of the network's estimate.
        offset_n: Newtons to add.
        covariance: Covariance of gain and offset, (2, 2).
        touch_std: Standard deviations of the touches' gains and offsets about the line's, (2,).
        degrees: Degrees of freedom of `touch_std`: one less than the touches, and the prior's weight.
        frame_std_n: Standard deviation of a frame about the line of its touch.
    """

    gain: float
    offset_n: float
    covariance: Floats
    touch_std: Floats
    degrees: float
    frame_std_n: float

    def predict(self, estimate_n: Floats) -> Floats:
        """Returns the forces, (N,)."""
        return self.gain * estimate_n + self.offset_n

    def curve(self, max_estimate_n: float) -> OutputCurve:
        """Returns the line as a curve from 0 to ``max_estimate_n``, or to 1 N if that is larger."""
        ends = (0.0, max(max_estimate_n, 1.0))
        return OutputCurve(
            kind="affine", estimate_n=ends, force_n=tuple(self.gain * end + self.offset_n for end in ends)
        )


class LineEvidence(NamedTuple):
    """Robust fit of a line to one touch alone: all that a fit to several touches needs of it.

    Attributes:
        gram: Weighted products of estimate and 1, (2, 2).
        moment: Their weighted products with force less estimate, (2,).
        square: Weighted sum of the squared residuals.
        frames: Sum of the frames' weights.
    """

    gram: Floats
    moment: Floats
    square: float
    frames: float


def line_evidence(touches: Touches) -> dict[int, LineEvidence]:
    """Returns the evidence of each touch, by its number."""
    return {number: _evidence(touches.only([number])) for number in touches.numbers}


def _evidence(touch: Touches) -> LineEvidence:
    design = np.column_stack([touch.estimate_n, np.ones(len(touch.estimate_n))])
    target = touch.force_n - touch.estimate_n
    weights = _huber_weights(design, target)
    root = np.sqrt(weights)
    fit = np.linalg.lstsq(design * root[:, None], target * root, rcond=None)[0]
    weighted = (design * weights[:, None]).T
    square = float(weights @ np.square(target - design @ fit))
    return LineEvidence(weighted @ design, weighted @ target, square, float(weights.sum()))


def fit_line(touches: Touches, evidence: Mapping[int, LineEvidence] | None = None) -> LinearFit:
    """Fits the line. One touch is enough; the prior then limits its effect.

    Args:
        touches: One or more touches.
        evidence: `line_evidence` of these touches, and perhaps of others, if it is known.
    """
    known = line_evidence(touches) if evidence is None else evidence
    gram, moment, square, frames = zip(*(known[number] for number in touches.numbers), strict=True)
    count = len(gram)
    frame_std_n = max(float(np.sqrt(sum(square) / sum(frames))), _MIN_STD_N)
    scale = 1 / (_FRAMES_PER_DRAW * frame_std_n**2)
    grams, moments = scale * np.stack(gram), scale * np.stack(moment)  # (K, 2, 2), (K, 2)
    gain_weight = 0.0  # the first iteration is without the gain's prior
    touch_var = np.square([_TOUCH_GAIN_STD, _TOUCH_OFFSET_STD_N])
    unit = np.eye(2)
    for _ in range(_ITERATIONS):
        shrinkage = np.linalg.inv(unit + grams * touch_var)
        prior = np.diag([gain_weight * GAIN_STD**-2, OFFSET_STD_N**-2])
        precision = prior + (shrinkage @ grams).sum(0)
        line = np.linalg.solve(precision, (shrinkage @ moments[..., None]).sum(0)[:, 0])
        gain_weight = (_GAIN_PRIOR_DOF + 1) / (_GAIN_PRIOR_DOF + (line[0] / GAIN_STD) ** 2)
        # Expectation-maximisation: posterior mean and variance of each touch's deviation from the line.
        covariances = np.linalg.inv(grams + np.diag(1 / touch_var))
        deviations = (covariances @ (moments - grams @ line)[..., None])[..., 0]  # (K, 2)
        variances = np.diagonal(covariances, axis1=1, axis2=2)
        prior_var = np.square([_TOUCH_GAIN_STD * max(1.0, 1 + line[0]), _TOUCH_OFFSET_STD_N])
        total = _TOUCH_PRIOR_WEIGHT * prior_var + (np.square(deviations) + variances).sum(0)
        touch_var = total / (_TOUCH_PRIOR_WEIGHT + count)
    # A correction never falls, also if the touches of a fold say so: then it is nearly constant.
    gain = max(float(1 + line[0]), _MIN_SLOPE)
    return LinearFit(
        gain=gain,
        offset_n=float(line[1] + (1 + line[0] - gain) * touches.estimate_n.mean()),
        covariance=np.asarray(np.linalg.inv(precision), np.float64),
        touch_std=np.sqrt(touch_var),
        degrees=count - 1 + _TOUCH_PRIOR_WEIGHT,
        frame_std_n=frame_std_n,
    )


class CurveProblem:
    """Weighted frames of a curve's fit about a line, for any bend."""

    def __init__(self, touches: Touches, line: LinearFit) -> None:
        """Prepares the fit to ``touches``, about their line."""
        estimate_n = touches.estimate_n
        max_estimate_n = max(float(estimate_n.max()), 1.0)
        segments = int(np.clip(round(max_estimate_n / _SEGMENT_N), 2, _MAX_SEGMENTS))
        self._line, self._knots = line, np.linspace(0.0, max_estimate_n, segments + 1)
        low, high = self._knots[:-1].copy(), np.diff(self._knots)
        inside = np.clip(estimate_n[:, None] - low, 0, high)  # (N, segments)
        inside[:, 0] = np.minimum(estimate_n, high[0])  # the first and last segment extend beyond the knots
        inside[:, -1] = np.where(estimate_n > low[-1], estimate_n - low[-1], 0.0)
        design = np.column_stack([np.ones(len(estimate_n)), inside])
        target = touches.force_n - line.predict(estimate_n)
        weight = np.sqrt(_huber_weights(design, target) / _FRAMES_PER_DRAW)
        self._rows, self._values = design * weight[:, None], target * weight

    def solve(self, bend: float) -> OutputCurve:
        """Returns the curve with one of `BENDS`."""
        line, knots, segments = self._line, self._knots, len(self._knots) - 1
        penalty = np.zeros((segments, segments + 1))
        penalty[:, 1:] = line.frame_std_n / bend * np.eye(segments)
        rows = np.vstack([self._rows, penalty])
        values = np.concatenate([self._values, np.zeros(segments)])
        lower = np.full(segments + 1, -np.inf)
        lower[1:] = _MIN_SLOPE - line.gain
        solution = lsq_linear(rows, values, bounds=(lower, np.inf)).x
        slopes = np.maximum(line.gain + solution[1:], _MIN_SLOPE)
        forces = line.offset_n + solution[0] + np.concatenate([[0.0], np.cumsum(slopes * np.diff(knots))])
        return OutputCurve(kind="monotone", estimate_n=tuple(knots.tolist()), force_n=tuple(forces.tolist()))


def identity(max_estimate_n: float) -> OutputCurve:
    """Returns the curve that leaves the network's estimate unchanged."""
    ends = (0.0, max(max_estimate_n, 1.0))
    return OutputCurve(kind="identity", estimate_n=ends, force_n=ends)


def _huber_weights(design: Floats, target: Floats) -> Floats:
    """Weights of a robust linear fit, (N,), by iteratively reweighted least squares."""
    weights = np.ones(len(target))
    for _ in range(_ITERATIONS):
        root = np.sqrt(weights)
        fit = np.linalg.lstsq(design * root[:, None], target * root, rcond=None)[0]
        residual = np.abs(target - design @ fit)
        width = _HUBER_WIDTH * max(1.4826 * float(np.median(residual)), _MIN_STD_N)
        weights = np.minimum(1.0, width / np.maximum(residual, 1e-12))
    return weights
