"""Made-up recordings to train on."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from gripper_force.config import dump_config, load_config
from gripper_force.dataset import Clip
from gripper_force.log import LogWriter
from gripper_force.training.recipe import TrainConfig
from gripper_force.types import NS_PER_MS, Frame, LoadCellSample
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


@pytest.fixture
def few_logs(clips: list[Clip], tmp_path: Path) -> Path:
    """Three of the clips as logs in a folder."""
    config = dump_config(load_config(None, ["object=disc"]))
    for clip in clips[:3]:
        with LogWriter(tmp_path / f"logs/{clip.name}.mcap", config=config, metadata={"set": clip.set}) as log:
            for i, (gray, force_n) in enumerate(zip(clip.frames, clip.forces_n.tolist(), strict=True)):
                log.write(Frame(i * 20 * NS_PER_MS, i * 20 * NS_PER_MS, i, gray))
                log.write(LoadCellSample(i * 20 * NS_PER_MS, force_n, force_n, True))
    return tmp_path / "logs"
