import json
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from gripper_force import cli, plugins
from gripper_force.config import Config, config_from_text, dump_config, load_config
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import Clip, load_clips
from gripper_force.jobs.estimates import estimate_clips
from gripper_force.jobs.evaluate import Evaluation, errors_on, evaluate
from gripper_force.jobs.replay import replay
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import LoadCellSample
from gripper_force.vision.checkpoint import Checkpoint, load_checkpoint
from gripper_force.vision.checkpoint_writer import replace_header, save_checkpoint
from gripper_force.vision.engines.pytorch import TorchEngine
from gripper_force.vision.estimator import ForceEstimator
from gripper_force.vision.header import Header, NetworkConfig, Residual
from gripper_force.vision.model_files import read_model
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess


@pytest.fixture
def checkpoint() -> Checkpoint:
    torch.manual_seed(0)
    configs = tuple(
        NetworkConfig.model_validate({"attention": a, "size": 16, "width": 0.25, "hidden": 6, "head": 7})
        for a in ("ssam", "scam")
    )
    header = Header(
        members=configs,
        preprocess=Preprocess(size=16),
        residuals=(Residual(force_n=0, std_n=1),),
        data_digest="",
        metrics={},
    )
    networks = tuple(ForceNetwork(config).eval().requires_grad_(False) for config in configs)
    return Checkpoint(networks, header, digest="")


pytestmark = pytest.mark.usefixtures("one_thread")


def clip(name: str, object_name: str, seed: int, size: int = 16) -> Clip:
    rng = np.random.default_rng(seed)
    forces_n = np.maximum(0, np.linspace(-3, 6, 30)).astype(np.float32)
    change = np.outer(forces_n, rng.integers(-5, 6, size * size)).reshape(30, size, size)
    frames = rng.integers(60, 140, (size, size)) + change
    return Clip(
        frames.clip(0, 255).astype(np.uint8), forces_n, np.ones(30, np.bool_), name, object_name, name
    )


def evaluate_clips(checkpoint: Checkpoint, clips: list[Clip]) -> Evaluation:
    forces_n = [members_n.mean(0) for members_n in estimate_clips(checkpoint, clips)]
    return errors_on(clips, forces_n, checkpoint.header.preprocess.lead_in)


