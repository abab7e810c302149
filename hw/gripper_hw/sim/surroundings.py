"""What goes on around the gripper and says nothing of the force: light that changes, things that pass."""

import numpy as np
import numpy.typing as npt

from gripper_hw.sim.scene import PASSING, Scene

_WAVES = 3
_LIGHT_HZ = (0.1, 2.0)
_LIGHT_SPREAD = 0.3
"""Most of what the light swells or fades by, as a share of its usual strength."""

_PASSING_HZ = (0.1, 0.6)
_BEHIND_M = np.array([[-0.12, 0.10, 0.0], [0.12, 0.24, 0.08]])
"""Corners of the space where things pass: behind every object and the rods, in sight part of the time."""


class Surroundings:
    """Surroundings of a scene as a function of time. The same scene has the same."""

    def __init__(self, scene: Scene) -> None:
        rng = np.random.default_rng([scene.table_seed, 1])
        self._changing_light, self._moving_background = scene.changing_light, scene.moving_background
        self._light_hz = rng.uniform(*_LIGHT_HZ, _WAVES)
        self._light_phase = rng.uniform(0, 2 * np.pi, _WAVES)
        self._passing_hz = rng.uniform(*_PASSING_HZ, (PASSING, 3))
        self._passing_phase = rng.uniform(0, 2 * np.pi, (PASSING, 3))

    def light(self, t_s: float) -> float:
        """Strength of the light over its usual one."""
        if not self._changing_light:
            return 1.0
        return 1.0 + _LIGHT_SPREAD * float(
            np.sin(2 * np.pi * self._light_hz * t_s + self._light_phase).mean()
        )

    def places_m(self, t_s: float) -> npt.NDArray[np.float64]:
        """Where the things that pass are, (N, 3); N is 0 where nothing does."""
        if not self._moving_background:
            return np.empty((0, 3))
        low, high = _BEHIND_M
        swing = np.sin(2 * np.pi * self._passing_hz * t_s + self._passing_phase)
        places_m: npt.NDArray[np.float64] = (low + high) / 2 + swing * (high - low) / 2
        return places_m
