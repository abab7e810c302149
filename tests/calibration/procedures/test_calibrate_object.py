"""Object profiles from touches on the simulated rig, and grasps with them."""

import json
import math
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from typer.testing import CliRunner, Result

from gripper_calibration import touch_logs
from gripper_calibration.procedures import calibrate_object as job
from gripper_calibration.procedures import estimate_time
from gripper_calibration.procedures.calibrate_object import (
    ObjectCalibration,
    calibrate_object,
    record_touches,
)
from gripper_force import __version__
from gripper_force.cli import app, console
from gripper_force.config import Config, config_from_text, load_config
from gripper_force.control.transmission import Transmission
from gripper_force.errors import ConfigError, DataError, RequestError, UnfamiliarFrameError
from gripper_force.jobs.dataset import CLIP_RECORDS, load_clip, load_clips
from gripper_force.jobs.evaluate import evaluate
from gripper_force.jobs.grasp import grasp
from gripper_force.jobs.replay import replay
from gripper_force.jobs.training.train import trained_on
from gripper_force.profiles.object_profile import read_object, weights_path
from gripper_force.runtime import process
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.runtime.resolve import resolve
from gripper_force.types import NS_PER_S, Frame, GraspStatus, LoadCellSample, Phase, ServoState
from gripper_force.vision.batch_inference import features
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.estimator import ForceEstimator, open_configured_engine
from gripper_force.vision.preprocess import Preprocess

