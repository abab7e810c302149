import itertools
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_force.config import ControlConfig
from gripper_force.control.safety import is_plausible
from gripper_force.control.state_machine import GraspController
from gripper_force.jobs.score import score_grasp
from gripper_force.qualification.loop_margin.analytic_plant import POSITION_LOOP
from gripper_force.types import Request, ServoState, VisualForce

PHASES = ("open", "approach", "contact", "ramp", "hold", "release", "move")


def phases(run):
    """Returns the phases in order, without repetitions."""
    names = [status.phase for status in run.statuses]
    return [name for i, name in enumerate(names) if i == 0 or names[i - 1] != name]


@pytest.mark.parametrize("target_n", [1.0, 8.0])
def test_fused_feedback_holds_the_target(drawn_run, target_n):
    seen, overshoot, outcomes = [], [], []
    for seed in range(8):
        run = drawn_run(seed).grasp(target_n, 6.0)
        assert phases(run) == ["approach", "contact", "ramp", "hold"]
        outcomes.append(run.last.status.outcome)
        score = score_grasp(run.cell, run.statuses, target_n)
        # A constant gain error of vision is not an error of the loop.
        seen.append(abs(score.steady_n * run.vision.gain - target_n) / target_n)
        overshoot.append(score.overshoot_n)
    # With the largest friction, a force slightly too high takes longer than this to fall.
    assert outcomes.count("held") >= 7
    deadband = 0.025 / target_n
    assert np.median(seen) < 0.015 + deadband
    # The share of the motor current in the estimate adds its error.
    assert max(seen) < 0.02 + 5 * deadband
    assert max(overshoot) < max(0.12 * target_n, 0.2)


@pytest.mark.parametrize("feedback", ["fused", "current"])
def test_approach_identifies_friction_and_limits_the_impact(drawn_run, feedback):
    nominal_n, learned_n = [], []
    for seed in range(8):
        run = drawn_run(seed, feedback=feedback)
        true_n = run.plant.friction_n / run.plant.gain
        nominal_n.append(run.transmission.friction_n - true_n)
        learned_n.append(run.to_phase("contact").last.estimate.friction_n - true_n)
        # Impact of 1.3 kg at 25 mm/s on 3 kN/m, plus the contact limit.
        assert max(sample.force_n for sample in run.cell) < 2.2
    # A travel of 8 mm may be too short for a steady speed.
    assert (np.abs(learned_n) < np.abs(nominal_n) + 0.1).all()
    assert np.median(np.abs(learned_n)) < 0.5 * np.median(np.abs(nominal_n))


@pytest.mark.parametrize("target_n", [2.0, 8.0])
def test_current_alone_is_within_friction_and_gearing(drawn_run, target_n):
    for seed in range(3):
        run = drawn_run(seed, feedback="current").grasp(target_n)
        score = score_grasp(run.cell, run.statuses, target_n)
        assert abs(score.steady_error_n) < 0.12 * target_n + 0.2
        assert {d.estimate.source for d in run.decisions} == {"current"}


def test_vision_alone_holds(drawn_run):
    for seed in range(2):
        run = drawn_run(seed, feedback="vision").grasp(4.0, 6.0)
        score = score_grasp(run.cell, run.statuses, 4.0)
        assert abs(score.steady_n * run.vision.gain - 4.0) < 0.15
        assert run.last.status.outcome == "held"


def test_fused_feedback_continues_when_vision_drops_out(make_run):
    run = make_run(plant={"gain": 1.08}, vision_off_s=3.0).grasp(4.0)
    assert run.last.estimate.source == "current"
    assert [text for text in run.texts if "vision dropped out" in text]
    assert run.last.status.outcome == "held"
    assert run.last.estimate.std_n > next(
        d.estimate.std_n for d in run.decisions if d.estimate.t_ns == 2_950_000_000
    )
    assert run.plant.force_n == pytest.approx(4.0, rel=0.04)  # the bias found with vision is kept


def test_hold_has_no_limit_cycle(make_run):
    """The force is nearly constant over the last three seconds."""
    run = make_run().grasp(4.0, 7.0)
    late = [sample.force_n for sample in run.cell[-600:]]
    assert max(late) - min(late) < 0.03 * 4.0


def test_stalled_start_up_is_not_contact(make_run):
    run = make_run(plant={"mass_kg": 3.0, "friction_n": 1.25, "gain": 0.9, "contact_m": 0.03}).grasp(2.0, 3.0)
    contact = next(status for status in run.statuses if status.phase == "contact")
    assert 0.026 < contact.width_m < 0.032


def test_jaws_already_in_contact_grip(make_run):
    run = make_run(plant={"contact_m": 0.0}).grasp(2.0)
    assert run.last.status.outcome == "held"
    assert run.plant.force_n == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("limit_n", [1.0, 3.0, 14.0])
def test_no_impact_on_a_hard_object_exceeds_the_force_limit(make_run, limit_n):
    plant = {"stiffness_n_m": 30_000.0, "mass_kg": 1.4, "friction_n": 0.3}
    run = make_run(plant=plant, force_limit_n=limit_n, approach_speed_m_s=0.05)
    run.grasp(0.64 * limit_n, 8.0)
    assert run.last.status.outcome == "held"
    assert run.plant.peak_n < 1.05 * limit_n


