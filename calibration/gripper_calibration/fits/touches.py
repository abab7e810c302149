"""Touches of one object, as input of the fits."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.profiles.correction import Features

Floats = npt.NDArray[np.float64]

MIN_PEAK_N: Final = 1.0
"""A calibration without a touch of this force contains no information about forces."""

_MIN_CORRELATION: Final = 0.5
_MIN_FRAMES: Final = 20


@dataclass(frozen=True, eq=False)
class Touches:
    """The labelled frames of all touches.

    Attributes:
        features: Inputs of the network's last layers, (N, F).
        estimate_n: Visual estimates of the network, (N,).
        force_n: Load-cell forces, (N,).
        touch: Number of the touch of each frame, (N,).
    """

    features: Features
    estimate_n: Floats
    force_n: Floats
    touch: npt.NDArray[np.int64]

    @property
    def numbers(self) -> list[int]:
        """Numbers of the touches, rising."""
        return [int(number) for number in np.unique(self.touch)]

    def only(self, numbers: list[int]) -> "Touches":
        """Returns these touches."""
        return self._select(np.isin(self.touch, numbers))

    def without(self, numbers: list[int]) -> "Touches":
        """Returns all touches except these."""
        return self._select(~np.isin(self.touch, numbers))

    def thinned(self, max_frames: int) -> "Touches":
        """Returns at most ``max_frames`` evenly spaced frames. Adjacent frames carry nearly the same data."""
        keep = np.zeros(len(self.touch), bool)
        keep[:: max(1, -(-len(self.touch) // max_frames))] = True
        return self._select(keep)

    def _select(self, keep: npt.NDArray[np.bool_]) -> "Touches":
        return Touches(self.features[keep], self.estimate_n[keep], self.force_n[keep], self.touch[keep])


def check_touches(touches: Touches) -> None:
    """Checks that the touches are sufficient for a calibration.

    Raises:
        DataError: Values are not finite, there are too few frames, the forces are too small, or the estimates
            do not correlate with the load cell.
    """
    if not all(np.isfinite(x).all() for x in (touches.force_n, touches.estimate_n, touches.features)):
        raise DataError("the touches contain values that are not finite; check the load cell's samples")
    if len(touches.force_n) < _MIN_FRAMES:
        raise DataError(
            f"only {len(touches.force_n)} frames have a label, and a calibration needs {_MIN_FRAMES}; record "
            "longer touches"
        )
    peak_n = float(np.quantile(touches.force_n, 0.99))
    if peak_n < MIN_PEAK_N:
        raise DataError(
            f"the load cell measured no more than {peak_n:.2f} N in all touches, and a calibration needs "
            f"{MIN_PEAK_N:g} N; press harder, or check load_cell.n_per_raw and its sign"
        )
    contact = touches.force_n > CONTACT_N
    pair = touches.estimate_n[contact], touches.force_n[contact]
    flat = min(float(np.ptp(values)) for values in pair) < 1e-6
    correlation = 0.0 if flat else float(np.corrcoef(*pair)[0, 1])
    if correlation < _MIN_CORRELATION:
        raise DataError(
            "the network's estimates do not follow the load cell: their correlation in contact is "
            f"{correlation:.2f}, and {_MIN_CORRELATION:g} is needed; check vision.region, the first frames "
            "(they must show open jaws) and the timestamps"
        )
