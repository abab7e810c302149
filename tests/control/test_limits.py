import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_force.config import ControlConfig, GripperConfig
from gripper_force.control.limits import Limits, largest_target_n, rounded_down
from gripper_force.control.transmission import Transmission
from gripper_force.errors import NonFiniteError
from gripper_force.types import ServoCommand

COARSE = Transmission.from_config(GripperConfig(), 1.78, 0.00269)
FINE = replace(COARSE, current_step_a=0.0)
CONFIG = ControlConfig()

numbers = st.floats(allow_nan=False, allow_infinity=False)
cycles = st.lists(
    st.tuples(
        numbers,
        numbers,
        st.floats(-5, 30),
        numbers,
        numbers,
        st.floats(0, 0.05),
        st.booleans(),
        st.booleans(),
    ),
    min_size=1,
    max_size=40,
)


@settings(deadline=None, max_examples=200)
@given(
    cycles,
    st.sampled_from([COARSE, FINE]),
    st.floats(0.01, 3.0),
    st.sampled_from([CONFIG.ramp_n_s, 1e4]),  # the first one alone hardly reaches the other limits
)
def test_no_output_ever_leaves_the_limits(cycles, transmission, limit_a, ramp_n_s):
    limits = Limits(ControlConfig(ramp_n_s=ramp_n_s), transmission, limit_a)
    last_a = 0.0
    for position_rad, current_a, force_n, friction_n, motor_force_n, dt_s, may_rise, opens in cycles:
        wanted = ServoCommand(0, position_rad, current_a)
        out, over = limits.apply(
            wanted, force_n, friction_n, motor_force_n, 0.0, dt_s, may_rise=may_rise, opening=opens
        )
        believed_n = min(max(friction_n, 0.0), 2 * transmission.friction_n)
        cap_n = 1.05 * CONFIG.force_limit_n / transmission.torque_constant_bound + believed_n
        cap_a = min(limit_a, cap_n / transmission.n_per_a(0.0))
        assert 0.0 <= out.goal_current_a <= cap_a
        low, high = transmission.goal_range_rad
        assert out.goal_position_rad == min(max(position_rad, low), high)
        assert over == (force_n > CONFIG.force_limit_n)
        if (over and not opens) or not may_rise:
            assert out.goal_current_a <= last_a
        if over and not opens and motor_force_n > CONFIG.force_limit_n - friction_n:
            assert out.goal_current_a <= 0.85 * last_a
        # An output is off by at most one step from what it rounds: half of it is the carried rounding error.
        rise_a = 4 * ramp_n_s / transmission.n_per_a(0.0) * dt_s + 2 * transmission.current_step_a
        assert out.goal_current_a <= last_a + rise_a + 1e-12
        last_a = out.goal_current_a


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", range(6))
def test_non_finite_is_refused(bad, where):
    values = [0.0] * 6
    values[where] = bad
    names = ("goal position", "goal current", "force estimate", "friction estimate", "motor force")
    name = (*names, "servo position")[where]
    with pytest.raises(NonFiniteError, match=name):
        Limits(CONFIG, FINE, 1.0).apply(
            ServoCommand(0, values[0], values[1]),
            values[2],
            values[3],
            values[4],
            values[5],
            0.005,
            may_rise=True,
        )


@settings(deadline=None)
@given(st.floats(0.01, 0.2))
def test_rounding_keeps_the_mean_current(wanted_a):
    limits = Limits(CONFIG, COARSE, 1.0)
    given_a = []
    for _ in range(600):
        out, _ = limits.apply(ServoCommand(0, 0.0, wanted_a), 0.0, 0.95, 0.0, 0.0, 0.05, may_rise=True)
        given_a.append(out.goal_current_a)
    tail = given_a[-500:]
    assert sum(tail) / 500 == pytest.approx(wanted_a, abs=COARSE.current_step_a / 400)
    assert all(abs(a / COARSE.current_step_a - round(a / COARSE.current_step_a)) < 1e-6 for a in tail)