def test_slower_jaws_have_more_time(make_run, transmission):
    usual, slow = make_run().controller, make_run(force_limit_n=1.0).controller
    assert (usual.timeout_s(5.0), usual.opening_s) == (8.0, pytest.approx(5.84))
    travel_s = transmission.open_width_m / 2 / transmission.impact_m_s(1.0)
    assert slow.timeout_s(math.inf) == pytest.approx(8.0 + travel_s - transmission.open_width_m / 2 / 0.025)
    assert slow.opening_s == pytest.approx(4.0 + 2 * travel_s)
    # The jaws are at least as slow as the target demands.
    assert usual.timeout_s(0.5) == pytest.approx(
        8.0 + transmission.open_width_m / 2 * (1 / 0.005 - 1 / 0.025)
    )
    assert usual.timeout_s(5e-324) < 500
    run = make_run(force_limit_n=1.0, timeout_s=3.0).grasp(0.6, 7.0)  # 4.4 s to the object
    assert run.last.status.outcome == "held"


def test_a_smaller_force_of_a_held_object_needs_no_time_to_travel(make_run):
    run = make_run(timeout_s=3.0).grasp(2.0)
    assert run.last.status.outcome == "held"
    run.grasp(1e-3, 3.5)  # less than the force can be controlled to
    assert run.last.status.outcome == "timeout"


def test_a_small_target_without_an_object_is_no_object_and_no_timeout(make_run):
    run = make_run(plant={"contact_m": 1.0}).grasp(0.5, 16.0)
    assert run.last.status.outcome == "no_object"


@pytest.mark.parametrize("limit_n", [0.8, 14.0])
def test_closed_jaws_open_in_their_time(make_run, limit_n):
    # The first request: no grasp has measured the friction.
    run = make_run(plant={"x_m": 0.044, "jaw_m": 0.044, "contact_m": 1.0}, force_limit_n=limit_n)
    run.go(0.005, "release").until(lambda status: status.phase == "open", run.controller.opening_s)


@pytest.mark.parametrize("limit_n", [0.8, 2.0])
def test_loss_under_a_small_force_limit_opens_soon(make_run, limit_n):
    run = make_run(force_limit_n=limit_n, on_slip="open").grasp(0.9 * limit_n / 1.4, 0.005)
    run.until(lambda status: status.outcome == "held", 9.0)
    run.plant.contact_m = 1.0
    assert run.go(0.2).last.status.phase == "release"


@pytest.mark.parametrize(("limit_n", "friction", "gain"), [(2.0, 3.0, 1.0), (10.0, 5.0, 0.7)])
def test_a_release_that_cannot_open_the_jaws_is_blocked(make_run, limit_n, friction, gain):
    plant = {"x_m": 0.02, "jaw_m": 0.02, "contact_m": 1.0, "gain": gain}
    plant |= {"friction_n": friction * make_run().transmission.friction_n}
    run = make_run(plant=plant, force_limit_n=limit_n)
    run.go(run.controller.opening_s - 0.1, "release")
    assert run.last.status.outcome == ""
    run.go(0.2)
    assert (run.last.status.phase, run.last.status.outcome) == ("release", "blocked")
    [reason] = [reason for reason in run.reasons if "not opened" in reason]
    assert "gripper.friction_n" in reason
    assert "control.force_limit_n" in reason
    # It goes on trying, and another release begins anew.
    assert run.go(0.1, "release").last.status.outcome == ""
    run.plant.friction_n /= friction
    run.until(lambda status: status.phase == "open", run.controller.opening_s)


SMALL = {
    "k": [1000.0, 20_000.0],
    "limit_n": [0.8, 1.06, 2.0],
    "x_m": [0.0, 0.005],
    "gap_m": [0.0, 0.0003, 0.001],
}


@pytest.mark.parametrize("then", ["grasp", "move", "move at once"])
@pytest.mark.parametrize(("friction", "gain"), [(0.3, 1.4), (0.63, 1.38), (1.0, 1.0)])
def test_jaws_near_an_object_keep_a_small_force_limit_whatever_is_requested(make_run, friction, gain, then):
    friction_n = friction * make_run().transmission.friction_n
    # A third of the cases for each friction and request, in which any two values of parameters meet; of the request
    # and friction that found the most, all.
    part = ["grasp", "move", "move at once"].index(then)
    for indices in itertools.product(*(range(len(values)) for values in SMALL.values())):
        if (friction, then) != (0.63, "move at once") and (sum(indices) + (friction < 1.0)) % 3 != part:
            continue
        k, limit_n, x_m, gap_m = (values[i] for values, i in zip(SMALL.values(), indices, strict=True))
        plant = {"x_m": x_m, "jaw_m": x_m, "contact_m": x_m + gap_m, "stiffness_n_m": k}
        run = make_run(
            plant={**plant, "friction_n": friction_n, "gain": gain},
            force_limit_n=limit_n,
            approach_speed_m_s=0.029,
            feedback="current",
        )
        run.grasp(0.6 * limit_n, 0.2 if then == "move at once" else 2.8)
        run.grasp(0.64 * limit_n, 1.0) if then == "grasp" else run.move(0.02, 2.0)
        peak_n = max(sample.force_n for sample in run.cell)
        # Wide open jaws may come loose with the configured friction (docs/reliability.md).
        share = 1.05 if x_m > 0 else 1.3
        assert peak_n <= share * limit_n, (k, limit_n, x_m, gap_m)


@pytest.mark.parametrize("limit_n", [0.8, 1.2, 2.0])
@pytest.mark.parametrize("x_m", [0.0, 0.02])
def test_a_grasp_that_begins_in_contact_keeps_a_small_force_limit(make_run, limit_n, x_m):
    # Friction is far smaller than configured, and no free travel has shown it.
    plant = {"contact_m": x_m, "x_m": x_m, "jaw_m": x_m, "stiffness_n_m": 20_000.0}
    plant |= {"friction_n": 0.3 * make_run().transmission.friction_n, "gain": 1.4}
    run = make_run(plant=plant, force_limit_n=limit_n, feedback="current").grasp(0.6 * limit_n)
    assert 0.0 < run.plant.peak_n <= 1.05 * limit_n


