"""Closed-form refit of the network's last layer: ridge regression on its features, for several penalties.

The regression target is the residual of the output correction. Zero weights leave the corrected network
unchanged, and the penalty shrinks the weights towards zero (A. E. Hoerl and R. W. Kennard, Technometrics 12
(1970) 55-67, doi:10.1080/00401706.1970.10488634). There are more features than frames, so the eigenvectors of
the frames' Gram matrix are used: a stable factorisation, and one for all penalties and right-hand sides.
"""

import numpy as np

from gripper_calibration.fits.touches import Floats
from gripper_force.profiles.correction import Features

PENALTIES = np.geomspace(1e1, 1e-6, 8)
"""Penalties as shares of the total variance of the features, strongest first."""


class Ridge:
    """Factorised features of some frames.

    Attributes:
        mean: Mean of the features, (F,).
    """

    def __init__(self, features: Features) -> None:
        """Factorises ``features``, (N, F)."""
        self.mean: Floats = features.mean(0, dtype=np.float64)
        self._deviation = features - self.mean  # (N, F)
        gram = self._deviation @ self._deviation.T
        values, self._vectors = np.linalg.eigh(gram)  # ascending
        # Eigenvalues at the rounding level belong to directions without variance; never divide by them.
        self._values = np.where(values > values[-1] * len(values) * np.finfo(np.float64).eps, values, 0.0)
        self._spread = max(float(np.trace(gram)) / len(gram), 1e-12)

    def solve(self, residual_n: Floats, penalty: float) -> tuple[Floats, float]:
        """Returns weights (F,) and offset in N that fit the residuals (N,) with one of `PENALTIES`."""
        mean_n = float(residual_n.mean())
        along = self._vectors.T @ (residual_n - mean_n)
        damped = along / (self._values + penalty * self._spread * len(self._values))
        weights: Floats = self._deviation.T @ (self._vectors @ damped)
        return weights, mean_n - float(self.mean @ weights)
