"""Force after a trip of the servo's Bus Watchdog, for every reaction that firmware may have."""

from typing import Any

import pytest

import gripper_force as gf
from gripper_force.config import load_config
from gripper_force.types import NS_PER_MS, Phase
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.virtual import VirtualServo, find_bus
from gripper_hw.sim import simulated_rig
from gripper_hw.sim.world import World


@pytest.fixture
def worlds(monkeypatch: pytest.MonkeyPatch) -> list[World]:
    built: list[World] = []

    class NotedWorld(World):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            built.append(self)

    monkeypatch.setattr(simulated_rig, "World", NotedWorld)
    return built


@pytest.mark.parametrize("phase", [Phase.APPROACH, Phase.RAMP, Phase.HOLD])
@pytest.mark.parametrize("reaction", ["limp", "brake", "continue"])
def test_the_force_stays_within_its_limit_without_the_program(
    worlds: list[World], reaction: Any, phase: Phase
) -> None:
    config = load_config(
        None,
        ["object=stapler", "sim.detail=coarse", "camera.backend=none", "seed=4", "control.force_limit_n=12"],
    )
    with pytest.raises(gf.HardwareFaultError, match="watchdog tripped"), gf.open_gripper(config) as gripper:
        bus = find_bus("rig")
        assert bus is not None
        bus.servos[0].on_watchdog = reaction
        gripper.grasp(7.0, wait=False)
        while gripper.state.phase != phase:
            gripper.step()
        (world,) = worlds
        forces_n = []
        for _ in range(200):  # the program is gone for two seconds
            world.advance_to(world.t_ns + 10 * NS_PER_MS)
            forces_n.append(world.force_n)
        assert bus.servos[0].tripped
        assert max(forces_n) < 1.05 * config.control.force_limit_n
        gripper.step()


def test_a_homing_offset_can_make_the_motor_run_away() -> None:
    """The defect of DynamixelSDK issue 584, of which `doctor` warns."""
    servo = VirtualServo(1, load_model("XM430-W350"))
    servo.on_watchdog = "run away"
    for name, value in {"homing_offset": 100, "operating_mode": 5, "goal_current": 100}.items():
        servo.set(name, value)
    servo.set("torque_enable", 1)
    servo.set("bus_watchdog", 1)
    servo.feed_watchdog(0)
    position_rad = 0.0
    for i in range(200):
        current_a = servo.control(i * 5 * NS_PER_MS, position_rad, 0.0)
        position_rad += 0.01 * (current_a > 0.05) - 0.01 * (current_a < -0.05)
    assert servo.tripped
    assert position_rad < -0.5
