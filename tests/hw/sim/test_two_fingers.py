"""Grasps with two servos, one per finger, in the simulated world: forces and speeds of each finger, and faults."""

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import gripper_force as gf
from gripper_calibration.procedures.calibrate_jaws import calibrate_jaws
from gripper_calibration.procedures.calibrate_servo import calibrate_servo
from gripper_force.config import Config, SimConfig, load_config
from gripper_force.errors import ConfigError, GripperError, HardwareFaultError
from gripper_force.profiles.rig_profile import RigProfile, ServoCalibration, read_rig
from gripper_force.runtime.resolve import resolve
from gripper_force.schema import dump
from gripper_force.types import NS_PER_MS, NS_PER_S
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus
from gripper_hw.sim import simulated_rig
from gripper_hw.sim.scene import draw_scene, draw_second_finger
from gripper_hw.sim.world import World

EXAMPLE = Path(__file__).parents[3] / "examples/grippers/two_servos.yaml"
CHEAP = ("object=block", "sim.detail=coarse", "camera.backend=none")
RACKS = ("servo.second.id=2", "gripper.friction_n=1.7", "gripper.damping_n_s_m=27")
"""Each servo drives a rack by a pinion."""

RADIUS_M = 0.020


@dataclass
class Trace:
    """The world of a run, and every 5 ms time, closing angles, angular speeds and contact forces of both fingers."""

    world: World
    rows: list[tuple[float, ...]]
    bus: VirtualBus | None = None

    def column(self, *columns: int) -> npt.NDArray[np.float64]:
        return np.array(self.rows)[:, columns]

    @property
    def torque(self) -> list[int]:
        assert self.bus is not None
        return [servo.get("torque_enable") for servo in self.bus.servos]

    @property
    def apart_rad(self) -> npt.NDArray[np.float64]:
        return np.abs(np.diff(self.column(1, 2), axis=1)[:, 0])


@pytest.fixture
def trace(monkeypatch: pytest.MonkeyPatch) -> Trace:
    found = Trace.__new__(Trace)

    class Traced(World):
        def __init__(self, *args: Any, **keys: Any) -> None:
            super().__init__(*args, **keys)
            found.world, found.rows, found.bus = self, [], None
            self.call_every(5 * NS_PER_MS, self._note)

        def _note(self, t_ns: int) -> None:
            data = self._data
            found.bus = found.bus or find_bus("rig")
            angles_rad = [float(data.qpos[drive.qpos]) for drive in self._drives]
            speeds_rad_s = [float(data.qvel[drive.dof]) for drive in self._drives]
            forces_n = [abs(float(data.sensordata[at])) for at in (self._right, self._left)]
            found.rows.append((t_ns / NS_PER_S, *angles_rad, *speeds_rad_s, *forces_n))

    monkeypatch.setattr(simulated_rig, "World", Traced)
    return found


def config_of(*sets: str) -> Config:
    return load_config(None, [*CHEAP, *RACKS, *sets])


def fix_object(trace: Trace, x_m: float) -> None:
    """Screws the block to the table beside the middle."""
    model = trace.world._model
    joint = model.joint("self_centre")
    model.jnt_stiffness[joint.id], model.dof_damping[joint.dofadr[0]] = 2e4, 200.0
    model.body("object").pos[0] = x_m


# Force and speed.


@pytest.mark.parametrize(("name", "seed"), [("block", 0), ("block", 1), ("sponge", 4)])
def test_fingers_stay_in_step_and_press_a_free_object_alike(trace: Trace, name: str, seed: int) -> None:
    """The drawn friction of the fingers differs by up to 50 %."""
    config = config_of(f"object={name}", f"seed={seed}")
    with gf.open_gripper(config) as gripper:
        assert gripper.grasp(3.0).outcome == "held"
        held_n = np.array(trace.column(5, 6)[-100:])
        gripper.release()
    assert trace.torque == [0, 0]
    assert np.median(held_n, axis=0) == pytest.approx([3.0, 3.0], abs=0.6)
    assert trace.apart_rad.max() < 0.2
    closing = trace.column(3, 4)[trace.column(5, 6).max(axis=1) == 0]
    assert RADIUS_M * closing.max() < 1.5 * config.control.approach_speed_m_s


def test_two_rotary_fingers_beside_the_middle_hold_by_their_linkage(trace: Trace) -> None:
    with gf.open_gripper(load_config(EXAMPLE, [*CHEAP, "seed=2"])) as gripper:
        fix_object(trace, 0.003)
        assert gripper.grasp(5.0).outcome == "held"
        held_n = trace.column(5, 6)[-100:]
        gripper.release()
    assert np.median(held_n, axis=0) == pytest.approx([5.0, 5.0], abs=0.75)


@pytest.mark.parametrize(("seed", "x_m"), [(0, 0.0), (2, 0.002), (0, -0.004)])
def test_a_fixed_object_beside_the_middle_is_pressed_by_both_alike(
    trace: Trace, x_m: float, seed: int
) -> None:
    """The first finger waits at the object with the force of the approach, and the other one comes to it."""
    config = config_of(f"seed={seed}")
    with gf.open_gripper(config) as gripper:
        fix_object(trace, x_m)
        assert gripper.grasp(5.0).outcome == "held"
        gripper.release()
    forces_n = trace.column(5, 6)
    both = int(np.argmax(forces_n.min(axis=1) > 0))  # the first time
    assert forces_n[:both].max() < 3.0  # the impact, which friction keeps
    # Motors and friction of the fingers differ by up to 8 % and 0.7 N.
    assert forces_n.max(axis=0) == pytest.approx([5.0, 5.0], abs=1.0)
    assert RADIUS_M * trace.column(3, 4)[:both].max() < 1.5 * config.control.approach_speed_m_s


