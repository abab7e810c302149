import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import config_from_text, load_config
from gripper_force.jobs import grasp as grasp_module
from gripper_force.jobs.grasp import GraspSummary, exclusive_device, summarise_grasp
from gripper_force.jobs.report.reading import read_run
from gripper_force.jobs.trials import summarise_trials
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import NS_PER_S, FusedForce, GraspStatus, LoadCellSample, VisualForce


def test_a_summary_is_what_the_log_says(fused_log: Path) -> None:
    summary = summarise_grasp(fused_log)
    log = LogReader(fused_log)
    assert summary["log"] == str(fused_log)
    assert (summary["object"], summary["target_n"], summary["seed"]) == ("stapler", 3.0, 0)
    assert summary["result"] in {"held", "timeout"}
    assert summary["reason"] == next(s.reason for s in log.records(GraspStatus) if s.outcome)
    assert summary["loop_hz"] == pytest.approx(200.0)
    assert summary["peak_n"] == max(s.force_n for s in log.records(LoadCellSample))
    assert summary["load_cell_mean_n"] is not None
    assert summary["steady_error_n"] == summary["load_cell_mean_n"] - 3.0
    times = [v.compute_ms for v in log.records(VisualForce)]
    assert summary["estimator_p50_ms"] == pytest.approx(np.percentile(times, 50))
    assert summary["estimator_p99_ms"] == pytest.approx(np.percentile(times, 99))
    camera = config_from_text(log.config, "it").camera
    assert summary["camera_hz"] == pytest.approx(camera.rate_hz, rel=0.02)
    assert summary["samples_rejected"] == 0


def test_a_summary_says_what_was_taken_for_auto(quick: list[str], tmp_path: Path) -> None:
    overrides = [
        "sim.detail=auto",
        "budget.sim_error_n=0.05",
        f"log.directory={tmp_path}",
        "log.report=false",
    ]
    (taken,) = grasp_module.grasp(load_config(None, [*quick, *overrides]))["taken"]
    assert taken.startswith("chose sim.detail=medium")


def test_what_was_not_measured_is_none(fused_log: Path, tmp_path: Path) -> None:
    reader = LogReader(fused_log)
    path = tmp_path / "run.mcap"
    with LogWriter(path, config=reader.config, metadata={}) as writer:
        for record in reader.records():
            if not isinstance(record, LoadCellSample | VisualForce):
                writer.write(record)
    summary = summarise_grasp(path)
    for name in (
        "load_cell_mean_n",
        "steady_error_n",
        "overshoot_n",
        "settle_s",
        "peak_n",
        "estimator_p50_ms",
        "camera_hz",
        "samples_rejected",
    ):
        assert summary[name] is None
    assert summary["loop_hz"] == pytest.approx(200.0)


@pytest.mark.parametrize(("outcome", "gain"), [("held", 3.0), ("timeout", None)])
def test_a_grasp_that_was_not_held_states_no_gain_of_the_object(
    fused_log: Path, tmp_path: Path, outcome: str, gain: float | None
) -> None:
    reader = LogReader(fused_log)
    path = tmp_path / "run.mcap"
    with LogWriter(path, config=reader.config, metadata=reader.metadata) as writer:
        for record in reader.records():
            if isinstance(record, FusedForce):
                record = replace(record, object_gain=3.0, object_gain_std=0.2)
            elif isinstance(record, GraspStatus) and record.outcome:
                record = replace(record, outcome=outcome)
            writer.write(record)
    assert summarise_grasp(path)["object_gain"] == gain
    assert read_run(LogReader(path)).object_gain == (gain and (gain, 0.2))


def test_the_error_floor_is_that_of_valid_samples(fused_log: Path, tmp_path: Path) -> None:
    reader = LogReader(fused_log)
    path = tmp_path / "spoilt.mcap"
    with LogWriter(path, config=reader.config, metadata=reader.metadata) as writer:
        for number, record in enumerate(reader.records()):
            if isinstance(record, LoadCellSample) and number % 3 == 0:
                writer.write(replace(record, force_n=math.nan, valid=False))
            else:
                writer.write(record)
    floor_n = summarise_grasp(fused_log)["estimate_mae_n"]["floor"]
    assert floor_n is not None
    assert summarise_grasp(path)["estimate_mae_n"]["floor"] == pytest.approx(floor_n, rel=0.1)


def test_a_run_that_ended_before_anything_was_interrupted(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path, config="object: tube", metadata={}):
        pass
    summary = summarise_grasp(path)
    assert (summary["result"], summary["object"], summary["loop_hz"]) == ("interrupted", "tube", None)


