from typing import get_args
from xml.etree import ElementTree

import numpy as np
import pytest

from gripper_force.config import GripperConfig
from gripper_force.errors import ConfigError
from gripper_hw.sim.engine import mujoco
from gripper_hw.sim.meshes import Detail
from gripper_hw.sim.objects import BLOCK_WIDTH_M, GAUGES, OBJECTS, PADS_ONLY, build_object
from gripper_hw.sim.scene import Scene, scene_mjcf

DETAILS = get_args(Detail)
RADIUS_M = GripperConfig().pinion_radius_m


def model_of(name: str, detail: str = "coarse", size: float = 1.0, stiffness: float = 1.0) -> mujoco.MjModel:
    scene = Scene(name, detail, size=size, stiffness=stiffness)
    return mujoco.MjModel.from_xml_string(*scene_mjcf(scene, GripperConfig()))


def press(model: mujoco.MjModel, data: mujoco.MjData, force_n: float, time_s: float) -> tuple[float, float]:
    """Closes slowly with a constant torque. Returns travel of the right jaw in m, and grip force in N.

    Without friction only the object resists in the end, so the grip force equals the motor's force.
    """
    data.ctrl[0] = 2 * force_n * RADIUS_M
    model.dof_frictionloss[:] = 0
    model.dof_damping[model.joint("servo").dofadr] = force_n * RADIUS_M / 0.8
    end_s = data.time + time_s
    while data.time < end_s:
        mujoco.mj_step(model, data)
    return float(data.joint("right").qpos[0]), float(np.mean(np.abs(data.sensordata[[1, 5]])))


@pytest.mark.parametrize("name", sorted(OBJECTS.keys() - PADS_ONLY))
def test_rods_press_and_release_a_rotated_object(name: str) -> None:
    scene = Scene(name, "coarse", "rods", yaw_deg=34, offset_m=(0.0015, 0.003))
    model = mujoco.MjModel.from_xml_string(*scene_mjcf(scene, GripperConfig()))
    data = mujoco.MjData(model)
    forces_n = []
    for torque_nm in (0.4, -0.4):
        data.ctrl[0] = torque_nm
        end_s = data.time + 1.0
        while data.time < end_s:
            mujoco.mj_step(model, data)
        forces_n.append(float(np.mean(np.abs(data.sensordata[[1, 5]]))))
    assert forces_n[0] == pytest.approx(0.4 / 2 / RADIUS_M, abs=2.5)  # less what friction takes
    assert forces_n[1] == 0


@pytest.mark.parametrize("name", PADS_ONLY)
def test_rods_are_refused_for_objects_they_would_dent(name: str) -> None:
    with pytest.raises(ConfigError, match="rods would dent the simulated ball beyond its model"):
        scene_mjcf(Scene(name, "coarse", "rods"), GripperConfig())


def travel_m(name: str, size: float = 1.0, stiffness: float = 1.0) -> float:
    """Travel of the jaws from 0.5 N to 4 N."""
    model = model_of(name, "medium" if name in ("paper_cup", "sponge") else "coarse", size, stiffness)
    data = mujoco.MjData(model)
    (start_m, _), (end_m, _) = (
        press(model, data, force_n, time_s) for force_n, time_s in ((0.5, 1.4), (4.0, 0.8))
    )
    return end_m - start_m


@pytest.mark.parametrize("detail", DETAILS)
@pytest.mark.parametrize("name", OBJECTS)
def test_untouched_object_does_not_move(name: str, detail: str) -> None:
    model = model_of(name, detail)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    shape = np.concatenate([data.flexvert_xpos.ravel(), data.xpos.ravel()])
    for _ in range(8):
        mujoco.mj_step(model, data)
    moved = np.concatenate([data.flexvert_xpos.ravel(), data.xpos.ravel()]) - shape
    assert np.abs(moved).max() < 4e-4
    assert not any(warning.number for warning in data.warning)
    assert float(data.sensordata[1]) == 0.0


@pytest.mark.parametrize("name", OBJECTS)
def test_finer_level_costs_no_less(name: str) -> None:
    models = [model_of(name, detail) for detail in DETAILS]
    cost = [model.nv / model.opt.timestep for model in models]
    assert cost == sorted(cost)
    assert cost[0] < cost[2]
    steps = [model.opt.timestep for model in models]
    assert steps == sorted(steps, reverse=True)


@pytest.mark.parametrize("name", OBJECTS)
def test_grip_force_equals_motor_force(name: str) -> None:
    model = model_of(name)
    closed_m, force_n = press(model, mujoco.MjData(model), 3.0, 1.5)
    assert force_n == pytest.approx(3.0, abs=0.1)
    assert 0.005 < closed_m < 0.04


@pytest.mark.parametrize("name", sorted(OBJECTS.keys() - GAUGES))
def test_size_does_not_change_stiffness_and_stiffness_scales_force(name: str) -> None:
    usual_m = travel_m(name)
    for size in (0.96, 1.04):
        assert travel_m(name, size=size) == pytest.approx(usual_m, rel=0.06)
    assert 0.94 < travel_m(name, stiffness=1.05) / usual_m < 0.975


@pytest.mark.parametrize("tool", ["pads", "rods"])
@pytest.mark.parametrize("detail", DETAILS)
def test_block_has_its_width_and_gives_exact_force(detail: str, tool: str) -> None:
    scene = Scene("block", detail, tool, yaw_deg=4, offset_m=(0.0015, 0.003))
    model = mujoco.MjModel.from_xml_string(*scene_mjcf(scene, GripperConfig()))
    model.dof_frictionloss[:] = 0
    data = mujoco.MjData(model)
    widths_m, forces_n = [], []
    for asked_n in (3.0, 10.0, 3.0):
        data.ctrl[0] = 2 * asked_n * RADIUS_M
        model.dof_damping[model.joint("servo").dofadr] = asked_n * RADIUS_M / 0.8
        end_s = data.time + 1.6
        while data.time < end_s:
            mujoco.mj_step(model, data)
            forces_n.append(float(np.mean(np.abs(data.sensordata[[1, 5]]))))
        assert forces_n[-1] == pytest.approx(asked_n, abs=0.01)
        widths_m.append(GripperConfig().open_width_m - 2 * float(data.joint("right").qpos[0]))
    assert max(forces_n) < 10.5
    assert all(BLOCK_WIDTH_M - 0.002 < width_m < BLOCK_WIDTH_M for width_m in widths_m)  # tips give way


def test_no_tetrahedron_of_ball_is_flat() -> None:
    text = ElementTree.fromstring(build_object("ball", "fine", 1.0, 1.0).body)
    points = np.array(text.attrib["point"].split(), float).reshape(-1, 3)
    corners = points[np.array(text.attrib["element"].split(), int).reshape(-1, 4)]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert volumes.min() > 0.2 * np.median(volumes)
    assert volumes.sum() == pytest.approx(4 / 3 * np.pi * 0.024**3, rel=0.04)
