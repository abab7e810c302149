"""Changes in the image that are unrelated to the force: varying light and moving background objects."""

import numpy as np
import numpy.typing as npt

from gripper_hw.sim.scene import BACKGROUND_OBJECTS, Scene

_WAVES = 3
"""Sine waves whose mean is the variation of the light."""

_LIGHT_HZ = (0.1, 2.0)
"""Range of their frequencies."""

_LIGHT_SPREAD = 0.3
"""Largest variation of the light, as a share of its mean."""

_MOTION_HZ = (0.1, 0.6)
"""Range of the frequencies of a background object's motion, per axis."""

_MOTION_BOUNDS_M = np.array([[-0.12, 0.10, 0.0], [0.12, 0.24, 0.08]])
"""Corners of the background objects' space: behind grasped objects and rods, in view part of the time."""


class Surroundings:
    """Light and background of a scene as a function of time, drawn from the scene's ``table_seed``."""

    def __init__(self, scene: Scene) -> None:
        rng = np.random.default_rng([scene.table_seed, 1])
        self._changing_light, self._moving_background = scene.changing_light, scene.moving_background
        self._light_hz = rng.uniform(*_LIGHT_HZ, _WAVES)
        self._light_phase = rng.uniform(0, 2 * np.pi, _WAVES)
        self._motion_hz = rng.uniform(*_MOTION_HZ, (BACKGROUND_OBJECTS, 3))
        self._motion_phase = rng.uniform(0, 2 * np.pi, (BACKGROUND_OBJECTS, 3))

    def light_factor(self, t_s: float) -> float:
        """Returns the factor on the scene's light at a time; 1 if the light is constant."""
        if not self._changing_light:
            return 1.0
        return 1.0 + _LIGHT_SPREAD * float(
            np.sin(2 * np.pi * self._light_hz * t_s + self._light_phase).mean()
        )

    def positions_m(self, t_s: float) -> npt.NDArray[np.float64]:
        """Returns the positions of the background objects at a time, (N, 3); N is 0 if nothing moves."""
        if not self._moving_background:
            return np.empty((0, 3))
        low, high = _MOTION_BOUNDS_M
        swing = np.sin(2 * np.pi * self._motion_hz * t_s + self._motion_phase)
        positions_m: npt.NDArray[np.float64] = (low + high) / 2 + swing * (high - low) / 2
        return positions_m
