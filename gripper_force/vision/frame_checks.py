"""Is this what a camera that works sees here? A network answers any picture; somebody has to ask."""

from typing import Final

import numpy as np

from gripper_force.errors import DataError
from gripper_force.types import Gray
from gripper_force.vision.preprocess import FLAT_STD

BRIGHTNESS: Final = 1.6
CONTRAST: Final = 2.5
ROUGHNESS: Final = 2.5
"""Factors by which a frame may differ from the run's first, either way. The extremes seen in presses are
1.15, 1.33 and 1.2 in simulation, and 1.06, 1.04 and 1.1 with a finger camera."""


class FrameChecks:
    """Compares each frame of a run with the first."""

    def __init__(self) -> None:
        self._first: tuple[float, float, float] | None = None

    def check(self, small: Gray) -> None:
        """Takes the next frame.

        Args:
            small: What the network is to see of it, (S, S) uint8.

        Raises:
            DataError: It is flat, or its brightness, contrast or roughness are far from those of the run's
                first frame.
        """
        pixels = small.astype(np.float32)
        contrast = float(pixels.std())
        if contrast < FLAT_STD:
            level = pixels.mean()
            raise DataError(
                f"the camera's picture is flat (gray level {level:.0f}); look at its lens, light and exposure"
            )
        brightness = float(pixels.mean())
        roughness = float(np.abs(np.diff(pixels)).mean()) / contrast
        if self._first is None:
            self._first = brightness, contrast, roughness
        for name, now, first, most in zip(
            ("brightness", "contrast", "roughness"),
            (brightness, contrast, roughness),
            self._first,
            (BRIGHTNESS, CONTRAST, ROUGHNESS),
            strict=True,
        ):
            if not first / most <= now <= first * most:
                raise DataError(
                    f"the picture's {name} went from {first:.3g} to {now:.3g} since the run began; look at "
                    "the camera and the light"
                )