def grasped(overrides: list[str], folder: Path) -> GraspSummary:
    options = ["log.report=false", f"log.directory={folder}"]
    return grasp_module.grasp(load_config(None, [*overrides, *options]))


SLOW_CAMERA = "camera.rate_hz=20"
NOT_FINITE = "faults=[{unit: estimator, kind: garbage, at_s: 0}]"


def test_a_camera_that_stops_during_the_hold_costs_vision_the_rest_of_it(
    quick_vision: list[str], fused_log: Path, tmp_path: Path
) -> None:
    hold_ns = [s.t_ns for s in LogReader(fused_log).records(GraspStatus) if s.phase == "hold"]
    stop_s = (hold_ns[0] + 0.3 * NS_PER_S) / NS_PER_S
    fault = f"faults=[{{unit: camera, kind: off, at_s: {stop_s}}}]"
    summary = grasped([*quick_vision, fault], tmp_path)
    log = LogReader(Path(summary["log"]))
    hold_ns = [s.t_ns for s in log.records(GraspStatus) if s.phase == "hold"]
    held_s = (hold_ns[-1] - hold_ns[0]) / NS_PER_S + 0.005
    lost_s = sum(loss.time_s for loss in summary["vision_losses"])
    assert "no new estimate" in [loss.reason for loss in summary["vision_losses"]]
    share, without_fault = summary["vision_share"] or 0, summarise_grasp(fused_log)["vision_share"] or 0
    assert share == pytest.approx(1 - lost_s / held_s)
    assert 0 < share < without_fault
    assert summary["fell_back"] == (share < 0.5)


@pytest.mark.parametrize("feedback", ["vision", "fused"])
def test_a_hold_without_vision_fell_back(quick_vision: list[str], tmp_path: Path, feedback: str) -> None:
    summary = grasped([*quick_vision, SLOW_CAMERA, NOT_FINITE, f"control.feedback={feedback}"], tmp_path)
    assert (summary["feedback"], summary["vision_share"], summary["fell_back"]) == (feedback, 0.0, True)
    assert [loss.reason for loss in summary["vision_losses"]] == ["it is not finite"]
    assert summary["steady_error_n"] is not None
    error = summarise_trials([summary], force_limit_n=12.0)["median_error_percent"]
    assert (error is None) == (feedback == "vision")


def test_motor_current_alone_has_no_share_of_vision(
    quick: list[str], quick_vision: list[str], tmp_path: Path
) -> None:
    for overrides in (quick, [*quick_vision, SLOW_CAMERA, "control.feedback=current"]):
        summary = grasped(overrides, tmp_path)
        assert (summary["vision_share"], summary["vision_losses"], summary["fell_back"]) == (None, [], False)


def test_feedback_from_vision_without_a_camera_fell_back(quick: list[str], tmp_path: Path) -> None:
    summary = grasped([*quick, "control.feedback=vision"], tmp_path)
    assert (summary["vision_share"], summary["fell_back"]) == (0.0, True)
    [loss] = summary["vision_losses"]
    assert loss.reason == "the configuration has no network or no camera"
    assert loss.time_s > 0


REAL = ["clock=realtime", "servo.port=/dev/ttyUSB7", "camera.backend=none", "load_cell.backend=none"]


@pytest.mark.parametrize(
    ("overrides", "device"),
    [
        ([], ""),
        (["camera.backend=none", "load_cell.backend=playback"], ""),
        (["camera.backend=oak"], "camera.backend=oak"),
        (["load_cell.backend=serial"], "load_cell.backend=serial"),
        (["servo.backend=package.module:Servo"], "servo.backend=package.module:Servo"),
        (REAL, "servo.port=/dev/ttyUSB7"),
    ],
)
def test_a_device_that_only_one_process_can_open_is_named(overrides: list[str], device: str) -> None:
    assert exclusive_device(load_config(None, overrides)) == device


def test_a_log_is_never_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "strftime", lambda _: "20260101-120000")
    config = load_config(None, [f"log.directory={tmp_path}", "object=tube", "target_n=2.5", "seed=7"])
    paths = []
    for _ in range(3):
        paths.append(grasp_module.new_log(config))
        paths[-1].touch()
    assert paths[0].name == "20260101-120000-tube-2.5N-fused-seed7.mcap"
    assert [path.stem.removeprefix(paths[0].stem) for path in paths] == ["", "-2", "-3"]
