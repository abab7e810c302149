"""Correction of the network's output: a line where touches are few, else a curve that never falls.

*The line.* Each touch has a line of its own: how an object lies between the jaws changes what is seen by some
percent. So a touch tells the object's line up to that scatter, however many frames it has, as studies do in a
meta-analysis with random effects (R. DerSimonian and N. Laird, Controlled Clinical Trials 7 (1986) 177-188,
doi:10.1016/0197-2456(86)90046-2), with a prior that the network was right. It has the tails of Student's t
(K. L. Lange et al., JASA 84 (1989) 881, doi:10.1080/01621459.1989.10478852): a kind of object that the
network never saw is not held to what holds of those it did. A load cell's spikes are held down by Huber's
weights (P. J. Huber, Annals of Mathematical Statistics 35 (1964) 73, doi:10.1214/aoms/1177703732).

*The curve.* Straight pieces with slopes that are not negative, drawn to the line by a penalty on how the
slopes differ from its own.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import lsq_linear

from gripper_calibration.fits.touches import Floats, Touches
from gripper_force.profiles.object_profile import OutputCurve

GAIN_STD: Final = 0.25
OFFSET_STD_N: Final = 0.1
"""What is thought of an object before it was touched: how far the network's gain and offset are off."""

_GAIN_TAIL: Final = 2.0
"""Degrees of freedom of the gain's prior: the fewer, the rather may an object be altogether different."""

_TOUCH_GAIN_STD: Final = 0.05
_TOUCH_OFFSET_STD_N: Final = 0.05
_TOUCH_WEIGHT: Final = 2.0
"""And of how far touches of one object differ, in the gain as a share of it, worth so many touches."""

_TOGETHER: Final = 20
"""Frames that tell no more than one: the network's window."""

_LEAST_STD_N: Final = 0.03
_HUBER: Final = 1.345
_ROUNDS: Final = 10

_PIECE_N: Final = 1.5
_MOST_PIECES: Final = 8
BENDS: Final = (0.03, 0.1, 0.3)
"""How far a curve's slopes are thought to differ from its line's, as standard deviations."""

_SMALLEST_SLOPE: Final = 1e-3


@dataclass(frozen=True, eq=False)
class LinearFit:
    """``force = gain * estimate + offset_n`` for an object, and how its touches scatter about it.

    Attributes:
        gain: Newtons for one of the network's.
        offset_n: Newtons to add.
        covariance: Of gain and offset, (2, 2).
        touch_std: Standard deviations of a touch's own gain and offset about them, (2,).
        frame_std_n: Standard deviation of a frame about its touch's line.
    """

    gain: float
    offset_n: float
    covariance: Floats
    touch_std: Floats
    frame_std_n: float

    def predict(self, estimate_n: Floats) -> Floats:
        """Forces, (N,)."""
        return self.gain * estimate_n + self.offset_n

    def curve(self, reach_n: float) -> OutputCurve:
        """The line as a curve."""
        ends = (0.0, max(reach_n, 1.0))
        return OutputCurve(
            kind="affine", estimate_n=ends, force_n=tuple(self.gain * end + self.offset_n for end in ends)
        )


