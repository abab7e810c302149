import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_force.config import ControlConfig, GripperConfig
from gripper_force.control.force_loop import ForceLoop, loop_gains, tolerance_n
from gripper_force.types import FusedForce


def estimate(force_n, bias_n=0.0, source="fused"):
    return FusedForce(0, force_n, 0.05, force_n - bias_n, bias_n, GripperConfig().friction_n, source)


def ramp(loop, target_n, bias_n=0.0):
    while loop.reference_n != target_n:
        motor_force_n = loop.step(0.005, target_n, estimate(loop.reference_n, bias_n))
    return motor_force_n


@pytest.fixture
def loop(transmission):
    loop = ForceLoop(ControlConfig(), transmission)
    loop.start(0.5, 4.0)
    return loop


def test_a_hold_with_the_motor_current_is_integral_and_slower():
    hold, vision = (loop_gains(ControlConfig(), vision_alone=alone) for alone in (False, True))
    assert hold.proportional == 0 < vision.proportional
    assert hold.integral_s < vision.integral_s


def test_vision_alone_is_never_faster_than_for_the_nominal_plant():
    def gains(**plant):
        return loop_gains(ControlConfig(feedback="vision", **plant), vision_alone=True)

    cautious = gains()
    assert gains(plant_lag_ms=165, plant_delay_ms=28) == cautious
    assert gains(plant_delay_ms=90).integral_s < cautious.integral_s
    assert gains(plant_lag_ms=25).proportional < cautious.proportional
    assert gains(plant_gain=2.0).integral_s == cautious.integral_s / 2


def test_ramp_subtracts_the_bias(loop, transmission):
    assert ramp(loop, 4.0, bias_n=0.3) == pytest.approx(4.0 + transmission.friction_n - 0.3)


def test_hold_ignores_a_small_error(loop):
    motor_force_n = ramp(loop, 4.0)
    for error_n in (0.2, -0.4):
        for _ in range(50):
            held_n = loop.step(0.005, 4.0, estimate(4.0 - error_n * tolerance_n(4.0)))
        assert held_n == pytest.approx(motor_force_n)


def test_hold_integrates_a_missing_force(loop):
    motor_force_n = ramp(loop, 4.0)
    for _ in range(100):
        raised_n = loop.step(0.005, 4.0, estimate(3.8))
    gain = loop_gains(ControlConfig(), vision_alone=False).integral_s
    assert raised_n - motor_force_n == pytest.approx(0.5 * 0.2 * gain)


def test_too_much_force_reverses_the_motor_force_within_friction(loop, transmission):
    motor_force_n = ramp(loop, 4.0)
    turned_n = loop.step(0.005, 4.0, estimate(4.1))
    assert turned_n == pytest.approx(motor_force_n - 0.75 * transmission.friction_n, abs=0.01)
    assert loop.step(0.005, 4.0, estimate(4.03)) == turned_n
    assert loop.step(0.005, 4.0, estimate(3.9)) == pytest.approx(motor_force_n, abs=0.02)


@pytest.mark.parametrize("feedback", ["fused", "current", "vision"])
@settings(max_examples=15)
@given(forces_n=st.lists(st.floats(-100, 100), min_size=5, max_size=5), target_n=st.floats(0.1, 12))
def test_no_estimate_drives_the_motor_force_out_of_its_plausible_range(
    transmission, feedback, forces_n, target_n
):
    loop = ForceLoop(ControlConfig(feedback=feedback), transmission)
    loop.start(0.0, target_n)
    for force_n in forces_n:
        for _ in range(200):
            motor_force_n = loop.step(0.05, target_n, estimate(force_n, bias_n=force_n))
            margin_n = 3 * transmission.bias_std_n(loop.reference_n) + transmission.friction_n
            assert abs(motor_force_n - loop.reference_n) <= margin_n * (1 + 1e-9)


@pytest.mark.parametrize(("seen_n", "then_n", "side"), [(0.0, 4.2, -1), (100.0, 3.8, 1)])
def test_however_long_an_error_lasts_its_opposite_takes_effect_at_once(
    loop, transmission, seen_n, then_n, side
):
    ramp(loop, 4.0)
    for _ in range(1000):
        before_n = loop.step(0.05, 4.0, estimate(seen_n))
    change_n = loop.step(0.005, 4.0, estimate(then_n)) - before_n
    assert side * change_n == pytest.approx(0.75 * transmission.friction_n, abs=0.05)


def test_retarget_starts_at_the_present_reference(loop, transmission):
    ramp(loop, 4.0)
    loop.retarget(2.0)
    assert loop.reference_n == 4.0
    loop.retarget(6.0)
    assert ramp(loop, 6.0) == pytest.approx(6.0 + transmission.friction_n)


def test_lower_targets_within_the_tolerance_add_up_before_the_jaws_open(loop):
    ramp(loop, 4.0)
    lowered = []
    for target_n in (3.95, 3.9, 3.86, 3.8):
        loop.retarget(target_n)
        loop.step(0.005, target_n, estimate(4.0))
        lowered.append(loop.is_lowering)
    assert lowered == [False, False, False, True]


