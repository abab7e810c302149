import json
from collections.abc import Generator, Iterator
from dataclasses import asdict
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import ConfigError
from gripper_force.jobs.dataset import Clip
from gripper_force.qualification.bench import training_bench
from gripper_force.qualification.bench.training_bench import COMPARED, Load, Point, learn, reached
from gripper_force.vision.preprocess import Preprocess

pytestmark = pytest.mark.usefixtures("one_thread")

KEYS = ["preprocess.size=16", "width=0.1", "device=cpu", "validation=0.3", "clips=2"]


def test_every_recipe_is_trained_for_its_time_and_saved(clips: list[Clip], tmp_path: Path) -> None:
    sizes = []

    def load(preprocess: Preprocess) -> list[Clip]:
        sizes.append(preprocess.size)
        return clips

    points = list(learn(load, 0.004, KEYS, tmp_path))
    assert sizes == [16]
    ends = {point.way: point for point in points}
    assert set(ends) == set(COMPARED)
    first, *others = COMPARED
    assert all(ends[way].minutes >= 0.004 and ends[way].steps > 0 for way in others)
    assert ends[first].minutes >= 0.0004
    kept = json.loads((tmp_path / "learning.json").read_text())
    assert kept["points"] == [asdict(point) for point in points]
    assert kept["recipes"]["paper"]["windows"] == "separate"
    assert (tmp_path / "learning.png").stat().st_size > 1000


def test_an_interrupted_comparison_keeps_its_points(clips: list[Clip], tmp_path: Path) -> None:
    training = learn(lambda _: clips, 1.0, KEYS, tmp_path)
    assert isinstance(training, Generator)
    point = next(training)
    assert isinstance(training, Generator)
    training.close()
    assert json.loads((tmp_path / "learning.json").read_text())["points"] == [asdict(point)]


def test_reached_gives_the_time_to_the_error_of_the_paper() -> None:
    def point(way: str, minutes: float, mae_n: float) -> Point:
        return Point(way, minutes, 1, mae_n, mae_n)

    points = [point("paper", 1, 0.5), point("short clips", 1, 0.4), point("short clips", 2, 0.29)]
    points += [point("dense windows", 2, 0.4), point("paper", 2, 0.3)]
    found = reached(points)
    assert (found["short clips"], found["dense windows"], found["paper"]) == (2, None, 2)


def test_several_networks_or_a_bad_folder_raise(clips: list[Clip], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="set attentions to one module"):
        next(learn(lambda _: clips, 1.0, ["attentions=[ssam, scam]"], tmp_path))
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="give another folder"):
        next(learn(lambda _: clips, 1.0, KEYS, tmp_path / "file"))


def test_bench_training_prints_the_minutes_of_each_recipe(
    few_logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def learn(load: Load, minutes: float, keys: list[str], out: Path, progress: object) -> Iterator[Point]:
        assert [clip.frames.shape[1:] for clip in load(Preprocess(size=16))] == [(16, 16)] * 3
        assert (minutes, keys, out) == (0.5, KEYS, tmp_path)
        yield Point("short clips", 0.25, 10, 0.4, 0.5)
        yield Point("paper", 0.5, 20, 0.4, 0.5)

    monkeypatch.setattr(training_bench, "learn", learn)
    sets = [part for key in KEYS for part in ("--set", key)]
    call = ["bench", "training", str(few_logs), "--minutes", "0.5", "--jobs", "1", "--out", str(tmp_path)]
    shown = CliRunner().invoke(cli.app, [*call, *sets], catch_exceptions=False)
    assert "as good as the paper's" in shown.stdout
