import math

import pytest

from gripper_force.config import ControlConfig
from gripper_force.control.approach import Approach, ApproachState
from gripper_force.types import EstimateSource, FusedForce

START_M = 0.09
TRAVELLED_M = START_M - 0.002
SPEED_M_S = 0.025


def estimate(current_n=0.0, force_n=0.0, friction_n=0.95, source=EstimateSource.CURRENT):
    return FusedForce(0, force_n, 0.1, current_n, 0.0, friction_n, source)


@pytest.fixture
def approach(transmission):
    tested = Approach(ControlConfig(), transmission, max_m_s=0.025)
    tested.start(START_M, 4.0)
    return tested


def run(approach, cycles, width_m=START_M, closing_m_s=0.0, sensed=None, max_n=math.inf):
    """Steps with constant readings until the progress changes. Returns it."""
    before = ApproachState.BACKING_OFF if approach.is_backing_off else ApproachState.CLOSING
    for _ in range(cycles):
        progress = approach.step(
            0.005, width_m, closing_m_s, approach.motor_force_n, sensed or estimate(current_n=0.5), max_n
        )
        if progress is not before:
            return progress
    return before


def test_standstill_without_travel_backs_off_and_is_stuck(approach):
    assert run(approach, 50) is ApproachState.CLOSING
    assert run(approach, 40) is ApproachState.BACKING_OFF
    assert approach.back_off_width_m == pytest.approx(START_M + 0.004)
    assert run(approach, 110) is ApproachState.BACKING_OFF
    assert run(approach, 20) is ApproachState.STUCK


def test_a_back_off_has_the_motor_force_of_free_travel(approach, transmission):
    run(approach, 400)
    run(approach, 50)
    assert approach.motor_force_n == 0.5 + transmission.friction_n
    assert not approach.moves_freely(SPEED_M_S, approach.motor_force_n)


@pytest.mark.parametrize(("opened_m", "cycles"), [(0.0037, 1), (0.002, 120)])
def test_a_back_off_ends_once_it_is_wide_enough_or_late(approach, opened_m, cycles):
    run(approach, 400)
    if cycles > 1:
        assert run(approach, cycles - 10, START_M + opened_m) is ApproachState.BACKING_OFF
    assert run(approach, 10, START_M + opened_m) is ApproachState.CLOSING


def test_a_standstill_counts_only_at_the_largest_motor_force(approach):
    strong = estimate(friction_n=5.0)  # the motor force rises for seconds
    assert run(approach, 200, START_M, 0.0, strong) is ApproachState.CLOSING


@pytest.mark.parametrize(
    ("speed_share", "max_n", "progress"),
    [
        (0.3, 0.8, ApproachState.BACKING_OFF),
        (0.7, 0.8, ApproachState.CLOSING),
        (0.3, math.inf, ApproachState.CLOSING),
    ],
)
def test_jaws_that_creep_because_they_may_not_press_harder_back_off(approach, speed_share, max_n, progress):
    assert run(approach, 200, TRAVELLED_M, speed_share * SPEED_M_S, estimate(), max_n) is progress
    if progress is ApproachState.CLOSING:
        assert approach.motor_force_n <= max_n


def test_standstill_after_a_back_off_is_stuck(approach):
    assert run(approach, 400) is ApproachState.BACKING_OFF
    assert run(approach, 400, START_M + 0.004) is ApproachState.CLOSING
    assert run(approach, 400, START_M + 0.004) is ApproachState.STUCK


def test_standstill_after_travel_is_contact(approach):
    assert run(approach, 40, START_M - 0.001, 0.025, estimate()) is ApproachState.CLOSING
    assert run(approach, 40, START_M - 0.001) is ApproachState.CLOSING
    assert run(approach, 9, TRAVELLED_M) is ApproachState.CLOSING
    assert run(approach, 2, TRAVELLED_M) is ApproachState.CONTACT


def test_contact_after_a_back_off(approach):
    assert run(approach, 400) is ApproachState.BACKING_OFF
    assert run(approach, 400, START_M + 0.004) is ApproachState.CLOSING
    assert run(approach, 400, START_M) is ApproachState.CONTACT


def test_jaws_that_still_speed_up_are_not_in_contact(approach):
    seen = estimate(force_n=2.0, source=EstimateSource.FUSED)
    assert run(approach, 40, START_M - 0.002, 0.01, seen) is ApproachState.CLOSING
    assert run(approach, 1, START_M - 0.002, 0.025, seen) is ApproachState.CLOSING
    assert run(approach, 40, START_M - 0.003, 0.01, seen) is ApproachState.CONTACT


