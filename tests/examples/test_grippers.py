"""Grasps with each gripper of examples/grippers, simulated with its own linkage."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import gripper_force as gf
from gripper_calibration.procedures.calibrate_servo import calibrate_servo
from gripper_force.config import Config, load_config
from gripper_force.profiles.rig_profile import read_rig
from gripper_force.runtime.log import LogReader
from gripper_force.types import GraspStatus, LoadCellSample, Phase
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.sim.scene import draw_scene

GRIPPERS = sorted((Path(__file__).parents[2] / "examples/grippers").glob("*.yaml"))


def config_of(path: Path, seed: int) -> Config:
    return load_config(
        path, ["object=block", "sim.detail=coarse", "camera.backend=none", f"seed={seed}", "log.report=false"]
    )


@pytest.mark.parametrize("target_n", [2.0, 5.0])
@pytest.mark.parametrize("path", GRIPPERS, ids=lambda path: path.stem)
def test_the_force_is_held_by_motor_current(path: Path, target_n: float, tmp_path: Path) -> None:
    config = config_of(path, seed=3)
    with gf.open_gripper(config, log=tmp_path / "run.mcap") as gripper:
        assert gripper.grasp(target_n).outcome == "held"
        gripper.release()
    records = list(LogReader(tmp_path / "run.mcap").records(GraspStatus, LoadCellSample))
    statuses = [record for record in records if isinstance(record, GraspStatus)]
    held_ns = [status.t_ns for status in statuses if status.phase == Phase.HOLD]
    forces_n = [r.force_n for r in records if isinstance(r, LoadCellSample)]
    held_n = [
        r.force_n for r in records if isinstance(r, LoadCellSample) and held_ns[100] < r.t_ns < held_ns[-1]
    ]
    # Uncalibrated: the scene's friction and torque constant differ from the believed ones by up to 30 % and 8 %.
    assert np.median(held_n) == pytest.approx(target_n, abs=0.35 + 0.08 * target_n)
    assert max(forces_n) < 1.05 * config.control.force_limit_n
    approach = [status for status in statuses if status.phase == Phase.APPROACH]
    speeds_m_s = [
        (before.width_m - after.width_m) / 2 / ((after.t_ns - before.t_ns) * 1e-9)
        for before, after in pairwise(approach[::5])
    ]
    assert max(speeds_m_s) < 1.5 * config.control.approach_speed_m_s


def test_calibrate_servo_finds_the_torque_constant_through_a_linkage(tmp_path: Path) -> None:
    # The travel of a jaw grows from 14 to 26 mm per radian.
    rows = [[angle, 0.092 - 2 * (0.014 * angle + 0.0025 * angle**2)] for angle in (0.0, 0.6, 1.2, 1.8, 2.3)]
    linkage = f"gripper.linkage={{kind: table, table: {rows}}}"
    config = load_config(None, ["object=block", "sim.detail=coarse", "seed=7", linkage])
    calibrate_servo(config, [0.03], tmp_path / "rig.yaml", prompt=lambda text: None)
    found = read_rig(tmp_path / "rig.yaml").servo
    assert found is not None
    scene = draw_scene("block", config.seed, config.sim)
    true_nm_per_a = load_model(found.model).nm_per_a * scene.nm_per_a
    assert found.nm_per_a.value == pytest.approx(true_nm_per_a, rel=0.02)
    assert found.open_position_rad.value == pytest.approx(0.0, abs=0.03)
