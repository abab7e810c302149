import json

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import GripperError
from gripper_force.qualification.bench import command_bench as commands


def test_commands_are_run_and_measured() -> None:
    first, second = commands.commands(
        ["--help", "grasp --set camera.backend=none --set clock=lockstep --help"]
    )
    assert (first.command, first.wall_s > 0, first.cpu_s > 0) == ("--help", True, True)
    assert 10 < first.memory_mb < 1000
    assert second.memory_mb > 10


def test_a_failing_command_raises_with_its_message() -> None:
    with pytest.raises(GripperError, match=r"gripper-force replay nothing failed: .*nothing"):
        list(commands.commands(["replay nothing"]))


def test_bench_commands_prints_a_table_and_json(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "COMMANDS", ("--help",))
    monkeypatch.setattr(commands, "commands", lambda: iter([commands.CommandCost("--help", 0.4, 0.3, 55.0)]))
    assert "0.4" in CliRunner().invoke(cli.app, ["bench", "commands"]).stdout
    printed = json.loads(CliRunner().invoke(cli.app, ["bench", "commands", "--json"]).stdout)
    assert printed["commands"] == [{"command": "--help", "wall_s": 0.4, "cpu_s": 0.3, "memory_mb": 55.0}]
