from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import ControlConfig
from gripper_force.control.current_estimate import CurrentEstimate, combined_variance_n2
from gripper_force.types import NS_PER_MS, ServoState

CYCLE_NS = 5 * NS_PER_MS


@pytest.fixture
def press(transmission):
    """Feeds an estimate with cycles of constant motor force, and returns it."""
    current = CurrentEstimate(ControlConfig(), transmission)
    t_ns = 0

    def feed(motor_force_n, cycles=200, *, closing_m_s=0.0, free=False, holding=False, lowering=False):
        nonlocal t_ns
        velocity_rad_s = closing_m_s / transmission.closing_m_s(1.0, 0.0)
        current_a = transmission.current_a(motor_force_n + transmission.damping_n_s_m * closing_m_s, 0.0)
        for _ in range(cycles):
            servo = ServoState(t_ns, 0.0, velocity_rad_s, current_a, 30.0, 12.0, 0)
            current.step(servo, free=free, holding=holding, lowering=lowering)
            t_ns += CYCLE_NS
        return current

    return feed


def test_the_force_stays_until_the_motor_force_differs_by_friction(press, transmission):
    friction_n = transmission.friction_n
    assert press(3.0 + friction_n).force_n == pytest.approx(3.0, abs=0.01)
    assert press(3.0).force_n == pytest.approx(3.0, abs=0.01)
    assert press(3.0 - 0.9 * friction_n).reversal == pytest.approx(0.95, abs=0.01)
    assert press(2.0 - friction_n).force_n == pytest.approx(2.0, abs=0.01)
    assert press(2.0 - friction_n).reversal == pytest.approx(1.0, abs=0.01)


def test_jaws_that_slide_in_a_hold_have_lost_their_object(press, transmission):
    motor_force_n = transmission.friction_n
    press(3.0 + motor_force_n)
    assert press(motor_force_n, holding=True).force_n > 2 * motor_force_n - 0.01
    assert press(motor_force_n, closing_m_s=0.02).force_n > 2 * motor_force_n - 0.01
    assert press(motor_force_n, holding=True, closing_m_s=0.02).force_n == pytest.approx(0.0, abs=0.01)


def test_jaws_that_slide_slowly_have_lost_it_if_the_force_limit_makes_them_slow(transmission):
    for limit_n, slides in ((14.0, False), (1.0, True)):
        current = CurrentEstimate(ControlConfig(force_limit_n=limit_n), transmission)
        velocity_rad_s = 0.003 / transmission.closing_m_s(1.0, 0.0)
        current_a = transmission.current_a(transmission.friction_n, 0.0)
        current.force_n = 2 * transmission.friction_n
        current.step(
            ServoState(0, 0.0, velocity_rad_s, current_a, 30.0, 12.0, 0),
            free=False,
            holding=True,
            lowering=False,
        )
        assert (current.force_n < 0.1) == slides


def test_a_lowered_force_is_followed_with_less_lag(press, transmission):
    steady_n = press(3.0 + transmission.friction_n).force_n
    followed_n = press(-transmission.friction_n, cycles=3, lowering=True).force_n
    assert followed_n < 0.5 * steady_n


def test_free_travel_shows_friction_until_the_next_grasp(press, transmission):
    nominal_n, nominal_n2 = transmission.friction_n, press(1.5, cycles=1).friction_variance_n2
    current = press(1.5, free=True)
    assert current.force_n == current.reversal == 0.0
    assert current.friction_n == pytest.approx(1.5, abs=0.02)
    assert current.friction_variance_n2 < nominal_n2
    assert current.free_travel.mean_n == pytest.approx(1.5, abs=0.2)
    current.restart()
    assert (current.friction_n, current.friction_variance_n2) == (nominal_n, nominal_n2)
    assert current.free_travel.mean_n is None
    for taken_n, kept_n in ((0.7, 0.7), (-0.1, 0.0)):
        current.take_friction(taken_n)
        assert current.friction_n == kept_n


def test_a_reading_from_the_past_changes_nothing(transmission):
    current = CurrentEstimate(ControlConfig(), transmission)
    for t_ns, current_a in ((10 * CYCLE_NS, 0.1), (0, 0.3)):
        servo = ServoState(t_ns, 0.0, 0.0, current_a, 30.0, 12.0, 0)
        current.step(servo, free=False, holding=False, lowering=False)
    assert current.dt_s == 0.0
    assert current.force_n == pytest.approx(transmission.force_n(0.1, 0.0) - transmission.friction_n)


def test_no_friction_leaves_no_play(transmission):
    current = CurrentEstimate(ControlConfig(), replace(transmission, friction_n=0.0))
    servo = ServoState(0, 0.0, 0.0, transmission.current_a(2.0, 0.0), 30.0, 12.0, 0)
    current.step(servo, free=False, holding=False, lowering=False)
    assert current.force_n == pytest.approx(2.0)
    assert current.reversal == 0.0


def test_past_forces_are_interpolated_and_held_beyond_both_ends(press, transmission):
    press(transmission.friction_n + 1.0, cycles=1)
    current = press(transmission.friction_n + 2.0, cycles=1)
    assert current.at(0) == current.at(-CYCLE_NS) == pytest.approx(1.0)
    assert current.at(CYCLE_NS) == current.at(2 * CYCLE_NS) == current.force_n > 1.0
    assert current.at(CYCLE_NS // 2) == pytest.approx((1.0 + current.force_n) / 2)


@given(st.floats(-20, 20), st.floats(-20, 20))
def test_the_variance_grows_with_the_force(transmission, one_n, other_n):
    current = CurrentEstimate(ControlConfig(), transmission)
    smaller_n, larger_n = sorted((one_n, other_n), key=abs)
    assert 0 < current.variance_n2(smaller_n) <= current.variance_n2(larger_n)


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))
def test_combined_estimates_are_at_least_as_certain_as_either(one_n2, other_n2):
    combined_n2 = combined_variance_n2(one_n2, other_n2)
    assert 0 < combined_n2 <= min(one_n2, other_n2) * (1 + 1e-12)
