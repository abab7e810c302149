import math

import pytest

from gripper_force.control.travel import Travel

SPEED_M_S, FREE_N, OPEN_M = 0.05, 2.0, 0.08
CYCLE_S = 0.005


def make_travel(grip_n=0.0, *, opens=True):
    travel = Travel(SPEED_M_S, FREE_N, OPEN_M)
    travel.start(0.04, grip_n, opens=opens)
    return travel


def opened(travel, seconds, width_m, closing_m_s, t_s=0.0):
    for cycle in range(round(seconds / CYCLE_S)):
        travel.open(CYCLE_S, t_s + cycle * CYCLE_S, width_m, closing_m_s)
    return travel


def test_an_opening_without_an_object_leads_by_8_mm_with_the_free_motor_force():
    travel = opened(make_travel(), 0.5, 0.04, -SPEED_M_S)
    assert travel.goal_width_m == pytest.approx(0.048)
    assert travel.motor_force_n == FREE_N


def test_slow_jaws_get_more_motor_force_up_to_four_times():
    travel = opened(make_travel(), 10.0, 0.04, 0.0)
    assert travel.motor_force_n == pytest.approx(4 * FREE_N)
    travel.start(0.04, 0.0, opens=True)
    assert travel.motor_force_n == FREE_N


@pytest.mark.parametrize("speed_m_s", [0.0, 0.2 * SPEED_M_S])
def test_the_motor_force_of_slow_jaws_grows_slowly_once_they_had_time_to_start(speed_m_s):
    travel = opened(make_travel(), 0.2, 0.04, -speed_m_s)
    assert travel.motor_force_n == FREE_N
    travel = opened(travel, 0.4, 0.04, -speed_m_s, t_s=0.201)
    assert travel.motor_force_n == pytest.approx(FREE_N + 5.0 * 0.4)


def test_an_opening_starts_from_rest_where_the_jaws_are():
    travel = opened(make_travel(), 0.5, 0.06, -SPEED_M_S)
    travel.start(0.04, 0.0, opens=True)
    goals_m = [opened(travel, CYCLE_S, 0.04, 0.0).goal_width_m for _ in range(10)]
    assert 0.04 < goals_m[0] < goals_m[-1] < 0.0408  # half of the way at full speed


@pytest.mark.parametrize("motion", ["open", "move"])
def test_the_motor_force_of_a_grip_falls_to_that_of_free_travel(motion):
    travel = make_travel(grip_n=6.0)
    forces_n = []
    for cycle in range(160):
        if motion == "open":
            travel.open(CYCLE_S, cycle * CYCLE_S, 0.04, -SPEED_M_S)
        else:
            travel.move(CYCLE_S, cycle * CYCLE_S, 0.04, 0.02)
        forces_n.append(travel.motor_force_n)
    assert forces_n[0] == 6.0
    assert forces_n == sorted(forces_n, reverse=True)
    assert forces_n[-1] == FREE_N
    assert travel.remaining_grip_n(160 * CYCLE_S) == 0.0


def test_the_lead_after_a_grip_grows_from_zero():
    travel = make_travel(grip_n=6.0)
    travel.open(CYCLE_S, 0.0, 0.04, 0.0)
    assert travel.goal_width_m == 0.04
    travel.open(CYCLE_S, 0.015, 0.04, 0.0)
    assert travel.goal_width_m == pytest.approx(0.044)
    travel.open(CYCLE_S, 0.06, 0.04, 0.0)
    assert travel.goal_width_m == pytest.approx(0.048)


@pytest.mark.parametrize("to_m", [0.0, 0.08])
def test_a_move_of_jaws_that_stand_still_leads_by_8_mm(to_m):
    travel = make_travel()
    for cycle in range(200):
        travel.move(CYCLE_S, cycle * CYCLE_S, 0.04, to_m)
    assert abs(travel.goal_width_m - 0.04) == pytest.approx(0.008)
    assert travel.motor_force_n == FREE_N


def test_jaws_that_were_held_back_in_a_move_do_not_jump():
    travel = make_travel()
    for cycle in range(200):
        travel.move(CYCLE_S, cycle * CYCLE_S, 0.04, 0.0)
    before_m = travel.goal_width_m
    travel.move(CYCLE_S, 1.0, 0.035, 0.0)
    assert before_m - travel.goal_width_m == pytest.approx(SPEED_M_S * CYCLE_S)


def test_a_move_ends_at_its_width():
    travel = make_travel()
    for cycle in range(400):
        travel.move(CYCLE_S, cycle * CYCLE_S, travel.goal_width_m, 0.06)
    assert travel.goal_width_m == 0.06


@pytest.mark.parametrize(
    ("grip_n", "t_s", "closing_share", "is_friction"),
    [
        (0.0, 0.0, -0.9, True),
        (0.0, 0.0, -0.5, True),
        (0.0, 0.0, -0.3, False),  # something resists
        (6.0, 0.3, -0.9, False),  # the object may help
        (6.0, 0.6, -0.9, True),
        (0.0, 0.0, 0.5, True),
        (0.0, 0.0, 0.3, False),
    ],
)
def test_free_travel_shows_the_friction(grip_n, t_s, closing_share, is_friction):
    travel = make_travel(grip_n)
    for _ in range(100):
        motor_force_n = math.copysign(1.3, closing_share)
        travel.note_friction(t_s, closing_share * SPEED_M_S, motor_force_n, opens=closing_share < 0)
    if is_friction:
        assert 1.0 < travel.free_travel.friction_n <= 1.3
    else:
        assert travel.free_travel.friction_n is None
    travel.start(0.04, 0.0, opens=True)
    assert travel.free_travel.friction_n is None


def test_only_the_begin_of_a_move_that_closes_shows_the_friction():
    """In later cycles the jaws may press on a soft object."""
    travel = make_travel(opens=False)
    for cycle in range(60):
        travel.note_friction(0.0, 0.9 * SPEED_M_S, 1.3 if cycle < 10 else 9.0, opens=False)
    assert travel.free_travel.mean_n == pytest.approx(1.3)
