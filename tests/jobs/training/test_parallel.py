import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gripper_force.errors import ConfigError
from gripper_force.jobs.training.parallel import TrainingProcess, join_training_processes
from gripper_force.vision.checkpoint import load_checkpoint

SCRIPT = Path(__file__).with_name("train_together.py")


def test_two_processes_train_like_one(tmp_path: Path) -> None:
    launches = {
        "one": [sys.executable],
        "two": [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"],
    }
    running = []
    for name, launch in launches.items():
        (tmp_path / name).mkdir()
        command = [*launch, str(SCRIPT), str(tmp_path / name)]
        running.append(subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"}))
    try:
        assert [process.wait(timeout=240) for process in running] == [0, 0]
    finally:
        for process in running:
            process.terminate()  # torchrun passes it on
            process.wait()

    one, first, second = (
        json.loads((tmp_path / name).read_text()) for name in ("one/0.json", "two/0.json", "two/1.json")
    )
    assert len(one["whole"]) == 8
    assert first["whole"] == pytest.approx(one["whole"], rel=1e-3)
    assert first["whole"][0] == pytest.approx(one["whole"][0], rel=1e-6)
    assert first["whole"] == second["whole"] == first["resumed"] == second["resumed"]
    whole = (tmp_path / "two/whole.safetensors").read_bytes()
    assert whole == (tmp_path / "two/resumed.safetensors").read_bytes()
    weights = [
        torch.cat([t.flatten() for t in load_checkpoint(tmp_path / name).networks[0].state_dict().values()])
        for name in ("one/whole.safetensors", "two/whole.safetensors")
    ]
    np.testing.assert_allclose(weights[0], weights[1], rtol=0.01, atol=1e-3)
    assert not one["refused"]
    assert "different recipes, data or states" in first["refused"]
    assert first["refused"] == second["refused"]
    assert first["left"]
    assert second["left"]


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
