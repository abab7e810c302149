from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import load_config
from gripper_force.errors import DataError, UnfamiliarFrameError
from gripper_force.jobs.simulate import SimulationPlan, make_log
from gripper_force.qualification import recognition
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import Frame, Gray
from gripper_force.vision.frame_checks import FrameChecks
from gripper_force.vision.preprocess import downscale

RNG = np.random.default_rng(0)


def scene(seed: int) -> Gray:
    """Returns a smooth image with sensor noise."""
    y, x = np.mgrid[:128, :128] / 128
    image = 110 + 60 * np.sin(6 * x) * np.cos(4 * y) + np.random.default_rng(seed).normal(0, 3, (128, 128))
    gray: Gray = image.round().astype(np.uint8)
    return gray


def check(checks: FrameChecks, gray: Gray) -> None:
    checks.check(downscale(gray, None, 64))


def test_frames_of_a_grasp_pass(fused_log: Path) -> None:
    frames = [frame.gray for frame in LogReader(fused_log).records(Frame)]
    assert len(frames) > 50
    checks = FrameChecks()
    for gray in frames:
        check(checks, gray)


FAULTS: dict[str, Callable[[Gray], Gray]] = {
    "flat": np.zeros_like,
    "flat ": lambda gray: np.full_like(gray, 255),
    "roughness": lambda gray: RNG.integers(60, 160, gray.shape, np.uint8),
    "brightness": lambda gray: gray // 2,
    "contrast": lambda gray: np.where(gray > 110, 255, 0).astype(np.uint8),
}


@pytest.mark.parametrize("what", FAULTS)
def test_implausible_frame_is_refused_and_the_next_good_one_passes(what: str) -> None:
    checks = FrameChecks()
    for seed in range(5):
        check(checks, scene(seed))
    with pytest.raises(DataError, match=what.strip()):
        check(checks, FAULTS[what](scene(4)))
    check(checks, scene(6))


def test_covered_lens_is_refused_from_the_first_frame() -> None:
    with pytest.raises(DataError, match="lens"):
        check(FrameChecks(), np.full((128, 128), 3, np.uint8))


@given(st.floats(0.75, 1.3))
def test_moderate_light_change_passes(gain: float) -> None:
    checks = FrameChecks()
    check(checks, scene(0))
    check(checks, np.clip(scene(1) * gain, 0, 255).astype(np.uint8))


@pytest.fixture(scope="module")
def press(tmp_path_factory: pytest.TempPathFactory) -> Gray:
    """Frames of a simulated sponge, pressed, (T, 128, 128)."""
    config = load_config(None, ["sim.detail=coarse"]).model_dump(mode="json")
    path = make_log(SimulationPlan("tap", "sponge", 904_100), tmp_path_factory.mktemp("tap"), config)
    return np.stack([frame.gray for frame in LogReader(path).records(Frame)])


@pytest.mark.parametrize(
    ("change", "remark"),
    [
        (recognition.shift, "view moved"),
        (recognition.bump, "view moved"),
        (recognition.zoom, "zoomed"),
        (recognition.refocus, "fine detail"),
        (recognition.lamp, "the light changed"),
    ],
)
def test_disturbed_frames_of_a_press_are_refused(
    press: Gray, change: recognition.Change, remark: str
) -> None:
    checks = FrameChecks()
    check(checks, press[0])
    for frame in press:
        check(checks, frame)
    disturbed = change(press[10::5], np.random.default_rng(0))
    for frame in disturbed:
        with pytest.raises(DataError, match=remark) as caught:
            check(checks, frame)
        if change is not recognition.refocus:  # a strong blur covers
            assert not isinstance(caught.value, UnfamiliarFrameError)


def test_a_covered_view_is_an_unfamiliar_frame(press: Gray) -> None:
    checks = FrameChecks()
    check(checks, press[0])
    for frame in recognition.blob(press[10::5], np.random.default_rng(0)):
        with pytest.raises(UnfamiliarFrameError, match="lost its detail, as if it was covered") as caught:
            check(checks, frame)
        assert np.isnan(caught.value.force_n)
    check(checks, press[10])


def test_the_share_that_may_be_covered_is_a_setting(press: Gray) -> None:
    checks = FrameChecks(max_covered=1.0)
    check(checks, press[0])
    for frame in recognition.blob(press[10::5], np.random.default_rng(0)):
        check(checks, frame)
