"""A grip whose jaws somebody pulls open, for both current loops that firmware may have (decision 21)."""

from itertools import pairwise

import pytest

import gripper_force as gf
from gripper_force.config import load_config
from gripper_force.types import Phase
from gripper_hw.dynamixel.virtual import VirtualServo, find_bus

CYCLES_PER_S = 200


def read(gripper: gf.Gripper, servo: VirtualServo, cycles: int) -> list[tuple[float, float, float]]:
    """Steps, and returns time, width and the motor current beyond its goal in each cycle."""
    steps = []
    for _ in range(cycles):
        gripper.step()
        excess = abs(servo.get("present_current")) - servo.get("goal_current")
        steps.append((gripper.state.t_ns * 1e-9, gripper.state.width_m, excess * servo.model.current_unit_a))
        assert gripper.state.phase != Phase.FAULT, gripper.state.reason
    return steps


@pytest.mark.parametrize("reverses_voltage", [True, False])
def test_a_pull_is_no_fault_of_the_motor(reverses_voltage: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(None, ["object=stapler", "sim.detail=coarse", "camera.backend=none", "seed=4"])
    with gf.open_gripper(config) as gripper:
        bus = find_bus("rig")
        assert bus is not None
        servo = bus.servos[0]
        servo.reverses_voltage = reverses_voltage
        assert gripper.grasp(3.0).outcome == "held"
        held_m = gripper.state.width_m
        torque_nm = 8.0 * 2 * config.gripper.pinion_radius_m
        drive = servo.control
        with (
            monkeypatch.context() as pulled
        ):  # the world turns the returned current into a torque at the horn
            pulled.setattr(servo, "control", lambda *now: drive(*now) - torque_nm / servo.model.nm_per_a)
            pull = read(gripper, servo, CYCLES_PER_S // 4)
        after = read(gripper, servo, CYCLES_PER_S)
    assert pull[-1][1] > held_m + 0.001
    assert (max(excess_a for _, _, excess_a in pull[10:]) > 0.04) == (not reverses_voltage)
    speeds_m_s = [(a[1] - b[1]) / 2 / (b[0] - a[0]) for a, b in pairwise(after[::5])]
    assert max(speeds_m_s) < 1.5 * config.control.approach_speed_m_s