def test_estimates_equal_the_streaming_estimators(checkpoint: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "written.safetensors"
    save_checkpoint(path, checkpoint.networks, checkpoint.header)
    clips = [clip("a", "cup", 0), clip("b", "cup", 1), clip("c", "tube", 2)]
    clips[1].valid[10:20] = False
    result = evaluate_clips(load_checkpoint(path), clips)
    errors: dict[str, list[float]] = {"cup": [], "tube": []}
    estimator = ForceEstimator(TorchEngine(read_model(path)))
    for one in clips:
        estimator.reset()
        for frame, force_n, valid in zip(one.frames, one.forces_n, one.valid, strict=True):
            estimate = estimator.update(frame)
            if estimate is not None and valid:
                errors[one.object].append(estimate.force_n - float(force_n))
    every = np.array(errors["cup"] + errors["tube"])
    assert result.frames == len(every) == 27 + 17 + 27
    assert result.mae_n == pytest.approx(np.abs(every).mean(), rel=1e-5)
    assert result.rmse_n == pytest.approx(np.sqrt((every**2).mean()), rel=1e-5)
    assert result.bias_n == pytest.approx(every.mean(), rel=1e-5)
    assert result.per_object["cup"].mae_n == pytest.approx(np.abs(errors["cup"]).mean(), rel=1e-5)
    assert result.per_object["tube"].frames == 27
    assert sum(b.frames for b in result.per_bin) == result.frames


@pytest.mark.usefixtures("pool_here")
def test_logs_are_evaluated_like_their_clips(
    few_logs: Path, tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = load_checkpoint(tiny_checkpoint)
    expected = evaluate_clips(checkpoint, load_clips(few_logs, checkpoint.header.preprocess))
    assert expected.frames == 3 * 57
    assert capsys.readouterr() == ("", "")
    for logs, workers in ((str(few_logs), 1), (sorted(few_logs.iterdir()), 2)):
        progress = Mock()
        result = evaluate(logs, tiny_checkpoint, objects=["disc"], workers=workers, progress=progress)
        assert (result.mae_n, result.per_bin) == (expected.mae_n, expected.per_bin)
        steps = [call.args[1] if len(call.args) > 1 else 1 for call in progress.call_args_list]
        assert sum(steps) == len(list(few_logs.iterdir()))
    (few_logs / "damaged.mcap").write_bytes(b"no log")
    for objects in (["cup"], "cup"):
        with pytest.raises(DataError, match="no log is of cup; there are disc"):
            evaluate(few_logs, tiny_checkpoint, objects=objects)


def test_files_of_an_evaluation_may_be_named_by_text(
    few_logs: Path, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    figure, folder = tmp_path / "figures" / "errors.png", tmp_path / "summary"
    evaluate(few_logs, tiny_checkpoint, plot=str(figure), out=str(folder))
    assert figure.stat().st_size > 1000
    assert (folder / "summary.json").exists()
    with pytest.raises(ConfigError, match="the figure must be a path, not 5; name a file"):
        evaluate(few_logs, tiny_checkpoint, plot=5)  # type: ignore[arg-type]


def test_bfloat16_rounds_the_estimates_a_little(few_logs: Path) -> None:
    log = min(few_logs.iterdir())
    errors = [
        evaluate(log, "small", config=Config().with_values(vision={"precision": precision}))
        for precision in ("float32", "bfloat16")
    ]
    assert 0 < abs(errors[0].rmse_n - errors[1].rmse_n) < 0.01 * errors[0].rmse_n


def test_a_log_without_frames_is_named(few_logs: Path, tiny_checkpoint: Path) -> None:
    path = few_logs / "blind.mcap"
    with LogWriter(path, config="object: sponge\n", metadata={}) as log:
        log.write(LoadCellSample(1, 0.0, 0.0))
    result = evaluate(few_logs, tiny_checkpoint)
    assert result.failed == {str(path): f"{path} holds no camera frames; remove it from the logs"}
    assert len(result.per_log) == 3


def test_logs_that_start_in_contact_are_left_out(
    few_logs: Path, tiny_checkpoint: Path, loaded_log: Path
) -> None:
    without = evaluate(few_logs, tiny_checkpoint)
    assert (without.frames, without.left_out) == (3 * 57, 1)
    every = evaluate(few_logs, tiny_checkpoint, include_contact_starts=True)
    assert (every.frames, every.left_out) == (3 * 57 + 37, 0)
    progress = Mock()
    evaluate(few_logs, tiny_checkpoint, progress=progress)
    assert sum(call.args[1] if len(call.args) > 1 else 1 for call in progress.call_args_list) == 4
    with pytest.raises(DataError, match="all 1 recordings start in contact"):
        evaluate([loaded_log], tiny_checkpoint)
    call = ["evaluate", str(few_logs), "--checkpoint", str(tiny_checkpoint), "--jobs", "1"]
    assert "left out 1 of 4 logs, which start in contact" in CliRunner().invoke(cli.app, call).stderr
    included = CliRunner().invoke(cli.app, [*call, "--include-contact-starts", "--json"])
    assert "left out" not in included.stderr
    assert json.loads(included.stdout)["frames"] == every.frames


def test_logs_of_another_rig_than_that_of_the_network_are_told(
    few_logs: Path, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    network = tmp_path / "one_rig.safetensors"
    rig = {"rigs": 1, "vision.region": [0, 0, 10, 10]}
    header = read_model(tiny_checkpoint).header.model_copy(update={"trained_on": rig})
    replace_header(tiny_checkpoint, header, network)
    reader = LogReader(min(few_logs.iterdir()))
    config = config_from_text(reader.config, "").with_values(gripper={"nm_per_a": 1.0})
    assert evaluate(few_logs, network).other_rig == [], "the rig of imported recordings is not known"
    with LogWriter(few_logs / "run.mcap", config=dump_config(config), metadata={}) as log:
        for record in reader.records():
            log.write(record)
    call = ["evaluate", str(few_logs), "--checkpoint", str(network), "--jobs", "1", "--json"]
    done = CliRunner().invoke(cli.app, call)
    assert json.loads(done.stdout)["other_rig"] == ["vision.region [0, 0, 10, 10], not None"]
    assert "learned from one rig only, and logs are of another: vision.region" in done.stderr
    for more in ([], ["--compare", "log", "control.ramp_n_s=4"]):
        again = CliRunner().invoke(
            cli.app, ["replay", str(few_logs), "--set", f"vision.checkpoint={network}", "--jobs", "1", *more]
        )
        assert again.stderr.count("learned from one rig only, and logs are of another: vision.region") == 1
    assert replay(few_logs / "run.mcap", network).other_rig == ["vision.region [0, 0, 10, 10], not None"]
    assert replay(reader.path, network).other_rig == []
    same = Config().with_values(vision={"region": (0, 0, 10, 10)})
    assert evaluate(few_logs, network, config=same).other_rig == []


def test_estimates_are_drawn(few_logs: Path, tiny_checkpoint: Path, tmp_path: Path) -> None:
    figure = tmp_path / "figure.png"
    call = [
        "evaluate",
        str(few_logs),
        "--checkpoint",
        str(tiny_checkpoint),
        "--jobs",
        "1",
        "--plot",
        str(figure),
    ]
    done = CliRunner().invoke(cli.app, call)
    assert done.exit_code == 0
    assert f"figure: {figure}" in done.stderr
    assert figure.is_file()


def test_a_figure_that_cannot_be_written_ends_the_evaluation_before_its_work(
    few_logs: Path, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    done: list[str] = []
    with pytest.raises(DataError, match=r"can't write the figure .*; choose another path"):
        evaluate(
            few_logs,
            tiny_checkpoint,
            plot=tmp_path / "file" / "x.png",
            progress=lambda text, steps=1: done.append(text),
        )
    assert not done


def test_profile_of_another_checkpoint_raises(few_logs: Path, tiny_checkpoint: Path) -> None:
    with pytest.raises(ConfigError, match="object profile"):
        evaluate(few_logs, tiny_checkpoint, profile="sponge")
    config = load_config(None, ["calibration.object=sponge"])
    with pytest.raises(ConfigError, match="object profile"):
        evaluate(few_logs, tiny_checkpoint, config=config)


def test_contact_error_without_contact_is_nan(checkpoint: Checkpoint) -> None:
    free = clip("a", "cup", 0)
    free.forces_n[:] = 0
    result = evaluate_clips(checkpoint, [free])
    assert np.isnan(result.per_object["cup"].contact_mae_n)


def test_clips_without_labels_or_of_another_size_raise(checkpoint: Checkpoint) -> None:
    with pytest.raises(DataError, match="32 px, the network needs 16"):
        evaluate_clips(checkpoint, [clip("a", "cup", 0, size=32)])
    unlabelled = clip("a", "cup", 0)
    unlabelled.valid[:] = False
    with pytest.raises(DataError, match="label"):
        evaluate_clips(checkpoint, [unlabelled])
    with pytest.raises(DataError, match="label"):
        errors_on([], [], 0)


def test_without_pytorch_the_extra_is_named(few_logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugins, "find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"^evaluate needs torch, .*gripper-force\[train\]"):
        evaluate(few_logs)
