"""Moves to a width: speed, force on an obstacle, refusals, and what may follow."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_force.control.state_machine import GraspController
from gripper_force.qualification.loop_margin.analytic_plant import POSITION_LOOP
from gripper_force.types import Request

OPEN_M = 0.092
LEAD_M = 0.008
FAR = {"contact_m": 1.0}
PHASES = ("open", "approach", "contact", "ramp", "hold", "release", "move")


def has_ended(status):
    return status.outcome != ""


def motor_limit_a(run):
    """Goal current of the approach force plus friction, on the servo's grid."""
    rig = run.transmission
    return (run.config.approach_force_n + rig.friction_n) / rig.n_per_a(0.0) + rig.current_step_a


@pytest.mark.parametrize("width_m", [0.0905, 0.085, 0.06, 0.02, 0.005])
def test_move_closes_to_a_width(make_run, width_m):
    run = make_run(plant=FAR).move(width_m)
    assert run.last.status.phase == "move"
    assert run.last.status.width_m == pytest.approx(width_m, abs=0.0005)
    assert run.reasons == [
        f"move to {1e3 * width_m:.1f} mm requested",
        f"moved to {1e3 * width_m:.1f} mm",
    ]


def test_move_opens_to_a_width_and_holds_it(make_run):
    run = make_run(plant={**FAR, "x_m": 0.035}).move(0.06, 3.0)
    assert run.last.status.width_m == pytest.approx(0.06, abs=0.0005)
    arrived_m = run.last.status.width_m
    run.go(2.0)
    assert run.last.status.width_m == pytest.approx(arrived_m, abs=1e-4)
    assert sum(reason.startswith("moved") for reason in run.reasons) == 1


def test_move_to_the_present_width_ends_at_once(make_run):
    run = make_run(plant={**FAR, "x_m": 0.02}).move(OPEN_M - 0.04, 0.1)
    assert any(reason.startswith("moved to 52.0 mm") for reason in run.reasons)


@pytest.mark.parametrize("limit_n", [0.9, 2.0])
@pytest.mark.parametrize("contact_m", [0.004, 0.02])
def test_a_move_onto_an_object_keeps_the_force_limit_whatever_friction_is_configured(
    make_run, limit_n, contact_m
):
    friction_n = make_run().transmission.friction_n
    plant = {"friction_n": 0.3 * friction_n, "gain": 1.35, "contact_m": contact_m, "stiffness_n_m": 26_000.0}
    run = make_run(plant=plant, force_limit_n=limit_n).move(0.03, 0.005).until(has_ended)
    assert run.last.status.outcome == "blocked"
    assert 0.0 < run.go(2.0).plant.peak_n <= 1.05 * limit_n


@pytest.mark.parametrize(
    ("x_m", "limit_n", "most_n"),
    [
        (0.02, 4.0, 0.5 * 4.0 / 1.4),  # jaws that may touch an object: half of what the force limit allows
        (0.0, 4.0, 0.5 * 4.0 / 1.4),
        (0.0, 2.0, 0.95 + 0.1),  # open jaws: hardly more than the configured friction, to come loose
    ],
)
def test_a_move_presses_gently_until_a_motion_has_shown_the_friction(make_run, x_m, limit_n, most_n):
    plant = {**FAR, "x_m": x_m, "friction_n": 5.0}  # nothing moves
    run = make_run(plant=plant, force_limit_n=limit_n, approach_force_n=1.9).move(0.02, 0.25)
    most_a = max(decision.command.goal_current_a for decision in run.decisions)
    assert most_a == pytest.approx(
        most_n / run.transmission.n_per_a(0.0), abs=run.transmission.current_step_a
    )


