import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import GripperError
from gripper_force.qualification.bench import startup_bench as startup
from gripper_force.qualification.bench.startup_bench import STARTUP_CASES, Start, StartupCase, start
from gripper_force.vision.export import export
from gripper_force.vision.model_files import cache_folder, exported_name, read_model


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    with pytest.MonkeyPatch.context() as patch, startup.simulated_devices() as places:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield places


@pytest.mark.parametrize("scene", STARTUP_CASES, ids=lambda scene: scene.name)
def test_a_scene_loads_and_runs_only_what_it_needs(
    scene: StartupCase, places: dict[str, str], tiny_checkpoint: Path
) -> None:
    network = "small"
    if "openvino" in scene.needs:  # nothing is shipped for it, and its export needs PyTorch
        model, network = read_model(tiny_checkpoint), str(tiny_checkpoint)
        export(model, cache_folder() / exported_name(model, ".xml"))
    started = start(scene, {**places, "network": network})
    assert set(started.loaded) <= scene.needs
    assert set(started.threads) == scene.threads
    assert started.time_s > 0
    assert 10 < started.memory_mb < 2000


def test_a_scene_that_does_not_start_raises_with_its_message(places: dict[str, str]) -> None:
    with pytest.raises(GripperError, match=r"(?s)the scene 'broken' did not start: .*no_such_key"):
        start(StartupCase("broken", settings=("no_such_key=1",)), places)


def test_bench_startup_prints_the_medians_without_the_first_start(monkeypatch: pytest.MonkeyPatch) -> None:
    times_s = iter(2 * [90.0, 1.0, 4.0, 2.0])

    def start(scene: StartupCase, places: dict[str, str]) -> Start:
        assert {"servo", "load_cell", "log", "network"} == set(places)
        return Start(scene.name, time_s := next(times_s), 10 * time_s, ("cv2",), ())

    monkeypatch.setattr(startup, "start", start)
    monkeypatch.setattr(startup, "STARTUP_CASES", STARTUP_CASES[:1])
    printed = json.loads(CliRunner().invoke(cli.app, ["bench", "startup", "--json"]).stdout)
    assert "--help" in CliRunner().invoke(cli.app, ["bench", "startup"]).stdout
    assert printed["startup"] == [
        {"scene": "--help", "time_s": 2.0, "memory_mb": 20.0, "loaded": ["cv2"], "threads": []}
    ]
