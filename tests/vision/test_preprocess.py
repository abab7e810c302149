from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from gripper_force.errors import ConfigError, DataError
from gripper_force.vision.batch_inference import normalise
from gripper_force.vision.preprocess import Normaliser, Preprocess, downscale

SMALL = Preprocess(size=16)


def images(count: int) -> st.SearchStrategy:
    return arrays(np.uint8, (count, 16, 16))


def stream(preprocess: Preprocess, frames: np.ndarray) -> list[np.ndarray]:
    normaliser = Normaliser(preprocess)
    return [image for frame in frames for image in normaliser.push(frame)]


def test_downscale_crops_then_resizes() -> None:
    gray = np.arange(40 * 60, dtype=np.uint16).reshape(40, 60).astype(np.uint8)
    expected = cv2.resize(gray[4:36, 8:40], (16, 16), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(downscale(gray, (8, 4, 32, 32), 16), expected)
    assert downscale(gray, None, 16).shape == (16, 16)


@pytest.mark.parametrize("frame", [None, [[1, 2], [3, 4]], np.zeros((4, 4)), np.zeros((4, 4, 3), np.uint8)])
def test_what_is_no_gray_image_is_refused(frame: Any) -> None:
    """OpenCV gives None when no frame comes."""
    with pytest.raises(DataError, match=r"the frame is .*, not \(H, W\) uint8; convert it"):
        downscale(frame, None, 16)


@pytest.mark.parametrize(
    "region",
    [
        (-1, 0, 8, 8),
        (0, 0, 61, 8),
        (0, 33, 8, 8),
        (0, 0, 0, 8),
        (0, 0, 50),
        (0.0, 0.0, 8.0, 8.0),
        "abc",
        8,
    ],
)
def test_region_that_is_not_within_the_frame_is_refused(region: Any) -> None:
    with pytest.raises(ConfigError, match=r"vision\.region.*60x40"):
        downscale(np.zeros((40, 60), np.uint8), region, 16)


@pytest.mark.parametrize("frame", [np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8), np.float32)])
def test_frame_that_is_not_gray_bytes_is_refused(frame: np.ndarray) -> None:
    with pytest.raises(DataError, match="uint8"):
        downscale(frame, None, 16)


@pytest.mark.parametrize("region", [None, (0, 0, 1, 1)])
def test_frame_without_pixels_is_refused(region: Any) -> None:
    with pytest.raises(DataError, match="no pixels"):
        downscale(np.zeros((0, 8), np.uint8), region, 16)


def test_size_must_fit_the_backbone() -> None:
    with pytest.raises(ValidationError):
        Preprocess(size=20)


@given(images(7))
def test_streaming_and_batches_agree(frames: np.ndarray) -> None:
    clip = torch.from_numpy(frames)[None]
    for keys in ({}, {"reference": False}, {"magnitude": True}):
        preprocess = Preprocess(size=16, **keys)
        expected = normalise(clip, clip[:, : preprocess.reference_frames], preprocess)[0, :, 0].numpy()
        np.testing.assert_allclose(stream(preprocess, frames), expected, rtol=1e-4, atol=1e-4)


@given(st.integers(0, 99), st.floats(0.5, 0.9), st.floats(0, 20))
def test_gain_and_offset_of_the_image_have_no_effect(seed: int, gain: float, offset: float) -> None:
    gray = 255 * torch.rand(1, 2, 16, 16, generator=torch.Generator().manual_seed(seed))
    plain = Preprocess(size=16, reference=False)
    lit = normalise(gain * gray + offset, gray, plain)
    torch.testing.assert_close(lit, normalise(gray, gray, plain), rtol=1e-3, atol=1e-3)


@given(images(7))
def test_magnitude_ignores_the_sign_of_the_difference(frames: np.ndarray) -> None:
    magnitude = Preprocess(size=16, magnitude=True)
    np.testing.assert_allclose(stream(magnitude, frames), stream(magnitude, 255 - frames), atol=1e-4)


def test_magnitude_needs_a_reference() -> None:
    with pytest.raises(ValidationError, match="set reference too"):
        Preprocess(reference=False, magnitude=True)


def test_flat_frame_gives_zeros_and_faint_noise_is_not_amplified() -> None:
    frame = np.full((16, 16), 90, np.uint8)
    (flat,) = stream(Preprocess(size=16, reference=False), frame[None])
    assert not flat.any()
    frame[0, 0] += 1
    (faint,) = stream(Preprocess(size=16, reference=False), frame[None])
    assert np.abs(faint).max() <= 1


def test_reference_is_mean_of_first_frames() -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (6, 16, 16), np.uint8)
    normaliser = Normaliser(SMALL)
    assert [len(normaliser.push(frame)) for frame in frames] == [0, 0, 0, 4, 1, 1]
    assert normaliser.reference_image is not None
    np.testing.assert_array_equal(normaliser.reference_image, frames[:4].mean(0).round())
    still = stream(SMALL, np.repeat(frames[:1], 5, axis=0))
    np.testing.assert_allclose(still, 0, atol=1e-5)