@pytest.mark.parametrize(
    ("phase", "speed_m_s"),
    [
        ("approach", 0.025),
        ("contact", 0.97 * 0.025),
        ("ramp", 0.97 * 0.025),
        ("hold", 0.5 * 0.025),
        ("release", 2 * 0.025),
        ("move", 2 * 0.025),
    ],
)
def test_jaws_that_nothing_resists_have_the_lead_of_the_speed_of_their_phase(make_run, phase, speed_m_s):
    if phase in ("release", "move"):
        run = make_run(plant={"x_m": 0.02, "friction_n": 100.0}).go(0.5, phase, width_m=0.02)
    else:
        run = make_run().to_phase(phase).go(0.05)
    run.spoil = lambda _, servo: replace(servo, velocity_rad_s=0.0, current_a=0.0)
    run.go(0.005)
    assert run.last.status.phase == phase
    _, servo, *_ = run.inputs[-1]
    lead_m = abs(run.last.command.goal_position_rad - servo.position_rad) * run.transmission.jaw_m_per_rad(
        0.0
    )
    assert lead_m * POSITION_LOOP.gain_per_s == pytest.approx(1.3 * speed_m_s)


def test_a_release_after_a_stop_lets_a_springy_object_go_slowly(make_run):
    run = make_run(plant={"stiffness_n_m": 970.0, "mass_kg": 0.83}, on_fault="hold").grasp(6.9)
    run.go(0.5, "stop").go(2.0, "release")
    assert run.last.status.phase == "open"
    assert max(map(abs, run.speeds_m_s)) < 1.5 * 2 * run.config.approach_speed_m_s


def test_no_object(make_run):
    run = make_run(plant={"contact_m": 1.0}, timeout_s=20.0).grasp(8.0)
    assert phases(run)[:2] == ["approach", "release"]
    assert run.last.status.outcome == "no_object"
    run.go(3.0)
    assert run.last.status.phase == "open"
    assert run.last.status.outcome == "no_object"


def lose_object(run, distance_m=1.0, time_s=2.0):
    """Moves the object away. Returns the greatest speed of the jaws and the time until the slip is reported."""
    run.plant.contact_m += distance_m
    lost = len(run.decisions)
    run.go(time_s)
    slips = [i for i, status in enumerate(run.statuses) if i >= lost and status.outcome == "slip"]
    return max(run.speeds_m_s[lost:]), 0.005 * (slips[0] - lost + 1) if slips else math.inf


@pytest.mark.parametrize(
    ("phase", "target_n"), [("ramp", 4.0), ("ramp", 8.0), ("hold", 1.0), ("hold", 4.0), ("hold", 8.0)]
)
def test_lost_object_is_a_slip_at_bounded_speed(make_run, target_n, phase):
    run = make_run(settle_s=5.0)
    run.go(0.005, "grasp", target_n)
    while run.last.status.phase != phase or run.last.status.reference_n < 0.5 * target_n:
        run.go(0.005)
    fastest_m_s, reported_s = lose_object(run)
    assert reported_s <= 0.05
    assert fastest_m_s < 1.5 * run.config.approach_speed_m_s


@pytest.mark.parametrize("friction_n", [0.3, 0.95, 1.5])
def test_slip_after_held_is_reported_within_50_ms(make_run, friction_n):
    run = make_run(plant={"friction_n": friction_n}).grasp(4.0)
    assert run.last.status.outcome == "held"
    fastest_m_s, reported_s = lose_object(run)
    assert reported_s <= 0.05
    assert fastest_m_s < 1.5 * run.config.approach_speed_m_s


def test_lost_object_of_a_small_force_is_a_slip_soon(make_run):
    """Friction and damping need most of the motor force, so that it need not fall short."""
    run = make_run(plant={"friction_n": 0.3, "damping_n_s_m": 8.8}).grasp(0.6, 5.0)
    assert run.last.status.outcome == "held"
    _, reported_s = lose_object(run)
    assert reported_s <= 0.1


def test_object_that_leaves_jaws_on_an_end_stop_is_a_slip_with_a_camera(make_run):
    run = make_run(plant={"stiffness_n_m": 300.0, "stops_m": (0.0, 0.020)}).grasp(1.0)
    assert run.last.status.outcome == "held"
    run.plant.stops_m = (0.0, run.plant.x_m)
    _, reported_s = lose_object(run)
    assert reported_s <= 0.5
    assert any("the camera sees" in reason for reason in run.reasons)


def test_force_that_a_camera_sees_before_the_contact_confirms_no_grip(make_run):
    """A network can take the moving jaws themselves for force."""
    run = make_run(plant={"contact_m": 1.0, "stops_m": (0.0, 0.020)}, timeout_s=3.0)
    sample = run.vision.sample
    run.vision.sample = lambda t_ns, force_n, noise: sample(t_ns, 100.0 * run.plant.x_m, noise)
    run.grasp(3.0)
    assert run.last.status.outcome == "timeout"
    assert any("the camera sees" in reason and "before the contact" in reason for reason in run.reasons)


@pytest.mark.parametrize(("contact_m", "outcome"), [(1.0, "timeout"), (0.015, "held")])
def test_unfamiliar_frames_tell_a_grip_from_empty_jaws_on_an_end_stop(make_run, contact_m, outcome):
    run = make_run(plant={"contact_m": contact_m, "stops_m": (0.0, 0.020)}, timeout_s=3.0)
    sample = run.vision.sample

    def unfamiliar(t_ns, force_n, noise):
        """Sees force in the motion of the jaws, and a third of that on the object."""
        visual = sample(t_ns, 100.0 * run.plant.x_m + force_n / 3, noise)
        return None if visual is None else replace(visual, std_n=float("inf"))

    run.vision.sample = unfamiliar
    run.grasp(3.0)
    assert run.last.status.outcome == outcome
    assert {decision.estimate.source for decision in run.decisions} == {"current"}


