"""Grasps with each transmission and with each family of servos, simulated with its own linkage and firmware."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import gripper_force as gf
from gripper_force.config import ServoConfig, load_config
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import NS_PER_S, GraspStatus, LoadCellSample, Phase
from gripper_hw.dynamixel.control_table import load_model, model_names

GRIPPERS = sorted((Path(__file__).parents[2] / "examples/grippers").glob("*.yaml"))
TABLE = "[[0.0, 0.092], [0.5, 0.075], [1.0, 0.052], [1.5, 0.030], [2.0, 0.012]]"
MODELS = ["XM430-W350", "XL330-M288", "XC330-T288", "XH540-W270", "XD430-T210", "XW540-T260"]
TRANSMISSIONS = [*GRIPPERS, None]
# Each transmission with its own servo (None), and each family with another transmission.
PAIRS = [
    *((path, None) for path in TRANSMISSIONS),
    *zip([*TRANSMISSIONS[3:], *TRANSMISSIONS[:2]], MODELS, strict=True),
]


def test_every_family_of_servos_is_tried() -> None:
    assert {name[:2] for name in MODELS} == {name[:2] for name in model_names()}


@pytest.mark.parametrize("path", GRIPPERS, ids=lambda path: path.stem)
def test_free_jaws_arrive_at_each_width(path: Path) -> None:
    config = load_config(
        path, ["object=none", "sim.detail=coarse", "camera.backend=none", "load_cell.backend=none"]
    )
    with gf.open_gripper(config) as gripper:
        for share in (0.7, 0.2, 0.9):
            gripper.move(share * config.gripper.open_width_m)
            assert gripper.state.outcome == "moved"


@pytest.mark.parametrize(
    ("path", "model"),
    PAIRS,
    ids=[f"{path.stem if path else 'table'}-{model or 'own servo'}" for path, model in PAIRS],
)
def test_the_force_is_held_by_motor_current(path: Path | None, model: str | None, tmp_path: Path) -> None:
    wanted_n = 3.5 if model is None else 2.0
    overrides = ["object=block", "sim.detail=coarse", "camera.backend=none", "seed=3", "log.report=false"]
    if path is None:
        overrides.append(f"gripper.linkage={{kind: table, table: {TABLE}}}")
    if model is not None:
        limit_a = min(ServoConfig().current_limit_a, load_model(model).max_current_a)
        overrides += [f"servo.model={model}", f"servo.current_limit_a={limit_a}"]
    config = load_config(path, overrides)
    with gf.open_gripper(config, log=tmp_path / "run.mcap") as gripper:
        target_n = min(wanted_n, gripper.largest_force_n)
        result = gripper.grasp(target_n)
        held_ns = gripper.state.t_ns
        gripper.release()
    assert result.outcome == "held"
    assert result.force_n == pytest.approx(target_n, abs=max(0.04 * target_n, 0.1))
    records = list(LogReader(tmp_path / "run.mcap").records(GraspStatus, LoadCellSample))
    statuses = [record for record in records if isinstance(record, GraspStatus) and record.t_ns <= held_ns]
    samples = [record for record in records if isinstance(record, LoadCellSample)]
    # Uncalibrated: the scene's friction and torque constant differ from the believed ones by up to 30 % and 8 %.
    settled_ns = next(status.t_ns for status in statuses if status.phase == Phase.HOLD) + NS_PER_S // 2
    held_n = np.median([sample.force_n for sample in samples if settled_ns < sample.t_ns < held_ns])
    assert held_n == pytest.approx(result.force_n, abs=3 * result.std_n)
    assert max(sample.force_n for sample in samples) < 1.05 * config.control.force_limit_n
    speeds_m_s = [
        (before.width_m - after.width_m) / 2 / ((after.t_ns - before.t_ns) * 1e-9)
        for before, after in pairwise(statuses[::5])
    ]
    assert max(speeds_m_s) < 1.5 * config.control.approach_speed_m_s