def fit_line(touches: Touches) -> LinearFit:
    """Fits the line. One touch is enough, and then counts for as much as it can tell."""
    parts = [touches.only([number]) for number in touches.numbers]
    designs = [np.column_stack([part.estimate_n, np.ones(len(part.estimate_n))]) for part in parts]
    missing = [part.force_n - part.estimate_n for part in parts]
    weights = [_huber(x, r) for x, r in zip(designs, missing, strict=True)]
    frame_std_n = max(_spread(designs, missing, weights), _LEAST_STD_N)
    scale = 1 / (_TOGETHER * frame_std_n**2)
    grams = [scale * (x * w[:, None]).T @ x for x, w in zip(designs, weights, strict=True)]  # (2, 2) each
    pulls = [scale * (x * w[:, None]).T @ r for x, r, w in zip(designs, missing, weights, strict=True)]
    gain_weight = 0.0  # first what the touches say by themselves
    touch_var = np.square([_TOUCH_GAIN_STD, _TOUCH_OFFSET_STD_N])
    unit = np.eye(2)
    for _ in range(_ROUNDS):
        shrunk = [np.linalg.inv(unit + gram * touch_var) for gram in grams]
        prior = np.diag([gain_weight * GAIN_STD**-2, OFFSET_STD_N**-2])
        precision = prior + sum(s @ g for s, g in zip(shrunk, grams, strict=True))
        line = np.linalg.solve(precision, sum(s @ p for s, p in zip(shrunk, pulls, strict=True)))
        gain_weight = (_GAIN_TAIL + 1) / (_GAIN_TAIL + (line[0] / GAIN_STD) ** 2)
        # Each touch's own departure, as far as its frames tell it: expectation-maximisation.
        own = [
            np.linalg.solve(g + np.diag(1 / touch_var), p - g @ line)
            for g, p in zip(grams, pulls, strict=True)
        ]
        left = [np.diag(np.linalg.inv(g + np.diag(1 / touch_var))) for g in grams]
        first = np.square([_TOUCH_GAIN_STD * max(1.0, 1 + line[0]), _TOUCH_OFFSET_STD_N])
        total = _TOUCH_WEIGHT * first + sum(np.square(o) + v for o, v in zip(own, left, strict=True))
        touch_var = total / (_TOUCH_WEIGHT + len(parts))
    return LinearFit(
        gain=float(1 + line[0]),
        offset_n=float(line[1]),
        covariance=np.asarray(np.linalg.inv(precision), np.float64),
        touch_std=np.sqrt(touch_var),
        frame_std_n=frame_std_n,
    )


def fit_curve(touches: Touches, line: LinearFit, bend: float) -> OutputCurve:
    """Fits the curve about its line; ``bend`` is of `BENDS`."""
    estimate_n = touches.estimate_n
    reach_n = max(float(estimate_n.max()), 1.0)
    pieces = int(np.clip(round(reach_n / _PIECE_N), 2, _MOST_PIECES))
    knots = np.linspace(0.0, reach_n, pieces + 1)
    low, high = knots[:-1].copy(), np.diff(knots)
    inside = np.clip(estimate_n[:, None] - low, 0, high)  # (N, pieces): how far into each piece
    inside[:, 0] = np.minimum(estimate_n, high[0])  # the ends go on
    inside[:, -1] = np.where(estimate_n > low[-1], estimate_n - low[-1], 0.0)
    design = np.column_stack([np.ones(len(estimate_n)), inside])
    target = touches.force_n - line.predict(estimate_n)  # what the line leaves
    weight = np.sqrt(_huber(design, target) / _TOGETHER)
    drawn = np.zeros((pieces, pieces + 1))
    drawn[:, 1:] = line.frame_std_n / bend * np.eye(pieces)
    rows = np.vstack([design * weight[:, None], drawn])
    values = np.concatenate([target * weight, np.zeros(pieces)])
    least = np.full(pieces + 1, -np.inf)
    least[1:] = _SMALLEST_SLOPE - line.gain
    found = lsq_linear(rows, values, bounds=(least, np.inf)).x
    slopes = np.maximum(line.gain + found[1:], _SMALLEST_SLOPE)
    forces = line.offset_n + found[0] + np.concatenate([[0.0], np.cumsum(slopes * high)])
    return OutputCurve(kind="monotone", estimate_n=tuple(knots.tolist()), force_n=tuple(forces.tolist()))


def identity(reach_n: float) -> OutputCurve:
    """The network as it is."""
    ends = (0.0, max(reach_n, 1.0))
    return OutputCurve(kind="identity", estimate_n=ends, force_n=ends)


def _huber(design: Floats, target: Floats) -> Floats:
    """Weights of a robust fit, (N,)."""
    weights = np.ones(len(target))
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)
        fit = np.linalg.lstsq(design * root[:, None], target * root, rcond=None)[0]
        off = np.abs(target - design @ fit)
        width = _HUBER * max(1.4826 * float(np.median(off)), _LEAST_STD_N)
        weights = np.minimum(1.0, width / np.maximum(off, 1e-12))
    return weights


def _spread(designs: list[Floats], targets: list[Floats], weights: list[Floats]) -> float:
    """Standard deviation of frames about their own touch's line."""
    total, count = 0.0, 0.0
    for x, r, w in zip(designs, targets, weights, strict=True):
        root = np.sqrt(w)
        fit = np.linalg.lstsq(x * root[:, None], r * root, rcond=None)[0]
        total += float(w @ np.square(r - x @ fit))
        count += float(w.sum())
    return float(np.sqrt(total / count))
