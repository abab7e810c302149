"""Script of `test_parallel`, run under torchrun: trains on synthetic clips and writes each loss."""

import json
import os
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist

from gripper_force.errors import ConfigError
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.training import train as train_module
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.jobs.training.train import train
from gripper_force.jobs.training.trainer import Trainer
from gripper_force.vision.preprocess import Preprocess


def clip(seed: int) -> Clip:
    rng = np.random.default_rng(seed)
    forces_n = 8 * np.maximum(0, np.sin(np.linspace(-0.6, 3.4, 40))).astype(np.float32)
    frames = rng.integers(60, 140, (16, 16)) + np.outer(forces_n, rng.integers(-5, 6, 256)).reshape(
        40, 16, 16
    )
    valid = rng.random(40) < 0.8
    return Clip(frames.clip(0, 255).astype(np.uint8), forces_n, valid, f"p{seed}", "disc", f"s{seed}")


CONFIG = TrainConfig(
    attentions=("ssam",),
    width=0.5,
    preprocess=Preprocess(size=16),
    steps=8,
    clips=5,  # two processes get two and three
    learning_rate=3e-4,
    precision="float32",
    device="cpu",
    validation=0.3,
)


def main() -> None:
    folder, rank = Path(sys.argv[1]), int(os.environ["RANK"])
    torch.set_num_threads(1)
    train_module.STATE_EVERY_S = 0.0  # type: ignore[misc]
    losses: list[float] = []
    update = Trainer._update
    break_at = -1

    def spying(trainer: Trainer) -> torch.Tensor:
        if len(losses) == break_at:
            raise KeyboardInterrupt
        loss = update(trainer)
        losses.append(loss.item())
        return loss

    Trainer._update = spying  # type: ignore[assignment, method-assign]
    clips = [clip(seed) for seed in range(6)]
    train(CONFIG, clips, folder / "whole.safetensors", figure=False)
    whole, losses = losses, []
    break_at = 3
    with suppress(KeyboardInterrupt):
        train(CONFIG, clips, folder / "resumed.safetensors", figure=False)
    break_at = -1
    train(CONFIG, clips, folder / "resumed.safetensors", resume=True, figure=False)
    resumed, refused = losses, ""
    try:
        train(CONFIG, clips[rank:], folder / "refused.safetensors")
    except ConfigError as error:
        refused = str(error)
    (folder / f"{rank}.json").write_text(
        json.dumps(
            {"whole": whole, "resumed": resumed, "refused": refused, "left": not dist.is_initialized()}
        )
    )


if __name__ == "__main__":
    main()
