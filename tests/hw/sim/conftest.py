"""A motor that closes the jaws of a simulated world."""

import numpy as np
import pytest

from gripper_force.config import GripperConfig


class Squeeze:
    """Motor that closes the jaws by 50 mm/s, up to a force."""

    def __init__(self, force_n: float) -> None:
        self._radius_m = GripperConfig().pinion_radius_m
        self._limit_nm = 2 * force_n * self._radius_m

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        goal_rad = 0.05 / self._radius_m * t_ns * 1e-9
        limit = self._limit_nm
        return float(np.clip(8 * (goal_rad - position_rad) - 0.3 * velocity_rad_s, -limit, limit))


@pytest.fixture
def squeeze() -> type[Squeeze]:
    """Makes a motor for a force in newtons."""
    return Squeeze
