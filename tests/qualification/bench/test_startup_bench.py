import json
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import GripperError
from gripper_force.qualification.bench import startup_bench as startup
from gripper_force.qualification.bench.startup_bench import STARTUP_CASES, StartupCase, start
from gripper_force.vision.engines import open_engine
from gripper_force.vision.model_files import read_model


@pytest.fixture(scope="module")
def places(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    with pytest.MonkeyPatch.context() as patch, startup.simulated_devices() as places:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        for engine in ("openvino", "onnxruntime"):
            if find_spec(engine) is not None:
                open_engine(read_model(tiny_checkpoint), engine)  # exports it, which needs PyTorch
        yield {**places, "network": str(tiny_checkpoint)}


@pytest.mark.parametrize("scene", STARTUP_CASES, ids=lambda scene: scene.name)
def test_a_scene_loads_and_runs_only_what_it_needs(scene: StartupCase, places: dict[str, str]) -> None:
    started = start(scene, places)
    assert set(started.loaded) <= scene.needs
    assert set(started.threads) == scene.threads
    assert started.time_s > 0
    assert 10 < started.memory_mb < 2000


def test_a_scene_that_does_not_start_raises_with_its_message(places: dict[str, str]) -> None:
    with pytest.raises(GripperError, match=r"(?s)the scene 'broken' did not start: .*no_such_key"):
        start(StartupCase("broken", settings=("no_such_key=1",)), places)


def test_bench_startup_prints_a_table_and_json(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(startup, "STARTUP_CASES", STARTUP_CASES[:1])
    assert "--help" in CliRunner().invoke(cli.app, ["bench", "startup"]).stdout
    printed = json.loads(CliRunner().invoke(cli.app, ["bench", "startup", "--json"]).stdout)
    (row,) = printed["startup"]
    assert (row["scene"], row["loaded"], row["threads"]) == ("--help", [], [])
