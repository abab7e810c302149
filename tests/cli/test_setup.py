"""The command `setup` and its questions."""

import json
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_calibration.setup.rig_file import RigFile
from gripper_calibration.setup.run import STEPS, Setup
from gripper_force.cli import app
from gripper_force.errors import ConfigError

QUICK = [
    "--set",
    "servo.port=virtual:asked",
    "--set",
    "load_cell.backend=none",
    "--set",
    "camera.backend=none",
]


def finished(path: Path, *overrides: str) -> None:
    """Writes a rig file all of whose steps are finished, each with a remark."""
    rig = Setup(path, [*QUICK[1::2], *overrides])
    for name, step in STEPS.items():
        rig.rig.finish(
            name,
            {
                "date": "2026-01-02",
                "summary": f"{name} done",
                "remarks": [f"remark of {name}"],
                "files": {},
                "rests_on": rig._inputs(step),
            },
        )


@pytest.mark.parametrize("wrong", ["0", "-20", "nan", "inf"])
def test_a_wrong_number_is_asked_for_again(tmp_path: Path, wrong: str) -> None:
    arguments = ["setup", "--config", str(tmp_path / "rig.yaml"), "--step", "jaws", *QUICK]
    end = CliRunner().invoke(app, arguments, input=f"{wrong}\n20\n{wrong}\n")
    assert end.stderr.count(f"{float(wrong):g} is not possible; answer with a positive number") == 2
    assert end.stderr.count("Pitch radius of the pinion in mm") == 2
    assert isinstance(end.exception, ConfigError)
    assert "was not answered: Distance between the open jaws" in str(end.exception)


def test_nothing_is_an_answer_where_it_is_the_default(tmp_path: Path) -> None:
    arguments = ["setup", "--config", str(tmp_path / "rig.yaml"), "--step", "torque", *QUICK]
    end = CliRunner().invoke(app, arguments, input="0\n")
    assert "torque constant of the data sheet" in end.stderr


def test_remarks_of_steps_that_were_finished_before_are_shown(tmp_path: Path) -> None:
    finished(path := tmp_path / "rig.yaml")
    end = CliRunner().invoke(app, ["setup", "--config", str(path), "--yes", "--json"])
    assert [step["result"] for step in json.loads(end.stdout)["steps"]] == len(STEPS) * ["kept"]
    lines = end.stderr.splitlines()
    for name in STEPS:
        assert (
            lines[lines.index(f"{name}: finished before: {name} done (2026-01-02)") + 1]
            == f"  - remark of {name}"
        )


def test_the_next_command_finishes_the_setup_first_and_can_be_pasted(tmp_path: Path) -> None:
    path = tmp_path / "my rig" / "rig.yaml"
    path.parent.mkdir()
    end = CliRunner().invoke(
        app, ["setup", "--config", str(path), "--step", "servo", *QUICK, "--yes", "--json"]
    )
    assert end.exit_code == 0, end.stderr
    command = f"gripper-force setup --config {shlex.quote(str(path))}"
    assert end.stderr.splitlines()[-1] == f"next: {command}"
    assert json.loads(end.stdout)["next"] == command
    finished(path)
    end = CliRunner().invoke(app, ["setup", "--config", str(path), "--step", "servo", "--yes"])
    grasp = f"gripper-force grasp --config {shlex.quote(str(path))} --target-n 3"
    assert end.stderr.splitlines()[-1] == f"next: {grasp}"
    assert end.stdout == f"rig file: {path}\n"
    assert f"# {grasp}\n" in path.read_text(encoding="utf-8")
    RigFile.load(path, ["gripper.pinion_radius_m=0.01"], fresh=False).write()  # torque is outdated
    end = CliRunner().invoke(app, ["setup", "--config", str(path), "--step", "servo", "--yes"])
    assert end.stderr.splitlines()[-1] == f"next: {command}"
