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

from dataclasses import dataclass
from typing import Final

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


def fit_line(touches: Touches) -> LinearFit:
    """Fits the line. One touch is enough; the prior then limits its effect."""
    parts = [touches.only([number]) for number in touches.numbers]
    designs = [np.column_stack([part.estimate_n, np.ones(len(part.estimate_n))]) for part in parts]
    residuals = [part.force_n - part.estimate_n for part in parts]
    weights = [_huber_weights(x, r) for x, r in zip(designs, residuals, strict=True)]
    frame_std_n = max(_frame_std_n(designs, residuals, weights), _MIN_STD_N)
    scale = 1 / (_FRAMES_PER_DRAW * frame_std_n**2)
    grams = [scale * (x * w[:, None]).T @ x for x, w in zip(designs, weights, strict=True)]  # (2, 2) each
    moments = [scale * (x * w[:, None]).T @ r for x, r, w in zip(designs, residuals, weights, strict=True)]
    gain_weight = 0.0  # the first iteration is without the gain's prior
    touch_var = np.square([_TOUCH_GAIN_STD, _TOUCH_OFFSET_STD_N])
    unit = np.eye(2)
    for _ in range(_ITERATIONS):
        shrinkage = [np.linalg.inv(unit + gram * touch_var) for gram in grams]
        prior = np.diag([gain_weight * GAIN_STD**-2, OFFSET_STD_N**-2])
        precision = prior + sum(s @ g for s, g in zip(shrinkage, grams, strict=True))
        line = np.linalg.solve(precision, sum(s @ p for s, p in zip(shrinkage, moments, strict=True)))
        gain_weight = (_GAIN_PRIOR_DOF + 1) / (_GAIN_PRIOR_DOF + (line[0] / GAIN_STD) ** 2)
        # Expectation-maximisation: posterior mean and variance of each touch's deviation from the line.
        deviations = [
            np.linalg.solve(g + np.diag(1 / touch_var), p - g @ line)
            for g, p in zip(grams, moments, strict=True)
        ]
        variances = [np.diag(np.linalg.inv(g + np.diag(1 / touch_var))) for g in grams]
        prior_var = np.square([_TOUCH_GAIN_STD * max(1.0, 1 + line[0]), _TOUCH_OFFSET_STD_N])
        total = _TOUCH_PRIOR_WEIGHT * prior_var + sum(
            np.square(d) + v for d, v in zip(deviations, variances, strict=True)
        )
        touch_var = total / (_TOUCH_PRIOR_WEIGHT + len(parts))
    # A correction never falls, also if the touches of a fold say so: then it is nearly constant.
    gain = max(float(1 + line[0]), _MIN_SLOPE)
    return LinearFit(
        gain=gain,
        offset_n=float(line[1] + (1 + line[0] - gain) * touches.estimate_n.mean()),
        covariance=np.asarray(np.linalg.inv(precision), np.float64),
        touch_std=np.sqrt(touch_var),
        degrees=len(parts) - 1 + _TOUCH_PRIOR_WEIGHT,
        frame_std_n=frame_std_n,
    )


def fit_curve(touches: Touches, line: LinearFit, bend: float) -> OutputCurve:
    """Fits the curve about its line; ``bend`` is one of `BENDS`."""
    estimate_n = touches.estimate_n
    max_estimate_n = max(float(estimate_n.max()), 1.0)
    segments = int(np.clip(round(max_estimate_n / _SEGMENT_N), 2, _MAX_SEGMENTS))
    knots = np.linspace(0.0, max_estimate_n, segments + 1)
    low, high = knots[:-1].copy(), np.diff(knots)
    inside = np.clip(estimate_n[:, None] - low, 0, high)  # (N, segments)
    inside[:, 0] = np.minimum(estimate_n, high[0])  # the first and last segment extend beyond the knots
    inside[:, -1] = np.where(estimate_n > low[-1], estimate_n - low[-1], 0.0)
    design = np.column_stack([np.ones(len(estimate_n)), inside])
    target = touches.force_n - line.predict(estimate_n)
    weight = np.sqrt(_huber_weights(design, target) / _FRAMES_PER_DRAW)
    penalty = np.zeros((segments, segments + 1))
    penalty[:, 1:] = line.frame_std_n / bend * np.eye(segments)
    rows = np.vstack([design * weight[:, None], penalty])
    values = np.concatenate([target * weight, np.zeros(segments)])
    lower = np.full(segments + 1, -np.inf)
    lower[1:] = _MIN_SLOPE - line.gain
    solution = lsq_linear(rows, values, bounds=(lower, np.inf)).x
    slopes = np.maximum(line.gain + solution[1:], _MIN_SLOPE)
    forces = line.offset_n + solution[0] + np.concatenate([[0.0], np.cumsum(slopes * high)])
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


def _frame_std_n(designs: list[Floats], targets: list[Floats], weights: list[Floats]) -> float:
    """Standard deviation of frames about the line of their touch."""
    total, count = 0.0, 0.0
    for x, r, w in zip(designs, targets, weights, strict=True):
        root = np.sqrt(w)
        fit = np.linalg.lstsq(x * root[:, None], r * root, rcond=None)[0]
        total += float(w @ np.square(r - x @ fit))
        count += float(w.sum())
    return float(np.sqrt(total / count))
