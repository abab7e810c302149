"""`bench recognition` on one simulated press."""

import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.config import load_config
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import Clip
from gripper_force.qualification import recognition
from gripper_force.schema import Tree
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.estimator import ForceEstimator

ROWS = (
    recognition.Row("known kinds", "still", ("stapler",)),
    recognition.Row("disturbances", "blob", ("stapler",), change=recognition.blob),
)


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread_pool: object) -> list[str]:
    monkeypatch.setattr(recognition, "ROWS", ROWS)
    monkeypatch.setattr(recognition, "process_pool", thread_pool)
    call = ["bench", "recognition", "--presses", "1", "--jobs", "1", "--out", str(tmp_path)]
    return [*call, "--set", "vision.checkpoint=small", "--set", "sim.detail=coarse"]


def test_a_covered_view_is_rejected_and_an_existing_press_is_used_again(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = CliRunner().invoke(cli.app, [*command, "--json"], catch_exceptions=False)
    still, blob = json.loads(first.stdout)["rows"]
    assert (still["name"], blob["name"]) == ("still", "blob")
    assert still["frames"] > blob["frames"] > 10
    assert still["rejected"] < 0.25 < 0.9 < blob["rejected"]  # 3 % over many logs, but up to a fourth of one
    assert still["mae_n"] > 0
    assert len(list(tmp_path.rglob("*.mcap"))) == 1

    monkeypatch.delattr(recognition, "make_log")  # nothing is simulated again
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- recognition -->\nold\n<!-- end of recognition -->\nafter\n")
    again = CliRunner().invoke(cli.app, [*command, "--write", str(page)], catch_exceptions=False)
    assert "blob" in again.stdout
    written = page.read_text()
    assert "| disturbances | blob |" in written
    assert "old" not in written

    CliRunner().invoke(cli.app, [*command, "--set", "vision.max_covered=0.5"], catch_exceptions=False)
    assert len(list(tmp_path.rglob("disturbances-*.json"))) == 2  # what another check has judged is not used

    with monkeypatch.context() as patch:
        patch.setattr(recognition, "__version__", "0.1.0")
        simulates = CliRunner().invoke(cli.app, command).exception
    assert "make_log" in str(simulates)

    for kept in tmp_path.rglob("disturbances-*.json"):
        kept.write_text("{")
    error = CliRunner().invoke(cli.app, command).exception
    assert isinstance(error, DataError)
    assert "delete it" in str(error)


def test_rows_with_the_same_scene_make_its_log_once_with_several_workers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    running: set[tuple[object, ...]] = set()
    made: set[tuple[object, ...]] = set()

    def make(row: int, index: int, _folder: Path, _tree: Tree) -> Tree:
        log = (recognition.ROWS[row].settings, recognition.ROWS[row].objects, index)
        assert log in made or log not in running, "two workers make one log"
        running.add(log)
        time.sleep(0.01)
        made.add(log)
        return {"force_n": [1.0], "estimate_n": [1.0], "std_n": [1.0], "rejected": [False]}

    monkeypatch.setattr(recognition, "process_pool", ThreadPoolExecutor)
    monkeypatch.setattr(recognition, "_press", make)
    rows = recognition.measure(load_config(), tmp_path, 2, 8)
    assert [row["name"] for row in rows] == [row.name for row in recognition.ROWS]
    assert all(row["frames"] == 2 for row in rows)


def test_frames_are_judged_as_in_a_run(press: Callable[..., Clip], tiny_checkpoint: Path) -> None:
    frames = press(3).frames.repeat(2, 1).repeat(2, 2)
    frames[30:33] = 255  # flat: the network does not see them
    checkpoint = load_checkpoint(tiny_checkpoint)
    estimate_n, std_n, rejected = recognition.judge(frames, load_config(), checkpoint)
    assert np.flatnonzero(rejected).tolist() == [30, 31, 32]
    estimator = ForceEstimator.load(tiny_checkpoint)
    for i in np.flatnonzero(~rejected):
        if (found := estimator.update(frames[i])) is not None:
            assert (estimate_n[i], std_n[i]) == pytest.approx((found.force_n, found.std_n), abs=1e-3)
