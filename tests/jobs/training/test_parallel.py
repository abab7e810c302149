import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gripper_force.errors import ConfigError
from gripper_force.jobs.training.parallel import TrainingProcess, join_training_processes
from gripper_force.jobs.training.train import train
from gripper_force.jobs.training.trainer import Trainer
from gripper_force.vision.checkpoint import load_checkpoint

SCRIPT = Path(__file__).with_name("train_together.py")


@pytest.mark.usefixtures("one_thread")
def test_two_processes_train_like_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([*torchrun, str(SCRIPT), str(tmp_path)], env=environment)
    try:
        one = losses_of_one(tmp_path / "one.safetensors", monkeypatch)
        assert process.wait(timeout=240) == 0
    finally:
        process.terminate()  # torchrun passes it on
        process.wait()

    first, second = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in (0, 1))
    assert len(one) == 8
    assert first["whole"] == pytest.approx(one, rel=1e-3)
    assert first["whole"][0] == pytest.approx(one[0], rel=1e-6)
    assert first["whole"] == second["whole"] == first["resumed"] == second["resumed"]
    whole = (tmp_path / "whole.safetensors").read_bytes()
    assert whole == (tmp_path / "resumed.safetensors").read_bytes()
    weights = [
        torch.cat([t.flatten() for t in load_checkpoint(tmp_path / name).networks[0].state_dict().values()])
        for name in ("one.safetensors", "whole.safetensors")
    ]
    np.testing.assert_allclose(weights[0], weights[1], rtol=0.01, atol=1e-3)
    assert "different recipes, data or states" in first["refused"]
    assert first["refused"] == second["refused"]
    assert first["left"]
    assert second["left"]


def losses_of_one(out: Path, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Trains in this process as the script does. Returns the loss of each step."""
    script = runpy.run_path(str(SCRIPT))
    losses: list[float] = []
    update = Trainer._update

    def spying(trainer: Trainer) -> torch.Tensor:
        loss = update(trainer)
        losses.append(loss.item())
        return loss

    monkeypatch.setattr(Trainer, "_update", spying)
    train(script["CONFIG"], [script["clip"](seed) for seed in range(6)], out, figure=False)
    return losses


def test_one_process_needs_no_others() -> None:
    with join_training_processes("cpu") as process:
        assert process == TrainingProcess("cpu")
        assert process.first
        total = torch.ones(3)
        process.sum_over_all([total])
        process.check_equal("any", "thing")
        process.wait()
        assert total.tolist() == [1, 1, 1]
        assert process.broadcast_from_first(0.5) == 0.5
        assert list(range(4))[process.own_clips] == [0, 1, 2, 3]


def test_processes_that_cannot_join_raise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.delenv("RANK", raising=False)
    with pytest.raises(ConfigError, match="torchrun"), join_training_processes("cpu"):
        pass
    monkeypatch.setenv("LOCAL_RANK", "1")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ConfigError, match="1 GPUs are too few"), join_training_processes("cuda"):
        pass