@settings(max_examples=15)
@given(
    start_m=st.floats(0.0, 0.044),
    width_m=st.floats(0.004, OPEN_M),
    mass_kg=st.floats(0.8, 1.5),
    friction_n=st.floats(0.67, 1.0),
    speed_m_s=st.floats(0.01, 0.03),
)
def test_speed_and_lead_are_bounded_and_the_width_is_reached(
    make_run, start_m, width_m, mass_kg, friction_n, speed_m_s
):
    plant = {**FAR, "x_m": start_m, "mass_kg": mass_kg, "friction_n": friction_n}
    run = make_run(plant=plant, approach_speed_m_s=speed_m_s)
    run.move(width_m, 0.005).until(has_ended, 6.0).go(0.3)
    # The servo's position loop overshoots the speed of its goal by no more than this while settling.
    assert max(map(abs, run.speeds_m_s)) <= 1.2 * speed_m_s + 0.001
    assert run.last.status.width_m == pytest.approx(width_m, abs=0.0005)
    assert not any("obstacle" in reason for reason in run.reasons)
    goals_m = [run.transmission.width_m(d.command.goal_position_rad) for d in run.decisions]
    for decision, goal_m in zip(run.decisions, goals_m, strict=True):
        assert abs(goal_m - decision.status.width_m) <= LEAD_M + 1e-9
        assert decision.command.goal_current_a <= motor_limit_a(run)
    assert all(abs(b - a) <= 2 * speed_m_s * 0.005 + 1e-9 for a, b in pairwise(goals_m))


@settings(max_examples=12)
@given(
    stiffness_n_m=st.floats(300.0, 30_000.0),
    gain=st.floats(0.95, 1.1),
    friction_n=st.floats(0.67, 1.0),
    contact_m=st.floats(0.005, 0.03),
)
def test_force_on_an_obstacle_is_bounded(make_run, stiffness_n_m, gain, friction_n, contact_m):
    plant = {"stiffness_n_m": stiffness_n_m, "gain": gain, "friction_n": friction_n, "contact_m": contact_m}
    run = make_run(plant=plant).move(0.0, 5.0)
    motor_n = gain * (run.config.approach_force_n + run.transmission.friction_n + 0.1)
    impact_n = 1.2 * run.config.approach_speed_m_s * math.sqrt(stiffness_n_m * run.plant.mass_kg)
    forces_n = [sample.force_n for sample in run.cell]
    assert max(forces_n) <= impact_n + motor_n
    assert forces_n[-1] <= motor_n + friction_n
    assert max(d.command.goal_current_a for d in run.decisions) <= motor_limit_a(run)
    stopped_m = [s.width_m for s in run.statuses if s.reason.startswith("stopped at")]
    assert stopped_m == [pytest.approx(run.last.status.width_m, abs=1e-4)]
    assert run.last.status.phase == "move"


def test_steady_force_on_a_soft_obstacle_is_the_approach_force(make_run):
    run = make_run(plant={"stiffness_n_m": 300.0, "contact_m": 0.02}).move(0.02, 5.0)
    assert run.plant.force_n == pytest.approx(run.config.approach_force_n, abs=0.3)


def test_obstacle_is_reported_one_second_after_the_last_progress(make_run):
    run = make_run(plant={"contact_m": 0.01}).move(0.042, 5.0)
    stopped = next(s for s in run.statuses if s.reason.startswith("stopped"))
    contact = next(sample for sample in run.cell if sample.force_n > 0)
    assert stopped.t_ns - contact.t_ns == pytest.approx(1.0 * 1e9, abs=0.1e9)
    assert stopped.reason.endswith("by an obstacle, or by friction: check gripper.friction_n")


@pytest.mark.parametrize("width_m", [0.01, 0.085])
def test_jaws_that_friction_makes_slow_arrive_and_are_not_blocked(make_run, width_m):
    friction_n = 1.45 * make_run().transmission.friction_n
    run = make_run(plant={**FAR, "friction_n": friction_n}).move(width_m, 0.005).until(has_ended)
    assert run.last.status.outcome == "moved"


def test_jaws_that_stop_just_before_their_width_are_blocked(make_run):
    stop_m = make_run().transmission.open_width_m - 2 * 0.02
    run = make_run(plant={"contact_m": 1.0, "stops_m": (0.0, 0.02)}).move(stop_m - 0.002, 6.0)
    assert run.last.status.outcome == "blocked"
    assert f"stopped at {1e3 * run.last.status.width_m:.1f} mm" in run.reasons[-1]


