from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.training import ood_fit
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
    add_ood(tiny_checkpoint, model, None, out)
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


def test_logs_of_a_set_do_not_score_each_other(
    tiny_checkpoint: Path, clips_of_32: list[Clip], monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = load_checkpoint(tiny_checkpoint)

    def like_no_other(_: object, __: object, frames: np.ndarray, ___: str) -> tuple[np.ndarray, np.ndarray]:
        """Returns features in a direction that only logs with the same frames share."""
        direction = np.random.default_rng(int(frames.sum())).normal(size=2000)
        along = np.outer(np.arange(len(frames)), direction)
        return np.ones((1, len(frames)), np.float32), along.astype(np.float32)

    monkeypatch.setattr(ood_fit, "features", like_no_other)
    once = [replace(clip, set=f"s{i}") for i, clip in enumerate(clips_of_32[:MIN_LOGS])]
    again = [replace(clip, name=f"{clip.name} again") for clip in once]  # as under another light
    model = fit_ood(loaded.force_networks, loaded.header, [*once, *again])
    assert model is not None
    assert all(limit.typical > 0.5 for limit in model.limits)
    one_set = [replace(clip, set="all") for clip in clips_of_32]
    assert fit_ood(loaded.force_networks, loaded.header, one_set) is None


def test_command_says_how_many_logs_it_needs(few_logs: Path, tiny_checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    call = ["calibrate", "network", str(few_logs), "--checkpoint", str(tiny_checkpoint), "--out", str(out)]
    error = CliRunner().invoke(cli.app, [*call, "--jobs", "1"]).exception
    assert isinstance(error, DataError)
    assert f"at least {MIN_LOGS} logs" in str(error)
    assert not out.exists()
