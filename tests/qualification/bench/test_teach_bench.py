"""The bench of teaching: cells that are kept, what is measured, and its tables."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gripper_force.cli import app
from gripper_force.config import load_config
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.training import few
from gripper_force.qualification.bench import teach_bench as job
from gripper_force.qualification.bench.teach_bench import Cell, bench, foreign_rigs, list_cells, markdown

pytestmark = pytest.mark.usefixtures("one_thread")


def test_drawn_rigs_differ_and_belong_to_no_training() -> None:
    rigs = foreign_rigs(load_config(), 6)
    seeds = {rig.config.sim.rig_seed for rig in rigs}
    assert len(seeds) == len({rig.name for rig in rigs}) == 6
    assert min(seed for seed in seeds if seed is not None) >= job.FIRST_SEED
    assert len({(rig.config.sim.view_spread, rig.config.sim.jaw_spread) for rig in rigs}) == 6


def test_a_finished_cell_is_not_measured_again(
    quick: list[str], tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "TESTS", 1)
    keys = [*quick, "camera.backend=simulated", f"vision.checkpoint={tiny_checkpoint}"]
    rigs = foreign_rigs(load_config(None, keys), 1)

    def cells() -> list[Cell]:
        return list(bench(list_cells(rigs, ["stapler"], [4], ["shipped"]), grasps=0, folder=tmp_path))

    first = cells()
    assert first[0].mae_n is not None
    assert first[0].mae_n > 0
    assert (first[0].touches, first[0].fused_percent, first[0].problem) == (0, None, "")
    log = next(tmp_path.rglob("*.mcap"))
    log.unlink()
    assert cells() == first
    assert not log.exists()
    (kept,) = (tmp_path / "cells.jsonl").read_text().splitlines()
    assert Cell(**json.loads(kept)) == first[0]


def test_a_cell_of_other_settings_or_of_an_earlier_version_is_measured_again(
    tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "_measured", lambda cell, *_: replace(cell, mae_n=0.1))
    file = tmp_path / "cells.jsonl"

    def cell(grasps: int, *keys: str) -> Cell:
        rigs = foreign_rigs(load_config(None, [f"vision.checkpoint={tiny_checkpoint}", *keys]), 1)
        (found,) = bench(list_cells(rigs, ["peg"], [16], ["taught"]), grasps=grasps, folder=tmp_path)
        return found

    first = cell(4)
    old = asdict(replace(first, mae_n=0.9))
    del old["grasps"], old["settings"]
    file.write_text(json.dumps(old) + "\n" + json.dumps(asdict(first)) + "\n" + json.dumps(old)[:40])
    assert cell(4) == first  # whose file an interruption has cut
    assert cell(6).grasps == 6
    assert cell(4, "control.force_limit_n=5").settings != first.settings
    assert len(file.read_text().splitlines()) == 4
    assert cell(4) == first
    monkeypatch.setattr(job, "__version__", "0.1.0")
    assert cell(4).settings != first.settings
    assert len(file.read_text().splitlines()) == 5


def test_the_time_of_teaching_is_that_of_the_whole_work(
    tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[list[Path]] = []

    def teach(*_: object, folder: Path, **__: object) -> None:
        found.append(list(folder.rglob("*")))
        (folder / "teach").mkdir(parents=True)
        (folder / "teach" / "candidate").touch()
        raise DataError("too few touches")

    monkeypatch.setattr(job, "record_touches", lambda *_, **__: ())
    monkeypatch.setattr(job, "teach", teach)
    rigs = foreign_rigs(load_config(None, [f"vision.checkpoint={tiny_checkpoint}"]), 1)
    for grasps in (0, 6):  # measured again with more grasps
        list(bench(list_cells(rigs, ["peg"], [16], ["taught"]), grasps=grasps, folder=tmp_path))
    assert found == [[], []]


def test_table_has_medians_and_the_worst_of_what_was_measured() -> None:
    base = Cell("a", "lemon", 4, "taught", "d", mae_n=0.1, fused_percent=2.0, vision_percent=4.0, minutes=3.0)
    cells = [
        replace(base, touches=0, method="shipped", mae_n=0.8),
        base,
        replace(base, object="peg", mae_n=0.2, vision_percent=None),
        replace(base, rig="b", mae_n=None, fused_percent=None, vision_percent=None, problem="too weak"),
    ]
    assert markdown(cells).splitlines()[2:] == [
        "| shipped | - | 1 of 1 | 0.800 | 0.800 | 2.0 | 4.0 | 3.0 |",
        "| taught | 4 | 2 of 3 | 0.150 | 0.200 | 2.0 | 4.0 | 3.0 |",
    ]


@pytest.fixture
def recordings(
    press: Callable[..., Clip],
    write_log: Callable[[Clip, Path], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Path:
    """A folder with three recordings each of three objects, whose import writes pressed discs."""

    def import_video(video: Path, forces: Path, out: Path, *, name: str) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        number = int(name.removesuffix("b"))
        write_log(replace(press(number), name=name, object=f"o{number // 3}"), out.parent)

    folder = tmp_path / "real"
    folder.mkdir()
    for number in range(9):
        (folder / f"{number}.avi").touch()
        (folder / f"{number}.csv").touch()
    monkeypatch.setattr(job, "import_video", import_video)
    monkeypatch.setattr(few, "GRID", 16)  # the side of the discs: a larger one takes seconds
    return folder


def measured(folder: Path, out: Path) -> list[dict[str, Any]]:
    call = ["bench", "teach", "--recordings", str(folder), "--out", str(out), "--json"]
    rows: list[dict[str, Any]] = json.loads(CliRunner().invoke(app, call, catch_exceptions=False).stdout)[
        "recordings"
    ]
    return rows


def test_real_recordings_are_left_out_by_object_and_taught_in_order(recordings: Path, tmp_path: Path) -> None:
    rows = measured(recordings, tmp_path)
    assert [(row["object"], row["trials"], row["tested"]) for row in rows] == [
        (name, trials, 3 - trials) for name in ("o0", "o1", "o2") for trials in (1, 2)
    ]
    assert all(0 < row["taught_n"] < 3 for row in rows)
    kept = (tmp_path / "recordings.jsonl").read_text()
    assert measured(recordings, tmp_path) == rows
    assert (tmp_path / "recordings.jsonl").read_text() == kept
    # Missing recordings are imported, and rows of others are not used.
    next(tmp_path.rglob("4.mcap")).unlink()  # as after an interrupted import
    assert measured(recordings, tmp_path) == rows
    for name in ("0.avi", "0.csv"):
        (recordings / name).rename(recordings / f"{name[0]}b{name[1:]}")
    (recordings / "8.avi").unlink()
    fewer = measured(recordings, tmp_path)
    assert [row["tested"] for row in fewer] == [2, 1, 2, 1, 1]
    assert {row["recordings"] for row in fewer}.isdisjoint({row["recordings"] for row in rows})


def test_another_version_imports_the_recordings_again_and_uses_no_row_of_this_one(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs, rows = job.import_missing(recordings, tmp_path), job.digest_of_recordings([])
    monkeypatch.setattr(job, "__version__", "0.1.0")
    assert set(logs).isdisjoint(job.import_missing(recordings, tmp_path))
    assert job.digest_of_recordings([]) != rows


def test_recordings_of_which_none_can_be_left_out_do_not_replace_the_table_of_rigs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "bench_recordings", lambda *_: iter(()))
    page = tmp_path / "page.md"
    page.write_text(
        "".join(f"<!-- {name} -->\nold\n<!-- end of {name} -->\n" for name in ("teach", "teach recordings"))
    )
    call = [
        "bench",
        "teach",
        "--recordings",
        str(tmp_path),
        "--out",
        str(tmp_path),
        "--write",
        str(page),
        "--json",
    ]
    result = CliRunner().invoke(app, call, catch_exceptions=False)
    assert json.loads(result.stdout)["recordings"] == []
    assert page.read_text().count("old") == 1
    assert "<!-- teach -->\nold\n" in page.read_text()


def test_unknown_method_is_named() -> None:
    result = CliRunner().invoke(app, ["bench", "teach", "--method", "magic"])
    assert isinstance(result.exception, ConfigError)
    assert "no method 'magic'" in str(result.exception)