def test_slow_jaws_are_not_blocked(make_run):
    run = make_run(plant={**FAR, "friction_n": 0.5}, approach_speed_m_s=0.001).move(OPEN_M - 0.006, 0.005)
    assert run.until(has_ended).last.status.outcome == "moved"


def test_a_noisy_stream_of_moves_onto_an_obstacle_is_blocked(make_run):
    run = make_run(plant={"contact_m": 0.01})
    for i in range(120):
        run.move(0.042 + (1.5e-4 if i % 2 else 0.0), 1 / 30)
    assert any(status.outcome == "blocked" for status in run.statuses)


@pytest.mark.parametrize("every", [1, 20])
def test_a_repeated_move_is_one(make_run, every):
    run = make_run(plant=FAR)
    for _ in range(round(1.5 / (0.005 * every))):
        run.move(0.04, 0.005 * every)
    assert run.last.status.outcome == "moved"
    assert sum(reason.startswith("move to") for reason in run.reasons) == 1


def test_a_stream_of_moves_is_followed(make_run):
    run = make_run(plant=FAR)
    for i in range(1, 201):  # 20 mm/s, slower than the jaws may be
        run.move(OPEN_M - 1e-4 * i, 0.005)
    assert run.last.status.width_m == pytest.approx(OPEN_M - 0.02, abs=0.002)


def test_jaws_go_on_slowly_when_the_obstacle_is_gone(make_run):
    run = make_run(plant={"contact_m": 0.01}).move(0.03, 4.0)
    run.plant.contact_m = 1.0
    before = len(run.decisions)
    run.go(3.0)
    assert run.last.status.width_m == pytest.approx(0.03, abs=0.0005)
    widths_m = [decision.status.width_m for decision in run.decisions[before:]]
    assert max(a - b for a, b in pairwise(widths_m)) <= 2 * 0.1 * 0.005
    assert sum(reason.startswith(("moved", "stopped")) for reason in run.reasons) == 1


@pytest.mark.parametrize("width_m", [-0.001, OPEN_M + 0.001, math.nan, math.inf, -math.inf])
def test_widths_out_of_range_are_refused(make_run, width_m):
    run = make_run(plant={"x_m": 0.01})
    before_m = run.plant.x_m
    run.move(width_m, 0.5)
    assert run.last.status.phase == "open"
    assert run.plant.x_m == pytest.approx(before_m, abs=1e-4)
    assert f"refused 'move': the width {1e3 * width_m:g} mm is outside 0 to 92 mm" in run.texts


def test_refused_move_does_not_end_a_hold(make_run):
    run = make_run().grasp(4.0).move(0.2, 0.5)
    assert (run.last.status.phase, run.last.status.outcome) == ("hold", "held")
    assert run.plant.force_n == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize("phase", PHASES)
def test_move_pre_empts_every_phase(make_run, phase):
    run = make_run().to_phase(phase).move(0.08, 4.0)
    assert (run.last.status.phase, run.last.status.outcome) == ("move", "moved")
    assert run.last.status.width_m == pytest.approx(0.08, abs=0.0005)
    assert run.plant.force_n == 0.0


def test_move_resets_the_outcome_and_lets_go(make_run):
    run = make_run().grasp(4.0)
    assert run.last.status.outcome == "held"
    run.go(0.005, "move", width_m=0.08)
    assert run.last.status.outcome == ""
    run.go(1.0)
    assert run.plant.force_n == 0.0
    assert run.last.status.reference_n == 0.0


def test_move_from_a_hold_to_a_narrower_width_relaxes_the_grip(make_run):
    run = make_run().grasp(8.0).move(0.02, 4.0)
    assert run.last.status.phase == "move"
    # Friction may hold the object compressed above what the motor gives.
    assert run.plant.force_n <= run.config.approach_force_n + 2 * run.plant.friction_n + 0.1
    assert max(d.command.goal_current_a for d in run.decisions[-700:]) <= motor_limit_a(run)


