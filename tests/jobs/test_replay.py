import dataclasses
import gc
import json
import tracemalloc
from base64 import urlsafe_b64encode
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.config import load_config
from gripper_force.errors import CheckpointError, ConfigError, DataError, LogError
from gripper_force.jobs import metrics, report
from gripper_force.jobs import replay as job
from gripper_force.jobs.evaluate import evaluate
from gripper_force.jobs.grasp import run_grasp
from gripper_force.jobs.metrics import bias, mae, rmse
from gripper_force.jobs.profile_files import update_rig
from gripper_force.jobs.replay import replay, replay_each, replay_frames
from gripper_force.jobs.replay.comparison import (
    Columns,
    Comparison,
    ReplayResult,
    paired_differences,
    summarise_replays,
)
from gripper_force.jobs.replay.feed import changed_config, resolve_replay, run_again
from gripper_force.jobs.report import ReportPaths
from gripper_force.jobs.report.figure import draw
from gripper_force.profiles.rig_profile import ServoCalibration
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    EstimateSource,
    Frame,
    FusedForce,
    GraspStatus,
    Gray,
    LoadCellSample,
    Record,
    Request,
    ServoCommand,
    VisualForce,
)
from gripper_force.vision import batch_inference
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.checkpoint_writer import replace_header, save_checkpoint
from gripper_force.vision.header import VIEW_LENGTH, KnownViews
from gripper_force.vision.model_files import read_model


def tampered(log: Path, path: Path, change: Callable[[Record], Record | None]) -> Path:
    """A copy of a log in which records were changed, or left out."""
    reader = LogReader(log)
    with LogWriter(path, config=reader.config, metadata=reader.metadata) as writer:
        for record in reader.records():
            if (changed := change(record)) is not None:
                writer.write(changed)
    return path


