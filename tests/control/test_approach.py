import pytest

from gripper_force.config import ControlConfig
from gripper_force.control.approach import Approach, ApproachState
from gripper_force.types import EstimateSource, FusedForce

START_M = 0.09


def estimate(current_n=0.0, force_n=0.0, friction_n=0.95, source=EstimateSource.CURRENT):
    return FusedForce(0, force_n, 0.1, current_n, 0.0, friction_n, source)


@pytest.fixture
def approach(transmission):
    tested = Approach(ControlConfig(), transmission, max_m_s=0.025)
    tested.start(START_M, 4.0)
    return tested


def run(approach, cycles, width_m=START_M, closing_m_s=0.0, sensed=None):
    """Steps with constant readings until the progress changes. Returns it."""
    before = ApproachState.BACKING_OFF if approach.is_backing_off else ApproachState.CLOSING
    for _ in range(cycles):
        progress = approach.step(
            0.005, width_m, closing_m_s, approach.motor_force_n, sensed or estimate(current_n=0.5)
        )
        if progress is not before:
            return progress
    return before


def test_standstill_without_travel_backs_off_and_is_stuck(approach):
    assert run(approach, 400) is ApproachState.BACKING_OFF
    assert approach.back_off_width_m == pytest.approx(START_M + 0.004)
    assert run(approach, 400) is ApproachState.STUCK


def test_standstill_after_a_back_off_is_stuck(approach):
    assert run(approach, 400) is ApproachState.BACKING_OFF
    assert run(approach, 400, START_M + 0.004) is ApproachState.CLOSING
    assert run(approach, 400, START_M + 0.004) is ApproachState.STUCK


def test_standstill_after_travel_is_contact(approach):
    assert run(approach, 40, START_M - 0.001, 0.025, estimate()) is ApproachState.CLOSING
    assert run(approach, 40, START_M - 0.002) is ApproachState.CONTACT


def test_contact_after_a_back_off(approach):
    assert run(approach, 400) is ApproachState.BACKING_OFF
    assert run(approach, 400, START_M + 0.004) is ApproachState.CLOSING
    assert run(approach, 400, START_M) is ApproachState.CONTACT


def test_jaws_that_still_speed_up_are_not_in_contact(approach):
    seen = estimate(force_n=2.0, source=EstimateSource.FUSED)
    assert run(approach, 40, START_M - 0.002, 0.01, seen) is ApproachState.CLOSING
    assert run(approach, 1, START_M - 0.002, 0.025, seen) is ApproachState.CLOSING
    assert run(approach, 40, START_M - 0.003, 0.01, seen) is ApproachState.CONTACT


def test_closed_jaws(approach):
    assert run(approach, 1, 0.0019, 0.025, estimate()) is ApproachState.CLOSED


def test_too_much_motor_force_decays_within_a_tenth_of_a_second(transmission):
    approach = Approach(ControlConfig(), transmission, max_m_s=0.025)
    approach.start(START_M, 4.0)
    run(approach, 40, START_M, 0.0, estimate(friction_n=5.0))
    strong_n = approach.motor_force_n
    run(approach, 20, START_M - 0.002, 0.035, estimate(friction_n=5.0))
    assert approach.motor_force_n < 0.3 * strong_n


def test_motor_force_never_exceeds_friction_and_the_contact_limit(approach):
    for _ in range(400):
        approach.step(0.005, START_M, 0.0, 0.0, estimate())
        assert approach.motor_force_n <= 0.95 + 2 * 0.1 + 0.5 + 1e-9 or approach.is_backing_off


@pytest.mark.parametrize(("target_n", "speed_m_s"), [(1.0, 0.010), (2.0, 0.020), (8.0, 0.025)])
def test_small_targets_are_approached_slowly(transmission, target_n, speed_m_s):
    approach = Approach(ControlConfig(), transmission, max_m_s=0.025)
    approach.start(START_M, target_n)
    assert approach.speed_m_s == pytest.approx(speed_m_s)


def test_free_motion_needs_steady_speed_and_force(approach):
    run(approach, 60, START_M - 0.001, 0.025, estimate())
    assert approach.moves_freely(0.025, approach.motor_force_n)
    assert not approach.moves_freely(0.031, approach.motor_force_n)
    for difference_n, is_free in ((-1.0, True), (1.0, False)):  # the speed limit keeps the motor force low
        for _ in range(30):
            approach.step(0.005, START_M - 0.001, 0.025, approach.motor_force_n + difference_n, estimate())
        assert approach.moves_freely(0.025, approach.motor_force_n) == is_free