def test_a_carried_rounding_error_never_makes_the_current_negative():
    step_a = COARSE.current_step_a
    for half_steps in range(1, 26, 2):
        limits = Limits(CONFIG, COARSE, 1.0)
        for wanted_a in (half_steps / 2 * step_a, 0.0):
            wanted = ServoCommand(0, 0.0, wanted_a)
            out, _ = limits.apply(wanted, 0.0, 0.95, 0.0, 0.0, 0.05, may_rise=True)
        assert out.goal_current_a >= 0.0


def test_over_force_halves_within_five_cycles():
    limits = Limits(CONFIG, FINE, 1.0)
    wanted = ServoCommand(0, 0.0, 0.2)
    for _ in range(100):
        limits.apply(wanted, 5.0, 0.95, 6.0, 0.0, 0.005, may_rise=True)
    for _ in range(5):
        out, over = limits.apply(wanted, 15.0, 0.95, 16.0, 0.0, 0.005, may_rise=True)
    assert over
    assert out.goal_current_a < 0.1


@pytest.mark.parametrize("closing_sign", [-1, 1])
def test_a_grip_whose_friction_is_unknown_rises_with_the_ramp(closing_sign):
    risen_n = []
    for rises_slowly in (False, True):
        limits = Limits(CONFIG, replace(FINE, closing_sign=closing_sign), 1.0)
        for _ in range(4):
            out, _ = limits.apply(
                ServoCommand(0, 0.0, 1.0),
                0.0,
                0.0,
                0.0,
                0.0,
                0.005,
                may_rise=True,
                rises_slowly=rises_slowly,
            )
        risen_n.append(FINE.force_n(out.goal_current_a, 0.0))
    assert risen_n == pytest.approx([4 * CONFIG.ramp_n_s * 0.02, CONFIG.ramp_n_s * 0.02], abs=0.02)


@settings(deadline=None)
@given(st.floats(1.0, 2.0), st.floats(0.0, 1.0), st.floats(0.0, 1.5), st.floats(2.0, 60.0))
def test_ceiling_keeps_the_force_limit_for_any_torque_constant(bound, share, believed_n, limit_n):
    gain = 1.0 + share * (bound - 1.0)
    rig = replace(FINE, torque_constant_bound=bound)
    ceiling_a = Limits(ControlConfig(force_limit_n=limit_n), rig, 99.0).ceiling_a(believed_n, 0.0)
    friction_n = gain * believed_n  # measured in free travel, with the believed torque constant
    assert gain * rig.force_n(ceiling_a, 0.0) - friction_n <= 1.05 * limit_n


def test_friction_beyond_what_the_rig_may_have_does_not_raise_the_ceiling():
    limits = Limits(CONFIG, FINE, 99.0)
    most_n = (1 + 3 * FINE.friction_std) * FINE.friction_n
    assert limits.ceiling_a(0.0, 0.0) < limits.ceiling_a(0.9 * most_n, 0.0) < limits.ceiling_a(most_n, 0.0)
    assert limits.ceiling_a(10 * most_n, 0.0) == limits.ceiling_a(most_n, 0.0)
    assert limits.ceiling_a(-1.0, 0.0) == limits.ceiling_a(0.0, 0.0)


def test_current_that_caused_an_over_force_is_not_reached_again():
    limits = Limits(CONFIG, FINE, 1.0)
    wanted = ServoCommand(0, 0.0, 0.2)

    def run(force_n, cycles=100):
        return [
            limits.apply(wanted, force_n, 0.95, force_n + 1, 0.0, 0.005, may_rise=True)[0].goal_current_a
            for _ in range(cycles)
        ]

    assert run(5.0)[-1] == pytest.approx(0.2)
    low_a = run(15.0, 3)[-1]
    assert low_a < 0.15
    # It comes back with the force ramp only.
    assert run(5.0, 1)[0] - low_a == pytest.approx(CONFIG.ramp_n_s * 0.005 / FINE.n_per_a(0.0))
    assert run(5.0)[-1] == pytest.approx(0.95 * 0.2)
    limits.reset()
    assert run(5.0)[-1] == pytest.approx(0.2)


def test_a_force_over_its_limit_does_not_lower_the_current_of_jaws_that_open():
    limits, wanted = Limits(CONFIG, FINE, 1.0), ServoCommand(0, 0.0, 0.2)
    for force_n in (5.0, 15.0):
        for _ in range(100):
            out, _ = limits.apply(wanted, force_n, 0.95, 16.0, 0.0, 0.005, may_rise=True, opening=True)
        assert out.goal_current_a == pytest.approx(0.2)


