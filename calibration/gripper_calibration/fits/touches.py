"""Touches of one object, as the fits see them."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.profiles.correction import Features

Floats = npt.NDArray[np.float64]

LEAST_PEAK_N: Final = 1.0
"""A calibration without a touch of this force says nothing about forces."""

_LEAST_CORRELATION: Final = 0.5
_LEAST_FRAMES: Final = 20


@dataclass(frozen=True, eq=False)
class Touches:
    """Frames of all touches with a label.

    Attributes:
        features: What the network's last layers make the estimates from, (N, F).
        estimate_n: The network's estimates, (N,).
        force_n: What the load cell felt, (N,).
        touch: Number of each frame's touch, (N,).
    """

    features: Features
    estimate_n: Floats
    force_n: Floats
    touch: npt.NDArray[np.int64]

    @property
    def numbers(self) -> list[int]:
        """The touches there are."""
        return [int(number) for number in np.unique(self.touch)]

    def only(self, numbers: list[int]) -> "Touches":
        """These touches alone."""
        return self._part(np.isin(self.touch, numbers))

    def without(self, number: int) -> "Touches":
        """All touches but this one."""
        return self._part(self.touch != number)

    def thinned(self, most: int) -> "Touches":
        """Evenly spaced frames, no more than so many: neighbours tell nearly the same."""
        keep = np.zeros(len(self.touch), bool)
        keep[:: max(1, -(-len(self.touch) // most))] = True
        return self._part(keep)

    def _part(self, keep: npt.NDArray[np.bool_]) -> "Touches":
        return Touches(self.features[keep], self.estimate_n[keep], self.force_n[keep], self.touch[keep])


def check(touches: Touches) -> None:
    """Raises `DataError` where nothing can be learnt from the touches."""
    if not (np.isfinite(touches.force_n).all() and np.isfinite(touches.features).all()):
        raise DataError("the touches hold values that are not finite; see what the load cell gave")
    if len(touches.force_n) < _LEAST_FRAMES:
        raise DataError(
            f"{len(touches.force_n)} frames have a label, and a calibration needs {_LEAST_FRAMES}; touch "
            "longer"
        )
    peak_n = float(np.quantile(touches.force_n, 0.99))
    if peak_n < LEAST_PEAK_N:
        raise DataError(
            f"the load cell felt no more than {peak_n:.2f} N in all touches, and a calibration needs "
            f"{LEAST_PEAK_N:g} N; press harder, or see to load_cell.n_per_raw and its sign"
        )
    contact = touches.force_n > CONTACT_N
    pair = touches.estimate_n[contact], touches.force_n[contact]
    flat = min(float(np.ptp(values)) for values in pair) < 1e-6
    correlation = 0.0 if flat else float(np.corrcoef(*pair)[0, 1])
    if correlation < _LEAST_CORRELATION:
        raise DataError(
            f"what the network sees does not follow the load cell: their correlation in contact is "
            f"{correlation:.2f}, and {_LEAST_CORRELATION:g} is needed; see vision.region, the first frames "
            "(open jaws) and the timestamps"
        )
