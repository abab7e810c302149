import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import config_from
from gripper_force.jobs.grasp import PAPER_OBJECTS
from gripper_force.runtime.resolve import resolve
from gripper_force.types import Gray
from gripper_force.vision.header import VIEW_LENGTH
from gripper_force.vision.known_views import describe_view, view_score
from gripper_force.vision.model_files import read_model
from gripper_force.vision.preprocess import downscale
from gripper_hw.sim.kinds import held_out_kinds
from gripper_hw.sim.simulated_rig import SimulatedRig


def view_of(kind: str, seed: int, *, empty: bool = False) -> Gray:
    """The simulated rig's first image, (64, 64)."""
    config = resolve(config_from({"object": kind, "seed": seed}, "test"), vision=False).config
    rig = SimulatedRig(config)
    try:
        if empty:
            rig._world.remove_object()
        rig.camera.start()
        rig.clock.sleep_until_ns(100_000_000)
        frame = rig.camera.newest()
        assert frame is not None
        return downscale(frame.gray, None, 64)
    finally:
        rig.close()


@pytest.mark.parametrize("checkpoint", ["default", "small"])
def test_shipped_networks_know_their_objects_and_no_others(checkpoint: str) -> None:
    views = read_model(checkpoint).header.views
    assert views is not None
    assert all(view_score(views, view_of(kind, 31)) < 1 for kind in PAPER_OBJECTS)
    assert all(view_score(views, view_of(kind, 31)) > 1 for kind in ("ball", *held_out_kinds()))
    assert view_score(views, view_of("sponge", 31, empty=True)) > 1


def textured_square(side: int, gain: float = 1.0, seed: int = 0) -> Gray:
    image = np.random.default_rng(seed).normal(80, 6, (64, 64))
    image[20 : 20 + side, 20 : 20 + side] += 70
    return (gain * image).clip(0, 255).astype(np.uint8)


@given(st.floats(0.5, 1.5), st.integers(0, 100))
def test_a_description_depends_on_shape_more_than_on_light_and_noise(gain: float, seed: int) -> None:
    first, same, other = (
        describe_view(view)
        for view in (textured_square(20), textured_square(20, gain, seed), textured_square(30))
    )
    assert first.shape == (VIEW_LENGTH,)
    assert np.linalg.norm(first - same) < 0.7 * np.linalg.norm(first - other)


def test_an_image_without_detail_has_a_description() -> None:
    assert np.isfinite(describe_view(np.full((32, 32), 7, np.uint8))).all()
