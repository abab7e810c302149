"""Prepares a camera frame for the network: crop, downscale, standardise, subtract the reference frame.

Subtracting a reference frame halves the error in simulation and lets the network transfer to unseen objects.
On images of real finger cameras, training on raw gray values failed.
"""

from collections.abc import Sequence
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
"""Smallest standard deviation to divide by, in gray levels, so that the noise of a flat frame is not amplified."""

DIFFERENCE_GAIN: Final = 2.0
"""Factor that brings a difference of standardised frames to about unit variance."""


class Preprocess(Section):
    """Preparation of frames. A network needs frames prepared as in its training.

    Attributes:
        size: Side of the square input in pixels.
        reference: Subtract the mean of the first frames, which must show no contact.
        reference_frames: Number of frames of that mean.
        magnitude: Take the absolute value of the difference. In images of a soft pad lit from the side, the
            sign of a bulge's difference depends on the position of the lamps, which varies between pads.
    """

    size: Annotated[int, Field(ge=16, le=1024, multiple_of=16)] = 128
    reference: bool = True
    reference_frames: Annotated[int, Field(ge=1, le=1000)] = 4
    magnitude: bool = False

    @model_validator(mode="after")
    def _has_difference(self) -> Self:
        if self.magnitude and not self.reference:
            raise ValueError("magnitude needs the difference to a reference; set reference too")
        return self

    @property
    def lead_in(self) -> int:
        """Number of frames before the first estimate."""
        return self.reference_frames - 1 if self.reference else 0


def downscale(gray: Gray, region: Region | None, size: int) -> Gray:
    """Crops a frame to the region of interest and resizes it.

    Args:
        gray: Frame, (H, W) uint8.
        region: Left, top, width, height in pixels; None for the whole frame.
        size: Side of the result in pixels.

    Returns:
        (size, size) uint8.

    Raises:
        DataError: The frame is not a gray image of bytes, or has no pixels.
        ConfigError: The region is not four whole numbers, or reaches beyond the frame.
    """
    if not isinstance(gray, np.ndarray) or gray.ndim != 2 or gray.dtype != np.uint8:
        actual = f"{gray.shape} {gray.dtype}" if isinstance(gray, np.ndarray) else type(gray).__name__
        raise DataError(f"the frame is {actual}, not (H, W) uint8; convert it to a gray image of bytes")
    if not gray.size:
        raise DataError("the frame has no pixels; check the camera")
    if region is not None:
        values = np.ravel(region)
        is_whole = values.shape == (4,) and values.dtype.kind in "iu"
        left, top, width, height = values.tolist() if is_whole else (-1, 0, 0, 0)
        rows, columns = gray.shape
        if not (0 <= left < left + width <= columns and 0 <= top < top + height <= rows):
            raise ConfigError(
                f"vision.region {values.tolist()} (left, top, width, height in whole pixels) must lie within "
                f"the camera's frame of {columns}x{rows} pixels"
            )
        gray = gray[top : top + height, left : left + width]
    return np.asarray(cv2.resize(gray, (size, size), interpolation=cv2.INTER_AREA), np.uint8)


def mean_image(frames: Sequence[Gray] | Gray) -> Gray:
    """Returns the mean of images of one size, (S, S)."""
    return np.asarray(np.mean(frames, axis=0).round(), np.uint8)


class Normaliser:
    """Standardises the frames of a stream one by one and subtracts the stream's reference.

    Attributes:
        reference_image: Mean of the reference frames, (S, S) uint8; None until it is complete or if none is used.
    """

    def __init__(self, preprocess: Preprocess) -> None:
        self._preprocess = preprocess
        self._waiting: list[Gray] = []
        self._reference: npt.NDArray[np.float32] | None = None
        self.reference_image: Gray | None = None

    def push(self, small: Gray) -> list[npt.NDArray[np.float32]]:
        """Processes the next frame.

        Args:
            small: Cropped and resized frame, (S, S) uint8.

        Returns:
            The network inputs that are ready, each (S, S) float32, oldest first: none while the reference is
            being collected, then those of the reference frames, and from then on one per frame.
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
        self.reference_image = mean_image(waiting)
        return [self._difference(image, reference) for image in waiting]

    def _difference(self, small: Gray, reference: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        difference: npt.NDArray[np.float32] = np.float32(DIFFERENCE_GAIN) * (_standardise(small) - reference)
        return np.abs(difference) if self._preprocess.magnitude else difference


def _standardise(gray: Gray) -> npt.NDArray[np.float32]:
    image = gray.astype(np.float32)
    standardised: npt.NDArray[np.float32] = (image - image.mean()) / np.float32(max(image.std(), FLAT_STD))
    return standardised
