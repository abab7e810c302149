import json

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.bench import bus


def test_the_bus_is_measured_and_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus, "BUS_SETTINGS", ((4_000_000, 1.0),))
    call = ["bench", "--bus", "--cycles", "2"]
    assert "plain SDK" in CliRunner().invoke(cli.app, call).stdout
    told = json.loads(CliRunner().invoke(cli.app, [*call, "--json"]).stdout)
    assert [cost["client"] for cost in told["bus"]] == ["driver", "plain SDK", "bare bytes"]
    assert {"load", "cores"} < set(told)
