import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.control.speed_limit import SpeedLimit
from gripper_force.qualification.loop_margin.analytic_plant import POSITION_LOOP, Gripper
from gripper_force.types import ServoCommand, ServoState

RADIUS_M = 0.020


def reading(position_rad=0.0, velocity_rad_s=0.0):
    return ServoState(0, position_rad, velocity_rad_s, 0.0, 30.0, 12.0, 0)


@pytest.mark.parametrize("speed_m_s", [0.005, 0.0125, 0.025, 0.05])
@pytest.mark.parametrize("current_a", [0.01, 0.05, 0.3])
@pytest.mark.parametrize("friction_n", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("direction", [-1, 1])
def test_speed_is_bounded_for_any_current_and_friction(
    transmission, speed_m_s, current_a, friction_n, direction
):
    limit = SpeedLimit(transmission, POSITION_LOOP)
    plant = Gripper(transmission, friction_n=friction_n, contact_m=1.0)
    fastest_m_s = 0.0
    for i in range(200):
        wanted = ServoCommand(0, direction * 100.0, current_a)
        plant.advance(limit.apply(wanted, plant.read(i, 0.0), speed_m_s), 0.005)
        fastest_m_s = max(fastest_m_s, abs(plant.v_m_s))
    # At a high current the lead is the one that the current needs.
    pressing_m_s = RADIUS_M * POSITION_LOOP.gain_per_s * 1.3 * current_a / POSITION_LOOP.a_per_rad
    assert fastest_m_s < max(1.45 * speed_m_s, 1.2 * pressing_m_s)


@pytest.mark.parametrize("current_a", [0.02, 0.1, 0.3])
def test_lead_never_lowers_the_current_of_jaws_at_rest(transmission, current_a):
    command = SpeedLimit(transmission, POSITION_LOOP).apply(ServoCommand(0, 9.0, current_a), reading(), 0.001)
    assert command.goal_position_rad * POSITION_LOOP.a_per_rad > 1.2 * current_a


def test_servo_brakes_above_the_speed(transmission):
    limit = SpeedLimit(transmission, POSITION_LOOP)
    fast = reading(0.5, 1.5 * 0.025 / RADIUS_M)
    assert limit.apply(ServoCommand(0, 2.0, 0.1), fast, 0.025).goal_position_rad == 0.5
    assert limit.apply(ServoCommand(0, 0.0, 0.1), fast, 0.025).goal_position_rad < 0.5
    assert limit.apply(ServoCommand(0, 2.0, 0.1), fast, 0.05).goal_position_rad > 0.5


def test_unknown_position_loop_has_a_lead_of_2_mm(transmission):
    command = SpeedLimit(transmission, None).apply(ServoCommand(0, 9.0, 0.1), reading(0.5), 0.025)
    assert command.goal_position_rad - 0.5 == pytest.approx(0.002 / RADIUS_M)


@given(
    goal_rad=st.floats(-5, 5),
    position_rad=st.floats(-5, 5),
    velocity_rad_s=st.floats(-10, 10),
    current_a=st.floats(0, 3),
)
def test_goal_lies_between_present_and_wanted_position(
    transmission, goal_rad, position_rad, velocity_rad_s, current_a
):
    limit = SpeedLimit(transmission, POSITION_LOOP)
    command = limit.apply(ServoCommand(7, goal_rad, current_a), reading(position_rad, velocity_rad_s), 0.025)
    low_rad, high_rad = sorted((goal_rad, position_rad))
    assert low_rad - 1e-12 <= command.goal_position_rad <= high_rad + 1e-12
    assert (command.t_ns, command.goal_current_a) == (7, current_a)
    assert math.isfinite(command.goal_position_rad)


def test_to_open_the_lead_goes_by_the_current_of_free_travel(transmission):
    limit = SpeedLimit(transmission, POSITION_LOOP)

    def lead_rad(goal_rad, *free_a):
        return abs(limit.apply(ServoCommand(0, goal_rad, 0.5), reading(), 0.001, *free_a).goal_position_rad)

    assert lead_rad(-9.0, 0.05) == pytest.approx(0.1 * lead_rad(-9.0), rel=0.2)
    assert lead_rad(9.0, 0.05) == lead_rad(9.0) == lead_rad(-9.0)
