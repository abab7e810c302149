from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import Config, config_from_text, load_config
from gripper_force.errors import ConfigError, DataError, SimulationError
from gripper_force.jobs import paper_protocol as module
from gripper_force.jobs.grasp import PAPER_OBJECTS
from gripper_force.jobs.paper_protocol import INSTANCES, SetPlan, make_set, plan_protocol
from gripper_force.jobs.simulate import simulate
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import Frame, GraspStatus, LoadCellSample, Phase, Record
from gripper_hw.sim.scene import Scene, draw_scene


@pytest.fixture
def config(quick: list[str]) -> Config:
    return load_config(None, [*quick, "control.timeout_s=2"])


@pytest.fixture
def seeing(config: Config) -> Config:
    """A configuration with a camera of a low frame rate, which is cheap to render."""
    return config.with_values(camera={"backend": "simulated", "rate_hz": 20.0})


@pytest.mark.parametrize("instances", INSTANCES)
def test_full_protocol_is_the_papers(instances: str) -> None:
    sets = plan_protocol("full", instances)
    names = [name for one in sets for name in one.names]
    assert (len(sets), len(set(names)), len({one.seed for one in sets})) == (240, 720, 240)
    assert {one.degrees for one in sets} == {0, 10, 20, 30}
    assert {lux for one in sets for lux in one.lux} == {350, 550, 750}
    assert {one.object for one in sets} == set(PAPER_OBJECTS)
    assert sum(one.split == "test" for one in sets) == 240 * 3 // 15
    assert "test/stapler-30-15-750.mcap" in names
    with pytest.raises(ConfigError, match="no scale 'huge' of the protocol; use one of full, small"):
        plan_protocol("huge", instances)
    with pytest.raises(ConfigError, match="no instances 'other' of the protocol; use one of same, redrawn"):
        plan_protocol("full", "other")


def scenes(instances: str) -> dict[str, list[Scene]]:
    """Scenes of the first draws of the small scale, by object."""
    config = load_config(None)
    found: dict[str, list[Scene]] = {}
    for task in plan_protocol("small", instances):
        made = module._set_config(config, task, task.seed, task.lux[0], np.random.default_rng(0))
        found.setdefault(task.object, []).append(draw_scene(made.object, made.seed, made.sim))
    return found


def approaches(path: Path) -> int:
    phases = [s.phase for s in LogReader(path).records(GraspStatus)]
    return sum(a != b == Phase.APPROACH for a, b in pairwise(phases))


def without_pose(scene: Scene) -> Scene:
    return replace(scene, offset_m=(0.0, 0.0), yaw_deg=0.0)


def test_same_instances_differ_only_in_their_pose() -> None:
    for of_object in scenes("same").values():
        assert len(set(of_object)) == len(of_object) == 20
        assert len({without_pose(scene) for scene in of_object}) == 1


def test_redrawn_instances_differ_in_object_and_rig() -> None:
    for of_object in scenes("redrawn").values():
        for key in ("size", "stiffness", "texture_seed", "camera_offset_m", "rod_length_m", "offset_m"):
            assert len({getattr(scene, key) for scene in of_object}) == 20
        assert {(scene.nm_per_a, scene.jaw_friction_n) for scene in of_object} == {(1.0, 0.2)}


@pytest.mark.parametrize("instances", INSTANCES)
def test_peaks_of_the_stapler_overshoot_little(seeing: Config, tmp_path: Path, instances: str) -> None:
    task = next(
        one for one in plan_protocol("small", instances) if one.object == "stapler" and one.number == 2
    )
    (path,) = make_set(task, tmp_path, seeing.model_dump(mode="json"))
    assert 8.0 < max(s.force_n for s in LogReader(path).records(LoadCellSample)) <= 12.75
    assert approaches(path) == 4


def test_a_set_with_too_high_a_peak_is_refused(
    seeing: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_RAMP_N_S", {})
    monkeypatch.setattr(module, "_USUAL_RAMP_N_S", (300.0, 300.0))
    monkeypatch.setattr(module, "_MAX_DRAWS", 1)
    task = SetPlan("stapler", 0, 1, 700_000, (550,), 700_000)
    (tmp_path / "train").mkdir()
    with pytest.raises(SimulationError, match=r"a touch of 'stapler' at 0 degrees reached 1\d\.\d N"):
        make_set(task, tmp_path, seeing.model_dump(mode="json"))
    assert not list(tmp_path.rglob("*.mcap"))


def test_small_protocol_is_part_of_the_full_one() -> None:
    full = {name: one.seed for one in plan_protocol("full", "same") for name in one.names}
    small = {name: one.seed for one in plan_protocol("small", "same") for name in one.names}
    assert len(small) == 80
    assert sum(name.startswith("test/") for name in small) == 80 * 3 // 15
    assert small.items() <= full.items()


def records(path: Path) -> list[Record]:
    return [r for r in LogReader(path).records() if not isinstance(r, Frame)]


def test_lights_of_a_set_share_one_simulation(
    seeing: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "TOUCHES", 2)
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
    made = config_from_text(logs[2].config, "the log").sim
    assert (made.lux, made.yaw_deg, made.tool) == (750, 20, "rods")


@pytest.mark.usefixtures("pool_here")
def test_only_missing_logs_are_made_and_failed_draws_are_repeated(
    seeing: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "TOUCHES", 1)
    run, seeds = module._run_set, []

    def break_once(config: Config, task: SetPlan, seed: int, logs: dict[int, Path]) -> None:
        seeds.append(seed)
        if len(seeds) == 1:
            for log in logs.values():
                log.write_bytes(b"half a log")
            raise SimulationError("the object caught on a pad")
        run(config, task, seed, logs)

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
    kept.unlink()
    assert list(simulate([task], tmp_path, seeing, workers=1)) == [kept]
    assert list(simulate([task], tmp_path, seeing, workers=1)) == []
    other = seeing.with_values(sim={"rig_seed": 3, "view_spread": 3.0})
    for _ in range(2):
        with pytest.raises(
            DataError, match=r"recorded with sim\.view_spread 1\.0, not 3\.0; use another folder"
        ):
            list(simulate([task], tmp_path, other, workers=1))
        kept.unlink(missing_ok=True)  # then the set lacks a log
    assert not kept.exists()


def test_protocol_needs_simulated_camera(config: Config, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"needs a simulated camera and load cell, but camera\.backend is 'none'"
    ):
        make_set(plan_protocol("small", "same")[0], tmp_path, config.model_dump(mode="json"))
    assert not list(tmp_path.rglob("*.mcap"))
