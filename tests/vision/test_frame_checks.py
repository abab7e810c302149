from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.errors import DataError
from gripper_force.runtime.log import LogReader
from gripper_force.types import Frame, Gray
from gripper_force.vision.frame_checks import FrameChecks
from gripper_force.vision.preprocess import downscale

RNG = np.random.default_rng(0)


def scene(seed: int) -> Gray:
    """A smooth picture with a sensor's noise."""
    y, x = np.mgrid[:128, :128] / 128
    picture = 110 + 60 * np.sin(6 * x) * np.cos(4 * y) + np.random.default_rng(seed).normal(0, 3, (128, 128))
    gray: Gray = picture.round().astype(np.uint8)
    return gray


def look(plausibility: FrameChecks, gray: Gray) -> None:
    plausibility.check(downscale(gray, None, 64))


def test_whole_runs_pass(fused_log: Path) -> None:
    frames = [frame.gray for frame in LogReader(fused_log).records(Frame)]
    assert len(frames) > 50
    plausibility = FrameChecks()
    for gray in frames:
        look(plausibility, gray)


FAULTS: dict[str, Callable[[Gray], Gray]] = {
    "flat": np.zeros_like,
    "flat ": lambda gray: np.full_like(gray, 255),
    "roughness": lambda gray: RNG.integers(60, 160, gray.shape, np.uint8),
    "brightness": lambda gray: gray // 2,
    "contrast": lambda gray: np.where(gray > 110, 255, 0).astype(np.uint8),
}


@pytest.mark.parametrize("what", FAULTS)
def test_a_broken_picture_is_named_and_the_next_good_one_passes(what: str) -> None:
    plausibility = FrameChecks()
    for seed in range(5):
        look(plausibility, scene(seed))
    with pytest.raises(DataError, match=what.strip()):
        look(plausibility, FAULTS[what](scene(4)))
    look(plausibility, scene(6))


def test_a_covered_lens_is_told_from_the_first_frame_on() -> None:
    with pytest.raises(DataError, match="lens"):
        look(FrameChecks(), np.full((128, 128), 3, np.uint8))


@given(st.floats(0.75, 1.3), st.integers(-6, 6))
def test_light_and_shift_of_a_grasp_pass(gain: float, shift: int) -> None:
    plausibility = FrameChecks()
    look(plausibility, scene(0))
    look(plausibility, np.clip(np.roll(scene(1), shift, 1) * gain, 0, 255).astype(np.uint8))
