import json

import pytest
from typer.testing import CliRunner

from gripper_force import bench, cli
from gripper_force.errors import GripperError


def test_the_bus_is_measured_and_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "BUS_SETTINGS", ((4_000_000, 1.0),))
    call = ["bench", "--bus", "--cycles", "2"]
    assert "plain SDK" in CliRunner().invoke(cli.app, call).stdout
    told = json.loads(CliRunner().invoke(cli.app, [*call, "--json"]).stdout)
    assert [cost["client"] for cost in told["bus"]] == ["driver", "plain SDK", "bare bytes"]
    assert {"load", "cores"} < set(told)


def test_commands_are_run_and_measured() -> None:
    first, second = bench.commands(["--help", "grasp --set camera.backend=none --set clock=lockstep --help"])
    assert (first.command, first.wall_s > 0, first.cpu_s > 0) == ("--help", True, True)
    assert 10 < first.memory_mb < 1000
    assert second.memory_mb > 10


def test_a_command_that_fails_is_told() -> None:
    with pytest.raises(GripperError, match=r"gripper-force replay nothing failed: .*nothing"):
        list(bench.commands(["replay nothing"]))


def test_the_cost_of_commands_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "COMMANDS", ("--help",))
    monkeypatch.setattr(bench, "commands", lambda: iter([bench.CommandCost("--help", 0.4, 0.3, 55.0)]))
    assert "0.4" in CliRunner().invoke(cli.app, ["bench", "--commands"]).stdout
    told = json.loads(CliRunner().invoke(cli.app, ["bench", "--commands", "--json"]).stdout)
    assert told["commands"] == [{"command": "--help", "wall_s": 0.4, "cpu_s": 0.3, "memory_mb": 55.0}]
