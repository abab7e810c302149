import math

import pytest

from gripper_force.errors import DataError
from gripper_force.jobs.score import VisionLoss, score_grasp, vision_in_hold
from gripper_force.types import Event, FusedForce, GraspStatus, LoadCellSample, Phase, VisualForce

MS = 1_000_000


def statuses(*phases):
    """100 cycles of 10 ms for each phase."""
    return [
        GraspStatus(10 * MS * i, phase, "", 0.0, 0.05)
        for i, phase in enumerate(p for p in phases for _ in range(100))
    ]


def cell(force_of_s, seconds):
    return [LoadCellSample(10 * MS * i, force_of_s(i / 100), 0.0) for i in range(round(100 * seconds))]


def test_score_of_known_curve():
    states = statuses(Phase.OPEN, Phase.RAMP, Phase.HOLD, Phase.HOLD, Phase.HOLD, Phase.RELEASE)
    force = lambda t: 9.0 if t < 1 else 0.0 if t > 5 else 4.5 if t < 2 else 4.08  # noqa: E731
    score = score_grasp(cell(force, 6), states, 4.0)
    assert score.steady_n == pytest.approx(4.08)
    assert score.steady_error_n == pytest.approx(0.08)
    assert score.overshoot_n == pytest.approx(0.5)  # the 9 N came before the grasp
    assert score.settle_s == pytest.approx(1.0)


def test_score_uses_last_grasp_and_valid_samples():
    states = statuses(Phase.RAMP, Phase.HOLD, Phase.RELEASE, Phase.RAMP, Phase.HOLD, Phase.HOLD)
    samples = cell(lambda t: 2.0 if t < 3 else 1.0, 6)
    samples[450] = LoadCellSample(450 * 10 * MS, -70.0, 0.0, valid=False)
    score = score_grasp(samples, states, 1.0)
    assert (score.steady_error_n, score.overshoot_n, score.settle_s) == (0.0, 0.0, 0.0)


def test_a_changed_force_is_scored_from_its_request_on():
    states = statuses(Phase.RAMP, Phase.HOLD, Phase.HOLD, Phase.RAMP, Phase.HOLD)
    lowered = cell(lambda t: 6.0 if t < 3 else max(6.0 - 4 * (t - 3), 2.9 if t < 4.2 else 3.0), 5)
    score = score_grasp(lowered, states, 3.0, 3_000 * MS)
    assert score.overshoot_n == 0.0
    assert score.settle_s == pytest.approx(0.72, abs=0.02)
    assert score_grasp(lowered, states, 3.0).overshoot_n == pytest.approx(3.0)


def test_a_later_grasp_that_held_nothing_has_no_score():
    states = statuses(Phase.RAMP, Phase.HOLD, Phase.RELEASE, Phase.APPROACH, Phase.RAMP)
    with pytest.raises(DataError, match="no hold to score"):
        score_grasp(cell(lambda _: 3.0, 5), states, 6.0, 3_000 * MS)


def test_hard_contact_is_overshoot():
    states = statuses(Phase.APPROACH, Phase.CONTACT, Phase.RAMP, Phase.HOLD)
    score = score_grasp(cell(lambda t: 3.0 if 0.5 < t < 1.5 else 2.0, 4), states, 2.0)
    assert score.overshoot_n == pytest.approx(1.0)
    assert score.settle_s == 0.0  # which counts from the ramp on


def test_settling_time_is_nan_without_settling():
    assert math.isnan(score_grasp(cell(lambda _: 2.0, 2), statuses(Phase.RAMP, Phase.HOLD), 4.0).settle_s)


@pytest.mark.parametrize(("gap_s", "counts"), [(0.2, True), (0.3, False)])
def test_gap_of_load_cell_in_hold_raises(gap_s, counts):
    states = statuses(Phase.RAMP, Phase.HOLD, Phase.HOLD)
    samples = [s for s in cell(lambda _: 2.0, 3) if not 2.5 <= s.t_ns / 1e9 < 2.5 + gap_s]
    if counts:
        assert score_grasp(samples, states, 2.0).steady_error_n == 0.0
    else:
        with pytest.raises(DataError, match=r"no valid sample for 0\.31 s of the hold"):
            score_grasp(samples, states, 2.0)


