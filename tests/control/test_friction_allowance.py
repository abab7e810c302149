"""Friction that a command may count on."""

import math

import pytest

from gripper_force.config import ControlConfig
from gripper_force.control.friction_allowance import FrictionAllowance

SPEED_M_S = 0.01


@pytest.fixture
def allowance(transmission):
    """Open jaws whose friction no motion has shown, with a force limit below it."""
    allowance = FrictionAllowance(ControlConfig(force_limit_n=0.8), transmission)
    allowance.start_phase(from_open=True)
    return allowance


def close(allowance, time_s, closing_m_s=0.0):
    for _ in range(round(time_s / 0.005)):
        allowance.update(0.005, closing_m_s, SPEED_M_S, closing=True)


def closing_n(allowance):
    return allowance.allowance_n(0.95, opening=False, closing=True, gripping=False)


@pytest.mark.parametrize("closing_m_s", [0.0, 0.3 * SPEED_M_S])
def test_open_jaws_come_loose_with_the_configured_friction_for_a_while(allowance, closing_m_s):
    close(allowance, 0.25, closing_m_s)
    assert closing_n(allowance) == 0.95
    close(allowance, 0.1, closing_m_s)
    assert closing_n(allowance) == 0.0
    # From now on the ceiling of the current counts on no friction.
    assert allowance.max_closing_force_n(closing=True, approaching=False) == math.inf


def test_jaws_that_have_moved_and_stop_are_in_contact(allowance):
    close(allowance, 0.1, SPEED_M_S)
    close(allowance, 0.045)
    assert closing_n(allowance) == 0.95
    close(allowance, 0.02)
    assert closing_n(allowance) == 0.0


def test_jaws_that_moved_in_an_earlier_phase_may_have_to_come_loose_again(allowance):
    close(allowance, 0.1, SPEED_M_S)
    allowance.update(0.005, 0.0, SPEED_M_S, closing=False)
    close(allowance, 0.2)
    assert closing_n(allowance) == 0.95


def test_another_phase_does_not_begin_the_time_anew(allowance):
    close(allowance, 0.35)
    allowance.start_phase(from_open=True)
    allowance.update(0.005, 0.0, SPEED_M_S, closing=False)
    close(allowance, 0.005)
    assert closing_n(allowance) == 0.0
    allowance.end_stuck()
    close(allowance, 0.005)
    assert closing_n(allowance) == 0.95


def test_partly_closed_jaws_get_half_of_the_limit(allowance, transmission):
    allowance.start_phase(from_open=False)
    close(allowance, 0.005)
    assert closing_n(allowance) == 0.0
    most_n = allowance.max_closing_force_n(closing=True, approaching=True)
    assert most_n == pytest.approx(0.4 / transmission.torque_constant_bound)
    allowance.learn(0.3, only_lower=False)
    assert allowance.max_closing_force_n(closing=True, approaching=True) == math.inf


@pytest.mark.parametrize("limit_n", [0.8, 14.0])
def test_a_move_that_comes_loose_gets_half_of_the_limit_or_hardly_more_than_friction(transmission, limit_n):
    allowance = FrictionAllowance(ControlConfig(force_limit_n=limit_n), transmission)
    allowance.start_phase(from_open=True)
    close(allowance, 0.005)
    assert allowance.max_closing_force_n(closing=True, approaching=True) == math.inf
    most_n = allowance.max_closing_force_n(closing=True, approaching=False)
    half_n = 0.5 * limit_n / transmission.torque_constant_bound
    assert most_n == pytest.approx(max(half_n, transmission.friction_n + 0.1))


def test_open_jaws_in_contact_keep_the_motor_force_of_their_approach(allowance):
    assert allowance.max_closing_force_n(closing=False, approaching=False) == math.inf


def test_what_a_motion_shows_counts_from_then_on(allowance):
    allowance.learn(None, only_lower=False)
    assert allowance.shown_n == math.inf
    allowance.learn(0.4, only_lower=False)
    assert closing_n(allowance) == 0.4
    assert allowance.allowance_n(0.3, opening=True, closing=False, gripping=False) == 0.3
    allowance.learn(0.6, only_lower=True)  # the jaws may press on a soft object
    assert closing_n(allowance) == 0.4
    allowance.learn(0.6, only_lower=False)
    assert closing_n(allowance) == 0.6
    allowance.learn(0.5, only_lower=True)
    assert closing_n(allowance) == 0.5


def test_a_grip_counts_on_what_its_own_grasp_has_shown(allowance):
    allowance.learn(0.4, only_lower=False)
    allowance.start_grasp()
    gripping = {"opening": False, "closing": False, "gripping": True}
    assert allowance.allowance_n(0.95, **gripping) == 0.0
    assert closing_n(allowance) == 0.4
    allowance.learn(0.4, only_lower=False)
    assert allowance.allowance_n(0.95, **gripping) == 0.4


def test_an_opening_counts_on_the_configured_friction_until_one_is_shown(allowance):
    opening = {"opening": True, "closing": False, "gripping": False}
    assert allowance.allowance_n(0.95, **opening) == 0.95
    allowance.learn(0.4, only_lower=False)
    assert allowance.allowance_n(0.95, **opening) == 0.4
