from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import Config, config_from_text, load_config
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.jobs import simulate as module
from gripper_force.jobs.simulate import (
    OBJECTS,
    PEAK_N,
    Kind,
    SetPlan,
    SimulationPlan,
    make_log,
    make_set,
    plan,
    plan_protocol,
    simulate,
)
from gripper_force.runtime.log import LogReader
from gripper_force.types import Frame, GraspStatus, LoadCellSample, Phase, Record


@pytest.fixture
def config(quick: list[str]) -> Config:
    return load_config(None, [*quick, "control.timeout_s=2"])


def test_a_plan_is_always_the_same_and_takes_the_objects_in_turn() -> None:
    plans = plan("press", 6, 100)
    assert plans == plan("press", 6, 100)
    assert [p.object for p in plans] == [*OBJECTS, *OBJECTS[:2]]
    assert [p.seed for p in plans] == list(range(100, 106))
    assert len({p.name for p in plans + plan("grasp", 6, 100)}) == 12
    assert plan("grasp", 2, 7, ("tube",)) == [
        SimulationPlan("grasp", "tube", 7),
        SimulationPlan("grasp", "tube", 8),
    ]


@pytest.mark.parametrize("kind", ["press", "tap", "grasp"])
def test_a_log_holds_a_touch_and_says_what_it_is(kind: Kind, config: Config, tmp_path: Path) -> None:
    task = SimulationPlan(kind, "stapler", 100_003)
    path = make_log(task, tmp_path, config.model_dump(mode="json"))
    assert path == tmp_path / f"{kind}-stapler-100003.mcap"
    assert list(tmp_path.iterdir()) == [path]
    log = LogReader(path)
    assert (log.metadata["object"], log.metadata["set"]) == ("stapler", "stapler-100003")
    assert log.metadata["exposure_ms"] == "4.0"
    assert max(s.force_n for s in log.records(LoadCellSample)) > 0.5
    phases = [s.phase for s in log.records(GraspStatus)]
    assert phases[-1] == Phase.OPEN
    assert phases.count("open") > 20  # what comes before the touch, for the reference
    made = config_from_text(log.config, str(path))
    assert made.control.feedback == "current"
    assert 0.5 <= made.target_n <= PEAK_N


def test_a_seed_makes_one_log_and_another_seed_another(config: Config, tmp_path: Path) -> None:
    def forces(seed: int, folder: str) -> list[float]:
        (tmp_path / folder).mkdir()
        path = make_log(
            SimulationPlan("press", "stapler", seed), tmp_path / folder, config.model_dump(mode="json")
        )
        return [s.force_n for s in LogReader(path).records(LoadCellSample)]

    first = forces(1, "a")
    assert forces(1, "b") == first
    assert forces(2, "c") != first


def test_frames_are_in_the_log(config: Config, tmp_path: Path) -> None:
    camera = config.camera.model_copy(update={"backend": "simulated", "rate_hz": 10.0})
    seen = config.model_copy(update={"camera": camera})
    path = make_log(SimulationPlan("press", "stapler", 3), tmp_path, seen.model_dump(mode="json"))
    frames = list(LogReader(path).records(Frame))
    assert len(frames) > 5
    assert frames[0].gray.shape == (128, 128)


def test_what_was_broken_off_goes_on(config: Config, tmp_path: Path) -> None:
    plans = plan("press", 2, 5, ("stapler",))
    kept, missing = (tmp_path / p.name for p in plans)
    kept.write_bytes(b"made before")
    leftover = tmp_path / f".{missing.name}.part"
    leftover.write_bytes(b"half a log")
    assert list(simulate(plans, tmp_path, config, jobs=1)) == [missing]
    assert kept.read_bytes() == b"made before"
    assert LogReader(missing).complete
    assert not leftover.exists()
    assert list(simulate(plans, tmp_path, config, jobs=1)) == []


def test_a_scene_that_fails_leaves_no_log_under_its_name(config: Config, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no simulated object 'egg'"):
        make_log(SimulationPlan("press", "egg", 5), tmp_path, config.model_dump(mode="json"))
    assert not list(tmp_path.glob("*.mcap"))


# The paper's protocol.


@pytest.fixture
def seeing(config: Config) -> Config:
    """With a camera that is slow, and so cheap."""
    camera = config.camera.model_copy(update={"backend": "simulated", "rate_hz": 20.0})
    return config.model_copy(update={"camera": camera})


def test_the_protocol_is_the_papers() -> None:
    sets = plan_protocol("full")
    names = [name for one in sets for name in one.names]
    assert (len(sets), len(set(names)), len({one.seed for one in sets})) == (240, 720, 240)
    assert {one.degrees for one in sets} == {0, 10, 20, 30}
    assert {lux for one in sets for lux in one.lux} == {350, 550, 750}
    assert {one.object for one in sets} == set(OBJECTS)
    assert sum(one.split == "test" for one in sets) == 240 * 3 // 15
    assert "test/stapler-30-15-750.mcap" in names
    with pytest.raises(ConfigError, match="no scale 'huge' of the protocol; there are full, small"):
        plan_protocol("huge")


def test_the_small_protocol_is_a_part_of_the_full_one() -> None:
    full = {name: one.seed for one in plan_protocol("full") for name in one.names}
    small = {name: one.seed for one in plan_protocol("small") for name in one.names}
    assert len(small) == 80
    assert sum(name.startswith("test/") for name in small) == 80 * 3 // 15
    assert small.items() <= full.items()


def records(path: Path) -> list[Record]:
    return [r for r in LogReader(path).records() if not isinstance(r, Frame)]


def test_all_lights_of_a_set_are_one_physics_as_if_each_was_made_alone(
    seeing: Config, tmp_path: Path
) -> None:
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


def test_of_a_set_only_what_is_missing_is_made_and_bad_draws_are_drawn_again(
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


def test_the_protocol_needs_its_camera(config: Config, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"needs camera\.backend and load_cell\.backend simulated, got 'none'"
    ):
        make_set(plan_protocol("small")[0], tmp_path, config.model_dump(mode="json"))
    assert not list(tmp_path.rglob("*.mcap"))


def test_what_is_drawn_for_a_press_stays_to_the_bit() -> None:
    rng = np.random.default_rng([100_000, 10])
    made = module._randomised(Config(), SimulationPlan("press", "tube", 100_000), rng)
    assert (made.control.ramp_n_s, made.target_n, rng.uniform()) == (
        22.15120772485808,
        1.799035382848817,
        0.05474535092440547,
    )
