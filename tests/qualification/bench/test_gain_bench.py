"""`bench gain`, and `calibrate gain` on the logs that it leaves."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import DataError
from gripper_force.jobs.object_gain import gain_of
from gripper_force.profiles.object_profile import find_object, read_object, weights_path
from gripper_force.qualification.bench.gain_bench import best_gain

SETTINGS = (
    "vision.checkpoint=small",
    "sim.detail=coarse",
    "sim.stiffness=1.5",
    "control.settle_s=0.2",
    "control.hold_s=0.7",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("gain")


@pytest.fixture(scope="module")
def row(folder: Path) -> dict[str, Any]:
    (folder / "press-sponge-504.mcap").touch()  # left by an earlier run
    call = ["bench", "gain", "--object", "sponge", "--grasps", "2", "--presses", "1", "--out", str(folder)]
    sets = [part for key in SETTINGS for part in ("--set", key)]
    result = CliRunner().invoke(cli.app, [*call, *sets, "--seed", "4", "--json"], catch_exceptions=False)
    (found,) = json.loads(result.stdout)["objects"]
    assert isinstance(found, dict)
    return found


def grasp_logs(folder: Path) -> list[Path]:
    return sorted(
        (path for path in folder.rglob("*.mcap") if "press" not in path.name), key=lambda p: p.stat().st_mtime
    )


def test_the_gain_of_a_stiff_sponge_is_learned_and_reduces_the_error_of_vision(row: dict[str, Any]) -> None:
    assert (row["object"], row["seed"], row["grasps"], len(row["errors_n"])) == ("sponge", 4, 2, 2)
    assert row["stiffness"] == pytest.approx(1.5)
    assert row["gain"] > 1.2
    assert row["perfect_n"] < row["learned_n"] < 0.8 * row["mae_n"]


def test_the_best_gain_has_the_lowest_error() -> None:
    rng = np.random.default_rng(0)
    true_n = np.linspace(0, 8, 400)
    seen_n = np.where(true_n > 6, 0.7, 0.9) * true_n + rng.normal(
        0, 0.03, 400
    )  # a stop, beyond which nothing shows
    seen_n[0] = 0.0
    errors_n = [np.abs(gain * seen_n - true_n).mean() for gain in np.linspace(1, 1.5, 2001)]
    assert np.abs(best_gain(seen_n, true_n) * seen_n - true_n).mean() <= min(errors_n)


def test_the_command_saves_the_gain_of_the_last_log(
    row: dict[str, Any], folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "mine.yaml"
    call = ["calibrate", "gain", "sponge", "--from", str(grasp_logs(folder)[-1]), "--out", str(out), "--json"]
    result = CliRunner().invoke(cli.app, call, catch_exceptions=False)
    assert result.exit_code == 0, result.stderr
    printed = json.loads(result.stdout)
    assert printed["object"] == "sponge"
    assert printed["profile"] == str(out)
    assert f"next: gripper-force grasp --object sponge --profile {out} --target-n 4\n" in result.stderr
    assert printed["object_gain"] == pytest.approx(row["gain"], rel=1e-3)
    saved, source = read_object(out), find_object("sponge")
    assert saved.ratio == pytest.approx((printed["ratio"], printed["ratio_std"]))
    found = gain_of(saved.ratio, torque_constant_std=0.06)
    assert found is not None
    assert found.gain == pytest.approx(row["gain"], rel=1e-3)
    assert saved.model_copy(update={"ratio": None}) == read_object(source)
    assert weights_path(out).read_bytes() == weights_path(source).read_bytes()


def test_the_command_warns_of_logs_of_another_object(
    row: dict[str, Any], folder: Path, tmp_path: Path
) -> None:
    call = [
        "calibrate",
        "gain",
        "tube",
        "--from",
        str(grasp_logs(folder)[-1]),
        "--out",
        str(tmp_path / "tube.yaml"),
    ]
    result = CliRunner().invoke(cli.app, call, catch_exceptions=False)
    assert "warning: there are logs of sponge among those for tube" in result.stderr


def test_the_command_refuses_presses_without_vision(
    row: dict[str, Any], folder: Path, tmp_path: Path
) -> None:
    (press,) = folder.glob("press-*.mcap")
    call = ["calibrate", "gain", "sponge", "--from", str(press), "--out", str(tmp_path / "mine.yaml")]
    error = CliRunner().invoke(cli.app, call).exception
    assert isinstance(error, DataError)
    assert "no log holds a grasp" in str(error)
    assert not list(tmp_path.iterdir())