def test_rounding_errors_do_not_add_up_while_a_limit_holds_the_current_down():
    step_a = COARSE.current_step_a
    limits = Limits(CONFIG, COARSE, 10.9 * step_a)
    for _ in range(400):
        out, _ = limits.apply(ServoCommand(0, 0.0, 5.0), 0.0, 0.95, 0.0, 0.0, 0.005, may_rise=True)
    assert out.goal_current_a == pytest.approx(10 * step_a)  # the servo would round 10.9 steps up
    out, _ = limits.apply(ServoCommand(0, 0.0, 5 * step_a), 0.0, 0.95, 0.0, 0.0, 0.005, may_rise=True)
    assert out.goal_current_a <= 6 * step_a


def test_force_kept_up_by_friction_does_not_lower_the_current_further():
    limits = Limits(CONFIG, FINE, 1.0)
    for _ in range(100):
        limits.apply(ServoCommand(0, 0.0, 0.2), 5.0, 0.95, 6.0, 0.0, 0.005, may_rise=True)
    for _ in range(50):
        out, over = limits.apply(ServoCommand(0, 0.0, 0.3), 14.1, 0.95, 13.0, 0.0, 0.005, may_rise=True)
    assert over
    assert out.goal_current_a == pytest.approx(0.95 * 0.2)


@pytest.mark.parametrize(("current_limit_a", "holds"), [(0.1, True), (3.0, False)])
def test_the_current_limit_is_told_from_other_limits(current_limit_a, holds):
    limits = Limits(CONFIG, FINE, current_limit_a)
    for _ in range(400):
        out, _ = limits.apply(ServoCommand(0, 0.0, 5.0), 1.0, 0.95, 6.0, 0.0, 0.005, may_rise=True)
    assert limits.is_at_current_limit is holds
    assert out.goal_current_a <= current_limit_a


def test_the_largest_target_leaves_room_below_the_limit():
    assert largest_target_n(10.0, 1.0) == pytest.approx(9.0)
    assert largest_target_n(14.0, 1.4) == pytest.approx(9.0)


def test_a_motor_that_draws_more_than_its_goal_does_not_return_to_an_over_force():
    limits, limit_n = Limits(CONFIG, FINE, 3.0), CONFIG.force_limit_n

    def goal_a(motor_force_n, force_n=1.0):
        wanted = ServoCommand(0, 0.0, 0.05)
        return limits.apply(wanted, force_n, 0.0, motor_force_n, 0.0, 0.05, may_rise=True)[0].goal_current_a

    for _ in range(5):
        before_a = goal_a(4.0)
    assert goal_a(limit_n + 1.0, limit_n + 0.5) < before_a  # the motor gives more than the goal of 0.05 A
    low_a = goal_a(0.95 * (limit_n + 1.0))
    assert goal_a(0.95 * (limit_n + 1.0)) == low_a
    assert goal_a(0.5 * limit_n) > low_a
    limits.reset()
    assert goal_a(0.95 * (limit_n + 1.0)) > low_a


@pytest.mark.parametrize("reverses", [False, True])
def test_the_motor_force_of_opening_jaws_that_are_to_close_rises_from_zero(reverses):
    limits, wanted = Limits(CONFIG, FINE, 1.0), ServoCommand(0, 0.0, 0.1)
    for _ in range(100):
        limits.apply(wanted, 0.0, 0.95, 0.0, 0.0, 0.005, may_rise=True)
    limits.reset(reverses=reverses)
    first_a = limits.apply(wanted, 0.0, 0.95, 0.0, 0.0, 0.005, may_rise=True)[0].goal_current_a
    rise_a = 4 * CONFIG.ramp_n_s * 0.005 / FINE.n_per_a(0.0)
    assert first_a == pytest.approx(rise_a if reverses else 0.1)


@given(st.floats(0.01, 900.0))
def test_a_force_in_a_message_is_not_above_the_largest_one(force_n):
    assert force_n - 0.0011 <= float(rounded_down(force_n)) <= force_n
