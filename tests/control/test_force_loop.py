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


def lower(loop, target_n, seen_n=0.0, source="fused"):
    """Lowers the force, and sees ``seen_n`` beside the reference. Returns the first motor force at rest."""
    loop.retarget(target_n)
    motor_force_n = 0.0
    while loop.is_lowering:
        motor_force_n = loop.step(0.005, target_n, estimate(loop.reference_n + seen_n, source=source))
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


def test_hold_integrates_a_missing_force_that_the_camera_sees(loop):
    motor_force_n = ramp(loop, 4.0)
    for _ in range(100):
        raised_n = loop.step(0.005, 4.0, estimate(3.8))
    gain = loop_gains(ControlConfig(), vision_alone=False).integral_s
    assert raised_n - motor_force_n == pytest.approx(0.5 * 0.2 * gain)
    for _ in range(100):
        by_current_n = loop.step(0.005, 4.0, estimate(3.8, source="current"))
    assert by_current_n == raised_n


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
            assert motor_force_n >= 0.0


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
        ramp(loop, target_n)
    assert lowered == [False, False, False, True]
    lower(loop, 2.0)
    loop.retarget(1.95)  # they count from the newest lowering on
    assert not loop.is_lowering


@pytest.mark.parametrize(("target_n", "error_n"), [(1.0, 0.1), (10.0, 0.4)])
def test_the_tolerance_is_4_percent_and_at_least_100_mn(target_n, error_n):
    assert tolerance_n(target_n) == pytest.approx(error_n)


def test_a_ramp_starts_softly_and_keeps_its_speed_towards_a_newer_target(loop):
    for _ in range(20):
        loop.step(0.005, 4.0, estimate(0.5))
    assert loop.reference_n - 0.5 == pytest.approx(0.5 * 8.0 / 0.4 * 0.1**2, abs=0.01)
    strides_n = []
    for target_n in (4.0, 5.0, 0.3):
        loop.retarget(target_n)
        before_n = loop.reference_n
        loop.step(0.005, target_n, estimate(0.5))
        strides_n.append(loop.reference_n - before_n)
    assert 0.01 < strides_n[0] < strides_n[1]
    assert -0.003 < strides_n[2] < 0.0  # the other direction begins at rest


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


@pytest.mark.parametrize(
    ("left_n", "source", "falls"),
    [
        (0.05, "current", 1),
        (0.12, "current", 2),
        (0.12, "fused", 1),
        (0.3, "current", 2),
        (0.3, "fused", 2),
        (-0.3, "current", 1),
    ],
)
def test_lowering_that_leaves_too_much_force_is_repeated_once(loop, left_n, source, falls):
    ramp(loop, 4.0)
    loop.retarget(2.0)
    lowered = []
    for _ in range(200):
        left = left_n if not loop.is_lowering else max(left_n, 0.0)
        loop.step(0.005, 2.0, estimate(loop.reference_n + left, source=source))
        lowered.append(loop.is_lowering)
        if not loop.is_lowering and len(lowered) > 120:
            break  # later the camera may repeat it
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
    while loop.is_lowering:
        before_n = loop.reference_n
        loop.step(0.005, 2.0, estimate(outlier_n, source="vision"))
        assert loop.reference_n <= before_n
    for seen_n in (outlier_n, *[2.0] * 50):
        loop.step(0.005, 2.0, estimate(seen_n, source="vision"))
        assert not loop.is_lowering
        assert loop.reference_n == 2.0


@pytest.mark.parametrize(("outlier_n", "from_n"), [(2.5, 2.5), (9.0, 4.0)])
def test_a_second_lowering_does_not_begin_above_the_first_one(loop, outlier_n, from_n):
    ramp(loop, 4.0)
    loop.retarget(2.0)
    references_n = [loop.reference_n]
    while loop.reference_n <= references_n[-1]:
        references_n.append(loop.reference_n)
        loop.step(0.005, 2.0, estimate(outlier_n if len(references_n) > 30 else 2.0, source="current"))
    assert loop.reference_n == pytest.approx(from_n, abs=0.05)


