import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_force.cli import app
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import Clip
from gripper_force.qualification.bench import estimator_bench as estimator
from gripper_force.qualification.bench.estimator_bench import (
    PLAIN_WINDOW,
    WINDOW,
    EstimatorCost,
    bench,
    draw,
    markdown,
    ratios,
    write_json,
)
from gripper_force.qualification.bench.roofline import Roofline
from gripper_force.types import Gray
from gripper_force.vision.export import export
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import read_model

ROW = EstimatorCost(
    checkpoint="folder/force.safetensors",
    members=2,
    size=64,
    engine="torch",
    precision="float32",
    threads=1,
    p50_ms=4.0,
    p99_ms=5.0,
    frames_s=250.0,
    least_ms=2.0,
    memory_mb=300.0,
    mae_n=0.2,
    rmse_n=0.3,
    worst_n=1.0,
    frames=100,
)
PAPER = replace(ROW, engine=WINDOW, p50_ms=100.0, least_ms=None, memory_mb=None)
PLAIN = replace(PAPER, engine=PLAIN_WINDOW, p50_ms=150.0)
FAST = replace(ROW, engine="openvino", precision="bfloat16", p50_ms=1.0, mae_n=0.203)
ROUGH = replace(ROW, engine="openvino", precision="int8", p50_ms=0.5, mae_n=0.25)


def recordings(seed: int) -> list[Clip]:
    rng = np.random.default_rng(seed)
    return [
        Clip(
            name=f"{i}",
            object="tube",
            set=f"{i}",
            frames=rng.integers(0, 256, (40, 32, 32), np.uint8),
            forces_n=rng.uniform(0, 3, 40).astype(np.float32),
            valid=np.ones(40, bool),
            stiffness=1.0,
        )
        for i in range(2)
    ]


def test_bench_measures_every_variant(
    tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("openvino", reason="pip install 'gripper-force[engines]'")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(
        estimator, "measure", lambda precision, threads: Roofline(precision, threads, 1e9, 1e9)
    )
    monkeypatch.setattr(estimator, "_memory_mb", lambda *_: 300.0)
    monkeypatch.setattr(estimator, "_ROUNDS", 4)
    monkeypatch.setattr(estimator, "_STEPS", 2)
    monkeypatch.setattr(estimator, "_variants", lambda: [("torch", "float32", "float32")])
    reports: list[str] = []

    def scaling(model: Model) -> Sequence[Clip]:
        return recordings(1)

    def export_int8(model: Model, path: Path, frames: Sequence[Gray]) -> None:
        """Exports without quantisation, which takes seconds."""
        assert [clip.tolist() for clip in frames] == [clip.frames.tolist() for clip in recordings(1)]
        export(model, path)

    monkeypatch.setattr(estimator, "export_int8", export_int8)

    def progress(text: str, steps: int = 1) -> None:
        reports.append(text)

    rows = bench([str(tiny_checkpoint)], lambda model: recordings(0), scaling, [1], progress)
    assert [(row.engine, row.precision) for row in rows] == [
        (WINDOW, "float32"),
        (PLAIN_WINDOW, "float32"),
        ("torch", "float32"),
        ("openvino", "int8"),
    ]
    assert all(row.frames == 2 * 37 for row in rows)  # the first three of each are the reference
    assert rows[0].mae_n == rows[1].mae_n == rows[2].mae_n != rows[3].mae_n
    assert all(row.p99_ms >= row.p50_ms > 0 for row in rows)
    assert [row.memory_mb for row in rows[:2]] == [None, None]
    assert [row.memory_mb for row in rows[2:]] == [300.0, 300.0]
    assert all(row.least_ms is not None and row.least_ms > 0 for row in rows[2:])
    assert any(row.front for row in rows)
    assert reports


def test_the_memory_is_that_of_a_process_that_only_computes_estimates() -> None:
    model = read_model("small")
    assert 30 < estimator._memory_mb(model, "onnxruntime", "float32", 1) < 1000
    with pytest.raises(
        ConfigError, match=r"(?s)onnxruntime fails in a separate process: .*computes in float32"
    ):
        estimator._memory_mb(model, "onnxruntime", "bfloat16", 1)


def test_ratios_compare_the_fastest_accurate_variant_with_the_window() -> None:
    ratio = ratios([PAPER, PLAIN, ROW, FAST, ROUGH])[ROW.checkpoint]
    assert ratio["times_faster_than_window"] == 100
    assert ratio["times_faster_than_plain_window"] == 150
    assert ratio["fastest"] == "openvino, bfloat16, 1 threads"
    assert ratio["mae_over_float32"] == pytest.approx(1.015)


def test_page_file_and_plot_hold_every_row(tmp_path: Path) -> None:
    rows = estimator._with_front([PAPER, ROW, FAST, ROUGH])
    assert [row.front for row in rows] == [False, True, True, True]
    lines = markdown(rows).splitlines()
    assert len(lines) == 2 + 4
    assert lines[-1].startswith("| force | 2, 64 | openvino | int8 | 1 | 0.50, 5.00 |")
    write_json(tmp_path / "new" / "estimator.json", rows)
    kept = json.loads((tmp_path / "new" / "estimator.json").read_text(encoding="utf-8"))
    assert [row["p50_ms"] for row in kept["estimator"]] == [100.0, 4.0, 1.0, 0.5]
    draw(tmp_path / "plot.png", rows)
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_logs_that_start_in_contact_are_left_out(
    few_logs: Path, loaded_log: Path, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def bench(sources: Sequence[str], *loaders: Callable[[Model], Sequence[Clip]] | object) -> None:
        used = [len(load(read_model(sources[0]))) for load in loaders[:2] if callable(load)]
        raise DataError(f"{used} of {len(list(few_logs.iterdir()))} logs")

    monkeypatch.setattr(estimator, "bench", bench)
    call = ["bench", "estimator", "--data", str(few_logs), "--scale-on", str(few_logs), "--jobs", "1"]
    result = CliRunner().invoke(app, [*call, "--checkpoint", str(tiny_checkpoint)])
    assert str(result.exception) == "[3, 3] of 4 logs"
