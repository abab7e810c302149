"""The network's last layer refitted in closed form: ridge regression on its features, for many penalties.

The regression is on what the output correction leaves, so that its zero is the network with that correction,
and penalties draw towards it (A. E. Hoerl and R. W. Kennard, Technometrics 12 (1970) 55-67,
doi:10.1080/00401706.1970.10488634). There are more features than frames: the eigenvectors of the frames' Gram
matrix are a stable factorisation, and serve all penalties and all right sides.
"""

import numpy as np

from gripper_calibration.fits.touches import Floats
from gripper_force.profiles.correction import Features

PENALTIES = np.geomspace(1e1, 1e-6, 8)
"""Shares of the features' whole variance, the strongest first."""


class Ridge:
    """A factorisation of the features of some frames.

    Attributes:
        mean: Mean of the features, (F,).
        spread: Mean square distance from it.
    """

    def __init__(self, features: Features) -> None:
        """Factorises ``features``, (N, F)."""
        self.mean: Floats = features.mean(0, dtype=np.float64)
        self._deviation = features - self.mean  # (N, F)
        gram = self._deviation @ self._deviation.T
        values, self._vectors = np.linalg.eigh(gram)  # rising
        # What rounding leaves of directions that are not there must not be divided by.
        self._values = np.where(values > values[-1] * len(values) * np.finfo(np.float64).eps, values, 0.0)
        self.spread = max(float(np.trace(gram)) / len(gram), 1e-12)

    def solve(self, missing_n: Floats, penalty: float) -> tuple[Floats, float]:
        """Weights (F,) and offset for what is missing, (N,), at a penalty of `PENALTIES`."""
        mean_n = float(missing_n.mean())
        along = self._vectors.T @ (missing_n - mean_n)
        damped = along / (self._values + penalty * self.spread * len(self._values))
        weights: Floats = self._deviation.T @ (self._vectors @ damped)
        return weights, mean_n - float(self.mean @ weights)

    def axes(self, most: int) -> Floats:
        """Orthonormal directions in which the features vary most, (F, R) with R <= ``most``."""
        keep = np.flatnonzero(self._values > 0)[::-1][:most]
        directions: Floats = self._deviation.T @ (self._vectors[:, keep] / np.sqrt(self._values[keep]))
        return directions