@pytest.mark.parametrize(
    ("share", "source", "every", "after_s", "is_repeated"),
    [
        (0.8, "fused", 1, 0.0, True),
        (0.8, "vision", 1, 0.0, True),
        (70.0, "fused", 1, 0.0, True),
        (0.7, "fused", 1, 0.0, False),
        (0.8, "current", 1, 0.0, False),
        (0.8, "fused", 20, 0.0, False),  # not for long enough
        (0.8, "fused", 1, 1.0, False),  # something else than the lowering
    ],
)
def test_a_lowering_is_repeated_if_the_camera_sees_too_much_force(
    loop, share, source, every, after_s, is_repeated
):
    ramp(loop, 4.0)
    lower(loop, 2.0, seen_n=0.08)  # during the lowering it does not count
    seen_n = [2.0] * round(after_s / 0.005)
    seen_n += [2.0 if i % every == 1 else 2.0 + share * tolerance_n(2.0) for i in range(300)]
    starts = []
    for i, force_n in enumerate(seen_n):
        was_lowering = loop.is_lowering
        loop.step(0.005, 2.0, estimate(force_n, source=source))
        if loop.is_lowering and not was_lowering:
            starts.append(i)
            assert 2.0 < loop.reference_n <= min(force_n, 4.0)
    assert starts == ([pytest.approx(100, abs=2)] if is_repeated else [])


def test_too_much_force_before_a_lowering_does_not_count_after_it(loop):
    ramp(loop, 4.0)
    for target_n in (2.0, 1.0):
        lower(loop, target_n)
        for _ in range(90):
            loop.step(0.005, target_n, estimate(target_n + 0.08))
            assert not loop.is_lowering


@pytest.mark.parametrize("how", ["start", "retarget"])
def test_too_much_force_after_a_rise_starts_no_lowering(loop, how):
    ramp(loop, 4.0)
    lower(loop, 2.0)
    loop.start(2.0, 3.0) if how == "start" else loop.retarget(3.0)
    ramp(loop, 3.0)
    for _ in range(300):
        loop.step(0.005, 3.0, estimate(3.0 + 0.9 * tolerance_n(3.0)))
        assert not loop.is_lowering


def test_the_integral_waits_until_a_lowering_has_settled(loop, transmission):
    ramp(loop, 4.0, bias_n=0.3)  # the bias of the larger force does not count, either
    motor_n = [lower(loop, 2.0, seen_n=-0.5)]
    motor_n += [loop.step(0.005, 2.0, estimate(1.5)) for _ in range(40)]
    assert motor_n[:-2] == pytest.approx([2.0 + transmission.friction_n] * 39)
    one_cycle_n = 0.5 * 0.005 * loop_gains(ControlConfig(), vision_alone=False).integral_s
    assert motor_n[-1] - motor_n[-2] == pytest.approx(one_cycle_n)
    assert motor_n[-1] > motor_n[0]


@pytest.mark.parametrize("closing_m_s", [-0.05, -1.0])
def test_a_lowering_ends_whatever_the_measured_speed(loop, closing_m_s):
    ramp(loop, 4.0)
    for begin in (lambda: loop.retarget(2.0), lambda: loop.retarget(1.0), lambda: loop.start(3.0, 2.0)):
        begin()
        start_n, target_n = loop.reference_n, round(loop.reference_n / 2)
        for cycle in range(300):
            loop.step(0.005, target_n, estimate(loop.reference_n), closing_m_s=closing_m_s)
            if cycle == 195:
                assert loop.reference_n == start_n
        assert loop.reference_n == target_n
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


@pytest.mark.parametrize(("shortfall_n", "waits"), [(0.5, False), (0.7, True)])
def test_a_shortfall_of_a_fifth_and_200_mn_does_not_count(loop, shortfall_n, waits):
    while loop.reference_n < 2.0:
        loop.step(0.005, 4.0, estimate(loop.reference_n))
    before_n = loop.reference_n
    loop.step(0.005, 4.0, estimate(before_n), shortfall_n=shortfall_n)
    assert (loop.reference_n == before_n) == waits


def test_vision_alone_begins_each_grasp_without_the_trim_of_the_last_one(transmission):
    loop = ForceLoop(ControlConfig(feedback="vision"), transmission)
    for _ in range(2):
        loop.start(0.5, 4.0)
        assert ramp(loop, 4.0) == pytest.approx(4.0 + transmission.friction_n)
        for _ in range(100):
            loop.step(0.005, 4.0, estimate(3.8, source="vision"))


def test_vision_alone_waits_for_the_ramp(transmission):
    loop = ForceLoop(ControlConfig(feedback="vision"), transmission)
    loop.start(0.5, 4.0)
    assert ramp(loop, 4.0, bias_n=0.5) == pytest.approx(4.0 + transmission.friction_n)
    motor_force_n = loop.step(0.005, 4.0, estimate(3.8, source="vision"))
    gains = loop_gains(ControlConfig(feedback="vision"), vision_alone=True)
    assert motor_force_n == pytest.approx(
        4.0 + transmission.friction_n + 0.2 * (gains.proportional + 0.005 * gains.integral_s)
    )