@pytest.mark.parametrize("from_m", [0.08, 0.07, 0.02])
def test_grasp_after_a_move_holds(make_run, from_m):
    """From free travel, from beside the object, and from jaws that press on it."""
    run = make_run().move(from_m, 4.0).grasp(4.0, 7.0)
    assert run.last.status.outcome == "held"
    assert run.plant.force_n == pytest.approx(4.0, abs=0.2)


def test_release_after_a_move_opens(make_run):
    run = make_run(plant=FAR).move(0.03, 3.0).go(4.0, "release")
    assert run.last.status.phase == "open"
    assert run.plant.x_m < 0.003


@pytest.mark.parametrize("on_fault", ["limp", "hold", "open"])
def test_stop_during_a_move(make_run, on_fault):
    run = make_run(plant=FAR, on_fault=on_fault).move(0.03, 0.6)
    where_m = run.plant.x_m
    run.go(2.0, "stop")
    assert (run.last.status.phase, run.last.status.outcome) == ("fault", "fault")
    if on_fault == "open":
        assert run.plant.x_m < 0.003
    else:
        assert run.plant.x_m == pytest.approx(where_m, abs=3e-3)
        if on_fault == "limp":
            assert run.last.command.goal_current_a == 0.0
    run.move(0.05, 0.1)
    assert "refused 'move': stopped or in fault; request a release first" in run.texts
    assert run.go(4.0, "release").last.status.phase == "open"
    assert run.move(0.05).last.status.width_m == pytest.approx(0.05, abs=0.0005)


@pytest.mark.parametrize(("width_m", "reverses"), [(0.09, False), (0.02, True)])
def test_after_a_release_the_motor_force_rises_from_zero_only_if_the_jaws_reverse(
    make_run, width_m, reverses
):
    run = make_run(plant={"x_m": 0.03, "jaw_m": 0.03, "contact_m": 1.0}).go(0.3, "release")
    before_a = run.last.command.goal_current_a
    run.move(width_m, 0.005)
    assert (run.last.command.goal_current_a < 0.5 * before_a) == reverses


def test_newer_move_pre_empts_an_older_one(make_run):
    run = make_run(plant=FAR).move(0.02, 0.8).move(0.08, 3.0)
    assert run.last.status.width_m == pytest.approx(0.08, abs=0.0005)
    assert sum(reason.startswith("moved") for reason in run.reasons) == 1


def test_late_cycle_does_not_make_the_goal_jump(make_run):
    run = make_run(plant=FAR).move(0.03, 0.5)
    before_m = run.transmission.width_m(run.last.command.goal_position_rad)
    run.t_ns += 2_000_000_000
    run.go(0.005)
    after_m = run.transmission.width_m(run.last.command.goal_position_rad)
    assert abs(after_m - before_m) <= 2 * 0.025 * 0.05 + 1e-9


@pytest.mark.parametrize("closing_sign", [-1, 1])
def test_goal_positions_follow_the_closing_direction(make_run, transmission, closing_sign):
    rig = replace(transmission, closing_sign=closing_sign)
    run = make_run(plant=FAR)
    controller = GraspController(run.config, rig, 1.2, POSITION_LOOP)
    servo = replace(run.plant.read(0, 0.0), position_rad=rig.position_rad(0.08))
    controller.step(0, servo, None, Request(0, "move", width_m=0.04))
    for cycle in range(1, 40):
        decision = controller.step(cycle * 5_000_000, replace(servo, t_ns=cycle * 5_000_000), None, None)
    assert rig.width_m(decision.command.goal_position_rad) < 0.08


def test_same_inputs_give_identical_decisions(drawn_run, transmission):
    run = drawn_run(3).move(0.07, 1.0).grasp(4.0).move(0.09, 2.0).move(0.01, 2.0)
    again = GraspController(run.config, transmission, 1.2, POSITION_LOOP)
    assert [again.step(*inputs) for inputs in run.inputs] == run.decisions