@pytest.mark.parametrize(("std_n", "outcome"), [(1.4, ""), (math.inf, "held")])
def test_a_rise_within_the_noise_of_the_camera_begins_no_held_but_does_not_end_it(make_run, std_n, outcome):
    """The camera sees forces that are not there, more than the target before the contact."""
    run = make_run(vision={"noise_n": 0.0}, timeout_s=20.0)
    sample = run.vision.sample

    def weak(t_ns, force_n, noise):
        visual = sample(t_ns, 2.5 + 0.35 * force_n, noise)
        return None if visual is None else replace(visual, std_n=std_n)

    run.vision.sample = weak
    run.grasp(2.0)
    assert run.last.status.outcome == outcome
    std_n = 1.4
    run.go(2.0)
    assert run.last.status.outcome == outcome


def test_camera_that_is_uncertain_throughout_a_grip_prevents_held(make_run):
    run = make_run(vision={"noise_n": 2.0}, timeout_s=3.0).grasp(2.0)
    assert run.last.status.outcome == "timeout"
    assert any("the camera is uncertain" in reason for reason in run.reasons)


def test_springy_object_cannot_push_the_jaws_open_fast(make_run):
    run = make_run(plant={"stiffness_n_m": 300.0, "mass_kg": 0.8, "friction_n": 0.3}).grasp(8.0)
    run.go(1.5, "release")
    assert run.last.status.phase == "open"
    assert -min(run.speeds_m_s) < 1.5 * 2 * run.config.approach_speed_m_s


def test_after_a_slip_the_jaws_grip_again(make_run):
    run = make_run(on_slip="regrip").grasp(4.0)
    lose_object(run, 0.004, 4.0)
    assert run.last.status.outcome == "slip"
    assert run.last.status.phase == "hold"
    assert run.plant.force_n == pytest.approx(4.0, abs=0.2)


def test_after_a_slip_the_jaws_open_if_there_is_nothing(make_run):
    run = make_run(on_slip="regrip").grasp(4.0)
    lose_object(run, 1.0, 8.0)
    assert run.last.status.outcome == "slip"
    assert run.last.status.phase == "open"


def test_after_a_slip_the_width_is_held(make_run):
    run = make_run(on_slip="hold").grasp(4.0)
    lose_object(run, 1.0, 0.05)
    width_m = run.last.status.width_m
    run.go(2.0)
    assert run.last.status.outcome == "slip"
    assert run.last.status.width_m == pytest.approx(width_m, abs=0.002)


def test_after_a_slip_the_jaws_open(make_run):
    run = make_run(on_slip="open").grasp(4.0)
    lose_object(run, 1.0, 3.0)
    assert run.last.status.outcome == "slip"
    assert run.last.status.phase == "open"


def test_jaws_that_creep_are_a_slip_without_a_release(make_run):
    run = make_run().grasp(4.0)
    for _ in range(500):
        run.plant.contact_m += 0.00001
        run.go(0.005)
    assert run.last.status.outcome == "slip"
    assert run.last.status.phase == "hold"
    assert any("closed by" in status.reason for status in run.statuses)


@pytest.mark.parametrize("target_n", [1.0, 3.0, 8.0])
@pytest.mark.parametrize("factor", [2.0, 3.0, 5.0])
@pytest.mark.parametrize("feedback", ["fused", "current"])
def test_more_friction_than_configured_is_stuck_or_held(make_run, target_n, factor, feedback):
    run = make_run(plant={"friction_n": 0.95 * factor, "contact_m": 0.02}, feedback=feedback)
    run.grasp(target_n, 6.0)
    assert run.last.status.outcome in ("held", "stuck", "slip", "no_object", "timeout")
    if run.last.status.outcome == "held":
        assert run.plant.force_n == pytest.approx(target_n, rel=0.3)
    assert run.plant.peak_n < 1.05 * run.config.force_limit_n
    assert max(run.speeds_m_s) < 1.5 * run.config.approach_speed_m_s


@pytest.mark.parametrize("target_n", [1.0, 3.0])
def test_jaws_that_do_not_move_are_stuck(make_run, target_n):
    run = make_run(plant={"friction_n": 4.0}).grasp(target_n)
    assert run.last.status.outcome == "stuck"
    assert run.plant.x_m == 0.0
    assert any("gripper.friction_n" in reason for reason in run.reasons)


@pytest.mark.parametrize("configured_n", [2.0, 5.0])
@pytest.mark.parametrize("target_n", [1.0, 8.0])
def test_less_friction_than_configured_is_held(make_run, configured_n, target_n):
    transmission = replace(make_run().transmission, friction_n=configured_n)
    run = replace(make_run(plant={"contact_m": 0.02}), transmission=transmission).grasp(target_n)
    assert run.last.status.outcome == "held"
    assert run.plant.force_n == pytest.approx(target_n, abs=0.1 * target_n + 0.1)
    assert run.plant.peak_n < 1.05 * run.config.force_limit_n
    assert max(run.speeds_m_s) < 1.5 * run.config.approach_speed_m_s


def test_force_collapse_is_a_slip(make_run):
    run = make_run(feedback="vision").grasp(4.0)
    run.vision.gain = 0.3
    run.spoil = lambda _, servo: replace(servo, current_a=0.0)  # the motor current drops too
    run.go(1.5)
    assert run.last.status.outcome == "slip"
    assert any("fell to" in status.reason for status in run.statuses)


