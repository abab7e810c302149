"""Ill-conditioned fits of the last layer, compared with the same regression in decimals of 50 digits."""

from collections.abc import Iterable, Iterator
from decimal import Decimal, localcontext
from typing import Final

import numpy as np

from gripper_calibration.fits.object_fit import fit_correction
from gripper_calibration.fits.ridge import PENALTIES, Ridge
from gripper_calibration.fits.touches import Floats, Touches
from gripper_force.profiles.correction import Features
from gripper_force.qualification.numerics.numerical_case import NumericalCase

_FRAMES: Final = 20
_FEATURES: Final = 30
_DIGITS: Final = 50
_EPS: Final = float(np.finfo(np.float64).eps)

_CHANGES: Final = (1.0, 0.1, 0.01, 0.001)
"""Changes of the features within a touch. With the network's own last layer the change is 0.1."""

_NEGLIGIBLE_N: Final = 0.005
"""A tenth of the smallest error that an estimate is allowed to have."""


def cases() -> Iterator[NumericalCase]:
    """Yields the cases of the fit of the last layer."""
    for name, features in _feature_sets().items():
        worst, error_n, bound_n = 0.0, 0.0, 0.0
        missing_n = np.random.default_rng(1).normal(0.0, 2.0, len(features))
        for penalty in PENALTIES.tolist():
            allowed_n = _allowed_n(features, missing_n, penalty)
            off_n = _off_n(features, missing_n, penalty)
            if not off_n / allowed_n < worst:  # NaN is the worst
                worst, error_n, bound_n = off_n / allowed_n, off_n, allowed_n
        yield NumericalCase(
            f"last layer fitted to {name}", "all penalties; against 50 digits", error_n, bound_n, "N"
        )
    rounding_n = max(_rounding_n(change) for change in _CHANGES)
    detail = "float32 rounding error of the layer and its features, for feature changes of 1 to 0.001"
    yield NumericalCase("last layer of a profile", detail, rounding_n, _NEGLIGIBLE_N, "N")


def _feature_sets() -> dict[str, Features]:
    rng = np.random.default_rng(0)
    plain = np.tanh(rng.normal(size=(_FRAMES, _FEATURES)))
    one = np.repeat(plain[:1], _FRAMES, axis=0)
    sets = {
        "ordinary frames": plain,
        "more frames than features": np.tanh(rng.normal(size=(_FRAMES, 5))),
        "duplicated frames": np.repeat(plain[::2], 2, axis=0),
        "frames on a line": np.outer(rng.normal(size=_FRAMES), plain[0]) / 4,
        "one repeated frame": one,
        "frames that differ in their last digits": one * (1 + 1e-7 * rng.normal(size=plain.shape)),
        "saturated features": np.sign(plain),
        "denormal features": 1e-40 * plain,
        "a single frame": plain[:1],
    }
    return {name: features.astype(np.float32) for name, features in sets.items()}


def _off_n(features: Features, missing_n: Floats, penalty: float) -> float:
    """Largest error of the fitted forces at the frames of the fit, in N."""
    ridge = Ridge(features)
    weights, offset_n = ridge.solve(missing_n, penalty)
    found_n = features.astype(np.float64) @ weights + offset_n
    with localcontext(prec=_DIGITS):
        exact_n = np.array([float(force_n) for force_n in _exact(features, missing_n, penalty)])
    return float(np.abs(found_n - exact_n).max())


def _allowed_n(features: Features, missing_n: Floats, penalty: float) -> float:
    """Error bound of a numerically stable solution, in N.

    It is the product of the length of the sums, the condition number with the penalty, and the cancellation
    when nearly equal frames are centred (N. J. Higham, "Accuracy and Stability of Numerical Algorithms",
    2002, sections 1.7, 3.1 and 10.1).
    """
    deviation = features - features.mean(0, dtype=np.float64)
    largest = float(np.abs(features).max())
    centring = max(1.0, largest / max(float(np.sqrt(np.square(deviation).mean())), 1e-6))
    lost = sum(features.shape) * _EPS * (1 + 1 / penalty) * centring
    return lost * float(np.abs(missing_n).max())


def _exact(features: Features, missing_n: Floats, penalty: float) -> list[Decimal]:
    frames = [[Decimal(value) for value in row] for row in features.tolist()]
    count = len(frames)
    mean = [_sum(column) / count for column in zip(*frames, strict=True)]
    deviation = [[value - m for value, m in zip(row, mean, strict=True)] for row in frames]
    gram = [[_sum(a * b for a, b in zip(x, y, strict=True)) for y in deviation] for x in deviation]
    spread = max(_sum(gram[i][i] for i in range(count)) / count, Decimal("1e-12"))
    missing = [Decimal(value) for value in missing_n.tolist()]
    mean_n = _sum(missing) / count
    damped = [
        [value + (i == j) * Decimal(penalty) * spread * count for j, value in enumerate(row)]
        for i, row in enumerate(gram)
    ]
    along = _solved(damped, [value - mean_n for value in missing])
    return [mean_n + _sum(g * a for g, a in zip(row, along, strict=True)) for row in gram]


def _solved(matrix: list[list[Decimal]], right: list[Decimal]) -> list[Decimal]:
    """Solves by Gaussian elimination; a positive definite matrix needs no pivoting."""
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    for i, pivot in enumerate(rows):
        for row in rows[i + 1 :]:
            factor = row[i] / pivot[i]
            for j in range(i, len(row)):
                row[j] -= factor * pivot[j]
    solution: list[Decimal] = []
    for i, row in reversed(list(enumerate(rows))):
        known = _sum(a * x for a, x in zip(row[i + 1 : -1], solution, strict=True))
        solution.insert(0, (row[-1] - known) / row[i])
    return solution


def _sum(numbers: Iterable[Decimal]) -> Decimal:
    return sum(numbers, Decimal(0))


def _rounding_n(change: float) -> float:
    """Largest force error in N from rounding a fitted profile and its features to float32."""
    rng = np.random.default_rng(2)
    estimate_n = np.tile(np.concatenate([np.zeros(20), np.linspace(0, 8, 40)]), 6)
    force_n = 1.2 * estimate_n + 0.5 * np.sin(estimate_n) + rng.normal(0, 0.05, len(estimate_n))
    along = rng.normal(size=(2, _FEATURES))
    hidden = np.column_stack([estimate_n / 8, np.sin(estimate_n)])
    features = np.tanh(0.5 + change * (hidden @ along + 0.01 * rng.normal(size=(len(estimate_n), _FEATURES))))
    touches = Touches(features.astype(np.float32), estimate_n, force_n, np.repeat(np.arange(6), 60))
    head = fit_correction(touches).arrays.head.astype(np.float64)
    return float(2 * 2.0**-24 * (np.abs(features) @ np.abs(head)).max())
