import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import CheckpointError, ConfigError, DataError, NonFiniteError
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import Clip, digest, load_clips
from gripper_force.jobs.report.plots import draw_training
from gripper_force.jobs.training import train as train_module
from gripper_force.jobs.training.recipe import TrainConfig, recipe
from gripper_force.jobs.training.train import train
from gripper_force.jobs.training.trainer import Trainer
from gripper_force.vision.batch_inference import predict
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.preprocess import Preprocess

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(autouse=True)
def drawn(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """Stands in for the drawing of the figure, which takes longer than these trainings."""
    stub = Mock()
    monkeypatch.setattr(train_module, "draw_training", stub)
    return stub


def test_training_reduces_the_error(
    clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig, press: Callable[..., Clip]
) -> None:
    config = small_recipe.model_copy(update={"steps": 60, "clips": 6, "precision": "float32"})
    checkpoint = train(config, clips, tmp_path / "out.safetensors")
    unseen = press(99)
    error = predict(checkpoint.networks, config.preprocess, unseen.frames)[0] - unseen.forces_n
    constant = np.abs(unseen.forces_n - unseen.forces_n.mean()).mean()
    assert np.abs(error).mean() < 0.4 * constant


def test_checkpoint_holds_data_digest_and_metrics(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_recipe: TrainConfig
) -> None:
    monkeypatch.setattr(train_module, "draw_training", draw_training)
    config = small_recipe.model_copy(update={"attentions": ("ssam", "scam")})
    out = tmp_path / "folder" / "out.safetensors"
    header = train(config, clips, out).header
    assert [member.attention for member in header.members] == ["ssam", "scam"]
    assert header.preprocess == config.preprocess
    assert header.data_digest == digest(clips)
    assert {"mae_n", "rmse_n", "bias_n", "constant_mae_n"} == header.metrics.keys()
    assert [r.force_n for r in header.residuals] == sorted(r.force_n for r in header.residuals)
    assert all(r.std_n > 0 for r in header.residuals)
    assert sorted(out.parent.iterdir()) == [out.with_suffix(".png"), out]


@pytest.mark.parametrize(
    ("attention", "backbone", "pooling"),
    [
        ("none", "vgg", "gap"),
        ("ssam", "resnet18", "wap"),
        ("scam", "mobile", "gap"),
        ("se", "vgg", "wap"),
        ("cbam", "resnet18", "wap"),
    ],
)
def test_every_network_trains(
    attention: str, backbone: str, pooling: str, clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig
) -> None:
    recipe = {"attentions": [attention], "backbone": backbone, "pooling": pooling, "steps": 2, "clips": 2}
    config = TrainConfig.model_validate({**small_recipe.model_dump(), **recipe, "preprocess": {"size": 32}})
    larger = [replace(clip, frames=clip.frames.repeat(2, axis=1).repeat(2, axis=2)) for clip in clips]
    checkpoint = train(config, larger, tmp_path / "out.safetensors")
    (network,) = checkpoint.force_networks
    member = network.config
    assert (member.attention, member.backbone) == (attention, backbone)
    assert member.pooling == (pooling if attention in ("ssam", "scam") else "wap")


def test_the_stated_error_is_that_on_the_validation_clips(
    clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig
) -> None:
    out = tmp_path / "out.safetensors"
    checkpoint = train(small_recipe, clips[:-1], out, validation_clips=clips[-1:])
    lead_in = small_recipe.preprocess.lead_in  # a run gives no estimate before
    forces_n = predict(checkpoint.networks, small_recipe.preprocess, clips[-1].frames)[0, lead_in:]
    measured_n = clips[-1].forces_n[lead_in:]
    claimed = checkpoint.header.metrics
    assert claimed["mae_n"] == pytest.approx(np.abs(forces_n - measured_n).mean(), rel=0.01)
    mean_n = np.mean([clip.forces_n for clip in clips[:-1]])
    assert claimed["constant_mae_n"] == pytest.approx(np.abs(mean_n - measured_n).mean(), rel=1e-4)
    with pytest.raises(DataError, match="p5 has frames of 16 px"):
        train(
            small_recipe.model_copy(update={"preprocess": Preprocess(size=32)}),
            clips[-1:],
            out,
            validation_clips=clips[-1:],
        )


@pytest.mark.parametrize("method", ["network", "process"])
def test_validation_clips_without_a_label_are_refused(
    method: str, clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig
) -> None:
    few = recipe("few", ["preprocess.size=16"])
    first_only = replace(clips[-1], valid=np.arange(len(clips[-1].valid)) < 1)  # no run estimates this frame
    with pytest.raises(DataError, match=r"no frame after a recording's first \d has a load-cell force"):
        train(
            small_recipe if method == "network" else few,
            clips[:-1],
            tmp_path / "out.safetensors",
            validation_clips=[first_only],
        )


def test_same_seed_gives_identical_checkpoints(
    clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig
) -> None:
    a, b = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    train(small_recipe, clips, a)
    train(small_recipe, clips, b)
    assert a.read_bytes() == b.read_bytes()
    train(small_recipe.model_copy(update={"seed": 1}), clips, b)
    assert a.read_bytes() != b.read_bytes()


def test_resumed_training_gives_the_same_result(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_recipe: TrainConfig, drawn: Mock
) -> None:
    config = small_recipe.model_copy(update={"attentions": ("ssam", "scam")})
    whole, broken = tmp_path / "whole.safetensors", tmp_path / "broken.safetensors"
    train(config, clips, whole)
    monkeypatch.setattr(train_module, "STATE_EVERY_S", 0.0)
    steps = interrupt_step(monkeypatch, 6)  # in the second member
    with pytest.raises(KeyboardInterrupt):
        train(config, clips, broken)
    assert not broken.exists()
    train(config, clips, broken, resume=True)
    assert next(steps) == 9  # 8 steps and the failed one, none twice
    assert broken.read_bytes() == whole.read_bytes()
    assert not list(tmp_path.glob("*.state"))
    losses = drawn.call_args.args[0]
    assert set(losses) == {"1, ssam", "2, scam"}
    assert losses["1, ssam"][0, 0] == 0, "the error before the interruption is drawn, too"


def test_training_too_short_for_all_recordings_warns(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_recipe: TrainConfig
) -> None:
    out = tmp_path / "out.safetensors"
    one_clip = small_recipe.model_copy(update={"clips": 1, "short_share": 0.0})
    warnings: list[str] = []

    def warn(text: str) -> None:
        if "out-of-distribution" not in text:  # six logs are too few for a score
            warnings.append(text)

    train(one_clip.model_copy(update={"steps": 1}), clips, out, validation_clips=clips, warn=warn)
    assert warnings == [
        "the training was too short: it drew no clip from 5 of its 6 recordings; increase steps"
    ]
    monkeypatch.setattr(train_module, "MIN_STEPS", 1)
    train(small_recipe, clips, out, validation_clips=clips, warn=warn)
    assert len(warnings) == 1
    config = one_clip.model_copy(update={"steps": 3})
    train(config, clips, out, validation_clips=clips, warn=warn)
    monkeypatch.setattr(train_module, "STATE_EVERY_S", 0.0)
    interrupt_step(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        train(config, clips, out, validation_clips=clips)
    train(config, clips, out, validation_clips=clips, resume=True, warn=warn)
    assert warnings[2] == warnings[1]  # it also counts the steps before the interruption


def interrupt_step(monkeypatch: pytest.MonkeyPatch, step: int) -> Iterator[int]:
    """Interrupts the training in one step, once. Returns the numbers of the steps to come."""
    update = Trainer._update
    steps = iter(range(1000))

    def interrupted(trainer: Trainer) -> torch.Tensor:
        if next(steps) == step:
            raise KeyboardInterrupt
        return update(trainer)

    monkeypatch.setattr(Trainer, "_update", interrupted)
    return steps


SMALL = ["preprocess.size=16", "width=0.25", "hidden=16", "head=24", "device=cpu"]


def test_command_tells_what_to_do_next(
    few_logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.safetensors"
    call = ["train", str(few_logs), "--out", str(out), "--jobs", "1"]
    keys = [*SMALL, "attentions=[none]", "steps=3", "clips=1", "short_share=0"]
    call += [part for key in keys for part in ("--set", key)]
    refused = CliRunner().invoke(cli.app, [*call, "--resume"]).exception
    assert isinstance(refused, ConfigError)
    assert f"there is no {tmp_path / 'out.0.state'}; leave out --resume" in str(refused)
    interrupt_step(monkeypatch, 2)
    assert "--resume" not in CliRunner().invoke(cli.app, call).stderr  # nothing is saved in the first minute
    monkeypatch.setattr(train_module, "STATE_EVERY_S", 0.0)
    interrupt_step(monkeypatch, 2)
    assert "add --resume" in CliRunner().invoke(cli.app, call).stderr
    monkeypatch.setattr(train_module, "STATE_EVERY_S", 60.0)
    interrupt_step(monkeypatch, 0)
    assert "--resume" not in CliRunner().invoke(cli.app, call).stderr  # the state is of the training before
    interrupt_step(monkeypatch, 0)
    assert "add --resume" in CliRunner().invoke(cli.app, [*call, "--resume"]).stderr
    done = CliRunner().invoke(cli.app, [*call, "--resume"])
    assert done.exit_code == 0
    assert "constant MAE, N" in done.stdout
    assert f"next: gripper-force evaluate FOLDER --checkpoint {out}" in done.stderr
    short = CliRunner().invoke(cli.app, [*call, "--set", "steps=1", "--json"])
    too_short, no_score = json.loads(short.stdout)["warnings"]
    assert "too short" in too_short
    assert "out-of-distribution" in no_score
    assert f"warning: {too_short}" in short.stderr


def test_no_recording_is_one_sentence(clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig) -> None:
    with pytest.raises(DataError, match="no recording is left to train on"):
        train(small_recipe, [], tmp_path / "out.safetensors", validation_clips=clips)
    with pytest.raises(DataError, match="no recording is left to validate with"):
        train(small_recipe, clips, tmp_path / "out.safetensors", validation_clips=[])


def test_state_of_another_training_raises(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_recipe: TrainConfig
) -> None:
    out = tmp_path / "out.safetensors"
    monkeypatch.setattr(train_module, "save_checkpoint", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train(small_recipe, clips, out)
    with pytest.raises(CheckpointError, match="another recipe"):
        train(small_recipe.model_copy(update={"steps": 5}), clips, out, resume=True)
    with pytest.raises(CheckpointError, match="other data"):
        train(small_recipe, clips[:-1], out, resume=True)
    save_file({"weight": torch.zeros(1)}, out.with_suffix(".0.state"))  # without metadata
    with pytest.raises(CheckpointError, match="another recipe"):
        train(small_recipe, clips, out, resume=True)
    out.with_suffix(".0.state").write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match="can't read"):
        train(small_recipe, clips, out, resume=True)


def test_command_continues_a_checkpoint(few_logs: Path, tiny_checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    call = ["train", str(few_logs), "--init", str(tiny_checkpoint), "--out", str(out), "--jobs", "1"]
    call += ["--set", "steps=1", "--set", "clips=2", "--set", "device=cpu", "--json"]
    done = CliRunner().invoke(cli.app, call)
    assert done.exit_code == 0, done.output
    start, result = load_checkpoint(tiny_checkpoint), load_checkpoint(out)
    assert result.header.members == start.header.members
    assert result.header.preprocess == start.header.preprocess
    # One step changes each weight by no more than the learning rate; a new network has far smaller weights.
    before, after = (checkpoint.force_networks[0].out.weight for checkpoint in (start, result))
    assert before.abs().max() > 100
    torch.testing.assert_close(after, before, rtol=1e-3, atol=0.01)
    assert result.digest != start.digest
    out.unlink()
    refused = CliRunner().invoke(cli.app, [*call, "--recipe", "shin2019"]).exception
    assert isinstance(refused, ConfigError)
    assert "preprocess.size=128" in str(refused)
    assert not out.exists()


def test_command_takes_several_folders_and_a_teacher(
    few_logs: Path, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    moved = sorted(few_logs.glob("*.mcap"))[0]
    moved.rename(other / moved.name)
    out = tmp_path / "out.safetensors"
    call = ["train", str(other), str(few_logs), "--out", str(out), "--jobs", "1", "--json"]
    call += ["--teacher", str(tiny_checkpoint)]
    keys = [*SMALL, "preprocess.size=32", "attentions=[none]", "steps=1"]
    call += [part for key in keys for part in ("--set", key)]
    done = CliRunner().invoke(cli.app, call)
    assert done.exit_code == 0, done.output
    logs = [*other.glob("*.mcap"), *few_logs.glob("*.mcap")]
    assert len(logs) == 3
    assert load_checkpoint(out).header.data_digest == digest(load_clips(logs, Preprocess(size=32)))
    other_size = CliRunner().invoke(cli.app, [*call, "--set", "preprocess.size=16"]).exception
    assert isinstance(other_size, ConfigError)
    assert "the teacher sees frames" in str(other_size)


def test_frozen_statistics_need_an_initial_checkpoint(
    clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig
) -> None:
    frozen = small_recipe.model_copy(update={"freeze_statistics": True})
    with pytest.raises(ConfigError, match="add --init"):
        train(frozen, clips, tmp_path / "out.safetensors")


def test_command_leaves_out_logs_that_start_in_contact(
    few_logs: Path, loaded_log: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.safetensors"
    free, every = (
        load_clips(logs, Preprocess(size=16))
        for logs in (sorted(set(few_logs.glob("*.mcap")) - {loaded_log}), few_logs)
    )
    call = ["train", str(few_logs), "--out", str(out), "--jobs", "1", "--json"]
    keys = [*SMALL, "attentions=[none]", "steps=1"]
    call += [part for key in keys for part in ("--set", key)]
    for options, left_out, clips in (
        ([], 1, free),
        (["--include-contact-starts"], 0, every),
        (["--set", "preprocess.reference=false"], 0, every),
    ):
        done = CliRunner().invoke(cli.app, [*call, *options])
        assert json.loads(done.stdout)["left_out"] == left_out
        assert ("left out 1 of 4 logs, which start in contact" in done.stderr) == bool(left_out)
        assert load_checkpoint(out).header.data_digest == digest(clips)
    (tmp_path / "unseen").mkdir()
    loaded_log.rename(tmp_path / "unseen" / loaded_log.name)
    refused = CliRunner().invoke(cli.app, [*call, "--validation", str(tmp_path / "unseen")]).exception
    assert isinstance(refused, DataError)
    assert "all 1 recordings start in contact" in str(refused)


def test_validation_on_what_is_trained_on_is_refused(few_logs: Path, tmp_path: Path) -> None:
    (one, *_) = sorted(few_logs.glob("*.mcap"))
    copy = tmp_path / "copy.mcap"
    shutil.copy(one, copy)
    for path in (one, copy):
        call = ["train", str(few_logs), "--validation", str(path), "--out", str(tmp_path / "x.safetensors")]
        refused = CliRunner().invoke(cli.app, [*call, "--jobs", "1"]).exception
        assert isinstance(refused, ConfigError)
        assert f"1 logs of --validation are among those to train on, such as {path}" in str(refused)


def test_divergence_raises(clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig) -> None:
    clips[0].forces_n[:] = clips[1].forces_n[:] = clips[2].forces_n[:] = np.inf
    with pytest.raises(NonFiniteError, match="ssam diverged"):
        train(small_recipe, clips, tmp_path / "out.safetensors")


def test_data_without_contact_or_split_raise(
    clips: list[Clip], tmp_path: Path, small_recipe: TrainConfig, press: Callable[..., Clip]
) -> None:
    with pytest.raises(DataError, match="two"):
        train(small_recipe, clips[:1], tmp_path / "out.safetensors")
    with pytest.raises(DataError, match="too few"):
        train(small_recipe, [*clips, press(7, frames=3), press(8, frames=3)], tmp_path / "out.safetensors")
    for clip in clips:
        clip.forces_n[:] = 0
    with pytest.raises(DataError, match="contact"):
        train(small_recipe, clips, tmp_path / "out.safetensors")


def test_command_takes_a_recipe(few_logs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    keys = [*SMALL, "attentions=[cbam]", "epochs=null", "steps=1", "clips=2"]
    sets = [part for key in keys for part in ("--set", key)]
    call = ["train", str(few_logs), "--recipe", "shin2019", "--out", str(out), "--jobs", "1", *sets, "--json"]
    told = json.loads(CliRunner().invoke(cli.app, call).stdout)
    figures = {"mae_n", "rmse_n", "bias_n", "constant_mae_n"}
    assert set(told) == {"checkpoint", "digest", "figure", "left_out", "warnings", *figures}
    header = load_checkpoint(out).header
    assert [member.attention for member in header.members] == ["cbam"]
    assert not header.preprocess.reference
    (tmp_path / "unseen").mkdir()
    one = min(few_logs.glob("*.mcap"))
    one = one.rename(tmp_path / "unseen" / one.name)
    call = [*call, "--validation", str(tmp_path / "unseen")]
    told = json.loads(CliRunner().invoke(cli.app, call).stdout)
    (clip,) = load_clips([one], header.preprocess)
    forces_n = predict(load_checkpoint(out).networks, header.preprocess, clip.frames)[0]
    assert told["mae_n"] == pytest.approx(
        metrics.mae(forces_n[clip.valid], clip.forces_n[clip.valid]), rel=0.01
    )
    refused = CliRunner().invoke(cli.app, ["train", str(few_logs), "--recipe", "shin"]).exception
    assert isinstance(refused, ConfigError)
