"""Plausibility checks on camera frames.

A network returns a force for any image, so flat, badly exposed or garbled frames are rejected first.
"""

from typing import Final

import numpy as np

from gripper_force.errors import DataError
from gripper_force.types import Gray
from gripper_force.vision.preprocess import FLAT_STD

BRIGHTNESS: Final = 1.6
CONTRAST: Final = 2.5
ROUGHNESS: Final = 2.5
"""Largest ratios of a frame to the first frame of the stream, in either direction. The extremes observed in
presses are 1.15, 1.33 and 1.2 in simulation, and 1.06, 1.04 and 1.1 with a finger camera."""


class FrameChecks:
    """Compares brightness, contrast and roughness of each frame of a stream with the first frame's."""

    def __init__(self) -> None:
        self._first: tuple[float, float, float] | None = None

    def check(self, small: Gray) -> None:
        """Checks the next frame.

        Args:
            small: Cropped and resized frame, (S, S) uint8.

        Raises:
            DataError: The frame is flat, or its brightness, contrast or roughness are far from the first
                frame's.
        """
        pixels = small.astype(np.float32)
        contrast = float(pixels.std())
        if contrast < FLAT_STD:
            level = pixels.mean()
            raise DataError(
                f"the camera's image is flat (gray level {level:.0f}); check its lens, light and exposure"
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
                    f"the image's {name} changed from {first:.3g} to {now:.3g} since the first frame; check "
                    "the camera and the light"
                )
