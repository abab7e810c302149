import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_force.config import GripperConfig, load_config
from gripper_force.qualification.loop_margin.analytic_plant import (
    CURRENT_STEP_A,
    Gripper,
    SimulatedVision,
    transmission_of,
)
from gripper_force.types import NS_PER_MS, NS_PER_S, ServoCommand

RIG = transmission_of(GripperConfig())


def press(gripper: Gripper, motor_force_n: float, time_s: float = 3.0) -> Gripper:
    """Applies a constant motor force, far from the goal position."""
    goal_rad = RIG.position_rad(0.0)
    for _ in range(round(time_s / 0.005)):
        gripper.advance(ServoCommand(0, goal_rad, RIG.current_a(motor_force_n, 0.0)), 0.005)
    return gripper


@given(
    stiffness_n_m=st.floats(3e2, 1e6),
    motor_force_n=st.floats(3.0, 8.0),
    gain=st.floats(0.8, 1.2),
    play_m=st.floats(0, 1e-3),
)
@settings(max_examples=15, deadline=None)
def test_jaw_rests_where_motor_force_spring_and_friction_balance(
    stiffness_n_m: float, motor_force_n: float, gain: float, play_m: float
) -> None:
    gripper = press(
        Gripper(RIG, stiffness_n_m=stiffness_n_m, gain=gain, play_m=play_m, contact_m=0.005, step_a=0.0),
        motor_force_n,
    )
    assert abs(gripper.v_m_s) < 1e-6
    assert abs(gripper.force_n - gain * motor_force_n) <= gripper.friction_n + 1e-6
    assert gripper.peak_n >= gripper.force_n


def test_impact_is_that_of_a_mass_on_a_spring() -> None:
    gripper = Gripper(RIG, stiffness_n_m=1e5, friction_n=0.0, damping_n_s_m=0.0, play_m=0.0, contact_m=0.001)
    gripper.v_m_s = 0.025
    press(gripper, 0.0, 0.2)
    assert gripper.peak_n == pytest.approx(0.025 * math.sqrt(1.3e5), rel=0.02)


def test_play_delays_the_jaw_and_contact_keeps_the_teeth_engaged() -> None:
    gripper = press(Gripper(RIG, play_m=0.001, contact_m=0.005), 3.0)
    assert gripper.jaw_m == pytest.approx(gripper.x_m - 0.001)
    pressed_m = gripper.jaw_m
    press(gripper, 0.8)
    assert gripper.jaw_m == pytest.approx(gripper.x_m - 0.001)
    assert gripper.jaw_m < pressed_m


def test_goal_current_is_quantised() -> None:
    coarse, fine = (Gripper(RIG, step_a=step_a, friction_n=0.0, contact_m=0.0) for step_a in (0.01, 0.0))
    asked_a = 0.104
    for gripper in (coarse, fine):
        press(gripper, RIG.force_n(asked_a, 0.0))
    assert coarse.current_a == pytest.approx(0.10)
    assert fine.current_a == pytest.approx(asked_a)


def test_readings_are_quantised() -> None:
    gripper = Gripper(RIG, x_m=0.0123456, v_m_s=0.00777, current_a=0.0501)
    servo = gripper.read(7, 0.0)
    assert servo.t_ns == 7
    assert servo.current_a / CURRENT_STEP_A == pytest.approx(round(0.0501 / CURRENT_STEP_A))
    assert servo.position_rad == pytest.approx(0.0123456 / 0.02, abs=2 * math.pi / 4096)
    assert servo.velocity_rad_s == pytest.approx(0.00777 / 0.02, abs=0.012)


def test_vision_has_its_delay_and_returns_the_newest_estimate() -> None:
    vision = SimulatedVision(0.035, 0.0)
    seen = {t_ms: vision.sample(t_ms * NS_PER_MS, float(t_ms), 0.0) for t_ms in range(0, 200, 5)}
    first = next(visual for visual in seen.values() if visual is not None)
    assert (first.t_ns, first.ready_ns, first.force_n) == (0, 35 * NS_PER_MS, 0.0)
    frames = [visual for visual in seen.values() if visual is not None]
    assert len(frames) == pytest.approx(0.165 * 60, abs=1)
    assert all(visual.force_n == visual.t_ns / NS_PER_MS for visual in frames)
    late = vision.sample(NS_PER_S, 0.0, 0.0)
    assert late is not None
    assert late.seq == frames[-1].seq + 2


def test_stiffening_adds_a_quadratic_force() -> None:
    gripper = Gripper(RIG, stiffening_n_m2=1e5, contact_m=0.005, jaw_m=0.007, deepest_m=0.009)
    assert gripper.force_n == pytest.approx(1000.0 * 0.002 + 1e5 * 0.002**2)
    assert gripper.peak_n == pytest.approx(1000.0 * 0.004 + 1e5 * 0.004**2)
    linear, stiffening = (
        press(Gripper(RIG, stiffening_n_m2=quadratic, friction_n=0.0, contact_m=0.005), 4.0)
        for quadratic in (0.0, 1e5)
    )
    assert stiffening.jaw_m < linear.jaw_m
    assert stiffening.force_n == pytest.approx(linear.force_n, abs=0.05)


def test_motor_comes_to_rest_at_its_end_stops() -> None:
    gripper = press(Gripper(RIG, contact_m=1.0, stops_m=(0.0, 0.02)), 5.0)
    assert (gripper.x_m, gripper.v_m_s) == (0.02, 0.0)
    gripper = press(Gripper(RIG, contact_m=-0.01, stiffness_n_m=1e3, stops_m=(0.0, 0.02)), 0.0)
    assert (gripper.x_m, gripper.v_m_s) == (0.0, 0.0)


def test_visual_gain_and_a_new_delay_apply_to_the_next_frame() -> None:
    vision = SimulatedVision(0.0, 0.0, gain=1.5)
    first = vision.sample(0, 2.0, 0.0)
    assert first is not None
    assert first.force_n == 3.0
    vision.delay_s = 0.03
    assert vision.sample(20 * NS_PER_MS, 2.0, 0.0) is None
    late = vision.sample(50 * NS_PER_MS, 2.0, 0.0)
    assert late is not None
    assert late.t_ns == 20 * NS_PER_MS


def test_a_linkage_sets_travel_and_force_by_the_servo_angle() -> None:
    config = load_config(Path(__file__).parents[3] / "examples" / "grippers" / "viperx_aloha.yaml")
    rig = transmission_of(config.gripper)
    for travel_m in (0.005, 0.030):
        plant = Gripper(
            rig, x_m=travel_m, jaw_m=travel_m, friction_n=0.0, contact_m=travel_m, stiffness_n_m=1e5
        )
        position_rad = plant.read(0, 0.0).position_rad
        assert rig.width_m(position_rad) == pytest.approx(rig.open_width_m - 2 * travel_m, abs=2e-5)
        for _ in range(200):
            plant.advance(ServoCommand(0, position_rad + 0.5, 0.2), 0.005)
        assert plant.force_n == pytest.approx(0.2 * rig.n_per_a(position_rad), rel=0.03)
