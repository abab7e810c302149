import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.imports.video import import_folder
from gripper_force.jobs.training import few
from gripper_force.jobs.training import train as train_module
from gripper_force.jobs.training.ood_fit import calibrate_network
from gripper_force.jobs.training.recipe import TrainConfig, recipe
from gripper_force.jobs.training.stated_errors import errors, labelled_estimates
from gripper_force.jobs.training.train import train
from gripper_force.vision.batch_inference import predict
from gripper_force.vision.checkpoint import Checkpoint, load_checkpoint
from gripper_force.vision.engines.pytorch import restored_threads
from gripper_force.vision.estimator import ForceEstimator
from gripper_force.vision.export import export
from gripper_force.vision.header import GaussianProcessConfig
from gripper_force.vision.model_files import read_model

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="session")
def six(press: Callable[..., Clip]) -> list[Clip]:
    """Six recordings of six objects."""
    return [replace(press(seed), object=f"o{seed}") for seed in range(6)]


@pytest.fixture(scope="session")
def process(six: list[Clip], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("few") / "few.safetensors"
    with restored_threads():
        torch.set_num_threads(1)  # before `one_thread` does
        train(recipe("few", ["preprocess.size=16"]), six, path)
    return path


def test_one_image_throughout_is_named(six: list[Clip]) -> None:
    same = [replace(clip, frames=np.zeros_like(clip.frames)) for clip in six]
    with pytest.raises(DataError, match="all frames with a label show the same image"):
        few.fit(same, recipe("few", ["preprocess.size=16"]).preprocess)


def test_a_process_is_no_teacher(process: Path, six: list[Clip], tmp_path: Path) -> None:
    config = recipe("short_clips", ["preprocess.size=16", "preprocess.magnitude=true", "steps=1"])
    with pytest.raises(ConfigError, match="Gaussian process"):
        train(config, six, tmp_path / "taught.safetensors", teacher=load_checkpoint(process))


def mae_n(checkpoint: Checkpoint, clips: list[Clip]) -> float:
    """Returns the mean absolute error over all frames with a label."""
    preprocess = checkpoint.header.preprocess
    return errors(*labelled_estimates(clips, checkpoint.networks, preprocess, "cpu"))["mae_n"]


def test_a_process_learns_from_six_recordings_of_six_objects(
    process: Path, six: list[Clip], press: Callable[..., Clip]
) -> None:
    checkpoint = load_checkpoint(process)
    new_n = mae_n(checkpoint, [press(99)])
    claimed = checkpoint.header.metrics
    assert new_n < 0.4 * claimed["constant_mae_n"]
    # The claim is that on an object left out, not on the training data.
    assert claimed["mae_n"] > mae_n(checkpoint, six)
    assert 0.3 * claimed["mae_n"] < new_n < 3 * claimed["mae_n"]


def test_a_network_trains_on_six_recordings_of_six_objects(
    six: list[Clip], tmp_path: Path, small_recipe: TrainConfig
) -> None:
    config = small_recipe.model_copy(update={"validation": 0.1})
    header = train(config, six, tmp_path / "network.safetensors", figure=False).header
    assert header.metrics["constant_mae_n"] > 0
    with pytest.raises(DataError, match="two"):
        train(config, six[:1], tmp_path / "network.safetensors")


def test_a_stream_equals_the_batch(process: Path, press: Callable[..., Clip]) -> None:
    clip, checkpoint = press(50), load_checkpoint(process)
    whole_n = predict(checkpoint.networks, checkpoint.header.preprocess, clip.frames)[0]
    estimator = ForceEstimator.load(process)
    estimates = [estimator.update(frame) for frame in clip.frames]
    assert [estimate is None for estimate in estimates[:4]] == [True, True, True, False]
    found = [estimate for estimate in estimates if estimate is not None]
    np.testing.assert_allclose([e.force_n for e in found], whole_n[3:], atol=1e-3)
    assert all(e.std_n > 0 for e in found)


def test_the_stored_process_is_the_fitted_one(six: list[Clip], process: Path, tmp_path: Path) -> None:
    config = recipe("few", ["preprocess.size=16"])
    fitted = few.fit(six, config.preprocess).model
    (loaded,) = load_checkpoint(process).networks
    assert isinstance(loaded.config, GaussianProcessConfig)
    assert loaded.config == fitted.config
    for name, tensor in fitted.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name
    again = tmp_path / "again.safetensors"
    train(config, six, again)
    assert again.read_bytes() == process.read_bytes()


@pytest.mark.parametrize(("suffix", "package"), [(".onnx", "onnxruntime"), (".xml", "openvino")])
def test_an_exported_process_gives_the_same_forces(
    suffix: str, package: str, process: Path, press: Callable[..., Clip], tmp_path: Path
) -> None:
    pytest.importorskip(package)
    exported = tmp_path / f"few{suffix}"
    assert export(read_model(process), exported)["largest_n"] < 1e-3
    frames = press(51).frames
    plain, other = ForceEstimator.load(process), ForceEstimator.load(exported, engine=package)
    for frame in frames:
        a, b = plain.update(frame), other.update(frame)
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert a.force_n == pytest.approx(b.force_n, abs=2e-3)


def test_settings_are_chosen_on_what_was_left_out(six: list[Clip]) -> None:
    preprocess = recipe("few", ["preprocess.size=16"]).preprocess
    fit = few.fit(six, preprocess)
    for forces_n, clip in zip(fit.forces_n, six, strict=True):
        rest = [other for other in six if other is not clip]
        alone = few.fitted(rest, preprocess, fit.setting)
        expected_n = predict([alone], preprocess, clip.frames)[0]
        np.testing.assert_allclose(forces_n, expected_n, atol=5e-3)
    with pytest.raises(DataError, match="only one set"):
        few.fit(six[:1], preprocess)
    silent = [replace(clip, forces_n=0 * clip.forces_n) for clip in six]
    with pytest.raises(DataError, match="no training frame"):
        few.fit(silent, preprocess)


def test_stated_error_leaves_out_frames_without_an_estimate_in_a_run(six: list[Clip], process: Path) -> None:
    header = load_checkpoint(process).header
    lead_in = header.preprocess.lead_in
    assert lead_in > 0
    left_out_n = few.fit(six, header.preprocess).forces_n
    error_n = [one[lead_in:] - clip.forces_n[lead_in:] for one, clip in zip(left_out_n, six, strict=True)]
    assert header.metrics["mae_n"] == pytest.approx(np.abs(np.concatenate(error_n)).mean(), rel=1e-4)


def test_sets_of_two_objects_may_have_one_name(six: list[Clip]) -> None:
    two = [replace(clip, object=name, set="1") for clip, name in zip(six[:2], ("cup", "box"), strict=True)]
    assert len(few.fit(two, recipe("few", ["preprocess.size=16"]).preprocess).forces_n) == 2


def test_keys_of_networks_are_refused(
    six: list[Clip], process: Path, tmp_path: Path, small_recipe: TrainConfig
) -> None:
    out = tmp_path / "out.safetensors"
    with pytest.raises(ConfigError, match="a Gaussian process has no steps"):
        recipe("few", ["steps=5"])
    config = recipe("few", ["preprocess.size=16"])
    with pytest.raises(ConfigError, match="without --init and --replay"):
        train(config, six, out, replay_clips=six)
    with pytest.raises(ConfigError, match="is a Gaussian process"):
        train(small_recipe, six, out, init=load_checkpoint(process))


def test_a_process_gets_no_score_and_no_log_is_read_for_it(process: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a Gaussian process"):
        calibrate_network([tmp_path / "none.mcap"], tmp_path / "out.safetensors", process)


def test_a_network_of_the_recipe_few_can_be_evaluated(few_logs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    call = ["train", str(few_logs), "--out", str(out), "--recipe", "few", "--set", "preprocess.size=16"]
    done = CliRunner().invoke(cli.app, [*call, "--jobs", "1", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["mae_n"] < json.loads(done.stdout)["constant_mae_n"]
    call = ["evaluate", str(few_logs), "--checkpoint", str(out), "--jobs", "1", "--json"]
    told = CliRunner().invoke(cli.app, call)
    assert json.loads(told.stdout)["mae_n"] < 1


def test_init_keeps_batch_statistics(six: list[Clip], tmp_path: Path, small_recipe: TrainConfig) -> None:
    first = train(small_recipe, six, tmp_path / "first.safetensors", figure=False)
    second = train(small_recipe, six, tmp_path / "second.safetensors", init=first, figure=False)
    (a,), (b,) = first.networks, second.networks
    moved = {name for name, tensor in a.state_dict().items() if not torch.equal(tensor, b.state_dict()[name])}
    assert any("weight" in name for name in moved)
    assert not [name for name in moved if "running" in name or "batches_tracked" in name]


def test_replayed_objects_are_not_forgotten(
    press: Callable[..., Clip], tmp_path: Path, small_recipe: TrainConfig
) -> None:
    # The new object shows the opposite: less change, more force.
    old = [press(seed) for seed in range(6)]
    new = [replace(clip, forces_n=8 - clip.forces_n, object="new") for clip in (press(20), press(21))]
    config = small_recipe.model_copy(update={"steps": 60, "clips": 4, "precision": "float32"})
    first = train(config, old, tmp_path / "first.safetensors", figure=False)
    again = config.model_copy(update={"steps": 40})
    errors_n = {}
    for name, replay in (("alone", []), ("replayed", old)):
        out = tmp_path / f"{name}.safetensors"
        after = train(again, new, out, validation_clips=new, init=first, replay_clips=replay, figure=False)
        errors_n[name] = mae_n(after, old)
    before_n = mae_n(first, old)
    assert errors_n["alone"] > 2 * before_n
    assert errors_n["replayed"] < 0.6 * errors_n["alone"]


def test_too_few_steps_warn(
    six: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_recipe: TrainConfig
) -> None:
    warnings: list[str] = []
    config = small_recipe.model_copy(update={"steps": 8})
    out = tmp_path / "out.safetensors"
    train(config, six, out, validation_clips=six, figure=False, warn=warnings.append)
    (text,) = (w for w in warnings if "out-of-distribution" not in w)
    assert "only 8 steps" in text
    monkeypatch.setattr(train_module, "MIN_STEPS", 8)
    train(config, six, out, validation_clips=six, figure=False, warn=warnings.append)
    assert not [w for w in warnings[2:] if "out-of-distribution" not in w]


def test_the_recipe_few_beats_a_constant_on_real_recordings(real_grasps: Path, tmp_path: Path) -> None:
    chosen = tmp_path / "recordings"
    chosen.mkdir()
    names = ("purple_ball_hardest", "green_ball_softer", "red_foam_brick_softer", "blue_foam_brick_harder")
    for name in names:
        folder = f"2023-12-16_{name}_1"
        (chosen / folder).symlink_to(real_grasps / folder)
    import_folder(chosen, tmp_path / "logs")
    out = tmp_path / "few.safetensors"
    call = ["train", str(tmp_path / "logs"), "--out", str(out), "--recipe", "few", "--jobs", "1", "--json"]
    found = json.loads(CliRunner().invoke(cli.app, call).stdout)
    assert found["mae_n"] < 0.7 * found["constant_mae_n"]  # on objects left out