def test_timeout(make_run):
    run = make_run(timeout_s=1.5).grasp(4.0, 3.0)
    assert run.last.status.outcome == "timeout"
    assert run.last.status.phase == "hold"


def test_timeout_at_the_current_limit_names_it(make_run):
    run = make_run(timeout_s=2.0)
    run.controller = GraspController(run.config, run.transmission, 0.1, POSITION_LOOP)
    run.grasp(6.0)
    assert run.last.status.outcome == "timeout"
    assert any("check servo.current_limit_a" in reason for reason in run.reasons)


def test_retarget_without_letting_go(make_run):
    run = make_run().grasp(2.0).grasp(5.0)
    assert phases(run) == ["approach", "contact", "ramp", "hold", "ramp", "hold"]
    assert run.plant.force_n == pytest.approx(5.0, rel=0.03)
    run.grasp(3.0, 6.0)
    assert run.plant.force_n == pytest.approx(3.0, rel=0.05)
    assert min(sample.force_n for sample in run.cell[-1100:]) > 2.7
    assert run.last.status.outcome == "held"


@pytest.mark.parametrize("first", ["release", "move", "release grasp"])
def test_a_repeated_release_lets_go_of_a_springy_object_as_slowly_as_one(make_run, first):
    run = make_run(plant={"stiffness_n_m": 1_700.0, "friction_n": 0.6}, force_limit_n=19.0).grasp(11.0)
    for kind in first.split():
        run.go(0.02, kind, 5.0, width_m=0.092)
    for _ in range(50):
        run.go(0.02, "release")
    assert max(map(abs, run.speeds_m_s)) < 1.5 * 2 * run.config.approach_speed_m_s
    assert run.last.status.phase == "release" or run.plant.x_m < 0.002


def test_a_repeated_target_changes_nothing(make_run):
    once = make_run().grasp(2.0, 3.0).grasp(5.0, 3.0)
    for every in (1, 20):
        run = make_run().grasp(2.0, 3.0)
        for i in range(600 // every):
            run.grasp(5.0 + (0.04 if i % 2 else 0.0), 0.005 * every)  # a policy's output has noise
        assert run.last.status.outcome == "held"
        assert run.decisions == once.decisions


@pytest.mark.parametrize("feedback", ["fused", "current"])
def test_a_stream_of_targets_is_followed(make_run, feedback):
    run = make_run(feedback=feedback).grasp(3.5)
    errors_n = []
    for i in range(240):  # 8 s at 30 Hz
        target_n = 3.5 + 1.5 * math.sin(2 * math.pi * i / 120)
        run.grasp(target_n, 1 / 30)
        errors_n.append(run.plant.force_n - target_n)
    # The force lags behind: the ramp has its rate, and a fall has to overcome friction twice.
    assert np.sqrt(np.mean(np.square(errors_n))) < 0.6
    run.go(1.5)
    assert run.last.status.outcome == "held"


@pytest.mark.parametrize("feedback", ["fused", "current"])
@pytest.mark.parametrize(("before_n", "target_n"), [(5.0, 2.0), (8.0, 4.0)])
def test_lower_target_is_reached_within_half_a_second(drawn_run, feedback, before_n, target_n):
    errors_n = []
    for seed in range(5):
        run = drawn_run(seed, feedback=feedback)
        run.plant.gain = run.vision.gain = 1.0  # errors of the sensors are not errors of the manoeuvre
        run.grasp(before_n, 5.0).grasp(target_n, 0.5)
        errors_n.append(abs(run.plant.force_n - target_n))
        assert run.last.status.phase == "hold"
        assert "slip" not in [status.outcome for status in run.statuses]
    assert np.median(errors_n) < 0.08 * target_n
    assert max(errors_n) < 0.25 * target_n


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 15.0, 20.0, 30.0, 90.0])
def test_vision_stays_in_use_at_any_frame_rate(make_run, rate_hz):
    run = make_run(vision={"rate_hz": rate_hz}, vision_rate_hz=rate_hz).grasp(4.0)
    assert not [text for text in run.texts if "ms old" in text or "no new estimate" in text]
    assert "vision in use" in [text for text in run.texts if "vision" in text][-1]
    assert run.last.status.outcome == "held"
    assert run.plant.force_n == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize("feedback", ["fused", "current"])
@pytest.mark.parametrize("stiffness_n_m", [250.0, 350.0])
def test_a_lowering_does_not_lose_a_very_soft_object(make_run, feedback, stiffness_n_m):
    run = make_run(plant={"stiffness_n_m": stiffness_n_m}, feedback=feedback).grasp(6.0)
    held = len(run.cell)
    run.grasp(0.5, 2.0)
    assert "slip" not in [status.outcome for status in run.statuses]
    assert min(sample.force_n for sample in run.cell[held:]) > 0.0
    assert run.plant.force_n < run.plant.friction_n + 0.1  # friction alone holds as much


def test_vision_removes_the_rest_of_a_lowering(make_run):
    run = make_run(plant={"stiffness_n_m": 600.0}).grasp(5.0).grasp(2.0, 2.0)
    assert run.plant.force_n == pytest.approx(2.0, abs=0.1)


def test_new_targets_keep_what_the_approach_has_learned_of_friction(make_run):
    run = make_run(plant={"friction_n": 0.6})
    for i in range(100):
        run.grasp(3.0 + i % 2, 0.05)
        if run.last.status.phase == "contact":
            break
    assert run.last.estimate.friction_n == pytest.approx(0.6, abs=0.1)


def test_new_target_in_contact_is_used(make_run):
    run = make_run().to_phase("contact").grasp(2.0)
    assert run.plant.force_n == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("phase", PHASES)
