"""Made-up recordings to train on."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from gripper_force.dataset import Clip
from gripper_force.recipe import TrainConfig
from gripper_force.vision.preprocess import Preprocess


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Sums split over threads differ in their last bits, and threads contend where tests run side by side."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def small_recipe() -> TrainConfig:
    """Trains one small network in no time."""
    return TrainConfig(
        attentions=("ssam",),
        width=0.25,
        preprocess=Preprocess(size=16),
        steps=4,
        clips=3,
        device="cpu",
        validation=0.3,
    )


@pytest.fixture(scope="session")
def press() -> Callable[..., Clip]:
    """Makes a clip of a dark disc that grows with the force on a random background."""

    def make(seed: int, frames: int = 60) -> Clip:
        rng = np.random.default_rng(seed)
        forces_n = 8 * np.maximum(0, np.sin(np.linspace(-0.6, 3.4, frames))).astype(np.float32)
        y, x = np.mgrid[:16, :16]
        radius = np.hypot(y - 7.5, x - 7.5)
        background = rng.integers(90, 220, (16, 16))
        edge = 1 + 0.7 * forces_n[:, None, None] - radius
        images = np.where(edge > 0, 40, background) + (5 * edge).clip(0, 20)
        valid = np.ones(frames, np.bool_)
        return Clip(images.astype(np.uint8), forces_n, valid, f"p{seed}", "disc", f"s{seed}")

    return make


@pytest.fixture
def clips(press: Callable[..., Clip]) -> list[Clip]:
    """Six sets of one object."""
    return [press(seed) for seed in range(6)]