QUICK = [
    "object=stapler",
    "sim.detail=coarse",
    "sim.stiffness_spread=0.5",
    "sim.object_seed=5",
    "sim.rig_seed=3",
    "vision.checkpoint=small",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("object")


@pytest.fixture(scope="module")
def touched(folder: Path) -> list[Path]:
    return list(record_touches(load_config(None, QUICK), 4, 6.0, folder / "touches"))


@pytest.fixture(scope="module")
def profile(folder: Path, touched: list[Path]) -> Path:
    path = folder / "mine.yaml"
    calibrate_object(load_config(None, QUICK), "stapler", logs=[*map(str, touched[:3])], out=path)
    return path


def run(folder: Path, *more: str) -> Config:
    keys = (f"log.directory={folder}", "log.report=false", "target_n=2", "control.hold_s=0.5")
    return load_config(None, [*QUICK, *keys, *more])


@pytest.mark.usefixtures("no_figures")
def test_the_missing_touch_is_recorded_and_all_are_fitted(
    touched: list[Path], profile: Path, tmp_path: Path
) -> None:
    steps: list[int] = []
    asked: list[str] = []
    for path in (touched[0], touched[2]):
        shutil.copy(path, tmp_path)
    result = calibrate_object(
        load_config(None, QUICK[1:]),
        "stapler",
        touches=3,
        peak_n=6.0,
        folder=tmp_path,
        out=str(tmp_path / "it.yaml"),
        prompt=lambda text: asked.append(text),
        progress=lambda _text, steps_done=1: steps.append(steps_done),
    )
    assert asked == ["Put the object between the jaws for touch 2"]
    assert sum(steps) == 3 + 3 + 2
    assert result.profile.weights == read_object(profile).weights
    assert result.profile.version == __version__
    digests = [sha256(path.read_bytes()).hexdigest() for path in sorted(tmp_path.glob("*.mcap"))]
    assert list(result.profile.logs) == digests
    assert result.profile == read_object(result.profile_path)
    assert result.mae_before_n == result.as_dict()["before_n"]
    assert result.coverage == 0.9


def test_command_calibrates_from_one_touch_and_opens_the_engine_once(
    touched: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = Mock(wraps=open_configured_engine)
    monkeypatch.setattr(job, "open_configured_engine", opened)
    shutil.copy(touched[0], tmp_path)
    keys = [part for key in QUICK[1:] for part in ("--set", key)]
    given = ["calibrate", "object", "stapler", "--touches", "1", "--peak-n", "6", "--json", *keys]
    result = CliRunner().invoke(
        app, [*given, "--folder", str(tmp_path), "--out", str(tmp_path / "it.yaml")], catch_exceptions=False
    )
    assert result.exit_code == 0, result.stderr
    assert opened.call_count == 1
    found = json.loads(result.stdout)
    assert (found["touches"], found["after_n"], found["touches_needed"]) == (1, None, [])
    assert Path(found["report"]).stat().st_size > 10_000
    assert "needs at least 3 touches; 8 are recommended" in result.stderr
    profile = tmp_path / "it.yaml"
    largest_n = read_object(profile).force_n
    assert largest_n < 6.0
    words = f"grasp --object stapler --profile {profile} --target-n {largest_n / 2:.1f} --set"
    assert f"next: gripper-force {words}" in result.stderr


@pytest.mark.usefixtures("no_figures")
def test_in_real_time_the_open_engine_is_timed_whatever_the_region_of_the_camera(
    touched: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(estimate_time, "make_estimator")  # would open a second engine
    config = load_config(None, [*QUICK, "clock=realtime", "vision.region=[40, 40, 400, 400]"])
    plant = calibrate_object(config, "stapler", logs=touched[:1], out=tmp_path / "it.yaml").profile.plant
    assert plant is not None
    assert plant.delay_ms > 0


@pytest.mark.usefixtures("no_figures")
def test_in_bfloat16_a_profile_has_no_limits_as_its_runs_have_no_score(
    touched: list[Path], tmp_path: Path
) -> None:
    pytest.importorskip("openvino")
    config = load_config(None, [*QUICK, "vision.engine=openvino", "vision.precision=bfloat16"])
    result = calibrate_object(config, "stapler", logs=touched[:1], out=tmp_path / "it.yaml")
    assert result.profile.ood_limits is None


def test_calibration_needs_no_pytorch() -> None:
    code = "import sys, gripper_calibration.procedures.calibrate_object; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"torch", "gripper_force.vision.export"} & set(done.stdout.split())


def test_an_engine_that_can_not_run_is_named_before_the_touches(tmp_path: Path) -> None:
    config = load_config(None, [*QUICK, "vision.engine=pathlib:Path"])
    with pytest.raises(ConfigError, match=r"vision\.engine=pathlib:Path: .* has no method 'step'"):
        calibrate_object(config, "stapler", touches=1, folder=tmp_path, out=tmp_path / "it.yaml")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("library_process")
def test_the_threads_of_pytorch_are_the_programs() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(before + 1)
    try:
        job.prepare(load_config(None, [*QUICK, "vision.engine=torch"]), "stapler")
        assert torch.get_num_threads() == before + 1
    finally:
        torch.set_num_threads(before)


def test_log_is_read_once_with_the_results_of_separate_reads(
    touched: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, checkpoint = touched[0], load_checkpoint("small")
    preprocess = checkpoint.header.preprocess
    clip = load_clip(path, preprocess, None)
    reader = LogReader(path)
    config = config_from_text(reader.config, str(path))
    assert config.gripper.nm_per_a is not None
    transmission = Transmission.from_config(config.gripper, config.gripper.nm_per_a)
    phases = [status.phase for status in reader.records(GraspStatus)]
    states = [
        state
        for state, phase in zip(reader.records(ServoState), phases, strict=False)
        if phase in (Phase.RAMP, Phase.HOLD)
    ]
    delay_s = np.median([frame.received_ns - frame.t_ns for frame in reader.records(Frame)]) / NS_PER_S
    passes: list[int] = []

    class CountingReader(LogReader):
        def records(self, *types: Any) -> Any:
            passes.append(len(types))
            return super().records(*types)

    monkeypatch.setattr(touch_logs, "LogReader", CountingReader)
    recorded = touch_logs.read_log(path, preprocess, partial(features, checkpoint.networks, preprocess))
    assert passes == [len(CLIP_RECORDS) + 1]
    labelled = clip.valid & (np.arange(len(clip.frames)) >= preprocess.lead_in)
    forces_n, read_out = features(checkpoint.networks, preprocess, clip.frames)
    assert np.array_equal(recorded.touches.features, read_out[labelled])
    assert np.array_equal(recorded.touches.estimate_n, forces_n.mean(0).astype(np.float64)[labelled])
    assert np.array_equal(recorded.touches.force_n, clip.forces_n[labelled])
    (press,), (width_m,) = recorded.presses, recorded.width_m
    assert np.array_equal(press.t_s, np.array([state.t_ns for state in states]) / NS_PER_S)
    assert width_m.tolist() == [transmission.width_m(state.position_rad) for state in states]
    motor_force_n = np.array([transmission.force_n(state.current_a, state.position_rad) for state in states])
    assert np.array_equal(press.motor_force_n, motor_force_n - transmission.friction_n)
    assert recorded.delay_s >= delay_s + 0.5 / config.camera.rate_hz


def test_profile_reduces_the_error_and_has_stiffness_and_plant(profile: Path) -> None:
    found = read_object(profile)
    assert (found.object, found.touches) == ("stapler", 3)
    assert found.after_n is not None
    assert found.after_n < 0.7 * found.before_n
    assert found.stiffness_n_m is not None
    assert found.plant is not None
    assert 0.7 < found.plant.gain < 1.4
    config = load_config(None, QUICK)
    seen_ms = config.sim.camera_latency_ms + 500 / config.camera.rate_hz
    known_ms = seen_ms + config.vision.lockstep_compute_ms
    assert -0.01 < found.plant.delay_ms - known_ms < 60  # the rest is the lag of the network
    assert 30 < found.plant.phase_margin_deg < 90
    assert profile.with_suffix(".png").stat().st_size > 10_000


def test_a_grasp_with_it_is_corrected_and_replays_bit_for_bit(profile: Path, tmp_path: Path) -> None:
    known = grasp(run(tmp_path, f"calibration.object={profile}"))
    known_n = known["estimate_mae_n"]["visual"]
    assert known_n is not None
    log = Path(known["log"])
    assert LogReader(log).metadata["profile"] == read_object(profile).weights
    assert replay(log).identical
    other = replay(log, overrides=["calibration.object=none"])
    assert not other.identical
    assert "profile was" in other.note
    assert known_n < 0.7 * other.sources["visual"].mae_n


def test_plant_tunes_the_loop_unless_keys_are_set(profile: Path) -> None:
    plant = read_object(profile).plant
    assert plant is not None
    for keys, lag_ms in (([], plant.lag_ms), (["control.plant_lag_ms=77"], 77)):
        config = load_config(None, [*QUICK, f"calibration.object={profile}", *keys])
        control = resolve(config).config.control
        assert control.plant == pytest.approx((plant.gain, lag_ms * 1e-3, plant.delay_ms * 1e-3))


def test_target_above_the_calibrated_force_is_refused(profile: Path, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"that the object profile .* was calibrated with"):
        grasp(run(tmp_path, f"calibration.object={profile}", "target_n=8"))
    assert not list(tmp_path.glob("*.mcap"))


def test_different_exposure_is_refused_or_reported(profile: Path) -> None:
    keys = [*QUICK, f"calibration.object={profile}", "camera.exposure_us=3000"]
    with pytest.raises(ConfigError, match="exposure_us 4000, not 3000"):
        resolve(load_config(None, keys))
    notes = resolve(load_config(None, [*keys, "calibration.on_mismatch=warn"])).notes
    assert any("exposure_us 4000, not 3000" in text for _, text in notes)


@pytest.mark.usefixtures("no_figures")
def test_imported_recordings_belong_to_no_rig(touched: list[Path], profile: Path, tmp_path: Path) -> None:
    imported = []
    for log in touched[:2]:
        imported.append(tmp_path / log.name)
        with LogWriter(imported[-1], config="object: stapler", metadata={}) as writer:
            for record in LogReader(log).records(Frame, LoadCellSample):
                writer.write(record)
    other = [*QUICK, "camera.exposure_us=3000"]
    own = tmp_path / "own.yaml"
    calibrate_object(load_config(None, QUICK), "stapler", logs=imported, out=own)
    assert read_object(own).camera == {}
    assert not any("made with" in text for _, text in resolve(load_config(None, [*other, use(own)])).notes)
    of_other_rig = tmp_path / "of_other_rig.yaml"
    of_other_rig.write_text(profile.read_text().replace("exposure_us: 4000", "exposure_us: 3000"))
    shutil.copy(weights_path(profile), weights_path(of_other_rig))
    with pytest.raises(ConfigError, match="exposure_us 3000, not 4000"):
        replay(touched[0], "small", overrides=[use(of_other_rig)])
    replayed = replay(imported[0], "small", overrides=[use(of_other_rig)])
    evaluated = evaluate(imported[:1], "small", config=load_config(None, [*QUICK, use(of_other_rig)]))
    assert replayed.mae_n == pytest.approx(evaluated.mae_n, abs=0.05)
    assert trained_on(load_clips(imported, Preprocess(size=32))) is None


def use(profile: Path) -> str:
    return f"calibration.object={profile}"


def test_profile_with_missing_or_wrong_weights_is_refused(profile: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(profile, tmp_path / "copy.yaml"))
    with pytest.raises(ConfigError, match="belongs to the object profile"):
        grasp(run(tmp_path, f"calibration.object={copy}"))
    weights_path(copy).write_bytes(b"something else")
    with pytest.raises(ConfigError, match="does not belong to"):
        grasp(run(tmp_path, f"calibration.object={copy}"))


def rejected_share(log: Path, profile: Path | None) -> float:
    """Share of a log's frames that show what the network, or the profile, does not know."""
    estimator, rejected, count = ForceEstimator.load("default", profile=profile, threads=1), 0, 0
    for frame in LogReader(log).records(Frame):
        count += 1
        try:
            estimator.update(frame.gray)
        except UnfamiliarFrameError as error:
            rejected += math.isfinite(error.force_n)
    return rejected / count


@pytest.fixture(scope="module")
def unknown(folder: Path) -> list[Path]:
    """Touches of an object of a kind that the network does not know."""
    config = load_config(None, ["object=hourglass", "camera.rate_hz=30", *QUICK[1:2], *QUICK[3:]])
    return list(record_touches(config, 4, 6.0, folder / "unknown"))


@pytest.mark.usefixtures("no_figures")
def test_a_calibrated_unknown_object_is_accepted_and_another_object_is_not(
    touched: list[Path], unknown: list[Path], tmp_path: Path
) -> None:
    path = tmp_path / "hourglass.yaml"
    calibrate_object(load_config(), "hourglass", logs=unknown[:3], out=path)
    assert rejected_share(unknown[3], None) > 0.3
    assert rejected_share(unknown[3], path) < 0.05
    assert rejected_share(touched[0], None) < 0.1
    assert rejected_share(touched[0], path) > 0.4


@pytest.mark.usefixtures("no_figures")
def test_one_touch_widens_the_limits_of_the_network(unknown: list[Path], tmp_path: Path) -> None:
    path = tmp_path / "hourglass.yaml"
    calibrate_object(load_config(), "hourglass", logs=unknown[:1], out=path)
    assert rejected_share(unknown[3], path) < 0.05


def test_command_calibrates_from_logs_and_states_coverage_in_contact_and_by_force(
    touched: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "new" / "it.yaml"
    given = ["calibrate", "object", "stapler", "--from", str(touched[0].parent), "--out", str(out)]
    given += ["--set", "vision.checkpoint=small"]
    fit = job.fit_and_write
    fits: list[ObjectCalibration] = []

    def fit_once(*arguments: Any) -> ObjectCalibration:
        fits[:] = fits or [fit(*arguments)]
        return fits[0]

    monkeypatch.setattr(job, "fit_and_write", fit_once)
    result = CliRunner().invoke(app, [*given, "--json"], catch_exceptions=False)
    found = json.loads(result.stdout)
    assert found["touches"] == 4
    assert found["profile"] == str(out)
    assert [row["touches"] for row in found["touches_needed"]] == [1, 2]
    contact, *levels = found["coverages"]
    assert (contact["from_n"], contact["to_n"], contact["touches"]) == (0.25, None, 4)
    assert [level["from_n"] for level in levels[:2]] == [0.25, 1.0]
    assert all(0 <= level["covered"] <= 1 for level in found["coverages"])
    assert Path(found["report"]).stat().st_size > 10_000
    table = CliRunner().invoke(app, given, catch_exceptions=False)
    assert "in contact of the touches left out (0.25 to 1 N: " in " ".join(table.stdout.split())


@pytest.mark.usefixtures("no_figures")
def test_logs_that_start_in_contact_are_left_out_with_a_warning(touched: list[Path], tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    reader = LogReader(touched[0])
    pressed_ns = next(sample.t_ns for sample in reader.records(LoadCellSample) if sample.force_n > 1)
    with LogWriter(cut, config=reader.config, metadata=reader.metadata) as log:
        for record in reader.records():
            if record.t_ns >= pressed_ns:
                log.write(record)
    given = ["calibrate", "object", "stapler", "--out", str(tmp_path / "it.yaml"), "--json", "--from"]
    given[-1:-1] = ["--set", "vision.checkpoint=small"]
    result = CliRunner().invoke(app, [*given, str(cut), "--from", str(touched[0])])
    assert result.exit_code == 0, result.stderr
    assert "left out 1 logs starting in contact: cut.mcap" in result.stderr
    assert json.loads(result.stdout)["contact_starts"] == [str(cut)]
    assert json.loads(result.stdout)["touches"] == 1
    with pytest.raises(DataError, match="all 1 logs start in contact"):
        calibrate_object(load_config(None, QUICK), "stapler", logs=[cut], out=tmp_path / "it.yaml")


@pytest.mark.usefixtures("no_figures")
def test_range_ends_below_the_crushing_touch(
    touched: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "crushing_touch", lambda _contact_m, _peak_n: 2)
    found = calibrate_object(load_config(None, QUICK), "stapler", logs=touched[:3], out=tmp_path / "it.yaml")
    peaks_n = [
        max(sample.force_n for sample in LogReader(path).records(LoadCellSample)) for path in touched[:3]
    ]
    assert found.profile.force_n == pytest.approx(max(peaks_n[:2]), abs=0.3)
    assert found.crushed_at_n == pytest.approx(peaks_n[2], abs=0.3)
    assert abs(peaks_n[2] - max(peaks_n[:2])) > 0.3


class Terminal:
    """A terminal on which Enter is pressed some times, and then something else happens."""

    def __init__(self, often: int, then: Callable[[], str]) -> None:
        self._left, self._then = often, then

    def isatty(self) -> bool:
        return True

    def readline(self) -> str:
        self._left -= 1
        return "\n" if self._left >= 0 else self._then()


def interrupt() -> str:
    raise KeyboardInterrupt


def terminate() -> str:
    process.raise_interrupt(signal.SIGTERM, None)


class SysWithTerminal:
    """The module `sys` with another standard input."""

    def __init__(self, terminal: Terminal) -> None:
        self.stdin = terminal

    def __getattr__(self, name: str) -> Any:
        return getattr(sys, name)


def by_hand(folder: Path, monkeypatch: pytest.MonkeyPatch, terminal: Terminal) -> Result:
    monkeypatch.setattr(console, "sys", SysWithTerminal(terminal))
    keys = [part for key in QUICK[1:] for part in ("--set", key)]
    given = ["calibrate", "object", "stapler", "--touches", "3", "--peak-n", "6", "--pause", "--json", *keys]
    return CliRunner().invoke(
        app, [*given, "--folder", str(folder / "touches"), "--out", str(folder / "it.yaml")]
    )


@pytest.mark.usefixtures("no_figures")
def test_interrupted_command_calibrates_and_continues_later(
    touched: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "_received", [])
    (tmp_path / "touches").mkdir()
    shutil.copy(touched[0], tmp_path / "touches")
    stopped = by_hand(tmp_path, monkeypatch, Terminal(1, interrupt))
    assert json.loads(stopped.stdout)["touches"] == 2
    assert "stopped after 2 of 3 touches" in stopped.stderr
    assert "Put the object between the jaws for touch 3, then press Enter" in stopped.stderr
    profile = tmp_path / "it.yaml"
    profile.unlink()
    weights_path(profile).unlink()
    ended = by_hand(tmp_path, monkeypatch, Terminal(0, terminate))
    assert (ended.stdout, profile.exists()) == ("", False), "SIGTERM ends the command, not the touches alone"
    process._received.clear()
    finished = by_hand(tmp_path, monkeypatch, Terminal(1, interrupt))
    assert json.loads(finished.stdout)["touches"] == 3
    assert "2 of 3 touches exist already" in finished.stderr
    assert "and are used: number 1, 2; --fresh records all of them again" in finished.stderr


@pytest.mark.usefixtures("no_figures")
def test_fresh_touches_replace_the_earlier_ones(touched: list[Path], tmp_path: Path) -> None:
    folder, other = tmp_path / "touches", tmp_path / "touches" / "stapler-large-01.mcap"
    folder.mkdir()
    earlier = Path(shutil.copy(touched[0], folder))
    other.touch()
    (tmp_path / "touches-old-1").mkdir()
    content = earlier.read_bytes()
    keys = [part for key in QUICK[1:] for part in ("--set", key)]
    given = ["calibrate", "object", "stapler", "--touches", "1", "--peak-n", "4", "--json", "--fresh", *keys]
    result = CliRunner().invoke(
        app, [*given, "--folder", str(folder), "--out", str(tmp_path / "it.yaml")], catch_exceptions=False
    )
    assert result.exit_code == 0, result.stderr
    moved = tmp_path / "touches-old-2"
    assert f"the earlier touches are now in {moved}" in result.stderr
    assert (moved / earlier.name).read_bytes() == content
    assert earlier.read_bytes() != content
    assert other.exists()


RECORDING = ["--fresh", "--touches 8", "--peak-n 5", "--pause"]


@pytest.mark.parametrize(
    ("command", "option"),
    [
        *(("calibrate object", option) for option in (*RECORDING, "--folder x")),
        *(("teach", option) for option in RECORDING),  # it keeps its work in the folder
    ],
)
def test_options_of_recording_and_given_logs_exclude_each_other(
    command: str, option: str, tmp_path: Path
) -> None:
    words = [*command.split(), "stapler", *option.split(), "--from", str(tmp_path)]
    refused = CliRunner().invoke(app, words).exception
    assert isinstance(refused, ConfigError)
    name = option.split()[0]
    assert str(refused) == f"{name} is for recording touches and --from records none; leave out one of them"


def test_unwritable_profile_is_refused_first(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="can't write"):
        calibrate_object(load_config(), "stapler", logs=[], out=tmp_path / "file" / "p.yaml")


def test_no_logs_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no log"):
        calibrate_object(load_config(), "stapler", logs=[], out=tmp_path / "p.yaml")
