"""Prepares a camera frame for the network: crop, downscale, standardise, subtract the reference frame.

The difference to a reference frame halves the error in simulation and is what lets the network transfer to
objects it has not seen; raw gray values did not learn at all on real finger cameras.
"""

from typing import Annotated, Final, Self

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from gripper_force.errors import ConfigError, DataError
from gripper_force.schema import Section
from gripper_force.types import Gray

Region = tuple[int, int, int, int]
"""Region of interest in pixels: left, top, width, height."""

FLAT_STD: Final = 1.0
"""Least standard deviation, in gray levels, to divide by: a flat frame must not turn into amplified noise."""

DIFFERENCE_GAIN: Final = 2.0
"""A difference of standardised frames is small; this brings it back to about unit variance."""


class Preprocess(Section):
    """What is done to a frame; a network only understands frames prepared as in its training.

    Attributes:
        size: Side of the square input in pixels.
        reference: Whether the mean of the first frames, which must show no contact, is subtracted.
        reference_frames: How many frames that mean is taken over.
        magnitude: Whether only the size of that difference counts. Where a soft pad that is lit from its
            sides bulges, the sign tells where the lamps stand, and differs from pad to pad.
    """

    size: Annotated[int, Field(ge=16, le=1024, multiple_of=16)] = 128
    reference: bool = True
    reference_frames: Annotated[int, Field(ge=1, le=1000)] = 4
    magnitude: bool = False

    @model_validator(mode="after")
    def _has_difference(self) -> Self:
        if self.magnitude and not self.reference:
            raise ValueError("magnitude is that of the difference to a reference: set reference too")
        return self

    @property
    def lead_in(self) -> int:
        """Frames that pass before the first estimate."""
        return self.reference_frames - 1 if self.reference else 0


def downscale(gray: Gray, region: Region | None, size: int) -> Gray:
    """Cuts the region of interest out of a frame and resizes it.

    Args:
        gray: Frame, (H, W) uint8.
        region: Left, top, width, height in pixels; None for the whole frame.
        size: Side of the result in pixels.

    Returns:
        (size, size) uint8.

    Raises:
        DataError: The frame is not a gray image of bytes.
        ConfigError: The region reaches beyond the frame.
    """
    if gray.ndim != 2 or gray.dtype != np.uint8:
        raise DataError(f"a gray frame has shape (H, W) and type uint8, got {gray.shape} {gray.dtype}")
    if region is not None:
        left, top, width, height = region
        rows, columns = gray.shape
        inside = 0 <= left < left + width <= columns and 0 <= top < top + height <= rows
        if not inside:
            raise ConfigError(
                f"vision.region {list(region)} (left, top, width, height) must lie within "
                f"the camera's frame of {columns}x{rows} pixels"
            )
        gray = gray[top : top + height, left : left + width]
    return np.asarray(cv2.resize(gray, (size, size), interpolation=cv2.INTER_AREA), np.uint8)


class Normaliser:
    """Standardises the frames of one run, one at a time, and subtracts the run's own reference."""

    def __init__(self, preprocess: Preprocess) -> None:
        self._preprocess = preprocess
        self._waiting: list[Gray] = []
        self._reference: npt.NDArray[np.float32] | None = None
        self._reference_image: Gray | None = None

    @property
    def reference_image(self) -> Gray | None:
        """Mean of the reference frames, (S, S) uint8; None until they are there, or where none is used."""
        return self._reference_image

    def push(self, small: Gray) -> list[npt.NDArray[np.float32]]:
        """Takes the next frame, (S, S) uint8.

        Returns:
            The inputs that are ready now, each (S, S) float32, oldest first: none while the reference is
            being collected, then those frames themselves, and from then on one for each frame.
        """
        if not self._preprocess.reference:
            return [_standardise(small)]
        if self._reference is not None:
            return [self._difference(small, self._reference)]
        self._waiting.append(small)
        if len(self._waiting) < self._preprocess.reference_frames:
            return []
        waiting, self._waiting = self._waiting, []
        reference: npt.NDArray[np.float32] = np.mean([_standardise(image) for image in waiting], axis=0)
        self._reference = reference
        self._reference_image = np.mean(waiting, axis=0).round().astype(np.uint8)
        return [self._difference(image, reference) for image in waiting]

    def _difference(self, small: Gray, reference: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        difference: npt.NDArray[np.float32] = np.float32(DIFFERENCE_GAIN) * (_standardise(small) - reference)
        return np.abs(difference) if self._preprocess.magnitude else difference


def _standardise(small: Gray) -> npt.NDArray[np.float32]:
    image = small.astype(np.float32)
    standardised: npt.NDArray[np.float32] = (image - image.mean()) / np.float32(max(image.std(), FLAT_STD))
    return standardised