def test_release_pre_empts(make_run, phase):
    run = make_run().to_phase(phase).go(4.0, "release")
    assert run.last.status.phase == "open"
    assert run.plant.x_m < 0.003


@pytest.mark.parametrize("friction", [1.4, 1.8, 3.0, 5.0])
def test_release_opens_jaws_whose_friction_has_grown(make_run, friction):
    run = make_run().grasp(4.0, 3.0)
    run.plant.friction_n *= friction
    run.go(4.0, "release")
    assert run.last.status.phase == "open"
    assert run.plant.x_m < 0.003


@pytest.mark.parametrize("on_slip", ["hold", "open", "regrip"])
@pytest.mark.parametrize(("target_n", "gain"), [(8.1, 0.9), (7.5, 1.25)])
def test_jaws_that_lose_their_object_are_not_faster_than_an_approach(make_run, on_slip, target_n, gain):
    run = make_run(plant={"stiffness_n_m": 5000.0, "gain": gain}, on_slip=on_slip)
    run.grasp(target_n, 2.5)
    run.plant.contact_m = 1.0
    run.go(0.5)
    assert "slip" in [status.outcome for status in run.statuses]
    assert max(run.speeds_m_s) <= 1.4 * run.config.approach_speed_m_s


def test_soft_object_that_is_pressed_flat_is_let_go_slowly(make_run):
    plant = {"stiffness_n_m": 875.0, "contact_m": 0.036, "friction_n": 0.35}
    run = make_run(plant=plant, feedback="current").grasp(7.8)
    assert run.last.status.outcome == "no_object"
    run = make_run(plant=plant | {"contact_m": 0.026}, feedback="current").grasp(7.8)
    run.plant.contact_m = 1.0
    run.go(0.1)
    run.plant.contact_m = 0.036
    run.go(3.0)
    assert run.last.status.outcome == "slip"
    assert -min(run.speeds_m_s) <= 1.5 * 2 * run.config.approach_speed_m_s


@pytest.mark.parametrize("phase", ["open", "approach", "release", "move"])
def test_grasp_pre_empts(make_run, phase):
    run = make_run().to_phase(phase).grasp(2.0)
    assert run.last.status.outcome == "held"


@pytest.mark.parametrize("phase", PHASES)
def test_stop_has_priority_in_every_phase(make_run, phase):
    run = make_run().to_phase(phase)
    before_a = run.last.command.goal_current_a
    start = len(run.decisions)
    run.go(0.5, "stop").go(0.1, "grasp", 4.0).go(0.4)
    after = run.decisions[start:]
    assert {decision.status.phase for decision in after} == {"fault"}
    assert {decision.status.outcome for decision in after} == {"fault"}
    currents = [before_a, *(decision.command.goal_current_a for decision in after)]
    assert all(b <= a for a, b in pairwise(currents))
    assert any("refused 'grasp': " in text and "release first" in text for text in run.texts)
    run.go(4.0, "release").go(0.05)
    assert run.last.status.phase == "open"


@pytest.mark.parametrize("on_fault", ["limp", "hold"])
def test_estimate_over_the_limit_never_prevents_opening(make_run, on_fault):
    run = make_run(vision={"noise_n": 0.7}, feedback="vision", on_fault=on_fault, force_limit_n=4.5)
    run = replace(run, transmission=replace(run.transmission, torque_constant_bound=1.0))
    run.to_phase("hold")
    run.vision.gain = 1.3  # estimates in flight when the stop comes
    run.go(0.02).go(0.5, "stop")
    assert any("over the limit" in event.text for d in run.decisions[-100:] for event in d.events)
    run.go(4.0, "release")
    assert run.last.status.phase == "open"


def test_stop_during_a_release_holds_the_position(make_run):
    run = make_run(on_fault="hold").to_phase("hold").go(0.15, "release")
    run.go(0.005, "stop")
    stopped_m = run.last.status.width_m
    goal_m = run.transmission.width_m(run.last.command.goal_position_rad)
    assert goal_m == pytest.approx(stopped_m, abs=1e-6)
    assert stopped_m < run.transmission.open_width_m - 0.01


def test_at_fault_the_jaws_go_limp(make_run):
    run = make_run().to_phase("hold")
    run.go(0.005, "stop")
    assert run.last.command.goal_current_a == 0.0
    run.go(1.0)
    assert run.plant.force_n <= run.plant.friction_n + 0.01


def test_at_fault_the_hold_is_kept(make_run):
    run = make_run(on_fault="hold").to_phase("hold").go(1.0)
    before_n = run.plant.force_n
    run.go(1.0, "stop")
    assert run.plant.force_n == pytest.approx(before_n, abs=0.1)


def test_a_release_of_a_hot_servo_that_holds_lets_go(make_run):
    run = make_run(on_fault="hold").to_phase("hold").go(1.0)
    run.spoil = lambda _, servo: replace(servo, temperature_c=75.0)
    run.go(1.0)
    assert (run.last.status.phase, run.last.command.goal_current_a > 0) == ("fault", True)
    run.go(0.5, "release")
    assert run.last.status.phase == "fault", "its cause persists"
    assert run.last.command.goal_current_a == 0.0
    run.spoil = lambda _, servo: servo
    run.go(4.0, "release")
    assert run.last.status.phase == "open"


@pytest.mark.parametrize("phase", ["approach", "ramp", "hold"])
def test_at_fault_the_jaws_open(make_run, phase):
    run = make_run(on_fault="open").to_phase(phase).go(3.0, "stop")
    assert run.last.status.phase == "fault"
    assert run.plant.x_m < 0.002
    run.go(0.1, "grasp", 3.0)
    assert run.last.status.phase == "fault"


