import shutil
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from gripper_force.config import Config, config_from_text, dump_config, load_config
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs import simulate as module
from gripper_force.jobs.grasp import PAPER_OBJECTS
from gripper_force.jobs.simulate import (
    MAX_TARGET_N,
    Kind,
    SimulationPlan,
    make_log,
    plan,
    simulate,
)
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import Frame, GraspStatus, LoadCellSample, Phase

SEED = 100_003


@pytest.fixture(scope="session")
def config(quick: list[str]) -> Config:
    return load_config(None, [*quick, "control.timeout_s=2"])


@pytest.fixture(scope="session")
def logs(config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log of each kind. Not to be written to."""
    folder = tmp_path_factory.mktemp("simulated")
    for kind in get_args(Kind):
        make_log(SimulationPlan(kind, "stapler", SEED), folder, config.model_dump(mode="json"))
    return folder


@pytest.fixture
def with_tap(logs: Path, tmp_path: Path) -> Path:
    """A folder of a test with the log of the tap."""
    shutil.copy(logs / f"tap-stapler-{SEED}.mcap", tmp_path)
    return tmp_path


def test_plan_is_deterministic_and_cycles_through_objects() -> None:
    plans = plan("press", 6, 100)
    assert plans == plan("press", 6, 100)
    assert [p.object for p in plans] == [*PAPER_OBJECTS, *PAPER_OBJECTS[:2]]
    assert [p.seed for p in plans] == list(range(100, 106))
    assert len({p.name for p in plans + plan("grasp", 6, 100)}) == 12
    assert plan("grasp", 2, 7, ("tube",)) == [
        SimulationPlan("grasp", "tube", 7),
        SimulationPlan("grasp", "tube", 8),
    ]


@pytest.mark.parametrize("kind", get_args(Kind))
def test_log_holds_a_touch_and_its_metadata(kind: Kind, logs: Path) -> None:
    assert len(list(logs.iterdir())) == 3
    path = logs / f"{kind}-stapler-100003.mcap"
    log = LogReader(path)
    assert (log.metadata["object"], log.metadata["set"]) == ("stapler", "stapler-100003")
    assert log.metadata["exposure_ms"] == "4.0"
    assert max(s.force_n for s in log.records(LoadCellSample)) > 0.5
    phases = [s.phase for s in log.records(GraspStatus)]
    assert phases[-1] == Phase.OPEN
    assert phases.count("open") > 20  # what comes before the touch, for the reference
    made = config_from_text(log.config, str(path))
    assert made.control.feedback == "current"
    assert 0.5 <= made.target_n <= MAX_TARGET_N


def test_same_seed_gives_identical_logs(config: Config, logs: Path, tmp_path: Path) -> None:
    first = logs / f"tap-stapler-{SEED}.mcap"
    again, other = (
        make_log(SimulationPlan("tap", "stapler", seed), tmp_path, config.model_dump(mode="json"))
        for seed in (SEED, SEED + 1)
    )
    assert again.read_bytes() == first.read_bytes()
    drawn, otherwise = (config_from_text(LogReader(path).config, "it").control for path in (first, other))
    assert drawn.ramp_n_s != otherwise.ramp_n_s


def test_log_holds_frames(config: Config, tmp_path: Path) -> None:
    seen = config.with_values(camera={"backend": "simulated", "rate_hz": 10.0})
    path = make_log(SimulationPlan("tap", "stapler", 3), tmp_path, seen.model_dump(mode="json"))
    frames = list(LogReader(path).records(Frame))
    assert len(frames) > 5
    assert frames[0].gray.shape == (128, 128)


@pytest.mark.usefixtures("pool_here")
def test_interrupted_simulation_continues(config: Config, with_tap: Path) -> None:
    plans = plan("tap", 2, SEED, ("stapler",))
    kept, missing = (with_tap / p.name for p in plans)
    before = kept.read_bytes()
    leftover = with_tap / f".{missing.name}.part"
    leftover.write_bytes(b"half a log")
    assert list(simulate(plans, with_tap, config, workers=1)) == [missing]
    assert kept.read_bytes() == before
    assert LogReader(missing).complete
    assert not leftover.exists()
    assert list(simulate(plans, with_tap, config, workers=1)) == []


@pytest.mark.parametrize("kind", get_args(Kind))
def test_logs_of_other_settings_are_not_taken_for_these(kind: Kind, config: Config, logs: Path) -> None:
    plans = plan(kind, 1, SEED, ("stapler",))
    assert list(simulate(plans, logs, config, workers=1)) == []
    other = config.with_values(sim={"gain": 1.1})
    with pytest.raises(DataError, match=r"recorded with sim\.gain None, not 1\.1; use another folder"):
        list(simulate(plans, logs, other, workers=1))


@pytest.mark.usefixtures("pool_here")
def test_a_log_of_other_settings_is_found_among_others(config: Config, with_tap: Path) -> None:
    plans = plan("tap", 2, SEED, ("stapler",))
    assert len(list(simulate(plans[1:], with_tap, config.with_values(sim={"gain": 1.1}), workers=1))) == 1
    with pytest.raises(DataError, match=r"tap-stapler-100004\.mcap .* recorded with sim\.gain 1\.1"):
        list(simulate(plans, with_tap, config, workers=1))


@pytest.mark.usefixtures("pool_here")
def test_logs_of_an_object_file_that_was_changed_are_not_mixed(config: Config, tmp_path: Path) -> None:
    files = [tmp_path / "foam.yaml", tmp_path / "felt.yaml"]
    text = "family: solid\nsize_m: [0.05, 0.05, 0.05]\nmodulus_pa: {}\n"
    for file, modulus_pa in zip(files, (300000, 200000), strict=True):
        file.write_text(text.format(modulus_pa))
    plans = plan("tap", 3, 5, tuple(str(file) for file in files))
    assert len(list(simulate(plans[:2], tmp_path / "out", config, workers=1))) == 2
    files[0].write_text(text.format(400000))
    with pytest.raises(
        DataError, match=r"file has changed between .*foam-000005\.mcap and .*foam-000007\.mcap"
    ):
        list(simulate(plans, tmp_path / "out", config, workers=1))


def test_a_real_gripper_is_refused(config: Config, tmp_path: Path) -> None:
    real = config.with_values(servo={"port": "/dev/ttyUSB0"})
    with pytest.raises(ConfigError, match=r"simulate moves no real gripper, .* servo\.port=/dev/ttyUSB0"):
        list(simulate(plan("tap", 1, 5), tmp_path / "out", real, workers=1))
    assert not (tmp_path / "out").exists()


def test_failed_simulation_leaves_no_log(config: Config, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no simulated object 'egg'"):
        make_log(SimulationPlan("press", "egg", 5), tmp_path, config.model_dump(mode="json"))
    assert not list(tmp_path.glob("*.mcap"))


def test_logs_of_a_steep_linkage_can_be_read() -> None:
    linkage = {"kind": "finger", "finger_m": 0.06, "open_finger_rad": 1.4}
    config = load_config(None, [f"gripper.linkage={linkage}", "gripper.open_width_m=0.058"])
    rng = np.random.default_rng(0)
    made = module._randomised(config, SimulationPlan("press", "tube", 100_000), rng)
    assert config_from_text(dump_config(made), "a log").control.force_limit_n < 25


def test_draws_of_a_press_do_not_change() -> None:
    rng = np.random.default_rng([100_000, 10])
    made = module._randomised(Config(), SimulationPlan("press", "tube", 100_000), rng)
    assert (made.control.ramp_n_s, made.target_n, rng.uniform()) == (
        22.15120772485808,
        1.799035382848817,
        0.05474535092440547,
    )
