from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from gripper_force.errors import CheckpointError
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.jobs.training.stated_errors import state_errors
from gripper_force.jobs.training.train import train
from gripper_force.vision.batch_inference import predict
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.model_files import read_model

pytestmark = pytest.mark.usefixtures("one_thread")


def test_errors_are_stated_without_another_digest(
    clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig, press: Callable[..., Clip]
) -> None:
    paths = [tmp_path / "a.safetensors", tmp_path / "b.safetensors"]
    before = [
        train(small_recipe.model_copy(update={"seed": i}), clips, path, figure=False)
        for i, path in enumerate(paths)
    ]
    unseen = [press(99), press(98)]
    assert state_errors(paths, lambda _: unseen, write=False).keys() == {str(path) for path in paths}
    assert load_checkpoint(paths[0]).header == before[0].header
    for _ in range(2):  # also a second time, when the header already differs from the training's
        found = state_errors(paths, lambda _: unseen, write=True)
    for path, old in zip(paths, before, strict=True):
        new = load_checkpoint(path)
        assert new.digest == old.digest == read_model(path).digest
        for one, other in zip(new.networks[0].parameters(), old.networks[0].parameters(), strict=True):
            assert torch.equal(one, other)
        estimates_n = [predict(new.networks, small_recipe.preprocess, clip.frames)[0] for clip in unseen]
        lead_in = small_recipe.preprocess.lead_in  # a run gives no estimate before
        assert lead_in > 0
        error_n = np.concatenate(
            [n[lead_in:] - clip.forces_n[lead_in:] for n, clip in zip(estimates_n, unseen, strict=True)]
        )
        assert new.header.metrics["mae_n"] == pytest.approx(np.abs(error_n).mean(), rel=1e-4)
        assert found[str(path)].items() <= new.header.metrics.items()
        assert new.header.metrics["constant_mae_n"] == old.header.metrics["constant_mae_n"]
        assert new.header.residuals != old.header.residuals
    digests = {load_checkpoint(path).header.test_digest for path in paths}
    assert len(digests) == 1
    assert digests != {""}


def test_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        state_errors([tmp_path / "none.safetensors"], lambda _: [], write=True)