def test_at_fault_the_jaws_open_against_friction_that_has_grown(make_run):
    run = make_run(on_fault="open").grasp(2.0, 3.0)
    run.plant.friction_n *= 5.0
    run.go(4.0, "stop")
    assert run.last.status.phase == "fault"
    assert run.plant.x_m < 0.003


@pytest.mark.parametrize(("temperature_c", "is_hot"), [(65.0, True), (40.0, False)])
def test_a_result_says_that_a_hot_servo_holds_less(make_run, temperature_c, is_hot):
    run = make_run()
    run.spoil = lambda _, servo: replace(servo, temperature_c=temperature_c)
    run.grasp(4.0)
    assert run.last.status.outcome == "held"
    reduced = "reduced from 4 N because the servo is hot"
    assert any(reason.endswith(reduced) for reason in run.reasons) == is_hot


def test_hot_servo_holds_less_and_reports_it(make_run):
    run = make_run().to_phase("hold").go(1.0)
    before_n, before_a = run.plant.force_n, run.last.command.goal_current_a
    run.spoil = lambda _, servo: replace(servo, temperature_c=65.0)
    run.go(3.0)
    assert run.last.status.outcome == "held"
    assert run.last.status.reference_n == pytest.approx(0.8 * 4.0)
    assert run.last.command.goal_current_a < before_a
    assert run.plant.force_n < before_n
    assert any("at 65 C; holding 3.20 N" in text for text in run.texts)
    run.spoil = lambda _, servo: servo
    run.go(3.0)
    assert run.last.status.reference_n == 4.0


@pytest.mark.parametrize("gain", [0.92, 1.08])
def test_vision_that_reads_low_cannot_exceed_the_limit(make_run, gain):
    run = make_run(force_limit_n=5.0, plant={"gain": gain}, vision={"gain": 0.6}).grasp(4.4)
    assert max(sample.force_n for sample in run.cell) <= 1.05 * 5.0


def test_stop_freezes_moving_jaws(make_run):
    run = make_run(on_fault="hold").to_phase("approach").go(0.3)
    run.go(0.2, "stop")
    where_m = run.plant.x_m
    run.go(1.0)
    assert run.plant.x_m == pytest.approx(where_m, abs=2e-4)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"hardware_error": 0x20}, "hardware error 0x20"),
        ({"temperature_c": 71.0}, "71 C"),
        ({"temperature_c": math.nan}, "not finite"),
        ({"current_a": math.inf}, "not finite"),
    ],
)
def test_fault_is_latched_until_released(make_run, change, reason):
    run = make_run().to_phase("hold")
    run.spoil = lambda _, servo: replace(servo, **change)
    run.go(0.1)
    assert run.last.status.phase == "fault"
    assert any(reason in status.reason for status in run.statuses)
    run.go(0.1, "release")
    assert run.last.status.phase == "fault"  # the cause is still there
    run.spoil = lambda _, servo: servo
    run.go(0.1)
    assert run.last.status.phase == "fault"
    run.go(3.0, "release")
    assert run.last.status.phase == "open"


def test_nothing_moves_before_a_request(make_run):
    run = make_run(plant={"x_m": 0.01})
    run.go(1.0)
    assert run.plant.x_m == pytest.approx(0.01, abs=1e-4)


def test_non_finite_first_reading_moves_nothing(make_run):
    run = make_run(plant={"x_m": 0.01})
    run.spoil = lambda _, servo: replace(servo, position_rad=math.nan)
    run.go(0.5)
    assert {d.command.goal_current_a for d in run.decisions} == {0.0}


@pytest.mark.parametrize("target_n", [0.0, -1.0, 12.1, math.nan, math.inf])
def test_impossible_targets_are_refused(make_run, target_n):
    run = make_run().go(0.1, "grasp", target_n)
    assert run.last.status.phase == "open"
    assert any("refused 'grasp'" in text for text in run.texts)


def test_unknown_requests_are_refused(make_run):
    run = make_run().go(0.1, "dance")
    assert "refused 'dance': unknown kind of request; use grasp, release, move or stop" in run.texts


def test_too_much_force_lowers_the_current(make_run):
    run = make_run(force_limit_n=3.0).grasp(2.5)
    before_a = run.last.command.goal_current_a
    run.spoil = lambda _, servo: replace(servo, current_a=0.15)
    run.go(0.3)
    assert any("over the limit" in text for text in run.texts)
    assert min(d.command.goal_current_a for d in run.decisions[-60:]) < 0.7 * before_a


def test_late_cycle_causes_no_jump(make_run):
    run = make_run().to_phase("ramp")
    before = run.last.status.reference_n
    run.t_ns += 2_000_000_000
    run.go(0.005)
    assert run.last.status.reference_n - before <= 8.0 * 0.05


def test_replay_is_bit_for_bit_identical(drawn_run, transmission):
    run = drawn_run(3).grasp(4.0).go(1.0, "release")
    again = GraspController(run.config, transmission, 1.2, POSITION_LOOP)
    assert [again.step(*inputs) for inputs in run.inputs] == run.decisions


wild = st.one_of(st.floats(-10, 10), st.sampled_from([math.nan, math.inf, -math.inf]))
servos = st.builds(ServoState, st.just(0), wild, wild, wild, wild, wild, st.sampled_from([0, 0, 0, 32]))
visuals = st.one_of(
    st.none(),
    st.builds(
        VisualForce, st.integers(0, 10**9), st.just(0), st.just(0), wild | st.just(1e300), wild, st.just(1.0)
    ),
)
requests = st.one_of(
    st.none(),
    st.builds(
        Request,
        st.just(0),
        st.sampled_from(["grasp", "release", "move", "stop", "dance"]),
        wild,
        wild | st.floats(0, 0.092),
    ),
)