def test_run_without_hold_or_samples_raises():
    with pytest.raises(DataError, match="no hold"):
        score_grasp(cell(lambda _: 1.0, 1), statuses(Phase.APPROACH), 4.0)
    with pytest.raises(DataError, match="load cell"):
        score_grasp(cell(lambda _: 1.0, 0.5), statuses(Phase.RAMP, Phase.HOLD), 4.0)


def fused(states, is_used):
    sources = ("fused" if is_used(i) else "current" for i in range(len(states)))
    return [
        FusedForce(s.t_ns, 1.0, 0.1, 1.0, 0.0, 0.0, source) for s, source in zip(states, sources, strict=True)
    ]


def rounded(used):
    return round(used.share, 6), [(loss.reason, round(loss.time_s, 6)) for loss in used.losses]


def told(*entries):
    return [Event(10 * MS * cycle, "vision", text) for cycle, text in entries]


def dropped(reason):
    return f"vision dropped out: {reason}; using motor current alone"


def test_no_hold_has_no_share_of_vision():
    states = statuses(Phase.APPROACH)
    assert vision_in_hold(states, fused(states, lambda _: True), [], []) is None


def test_share_of_vision_counts_the_hold_of_the_last_grasp():
    states = statuses(Phase.RAMP, Phase.HOLD, Phase.RELEASE, Phase.RAMP, Phase.HOLD, Phase.RELEASE)
    used = vision_in_hold(
        states, fused(states, lambda i: i >= 425), [], told((90, dropped("it is 70 ms old")))
    )
    assert rounded(used) == (0.75, [("it is 70 ms old", 0.25)])


def test_losses_are_summed_by_reason_and_the_longest_comes_first():
    states = statuses(Phase.RAMP, Phase.HOLD)
    lost = {*range(100, 110), *range(120, 150), *range(160, 175)}
    events = told(
        (100, dropped("it jumps by -0.90 N")),
        (110, "vision in use; the force estimate is fused"),
        (120, dropped("it differs from the motor current by 1.20 N")),
        (160, dropped("it jumps by 1.10 N")),
    )
    used = vision_in_hold(states, fused(states, lambda i: i not in lost), [], events)
    losses = [("it differs from the motor current by 1.20 N", 0.3), ("it jumps by 1.10 N", 0.25)]
    assert rounded(used) == (0.45, losses)


@pytest.mark.parametrize(("ready_cycle", "reason"), [(120, "too dark"), (140, "no new estimate")])
def test_a_frame_without_estimate_tells_why_there_was_no_new_one(ready_cycle, reason):
    states = statuses(Phase.RAMP, Phase.HOLD)
    visuals = [VisualForce(0, 10 * MS * ready_cycle, 0, 1.0, 0.1, 1.0)]
    events = told((130, "no estimate: too dark"), (150, dropped("no new estimate")))
    used = vision_in_hold(states, fused(states, lambda i: i < 150), visuals, events)
    assert rounded(used) == (0.5, [(reason, 0.49)])


def test_vision_that_was_never_used_is_a_loss_too():
    states = statuses(Phase.HOLD, Phase.RELEASE)
    used = vision_in_hold(states, fused(states, lambda _: False), [], [])
    assert rounded(used) == (0.0, [("no estimate was used", 1.0)])


def test_a_view_that_the_network_does_not_know_is_the_reason_of_a_loss():
    states = statuses(Phase.HOLD, Phase.RELEASE)
    used = vision_in_hold(states, fused(states, lambda _: False), [], told((0, "no estimate: unlike all")))
    assert rounded(used) == (0.0, [("unlike all", 1.0)])


def test_a_loss_says_that_a_number_in_its_reason_is_that_of_its_first_estimate():
    assert str(VisionLoss("it jumps by -0.90 N", 0.25)) == "for 0.2 s: at first it jumps by -0.90 N"
    assert str(VisionLoss("no new estimate", 1.0)) == "for 1.0 s: no new estimate"
