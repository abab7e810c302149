from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.training.ood_fit import MIN_LOGS, add_ood, fit_ood
from gripper_force.vision.batch_inference import features
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.ood import OodScore


@pytest.fixture
def clips_of_32(press: Callable[..., Clip]) -> list[Clip]:
    clips = [press(seed) for seed in range(2 * MIN_LOGS)]
    return [replace(clip, frames=clip.frames.repeat(2, axis=1).repeat(2, axis=2)) for clip in clips]


def test_score_of_known_logs_is_below_the_limit_and_the_digest_stays(
    tiny_checkpoint: Path, clips_of_32: list[Clip], tmp_path: Path
) -> None:
    before = load_checkpoint(tiny_checkpoint)
    model = fit_ood(before.force_networks, before.header, clips_of_32)
    assert model is not None
    out = tmp_path / "scored.safetensors"
    add_ood(tiny_checkpoint, model, out)
    after = load_checkpoint(out)
    assert after.digest == before.digest
    assert after.header.ood == model
    preprocess = before.header.preprocess
    for clip in clips_of_32:
        forces_n, read_out = features(after.networks, preprocess, clip.frames)
        first = preprocess.lead_in
        score = OodScore(model).score(read_out[first:], forces_n.mean(0)[first:].astype(float))
        assert np.mean(score > 1) < 0.3


def test_few_logs_give_no_score(tiny_checkpoint: Path, clips_of_32: list[Clip]) -> None:
    loaded = load_checkpoint(tiny_checkpoint)
    assert fit_ood(loaded.force_networks, loaded.header, clips_of_32[: MIN_LOGS - 1]) is None


def test_command_says_how_many_logs_it_needs(few_logs: Path, tiny_checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    call = ["calibrate", "network", str(few_logs), "--checkpoint", str(tiny_checkpoint), "--out", str(out)]
    error = CliRunner().invoke(cli.app, [*call, "--jobs", "1"]).exception
    assert isinstance(error, DataError)
    assert f"at least {MIN_LOGS} logs" in str(error)
    assert not out.exists()