@settings(deadline=None, max_examples=100)
@given(
    st.lists(st.tuples(servos, visuals, requests), min_size=1, max_size=30),
    st.sampled_from(["fused", "current", "vision"]),
)
def test_command_is_within_limits_for_any_input(transmission, inputs, feedback):
    config = ControlConfig(feedback=feedback)
    controller = GraspController(config, transmission, 0.3)
    position_rad = None
    for i, (servo, visual, request) in enumerate(inputs):
        t_ns = i * 20_000_000
        decision = controller.step(t_ns, replace(servo, t_ns=t_ns), visual, request)
        command = decision.command
        assert 0.0 <= command.goal_current_a <= 0.3
        if is_plausible(servo):
            position_rad = servo.position_rad
        if position_rad is not None:
            low_rad = min(position_rad, transmission.goal_range_rad[0])
            high_rad = max(position_rad, transmission.goal_range_rad[1])
            assert low_rad <= command.goal_position_rad <= high_rad
            assert abs(command.goal_position_rad - position_rad) < 0.11  # 2 mm of one jaw
        assert math.isfinite(decision.estimate.force_n)
        if request is not None and request.kind == "stop":
            assert decision.status.phase == "fault"


def test_paper_is_gripped_with_the_full_force(make_run):
    """The servo's position loop needs a goal beyond the closed jaws: 0.2 mm is too short a lead for its current."""
    run = make_run(
        plant={"contact_m": 0.04585, "stops_m": (0.0, 0.046), "stiffness_n_m": 2e5, "play_m": 0.0},
        min_object_width_m=0.0001,
        feedback="current",
    ).grasp(9.0, 6.0)
    assert run.last.status.outcome == "held"
    assert run.plant.force_n == pytest.approx(9.0, abs=0.5)


@pytest.mark.parametrize(("least_m", "outcome"), [(0.0, "no_object"), (-0.002, "held")])
def test_gear_play_and_soft_pads_make_paper_look_thinner_than_nothing(make_run, least_m, outcome):
    plant = {"contact_m": 0.04595, "stops_m": (0.0, 0.05), "stiffness_n_m": 2e4, "play_m": 0.0003}
    run = make_run(plant=plant, min_object_width_m=least_m, feedback="current").grasp(4.0)
    assert run.last.status.outcome == outcome


def test_camera_that_sees_far_too_much_does_not_confirm_jaws_that_friction_holds(make_run):
    run = make_run(plant={"friction_n": 0.9}, vision={"gain": 1.4, "noise_n": 0.05}).grasp(0.8, 9.0)
    assert run.last.status.outcome == "held"
    run.plant.stiffness_n_m, run.vision.gain = 1e-3, 1e9  # nothing presses; the network gives any force
    run.go(0.5)
    assert run.last.status.outcome == "slip"
    assert any("the camera sees" in reason for reason in run.reasons)


def regrip(run, target_n):
    return run.go(2.0, "release").grasp(target_n)


def test_the_gain_of_a_strange_object_is_learned_over_grasps_and_replays_bit_for_bit(make_run, transmission):
    run = make_run(vision={"gain": 0.5})
    run.grasp(3.0, 6.0)
    assert run.last.estimate.object_gain == pytest.approx(2.0, rel=0.15)
    assert "fused" not in {decision.estimate.source for decision in run.decisions[-100:]}
    regrip(run, 4.0)
    assert run.last.status.outcome == "held"
    assert run.last.estimate.source == "fused"
    ratio = run.controller.end_grasps()
    assert ratio[0] == pytest.approx(2.0, rel=0.1)
    again = GraspController(run.config, transmission, 1.2, POSITION_LOOP)
    assert [again.step(*inputs) for inputs in run.inputs] == run.decisions
    assert again.end_grasps() == ratio


def test_a_move_between_two_grasps_keeps_what_was_learned(make_run):
    run = make_run(vision={"gain": 0.5}).grasp(3.0).move(0.08, 2.0).grasp(4.0)
    assert run.last.estimate.source == "fused"


def test_what_was_learned_of_one_object_is_forgotten_for_another(make_run):
    run = make_run(vision={"gain": 0.5}).grasp(3.0).go(2.0, "release")
    run.inputs.clear()
    decision = run.controller.step(
        run.t_ns, run.plant.read(run.t_ns, 0.0), None, Request(run.t_ns, "grasp", 4.0, new_object=True)
    )
    assert decision.refusal == ""
    assert decision.status.phase == "approach"
    assert run.controller.end_grasps() is None


def test_a_held_object_can_not_be_a_new_one(make_run):
    run = make_run().grasp(3.0)
    servo = run.plant.read(run.t_ns, 0.0)
    decision = run.controller.step(run.t_ns, servo, None, Request(run.t_ns, "grasp", 4.0, new_object=True))
    assert "release before the grasp of a new one" in decision.refusal


@pytest.mark.parametrize("end", ["stop", ""])
def test_a_grasp_without_a_good_end_teaches_nothing(make_run, end):
    run = make_run(vision={"gain": 0.5})
    run.grasp(3.0, 6.0 if end else 1.5)
    assert (run.last.status.outcome == "held") == bool(end)
    if end:
        run.go(0.05, end)
    run.go(2.0, "release")
    assert run.controller.end_grasps() is None


def test_a_stopped_grasp_after_a_good_one_teaches_nothing(make_run):
    once, twice = (make_run(vision={"gain": 0.5}).grasp(3.0).go(2.0, "release") for _ in range(2))
    twice.grasp(4.0).go(0.05, "stop").go(2.0, "release")
    assert twice.controller.end_grasps() == once.controller.end_grasps()