def test_a_first_ramp_that_lowers_takes_a_still_lower_target(loop):
    loop.start(1.5, 1.0)
    for _ in range(5):
        loop.step(0.005, 1.0, estimate(1.4))
    loop.retarget(0.8)
    for _ in range(400):
        loop.step(0.005, 0.8, estimate(1.3))
        assert loop.reference_n >= 0.8
    assert loop.reference_n == 0.8


def test_the_ramp_is_not_faster_than_the_force_limit_allows(transmission):
    def rise_n_s(**keys):
        loop = ForceLoop(ControlConfig(**keys), transmission)
        loop.start(0.0, 9.0)
        values = [loop.step(0.005, 9.0, estimate(0.0)) and loop.reference_n for _ in range(400)]
        return max(np.diff(values)) / 0.005

    assert rise_n_s(force_limit_n=1.0, ramp_n_s=1e4) == pytest.approx(10.0, rel=0.01)
    assert rise_n_s(force_limit_n=10.0, ramp_n_s=8.0) == pytest.approx(8.0, rel=0.01)


def test_lowering_falls_below_friction_and_returns(loop, transmission):
    ramp(loop, 4.0)
    loop.retarget(2.0)
    forces_n, lowered = [], []
    for _ in range(100):
        forces_n.append(loop.step(0.005, 2.0, estimate(loop.reference_n)))
        lowered.append(loop.is_lowering)
    assert min(forces_n) == pytest.approx(2.0 - transmission.friction_n, abs=0.25)
    assert forces_n[-1] == pytest.approx(2.0 + transmission.friction_n)
    assert lowered.index(False) * 0.005 < 0.4
    assert not any(lowered[lowered.index(False) :])


@pytest.mark.parametrize(("left_n", "falls"), [(0.05, 1), (0.3, 2), (-0.3, 1)])
def test_lowering_that_leaves_too_much_force_is_repeated_once(loop, left_n, falls):
    ramp(loop, 4.0)
    loop.retarget(2.0)
    lowered = []
    for _ in range(200):
        left = left_n if not loop.is_lowering else max(left_n, 0.0)
        loop.step(0.005, 2.0, estimate(loop.reference_n + left, source="current"))
        lowered.append(loop.is_lowering)
    starts = [now and not before for before, now in zip([False, *lowered], lowered, strict=False)]
    shows_again = [now < before for before, now in zip([False, *lowered], lowered, strict=False)]
    assert lowered[0]
    assert sum(starts) == sum(shows_again) == 1
    assert sum(lowered) * 0.005 == pytest.approx(0.35 if falls == 1 else 0.5, abs=0.03)


@pytest.mark.parametrize("outlier_n", [8.0, 15.0])
def test_one_visual_outlier_at_the_end_of_a_lowering_changes_nothing(transmission, outlier_n):
    loop = ForceLoop(ControlConfig(feedback="vision"), transmission)
    loop.start(0.5, 4.0)
    ramp(loop, 4.0)
    loop.retarget(2.0)
    was_lowering = True
    for _ in range(100):
        ends = was_lowering and not loop.is_lowering
        was_lowering = loop.is_lowering
        seen_n = outlier_n if loop.is_lowering or ends else 2.0
        loop.step(0.005, 2.0, estimate(seen_n, source="vision"))
    assert not loop.is_lowering
    assert loop.reference_n == 2.0


@pytest.mark.parametrize("closing_m_s", [-0.05, -1.0])
def test_a_lowering_ends_whatever_the_measured_speed(loop, closing_m_s):
    ramp(loop, 4.0)
    loop.retarget(2.0)
    for _ in range(300):
        loop.step(0.005, 2.0, estimate(loop.reference_n), closing_m_s=closing_m_s)
    assert loop.reference_n == 2.0
    assert not loop.is_lowering


def test_a_lowering_waits_while_the_jaws_open_fast(loop):
    ramp(loop, 4.0)
    loop.retarget(2.0)
    for _ in range(10):
        loop.step(0.005, 2.0, estimate(loop.reference_n), closing_m_s=-0.02)
    before_n = loop.reference_n
    for _ in range(10):
        loop.step(0.005, 2.0, estimate(loop.reference_n), closing_m_s=-0.05)
    assert 2.0 < loop.reference_n == before_n < 4.0


def test_ramp_and_integral_wait_while_the_motor_force_falls_short(loop):
    loop.start(0.5, 4.0)
    for _ in range(20):
        loop.step(0.005, 4.0, estimate(loop.reference_n), shortfall_n=0.0)
    before_n = loop.reference_n
    for _ in range(20):
        loop.step(0.005, 4.0, estimate(loop.reference_n), shortfall_n=before_n)
    assert loop.reference_n == before_n
    held_n = ramp(loop, 4.0)
    assert loop.step(0.005, 4.0, estimate(3.0), shortfall_n=2.0) == pytest.approx(held_n)


def test_vision_alone_waits_for_the_ramp(transmission):
    loop = ForceLoop(ControlConfig(feedback="vision"), transmission)
    loop.start(0.5, 4.0)
    assert ramp(loop, 4.0, bias_n=0.5) == pytest.approx(4.0 + transmission.friction_n)
    motor_force_n = loop.step(0.005, 4.0, estimate(3.8, source="vision"))
    gains = loop_gains(ControlConfig(feedback="vision"), vision_alone=True)
    assert motor_force_n == pytest.approx(
        4.0 + transmission.friction_n + 0.2 * (gains.proportional + 0.005 * gains.integral_s)
    )