@pytest.mark.parametrize(
    ("speed_share", "sensed", "is_contact"),
    [
        (0.05, estimate(current_n=0.5), True),
        (0.5, estimate(current_n=0.5), False),  # not stalled, and nothing is seen
        (1.0, estimate(current_n=2.0), False),
        (0.0, estimate(), False),  # nothing presses
        (0.5, estimate(force_n=0.5, source=EstimateSource.FUSED), True),
        (0.5, estimate(force_n=0.3, source=EstimateSource.FUSED), False),
        (0.5, estimate(force_n=2.0), False),  # by motor current alone
        (1.0, estimate(force_n=2.0, source=EstimateSource.FUSED), False),
    ],
)
def test_signs_of_contact_count_only_together(approach, speed_share, sensed, is_contact):
    run(approach, 1, TRAVELLED_M, SPEED_M_S, estimate())
    found = run(approach, 100, TRAVELLED_M, speed_share * SPEED_M_S, sensed)
    assert found is (ApproachState.CONTACT if is_contact else ApproachState.CLOSING)


def test_jaws_that_follow_the_wanted_speed_get_friction_and_damping(approach, transmission):
    for cycle in range(1, 61):
        closing_m_s = SPEED_M_S * min(cycle * 0.005 / 0.1, 1.0)
        approach.step(0.005, START_M, closing_m_s, 0.0, estimate())
        usual_n = transmission.friction_n + transmission.damping_n_s_m * closing_m_s
        assert approach.motor_force_n == pytest.approx(usual_n)
    approach.step(0.005, START_M, SPEED_M_S - 0.005, 0.0, estimate())
    assert approach.motor_force_n - usual_n == pytest.approx(10.0 * 0.005, abs=0.002)
    for _ in range(20):
        approach.step(0.005, START_M, SPEED_M_S - 0.005, 0.0, estimate())
    assert approach.motor_force_n - usual_n == pytest.approx(10.0 * 0.005 + 40.0 * 0.005 * 0.1, abs=0.002)


def test_jaws_that_are_far_too_fast_are_never_pushed_back(approach):
    run(approach, 200, START_M, 4 * SPEED_M_S, estimate())
    assert approach.motor_force_n == pytest.approx(0.0, abs=1e-9)


def test_closed_jaws(approach):
    assert run(approach, 1, 0.0019, 0.025, estimate()) is ApproachState.CLOSED


def test_too_much_motor_force_decays_within_a_tenth_of_a_second(transmission):
    approach = Approach(ControlConfig(), transmission, max_m_s=0.025)
    approach.start(START_M, 4.0)
    run(approach, 40, START_M, 0.0, estimate(friction_n=5.0))
    strong_n = approach.motor_force_n
    run(approach, 5, START_M - 0.002, 0.035, estimate(friction_n=5.0))
    assert approach.motor_force_n > 0.4 * strong_n
    run(approach, 15, START_M - 0.002, 0.035, estimate(friction_n=5.0))
    assert approach.motor_force_n < 0.3 * strong_n


@pytest.mark.parametrize(("target_n", "contact_n"), [(1.0, 0.25), (4.0, 0.5)])
@pytest.mark.parametrize("closing_m_s", [-0.001, 0.0, 0.005])
def test_motor_force_rises_to_friction_damping_and_the_contact_limit(
    approach, transmission, target_n, contact_n, closing_m_s
):
    approach.set_target(target_n)
    most_n = 0.0
    for _ in range(400):
        approach.step(0.005, START_M, closing_m_s, 0.0, estimate())
        if approach.is_backing_off:
            break
        most_n = max(most_n, approach.motor_force_n)
    assert approach.is_backing_off == (closing_m_s <= 0)
    damping_n = transmission.damping_n_s_m * max(closing_m_s, 0.0)
    assert most_n == pytest.approx(0.95 + 2 * 0.1 + contact_n + damping_n)


@pytest.mark.parametrize(("target_n", "speed_m_s"), [(1.0, 0.010), (2.0, 0.020), (8.0, 0.025)])
def test_small_targets_are_approached_slowly(transmission, target_n, speed_m_s):
    approach = Approach(ControlConfig(), transmission, max_m_s=0.025)
    approach.start(START_M, target_n)
    assert approach.speed_m_s == pytest.approx(speed_m_s)


def test_free_motion_needs_steady_speed_and_force(approach):
    run(approach, 39, START_M - 0.001, 0.025, estimate())
    assert not approach.moves_freely(0.025, approach.motor_force_n)  # too early
    run(approach, 21, START_M - 0.001, 0.025, estimate())
    for speed_m_s, is_free in ((0.019, False), (0.022, True), (0.025, True), (0.031, False)):
        assert approach.moves_freely(speed_m_s, approach.motor_force_n) == is_free
    approach.step(0.005, START_M - 0.001, 0.025, approach.motor_force_n + 1.0, estimate())  # noise
    assert approach.moves_freely(0.025, approach.motor_force_n)
    for difference_n, is_free in (
        (-1.0, True),
        (0.2, True),
        (1.0, False),
    ):  # the speed limit keeps the motor force low
        for _ in range(30):
            approach.step(0.005, START_M - 0.001, 0.025, approach.motor_force_n + difference_n, estimate())
        assert approach.moves_freely(0.025, approach.motor_force_n) == is_free
