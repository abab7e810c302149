from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import Config, config_from_text, load_config
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.jobs import paper_protocol as module
from gripper_force.jobs.paper_protocol import SetPlan, make_set, plan_protocol
from gripper_force.jobs.simulate import OBJECTS, simulate
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import Frame, GraspStatus, LoadCellSample, Phase, Record


@pytest.fixture
def config(quick: list[str]) -> Config:
    return load_config(None, [*quick, "control.timeout_s=2"])


@pytest.fixture
def seeing(config: Config) -> Config:
    """A configuration with a camera of a low frame rate, which is cheap to render."""
    camera = config.camera.model_copy(update={"backend": "simulated", "rate_hz": 20.0})
    return config.model_copy(update={"camera": camera})


def test_full_protocol_is_the_papers() -> None:
    sets = plan_protocol("full")
    names = [name for one in sets for name in one.names]
    assert (len(sets), len(set(names)), len({one.seed for one in sets})) == (240, 720, 240)
    assert {one.degrees for one in sets} == {0, 10, 20, 30}
    assert {lux for one in sets for lux in one.lux} == {350, 550, 750}
    assert {one.object for one in sets} == set(OBJECTS)
    assert sum(one.split == "test" for one in sets) == 240 * 3 // 15
    assert "test/stapler-30-15-750.mcap" in names
    with pytest.raises(ConfigError, match="no scale 'huge' of the protocol; use one of full, small"):
        plan_protocol("huge")


def test_small_protocol_is_part_of_the_full_one() -> None:
    full = {name: one.seed for one in plan_protocol("full") for name in one.names}
    small = {name: one.seed for one in plan_protocol("small") for name in one.names}
    assert len(small) == 80
    assert sum(name.startswith("test/") for name in small) == 80 * 3 // 15
    assert small.items() <= full.items()


def records(path: Path) -> list[Record]:
    return [r for r in LogReader(path).records() if not isinstance(r, Frame)]


def test_lights_of_a_set_share_one_simulation(seeing: Config, tmp_path: Path) -> None:
    tree = seeing.model_dump(mode="json")
    task = SetPlan("stapler", 20, 13, 700_000, (350, 550, 750))
    (tmp_path / "alone").mkdir()
    paths = make_set(task, tmp_path, tree)
    assert [path.name for path in paths] == [f"stapler-20-13-{lux}.mcap" for lux in task.lux]
    assert sorted((tmp_path / "test").iterdir()) == paths
    logs = [LogReader(path) for path in paths]
    assert records(paths[0]) == records(paths[1]) == records(paths[2])
    assert {log.metadata["set"] for log in logs} == {"stapler-700000"}
    assert [log.metadata["lux"] for log in logs] == ["350", "550", "750"]
    assert {(log.metadata["degrees"], log.metadata["split"]) for log in logs} == {("20", "test")}
    dark, middle, bright = ([f.gray for f in log.records(Frame)] for log in logs)
    assert np.mean(dark) < np.mean(middle) < np.mean(bright)
    (alone,) = make_set(SetPlan("stapler", 20, 13, 700_000, (750,)), tmp_path / "alone", tree)
    other = LogReader(alone)
    assert (other.metadata, other.config) == (logs[2].metadata, logs[2].config)
    assert np.array_equal([f.gray for f in other.records(Frame)], bright)
    forces_n = [s.force_n for s in LogReader(paths[0]).records(LoadCellSample)]
    assert max(forces_n) > 1.0
    phases = [s.phase for s in LogReader(paths[0]).records(GraspStatus)]
    assert sum(a != b == Phase.APPROACH for a, b in pairwise(phases)) == 4
    made = config_from_text(logs[2].config, "the log").sim
    assert (made.lux, made.yaw_deg, made.tool) == (750, 20, "rods")


def test_only_missing_logs_are_made_and_failed_draws_are_repeated(
    seeing: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, seeds = module._run_set, []

    def break_once(config: Config, task: SetPlan, seed: int, logs: dict[int, Path]) -> None:
        seeds.append(seed)
        run(config, task, seed, logs)
        if len(seeds) == 1:
            raise SimulationError("the object caught on a pad")

    monkeypatch.setattr(module, "_run_set", break_once)
    task = SetPlan("stapler", 0, 1, 5, (350, 550))
    kept = tmp_path / "train" / "stapler-00-01-350.mcap"
    kept.parent.mkdir()
    kept.write_bytes(b"made before")
    (made,) = make_set(task, tmp_path, seeing.model_dump(mode="json"))
    assert seeds == [5, 1005]
    assert LogReader(made).metadata["set"] == "stapler-1005"
    assert kept.read_bytes() == b"made before"
    assert sorted(kept.parent.iterdir()) == [kept, made]
    assert list(simulate([task], tmp_path, seeing, jobs=1)) == []


def test_protocol_needs_simulated_camera(config: Config, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"needs a simulated camera and load cell, but camera\.backend is 'none'"
    ):
        make_set(plan_protocol("small")[0], tmp_path, config.model_dump(mode="json"))
    assert not list(tmp_path.rglob("*.mcap"))