@pytest.fixture(scope="session")
def short_log(fused_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The begin of the grasp."""
    path = tmp_path_factory.mktemp("short") / "short.mcap"
    return tampered(fused_log, path, lambda r: r if r.t_ns < 1.2 * NS_PER_S else None)


def test_a_lockstep_run_comes_out_the_same(fused_log: Path) -> None:
    result = replay(fused_log)
    assert result.identical is True
    assert result.note == ""
    assert set(result.sources) == {"visual", "current", "fused"}
    assert result.mae_n == result.sources["fused"].mae_n


def test_its_figures_agree_with_the_logs_load_cell(fused_log: Path) -> None:
    result = replay(fused_log)
    log = LogReader(fused_log)
    cell = list(log.records(LoadCellSample))
    fused = list(log.records(FusedForce))
    measured = np.interp([f.t_ns for f in fused], [c.t_ns for c in cell], [c.force_n for c in cell])
    said = [f.force_n for f in fused]
    assert result.frames == pytest.approx(len(fused), abs=5)
    assert result.mae_n == pytest.approx(mae(said, measured), abs=0.02)
    assert result.rmse_n == pytest.approx(rmse(said, measured), abs=0.02)
    assert result.bias_n == pytest.approx(bias(said, measured), abs=0.02)
    assert sum(b.frames for b in result.per_bin) == result.frames
    assert result.per_object["stapler"]["mae_n"] == result.mae_n


NUDGED = [(ServoCommand, "goal_current_a"), (FusedForce, "bias_n"), (GraspStatus, "width_m")]
NUDGED += [(VisualForce, "force_n"), (VisualForce, "std_n")]


@pytest.mark.parametrize(("kind", "field"), NUDGED)
def test_the_slightest_change_is_found(short_log: Path, tmp_path: Path, kind: type, field: str) -> None:
    count = 0

    def nudge(record: Record) -> Record:
        nonlocal count
        count += isinstance(record, kind)
        if not isinstance(record, kind) or count != 40:
            return record
        return dataclasses.replace(record, **{field: np.nextafter(getattr(record, field), 99).item()})

    assert replay(short_log).identical is True
    path = tampered(short_log, tmp_path / "run.mcap", nudge)
    assert replay(path).identical is False
    assert count >= 40


def test_a_missing_request_is_found(short_log: Path, tmp_path: Path) -> None:
    path = tampered(short_log, tmp_path / "run.mcap", lambda r: None if isinstance(r, Request) else r)
    assert replay(path).identical is False


def test_another_checkpoint_estimates_otherwise(
    short_log: Path, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    tiny = load_checkpoint(tiny_checkpoint)
    with torch.no_grad():
        for network in tiny.force_networks:
            network.out.bias.add_(0.05)
    other = tmp_path / "other.safetensors"
    save_checkpoint(other, tiny.networks, tiny.header)
    first, second = replay(short_log), replay(short_log, str(other))
    assert second.identical is False
    assert load_checkpoint(other).digest[:12] in second.note
    moved = second.sources["visual"].bias_n - first.sources["visual"].bias_n
    assert moved == pytest.approx(1.0, abs=0.05)


def test_without_a_network_motor_current_is_alone(fused_log: Path) -> None:
    result, seeing = replay(fused_log, "none"), replay(fused_log)
    assert set(result.sources) == {"current", "fused"}
    assert result.sources["fused"] == result.sources["current"] == seeing.sources["current"]
    assert result.sources["fused"] != seeing.sources["fused"]
    assert (result.identical, result.note) == (False, "the run had a network, this has none")


def test_a_run_without_a_network_is_replayed_with_one(quick: list[str], tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run_grasp(load_config(None, [*quick, "camera.backend=simulated", "camera.rate_hz=20"]), path)
    found = replay(path, "small", overrides=["control.feedback=fused"])
    assert found.sources["visual"].frames > 40
    assert found.sources["fused"].mae_n != found.sources["current"].mae_n
    assert (found.identical, found.note) == (False, "the run had no network, this has one")


def test_an_estimate_that_the_replay_lacks_is_not_taken_from_the_log(short_log: Path, tmp_path: Path) -> None:
    def darken(
        record: Record,
    ) -> Record:  # `small` refuses these frames; the log has estimates of its own network
        if isinstance(record, Frame) and record.seq >= 40:
            return dataclasses.replace(record, gray=record.gray // 4)
        return record

    reader = LogReader(tampered(short_log, tmp_path / "dark.mcap", darken))
    again = run_again(reader, resolve_replay(changed_config(reader, "small")))
    assert max(v.seq for v in again.visual) < 40
    last_ns = again.visual[-1].t_ns + 300_000_000
    sources = {d.estimate.source for d in again.decisions if d.estimate.t_ns > last_ns}
    assert sources == {EstimateSource.CURRENT}


def test_an_override_changes_decisions(fused_log: Path) -> None:
    changed = replay(fused_log, overrides=["control.ramp_n_s=4"])
    assert changed.identical is False
    assert changed.changed["goal_current_a"] > 0.01
    same = replay(fused_log, overrides=["log.report=false"])
    assert same.identical is True
    assert same.changed == {"goal_current_a": 0, "fused_n": 0}


def test_log_without_a_load_cell_has_no_errors(
    short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report, "draw", lambda *shown: draw(*shown) and Figure())  # to write it takes seconds
    bare = tampered(short_log, tmp_path / "run.mcap", lambda r: None if isinstance(r, LoadCellSample) else r)
    result = replay(bare)
    assert (result.identical, result.mae_n, result.frames, result.sources) == (True, None, 0, {})
    done = CliRunner().invoke(cli.app, ["replay", str(bare), "--report"], catch_exceptions=False)
    assert (done.exit_code, bare.with_suffix(".html").exists()) == (0, True), done.stderr
    assert "No load cell: force errors can't be measured." in done.stdout
    results, _, failed = replay_each([short_log, bare], workers=1)
    assert not failed
    other = bare.with_name("other.mcap")
    other.write_bytes(bare.read_bytes())
    call = ["replay", str(bare), str(other), "--out", str(tmp_path / "summary"), "--jobs", "1"]
    done = CliRunner().invoke(cli.app, call, catch_exceptions=False)
    assert done.exit_code == 0, done.stderr
    assert "No load cell: force errors can't be measured." in done.stdout
    rows = json.loads((tmp_path / "summary" / "summary.json").read_text())["logs"]
    assert [row["mae_n"] for row in rows] == [None, None]
    done = CliRunner().invoke(
        cli.app, ["replay", str(bare), "--compare", "log", "control.ramp_n_s=4", "--jobs", "1"]
    )
    assert isinstance(done.exception, DataError)
    assert "no load cell to compare with" in str(done.exception)
    assert summarise_replays(results).sources["fused"].frames == results[0].sources["fused"].frames


def test_an_imported_recording_whose_frames_are_all_unknown_is_not_said_to_lack_a_load_cell(
    few_logs: Path, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    strict = tmp_path / "strict.safetensors"
    views = KnownViews(
        mean=urlsafe_b64encode(np.zeros(VIEW_LENGTH, np.float32).tobytes()),
        axes=urlsafe_b64encode(np.eye(VIEW_LENGTH, 1, dtype=np.float16).tobytes()),
        limit=1e-6,
    )
    header = read_model(tiny_checkpoint).header.model_copy(update={"views": views})
    replace_header(tiny_checkpoint, header, strict)
    logs = [str(log) for log in sorted(few_logs.iterdir())[:2]]
    result = replay(logs[0], strict)
    assert (result.identical, result.note) == (None, ""), "it was not written by another version"
    assert result.refused == result.seen > 0
    for given in (logs[:1], logs):
        call = ["replay", *given, "--checkpoint", str(strict), "--jobs", "1"]
        printed = CliRunner().invoke(cli.app, call, catch_exceptions=False).stdout
        assert "does not know" in printed
        assert "No load cell" not in printed
        assert "version" not in printed
    for sides in ([str(strict), str(tiny_checkpoint)], [str(tiny_checkpoint), str(strict)]):
        done = CliRunner().invoke(cli.app, ["replay", *logs, "--compare", *sides, "--jobs", "1"])
        assert isinstance(done.exception, DataError)
        assert f"the network of '{strict}' knows none of the" in str(done.exception)


def test_log_is_replayed_without_the_file_of_its_rig_profile(
    quick: list[str], servo_calibration: ServoCalibration, tmp_path: Path
) -> None:
    rig = tmp_path / "rig.yaml"
    update_rig(rig, servo_calibration)
    log = tmp_path / "run.mcap"
    run_grasp(load_config(None, [*quick, f"calibration.rig={rig}"]), log)
    rig.unlink()
    assert replay(log).identical is True


def test_what_can_not_be_read_is_named(fused_log: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no checkpoint at gone\.safetensors"):
        replay(fused_log, "gone.safetensors")
    with pytest.raises(LogError, match="No such file"):
        replay(tmp_path / "gone.mcap")
    with pytest.raises(ConfigError, match="the log must be a path, not 3"):
        replay(3)  # type: ignore[arg-type]


def test_auto_is_settled_as_a_run_would(short_log: Path, quick: list[str], tmp_path: Path) -> None:
    taken = replay(short_log, "auto")
    assert "estimates differ" in taken.note
    blind = tmp_path / "blind.mcap"
    run_grasp(load_config(None, [*quick, "vision.checkpoint=auto"]), blind)
    assert replay(blind).identical is True


@pytest.mark.parametrize("kind", ["off", "wrong"])
def test_decisions_on_an_estimator_that_was_made_to_fail_are_still_compared(
    quick_vision: list[str], tmp_path: Path, kind: str
) -> None:
    path = tmp_path / "spoilt.mcap"
    fault = f"faults=[{{unit: estimator, kind: {kind}, at_s: 0.6}}]"
    run_grasp(load_config(None, [*quick_vision, "camera.rate_hz=20", fault]), path)
    result = replay(path)
    assert result.identical is True
    assert "faults were injected" in result.note


@pytest.mark.usefixtures("pool_here")
def test_several_logs_give_the_errors_over_all(fused_log: Path, short_log: Path) -> None:
    results, _, failed = replay_each([fused_log, short_log], workers=2)
    assert not failed
    assert [result.log for result in results] == [str(fused_log), str(short_log)]
    assert results[0] == replay(fused_log)
    found = summarise_replays(results)
    assert (found.logs, found.identical) == (2, 2)
    parts = [result.sources["fused"] for result in results]
    assert found.sources["fused"].frames == sum(part.frames for part in parts)
    expected_n = sum(part.mae_n * part.frames for part in parts) / sum(part.frames for part in parts)
    assert found.sources["fused"].mae_n == pytest.approx(expected_n)
    assert found.per_object["stapler"] == found.sources


def result_with(mae_n: float) -> ReplayResult:
    errors = Comparison(mae_n, mae_n, 0.0, mae_n, 0.0, 100, [])
    return ReplayResult(mae_n, mae_n, 0.0, [], 100, 0, 0, {}, None, "", {}, {"fused": errors}, "a.mcap")


def test_differences_are_those_of_each_log() -> None:
    first, second = [result_with(n) for n in (0.1, 0.5, 1.0)], [result_with(n) for n in (0.2, 0.6, 1.1)]
    (name, found), *more = paired_differences(first, second).items()
    assert (name, more, found.logs) == ("fused", [], 3)
    assert found.difference_n == pytest.approx(0.1)
    assert found.low_n == pytest.approx(0.1), "every log differs by the same"
    assert found.high_n == pytest.approx(0.1)
    alone = paired_differences(first[:1], second[:1])["fused"]
    assert (alone.low_n, alone.high_n) == (None, None)


def columns_with(visual_n: list[float], std_n: list[float]) -> Columns:
    """Frames with 1 N each."""
    return {
        "seq": np.arange(len(visual_n)),
        "measured_n": np.ones(len(visual_n)),
        "visual_n": np.array(visual_n),
        "visual_std_n": np.array(std_n),
    }


def test_a_network_that_rejects_the_hard_frames_does_not_look_better() -> None:
    both = [result_with(1.0)], [result_with(1.0)]
    all_known, strict = columns_with([1.1, 3.0], [0.1, 0.1]), columns_with([1.1, 3.0], [0.1, np.inf])
    found = paired_differences(*both, ([all_known], [strict]))["visual"]
    assert found.difference_n == 0.0
    assert found.first_n == pytest.approx(0.1)
    none_known = columns_with([1.1, 3.0], [np.inf, np.inf])
    assert "visual" not in paired_differences(*both, ([all_known], [none_known]))


def test_the_interval_of_a_difference_is_students() -> None:
    first, second = [result_with(1.0)] * 2, [result_with(n) for n in (1.0, 1.2)]
    found = paired_differences(first, second)["fused"]
    assert found.difference_n == pytest.approx(0.1)
    assert found.high_n == pytest.approx(0.1 + 12.706 * 0.1, rel=1e-3)


def test_a_profile_of_another_network_is_refused_with_a_remedy_that_replays_the_log(short_log: Path) -> None:
    with pytest.raises(ConfigError, match=r"leave the profile out with calibration\.object=none"):
        replay(short_log, overrides=["calibration.object=sponge"])
    assert replay(short_log, overrides=["calibration.object=none"]).identical is True


def test_a_broken_log_is_named_and_the_others_are_replayed(short_log: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(short_log.read_bytes()[:5000])
    call = ["replay", str(broken), str(short_log), "--jobs", "1", "--json"]
    done = CliRunner().invoke(cli.app, call)
    assert done.exit_code == 2
    assert f"error: {broken}" in done.stderr
    printed = json.loads(done.stdout)
    assert [log["log"] for log in printed["logs"]] == [str(short_log)]
    assert list(printed["failed"]) == [str(broken)]
    with pytest.raises(LogError, match=r"broken\.mcap"):
        replay_each([broken, broken])


@pytest.mark.parametrize("stage", ["replay", "report"])
def test_an_unforeseen_exception_at_one_log_does_not_stop_the_others(
    short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(short_log.read_bytes())

    def replay_unless_bad(log: Path, **options: Any) -> object:
        if log == bad and stage == "replay":
            raise KeyError("gone")
        return replay_frames(log, **options)

    def report_unless_bad(log: Path, **_: object) -> ReportPaths:
        return {short_log: ReportPaths(log, log)}[log]

    monkeypatch.setattr(job, "replay_frames", replay_unless_bad)
    monkeypatch.setattr(report, "write_report", report_unless_bad)
    done = CliRunner().invoke(
        cli.app, ["replay", str(bad), str(short_log), "--jobs", "1", "--json", "--report"]
    )
    assert done.exit_code == 2
    assert f"error: {bad} failed with KeyError at test_replay.py:" in done.stderr
    printed = json.loads(done.stdout)
    assert printed["reports"] == [str(short_log)]
    assert len(printed["logs"]) == (1 if stage == "replay" else 2)
    assert list(printed.get("failed", [])) == ([str(bad)] if stage == "replay" else [])
    assert list(printed.get("unreported", [])) == ([str(bad)] if stage == "report" else [])


def test_frames_that_a_network_does_not_know_are_counted(short_log: Path, tmp_path: Path) -> None:
    small = load_checkpoint("small")
    assert small.header.ood is not None
    limits = [one.model_copy(update={"limit": 0.45 * one.limit}) for one in small.header.ood.limits]
    ood = small.header.ood.model_copy(update={"limits": tuple(limits)})
    strict = tmp_path / "strict.safetensors"
    save_checkpoint(strict, small.networks, small.header.model_copy(update={"ood": ood}))

    def spoil(record: Record) -> Record:
        if isinstance(record, Frame) and record.seq == 40:  # rejected before the network sees it
            return dataclasses.replace(record, gray=record.gray // 4)
        if isinstance(record, Frame) and record.seq in (30, 45):
            return dataclasses.replace(record, gray=half_covered(record.gray))
        return record

    covered = tampered(short_log, tmp_path / "covered.mcap", spoil)
    reader = LogReader(covered)
    run = resolve_replay(changed_config(reader, str(strict)))
    visual = run_again(reader, run).visual
    assert {v.is_familiar for v in visual} == {True, False}
    assert 40 not in {v.seq for v in visual}
    assert [v.seq for v in visual if np.isnan(v.force_n)] == [30, 45]
    found = replay(covered, strict)
    assert (found.seen, found.refused) == (len(visual), sum(not v.is_familiar for v in visual))
    assert found.sources["visual"].frames <= found.seen - found.refused
    done = CliRunner().invoke(cli.app, ["replay", str(covered), "--checkpoint", str(strict)])
    assert f"does not know {found.refused} of {found.seen} frames" in " ".join(done.stdout.split())


def test_the_replay_of_a_log_with_covered_frames_is_identical(short_log: Path, tmp_path: Path) -> None:
    def cover(record: Record) -> Record:
        if isinstance(record, Frame) and record.seq == 45:
            return dataclasses.replace(record, gray=half_covered(record.gray))
        return record

    covered = tampered(short_log, tmp_path / "covered.mcap", cover)
    # The images of the log's own network are too small for this check.
    run = resolve_replay(changed_config(LogReader(covered), "small"))
    again = {v.seq: v for v in run_again(LogReader(covered), run).visual}
    assert np.isnan(again[45].force_n)
    logged = tampered(
        covered,
        tmp_path / "logged.mcap",
        lambda r: again.get(r.seq) if isinstance(r, VisualForce) else r,
    )
    assert run_again(LogReader(logged), run).estimates_identical is True


def test_the_share_that_may_be_covered_is_the_configurations(fused_log: Path) -> None:
    """With 0, any block that a closing jaw hides covers the view."""
    reader = LogReader(fused_log)
    covered = []
    for share in (0.5, 0.0):
        run = resolve_replay(changed_config(reader, "small", [f"vision.max_covered={share}"]))
        covered.append([v.seq for v in run_again(reader, run).visual if np.isnan(v.force_n)])
    assert covered[0] == []
    assert covered[1]


def half_covered(gray: Gray) -> Gray:
    covered = gray.copy()
    covered[:, : gray.shape[1] // 2] = round(float(gray.mean()))
    return covered


def test_the_columns_hold_each_estimate(fused_log: Path) -> None:
    result, columns = replay_frames(fused_log)
    assert len({len(values) for values in columns.values()}) == 1
    error_n = columns["visual_n"] - columns["measured_n"]
    assert np.nanmean(np.abs(error_n)) == pytest.approx(result.sources["visual"].mae_n, rel=1e-6)


def long_log(log: Path, path: Path, times: int) -> Path:
    """A log whose records are those of another one, again and again."""
    reader = LogReader(log)
    records = list(reader.records())
    frames = 1 + max(record.seq for record in records if isinstance(record, Frame))
    with LogWriter(path, config=reader.config, metadata=reader.metadata) as writer:
        for turn in range(times):
            for record in records:
                changes = {
                    name: getattr(record, name)
                    for name in ("t_ns", "ready_ns", "received_ns")
                    if hasattr(record, name)
                }
                later = {
                    name: t_ns + turn * (reader.duration_ns + NS_PER_MS) for name, t_ns in changes.items()
                }
                number = {"seq": record.seq + turn * frames} if hasattr(record, "seq") else {}
                writer.write(dataclasses.replace(cast(Any, record), **later, **number))
    return path


@pytest.mark.parametrize("command", ["replay", "replay in batches", "evaluate"])
def test_memory_does_not_grow_with_the_records_of_a_log(
    short_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setattr(metrics, "lag_s", lambda *_: 0.0)  # its transform takes 0.1 MB for each second of log
    monkeypatch.setattr(batch_inference, "CHUNK", 64)  # fewer frames than the shorter log has

    def run(log: Path) -> None:
        if command == "evaluate":
            evaluate([log], "small")
        else:
            replay_frames(log, "small" if command == "replay in batches" else None)

    run(short_log)  # imports, and loads the network
    peaks = []
    for times in (1, 3):
        log = long_log(short_log, tmp_path / f"{times}.mcap", times)
        gc.collect()
        tracemalloc.start()
        run(log)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    longer_s = 2 * LogReader(short_log).duration_ns / NS_PER_S
    assert (peaks[1] - peaks[0]) / longer_s < 50_000, "bytes for each second of log"


def test_another_engine_is_the_reason_for_other_digits(short_log: Path) -> None:
    result = replay(short_log, overrides=["vision.engine=torch"])
    assert result.note == "the run's engine was onnxruntime, this one is torch: last digits differ"
