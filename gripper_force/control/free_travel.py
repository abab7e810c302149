"""Friction that a motion without contact shows."""

import math
from typing import Final

FREE_NOISE_N: Final = 0.5
"""Standard deviation of motor force about friction in one cycle of free travel. Inertia correlates the
cycles."""

_MIN_CYCLES = 10
_MAX_CYCLES = 40
"""Least and greatest number of cycles of free travel that prove friction. Later ones may press a soft object."""


class FreeTravel:
    """Mean motor force of jaws that move without contact: their friction."""

    def __init__(self, max_cycles: int = _MAX_CYCLES) -> None:
        self._max_cycles, self._cycles, self._sum_n = max_cycles, 0, 0.0

    def add(self, motor_force_n: float) -> None:
        """Adds the motor force of one cycle in the direction of the motion."""
        if self._cycles < self._max_cycles:
            self._cycles += 1
            self._sum_n += motor_force_n

    @property
    def mean_n(self) -> float | None:
        """Mean motor force; None before enough cycles."""
        return self._sum_n / self._cycles if self._cycles >= _MIN_CYCLES else None

    @property
    def friction_n(self) -> float | None:
        """Least friction that the motion proves; None before enough cycles."""
        mean_n = self.mean_n
        return None if mean_n is None else max(mean_n - 2 * FREE_NOISE_N / math.sqrt(self._cycles), 0.0)