def test_a_held_object_resists_pushes_beyond_friction(trace: Trace) -> None:
    """Friction of both fingers is 3.5 N."""
    with gf.open_gripper(config_of("seed=1")) as gripper:
        gripper.grasp(5.0)
        before_rad = trace.column(1, 2)[-1]
        world = trace.world
        body = int(world._model.joint("self_centre").id)
        for push_n in (6.0, -6.0):
            world._data.xfrc_applied[int(world._model.jnt_bodyid[body]), 0] = push_n
            for _ in range(200):
                gripper.step()
            assert np.abs(trace.column(1, 2)[-1] - before_rad).max() * RADIUS_M < 0.0025
            assert gripper.step().outcome == "held"


# Faults.


@pytest.mark.parametrize(("joint", "target_n"), [("servo", 0.5), ("second_servo", 5.0)])
def test_a_blocked_finger_is_a_fault_and_never_a_grip(trace: Trace, joint: str, target_n: float) -> None:
    with (
        pytest.raises(HardwareFaultError, match="max_difference_rad"),
        gf.open_gripper(config_of("seed=1")) as gripper,
    ):
        model = trace.world._model
        model.dof_frictionloss[model.joint(joint).dofadr[0]] = 20.0
        gripper.grasp(target_n)
    assert trace.torque == [0, 0]
    assert trace.column(5, 6).max() == 0


def test_a_wrong_direction_is_a_fault(trace: Trace) -> None:
    sets = ("seed=1", "servo.second.mirrored=false")
    with pytest.raises(GripperError), gf.open_gripper(config_of(*sets)) as gripper:
        gripper.grasp(5.0)
    assert trace.torque == [0, 0]
    assert trace.column(5, 6).max() == 0


@pytest.mark.parametrize(
    ("id_", "kind", "on_fault"),
    [
        *((id_, kind, "hold") for id_ in (1, 2) for kind in ("off", "stuck", "wrong", "intermittent")),
        (1, "wrong", "limp"),
    ],
)
def test_a_fault_of_one_servo_ends_with_torque_off_or_no_current_on_both(
    trace: Trace, id_: int, kind: str, on_fault: str
) -> None:
    """One finger alone cannot hold, whatever the configuration says."""
    fault = f"faults=[{{unit: servo, kind: {kind}, id: {id_}, at_s: 2.6}}]"
    ends_well = (kind, on_fault) == ("wrong", "limp")
    with (
        nullcontext() if ends_well else pytest.raises(GripperError),
        gf.open_gripper(config_of("seed=1", fault, f"control.on_fault={on_fault}")) as gripper,
    ):
        gripper.grasp(5.0)
        for _ in range(100):
            result = gripper.step()
        assert result.outcome == "fault"
        assert trace.bus is not None
        assert [servo.get("goal_current") for servo in trace.bus.servos] == [0, 0]
    bus = trace.bus
    assert bus is not None
    live = [servo for servo in bus.servos if not (kind in ("off", "intermittent") and servo.id == id_)]
    assert all(not servo.get("torque_enable") or not servo.get("goal_current") for servo in live)
    assert trace.column(5, 6).max() < 6.0


# The scene and the calibrations.


def test_the_second_finger_has_a_motor_of_its_own() -> None:
    config = SimConfig(detail="coarse")
    scene = draw_scene("block", 3, config)
    second = draw_second_finger(scene, 3, config)
    assert second == draw_second_finger(scene, 3, config) != scene
    assert (second.nm_per_a, second.servo_friction_nm) != (scene.nm_per_a, scene.servo_friction_nm)
    assert (second.size, second.lux, second.offset_m) == (scene.size, scene.lux, scene.offset_m)
    exact = SimConfig(detail="coarse", randomise=False)
    scene = draw_scene("block", 3, exact)
    assert draw_second_finger(scene, 3, exact) == scene


def test_calibrate_jaws_finds_the_mean_friction() -> None:
    seed = 2
    config = config_of("object=none", f"seed={seed}", "gripper.open_width_m=0.06")
    result = calibrate_jaws(config, prompt=lambda text: None)
    scene = draw_scene("none", seed, config.sim)
    both = (scene, draw_second_finger(scene, seed, config.sim))
    true_n = np.mean([one.servo_friction_nm / RADIUS_M + one.jaw_friction_n for one in both])
    assert result.closing_sign == 1
    assert result.friction_n == pytest.approx(true_n, rel=0.15)


def test_calibrate_servo_refuses_two(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="two servos do not stay in step"):
        calibrate_servo(config_of(), [0.03], tmp_path / "rig.yaml", prompt=lambda text: None)


def test_a_rig_profile_of_one_servo_is_refused(tmp_path: Path, servo_calibration: ServoCalibration) -> None:
    """Its torque constant is half of that of both."""
    rig = tmp_path / "rig.yaml"
    rig.write_text(dump(RigProfile(servo=servo_calibration)))
    assert read_rig(rig).servo is not None
    with pytest.raises(ConfigError, match="made with servo XM430-W350, not two XM430-W350"):
        resolve(config_of(f"calibration.rig={rig}"))
