import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import ControlConfig
from gripper_force.control.speed_limit import SpeedLimit, hold_speed_m_s
from gripper_force.qualification.loop_margin.analytic_plant import POSITION_LOOP, Gripper
from gripper_force.types import ServoCommand, ServoState

RADIUS_M = 0.020


def reading(position_rad=0.0, velocity_rad_s=0.0, current_a=0.0):
    return ServoState(0, position_rad, velocity_rad_s, current_a, 30.0, 12.0, 0)


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
    rests = reading(current_a=0.7 * current_a)  # a hot motor, or the supply voltage, may lower it
    command = SpeedLimit(transmission, POSITION_LOOP).apply(ServoCommand(0, 9.0, current_a), rests, 0.001)
    assert command.goal_position_rad * POSITION_LOOP.a_per_rad > 1.2 * current_a


@pytest.mark.parametrize("direction", [-1, 1])
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_blocked_jaws_come_to_their_goal_current(transmission, direction, share):
    # The servo may draw less at the same lead than its data say.
    limit, current_a = SpeedLimit(transmission, POSITION_LOOP), 0.0
    for _ in range(20):
        command = limit.apply(ServoCommand(0, direction * 9.0, 0.5), reading(current_a=current_a), 0.005)
        drawn_a = share * command.goal_position_rad * POSITION_LOOP.a_per_rad
        current_a = math.copysign(min(abs(drawn_a), 0.5), drawn_a)
    assert direction * current_a == pytest.approx(min(0.5, 1.3 * share * 0.5))


@pytest.mark.parametrize("current_a", [0.0, -0.1, 0.1])
def test_jaws_that_nothing_resists_do_not_get_the_lead_of_a_grip(transmission, current_a):
    # The brake has just stopped them. With the lead of the goal current they were too fast in every second cycle.
    command = SpeedLimit(transmission, POSITION_LOOP).apply(
        ServoCommand(0, 9.0, 0.5), reading(current_a=current_a), 0.01
    )
    assert RADIUS_M * POSITION_LOOP.gain_per_s * command.goal_position_rad == pytest.approx(1.3 * 0.01)


@pytest.mark.parametrize("way", [-1, 1])
def test_servo_brakes_above_the_speed(transmission, way):
    limit = SpeedLimit(transmission, POSITION_LOOP)
    fast = reading(0.5, way * 1.5 * 0.025 / RADIUS_M)

    def lead_rad(goal_rad, speed_m_s):
        command = ServoCommand(0, 0.5 + way * goal_rad, 0.1)
        return way * (limit.apply(command, fast, speed_m_s).goal_position_rad - 0.5)

    assert lead_rad(1.5, 0.025) == 0.0
    assert lead_rad(-0.5, 0.025) < 0.0
    assert lead_rad(1.5, 0.05) > 0.0


def test_unknown_position_loop_has_a_lead_of_2_mm(transmission):
    command = SpeedLimit(transmission, None).apply(ServoCommand(0, 9.0, 0.1), reading(0.5), 0.025)
    assert command.goal_position_rad - 0.5 == pytest.approx(0.002 / RADIUS_M)


@pytest.mark.parametrize("current_a", [-0.1, 0.1])
def test_jaws_may_stop_short_of_their_goal_by_the_lead_that_friction_needs(transmission, current_a):
    short_m = SpeedLimit(transmission, POSITION_LOOP).rest_error_m(current_a, 0.0)
    assert short_m == pytest.approx(2 * RADIUS_M * 1.3 * 0.1 / POSITION_LOOP.a_per_rad)
    assert SpeedLimit(transmission, None).rest_error_m(current_a, 0.0) == 0.0


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


def test_to_open_the_lead_does_not_go_by_the_current_of_the_grip(transmission):
    grips, wanted = reading(current_a=0.5), ServoCommand(0, -9.0, 0.5)
    command = SpeedLimit(transmission, POSITION_LOOP).apply(wanted, grips, 0.001)
    assert RADIUS_M * POSITION_LOOP.gain_per_s * command.goal_position_rad == pytest.approx(-1.3 * 0.001)


def test_a_hold_is_slower_with_a_small_force_limit(transmission):
    assert hold_speed_m_s(ControlConfig(), transmission) == 0.0125
    assert (
        hold_speed_m_s(ControlConfig(force_limit_n=1.0), transmission) == transmission.impact_m_s(1.0) < 0.004
    )
