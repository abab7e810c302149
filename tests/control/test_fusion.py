import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import ControlConfig
from gripper_force.control.fusion import NO_NEW_ESTIMATE, Fusion, drop_out_reason
from gripper_force.types import ServoState, VisualForce

MS = 1_000_000


class Bench:
    """A motor with a known force, and vision with a delay of 40 ms."""

    def __init__(self, transmission, **control):
        self.transmission = transmission
        self.fusion = Fusion(ControlConfig(**control), transmission)
        self.t_ns = 0
        self.events = []
        self.estimate = None

    def run(
        self,
        time_s,
        motor_force_n,
        seen_n=None,
        std_n=0.1,
        latency_ms=40,
        noise=None,
        free=False,
        opening=False,
        lowering=False,
        gripping=False,
        holding=False,
        closing_m_s=0.0,
    ):
        """`motor_force_n` and `seen_n` are functions of the time in seconds; `seen_n` is the visual force."""
        for _ in range(round(time_s * 200)):
            t_s = self.t_ns / 1e9
            damping_n = self.transmission.damping_n_s_m * closing_m_s
            current_a = self.transmission.current_a(motor_force_n(t_s) + damping_n, 0.0)
            rad_s = closing_m_s / self.transmission.closing_m_s(1.0, 0.0)
            servo = ServoState(self.t_ns, 0.0, rad_s, current_a, 30.0, 12.0, 0)
            visual = None
            if seen_n is not None and self.t_ns // (5 * MS) % 3 == 0:
                capture_ns = self.t_ns - latency_ms * MS
                force_n = seen_n(capture_ns / 1e9) + (noise.normal(0, std_n) if noise else 0.0)
                visual = VisualForce(capture_ns, self.t_ns, self.t_ns, force_n, std_n, 10.0)
            self.estimate, events = self.fusion.step(
                self.t_ns,
                servo,
                visual,
                free=free,
                gripping=gripping,
                holding=holding,
                opening=opening,
                lowering=lowering,
            )
            self.events += [event.text for event in events]
            self.t_ns += 5 * MS
        return self.estimate


@pytest.fixture
def bench(transmission):
    return lambda **control: Bench(transmission, **control)


def test_current_alone_subtracts_friction(bench, transmission):
    b = bench(feedback="current")
    estimate = b.run(1.0, lambda _: 3.0 + transmission.friction_n, lambda _: 9.0)
    assert estimate.force_n == pytest.approx(3.0, abs=1e-6)
    assert (estimate.source, estimate.bias_n, b.events) == ("current", 0.0, [])


def test_friction_acts_as_play(bench, transmission):
    b = bench(feedback="current")
    b.run(1.0, lambda _: 3.0 + transmission.friction_n)
    assert b.run(1.0, lambda _: 3.0 - 0.9 * transmission.friction_n).force_n == pytest.approx(3.0, abs=1e-6)
    assert b.run(1.0, lambda _: 2.0 - transmission.friction_n).force_n == pytest.approx(2.0, abs=1e-6)


def test_sliding_jaws_leave_the_play(bench, transmission):
    motor_force_n = 3.0
    b = bench(feedback="current")
    b.run(1.0, lambda _: motor_force_n + transmission.friction_n)
    held = b.run(0.5, lambda _: motor_force_n, holding=True)
    assert held.current_n == pytest.approx(motor_force_n, abs=1e-6)
    slid = b.run(0.05, lambda _: motor_force_n, holding=True, closing_m_s=0.02)
    assert slid.current_n == pytest.approx(motor_force_n - transmission.friction_n, abs=0.001)


def test_vision_finds_the_bias(bench):
    b = bench()
    estimate = b.run(2.0, lambda _: 4.0, lambda _: 3.4, noise=np.random.default_rng(0))
    assert estimate.force_n == pytest.approx(3.4, abs=0.05)
    assert estimate.source == "fused"
    assert estimate.std_n < 0.2
    assert b.events == ["vision in use; the force estimate is fused"]


def test_latency_causes_no_error_on_a_ramp(bench, transmission):
    """The comparison is made at the capture time, so the delay of vision causes no bias on a ramp."""
    b = bench()
    friction_n = transmission.friction_n
    b.run(0.5, lambda _: friction_n, lambda _: 0.0)
    ramp = lambda t: max(4.0 * (t - 0.5), 0.0)  # noqa: E731
    lag_s = 0.06  # lag of the plant, on both sides of the comparison
    estimate = b.run(1.5, lambda t: ramp(t) + friction_n, lambda t: ramp(t - lag_s))
    assert estimate.bias_n == pytest.approx(0.0, abs=0.03)


def test_free_travel_identifies_friction(bench, transmission):
    b = bench(feedback="current")
    nominal_n = transmission.friction_n
    before = b.run(0.5, lambda _: nominal_n + 0.2)
    estimate = b.run(1.0, lambda _: nominal_n + 0.2, free=True)
    assert estimate.friction_n == pytest.approx(nominal_n + 0.2, abs=0.02)
    assert estimate.force_n == 0.0
    assert estimate.std_n < before.std_n
    pressing = b.run(1.0, lambda _: nominal_n + 3.2)
    assert pressing.force_n == pytest.approx(3.0, abs=0.02)
    b.fusion.restart()
    assert b.run(0.005, lambda _: nominal_n + 3.2).friction_n == nominal_n


def test_vision_is_followed_while_the_jaws_open(bench, transmission):
    friction_n = transmission.friction_n
    estimates = []
    for opening in (False, True):
        b = bench()
        b.run(1.0, lambda _: 3.0 + friction_n, lambda _: 3.0)
        # Within the friction play, the current estimate does not change.
        estimates.append(
            b.run(0.05, lambda _: 3.0 - 0.5 * friction_n, lambda _: 2.2, opening=opening).force_n
        )
    assert estimates[1] == pytest.approx(2.2, abs=0.1)
    assert estimates[0] > estimates[1]


@given(st.lists(st.floats(-50, 50), min_size=1, max_size=30))
def test_friction_is_never_negative_for_any_motor_force(transmission, motor_forces_n):
    b = Bench(transmission, feedback="current")
    for motor_force_n in motor_forces_n:
        assert b.run(0.005, lambda _, n=motor_force_n: n, free=True).friction_n >= 0


@pytest.mark.parametrize(
    ("seen_n", "std_n", "latency_ms", "reason"),
    [
        (math.nan, 0.1, 40, "finite"),
        (3.0, math.inf, 40, "finite"),
        (1e300, 0.3, 40, "finite"),
        (3.0, 0.1, 61, "61 ms old"),
        (3.0, 0.1, -10, "in the future"),
        (3.0, 1.6, 40, "standard deviation is 1.60 N"),
        (9.0, 0.1, 40, "differs from the motor current by"),
    ],
)
def test_bad_vision_drops_out_with_its_reason(bench, seen_n, std_n, latency_ms, reason):
    b = bench(vision_age_ms=60.0)
    b.run(1.0, lambda _: 4.0, lambda _: 3.2)
    before = b.estimate
    estimate = b.run(0.2, lambda _: 4.0, lambda _: seen_n, std_n=std_n, latency_ms=latency_ms)
    assert estimate.source == "current"
    assert estimate.force_n == pytest.approx(before.force_n, abs=0.02)
    assert len(b.events) == 2
    assert reason in b.events[-1]
    b.run(0.2, lambda _: 4.0, lambda _: 3.2)
    assert b.events[-1] == "vision in use; the force estimate is fused"


def test_one_frame_from_the_future_does_not_hide_later_ones(bench):
    b = bench()
    b.run(1.0, lambda _: 4.0, lambda _: 3.2)
    b.run(0.015, lambda _: 4.0, lambda _: 3.2, latency_ms=-3_600_000)
    b.run(0.5, lambda _: 4.0, lambda _: 3.2)
    assert b.estimate.source == "fused"


def test_vision_that_is_rejected_from_the_start_has_one_event_with_its_reason(bench):
    b = bench()
    b.run(0.5, lambda _: 4.0, lambda _: 3.2, std_n=1.6)
    assert b.events == ["vision is not used: its standard deviation is 1.60 N; using motor current alone"]
    b.run(0.5, lambda _: 4.0, lambda _: 3.2)
    b.run(0.5, lambda _: 4.0)
    assert b.events[1:] == [
        "vision in use; the force estimate is fused",
        "vision dropped out: no new estimate; using motor current alone",
    ]
    reasons = [drop_out_reason(text) for text in b.events]
    assert reasons == ["its standard deviation is 1.60 N", None, NO_NEW_ESTIMATE]


def test_not_finite_drops_out_in_the_same_cycle(bench):
    b = bench()
    b.run(1.0, lambda _: 4.0, lambda _: 3.2)
    while b.t_ns // (5 * MS) % 3:
        b.run(0.005, lambda _: 4.0)
    assert b.run(0.005, lambda _: 4.0, lambda _: math.nan).source == "current"


def test_std_grows_without_vision(bench):
    b = bench()
    sharp = b.run(1.0, lambda _: 4.0, lambda _: 3.2).std_n
    wide = b.run(5.0, lambda _: 4.0)
    assert wide.source == "current"
    assert wide.std_n > sharp
    assert "no new estimate" in b.events[-1]


@pytest.mark.parametrize(("rate_hz", "rejected_s"), [(60.0, 0.28), (5.0, 0.04)])
def test_jump_is_gated_until_it_persists(bench, rate_hz, rejected_s):
    b = bench(vision_rate_hz=rate_hz)
    b.run(2.0, lambda _: 4.0, lambda _: 3.2)
    assert b.run(rejected_s, lambda _: 4.0, lambda _: 2.6).bias_n == pytest.approx(3.2 - 3.05, abs=0.05)
    assert b.run(0.04, lambda _: 4.0, lambda _: 2.6).force_n < 2.8
    if rate_hz == 60.0:  # at 5 Hz, this time is no drop-out yet
        assert "jumps by" in b.events[1]


def test_jumps_to_both_sides_are_always_rejected(bench):
    b = bench()
    b.run(2.0, lambda _: 4.0, lambda _: 3.05)
    estimate = b.run(2.0, lambda _: 4.0, lambda t: 3.05 + (0.6 if round(t * 1000) // 15 % 2 else -0.6))
    assert estimate.source == "current"
    assert estimate.force_n == pytest.approx(3.05, abs=0.05)


def test_vision_alone_is_the_newest_estimate(bench):
    b = bench(feedback="vision")
    assert b.run(1.0, lambda _: 4.0, lambda t: 3.0 + 0.1 * t).force_n == pytest.approx(3.095, abs=0.006)
    assert b.estimate.source == "vision"
    assert b.run(0.1, lambda _: 4.0).source == "current"
    assert b.run(0.1, lambda _: 4.0).force_n == pytest.approx(3.07, abs=0.05)


def test_repeated_estimate_is_used_once(transmission):
    fusion = Fusion(ControlConfig(), transmission)
    visual = VisualForce(0, 0, 0, 0.3, 0.1, 1.0)
    for i in range(5):
        estimate, _ = fusion.step(i * 5 * MS, ServoState(i * 5 * MS, 0.0, 0.0, 0.0, 30.0, 12.0, 0), visual)
        if i == 0:
            first = estimate.bias_n
    assert estimate.bias_n == first != 0.0


def test_a_gripper_without_friction(transmission):
    b = Bench(replace(transmission, friction_n=0.0))
    assert b.run(1.0, lambda _: 2.0).force_n == pytest.approx(2.0, abs=1e-6)


def test_estimate_before_the_first_reading_is_compared_with_the_oldest_current(transmission):
    fusion = Fusion(ControlConfig(), transmission)
    servo = ServoState(50 * MS, 0.0, 0.0, transmission.current_a(1.0, 0.0), 30.0, 12.0, 0)
    estimate, _ = fusion.step(50 * MS, servo, VisualForce(10 * MS, 50 * MS, 0, 0.3, 0.1, 1.0))
    assert estimate.source == "fused"
    assert 0.0 < estimate.bias_n < 0.3 - estimate.current_n


def test_vision_keeps_its_error_on_a_rig_with_a_wide_prior(transmission):
    """`1 - gain` cancels for a gain close to one."""
    loose = Bench(replace(transmission, friction_std=1e9))
    known = Bench(replace(transmission, friction_std=1e2))
    ends = [b.run(1.0, lambda _: 4.0, lambda _: 3.4) for b in (loose, known)]
    assert ends[0].std_n == pytest.approx(ends[1].std_n, rel=1e-3)
    assert ends[0].std_n > 0.1


def test_while_the_force_is_lowered_the_difference_by_the_gearing_falls_with_it(bench, transmission):
    """A difference that the friction may cause stays."""
    b = bench()
    before = b.run(3.0, lambda _: 8.0 + transmission.friction_n, lambda _: 7.0)
    after = b.run(0.3, lambda _: 2.0 - transmission.friction_n, lambda _: 7.0, lowering=True)
    assert after.current_n == pytest.approx(2.0, abs=0.1)
    assert 0.25 * before.bias_n > after.bias_n > 0.75 * before.bias_n
    assert b.events == ["vision in use; the force estimate is fused"], "the lag of vision is no drop-out"


def test_lowering_a_force_that_is_zero_already(bench):
    estimate = bench().run(0.1, lambda _: 0.0, lambda _: 0.0, lowering=True)
    assert estimate.force_n == pytest.approx(0.0, abs=0.1)


def test_after_a_lowering_known_friction_still_counts(bench, transmission):
    """With 0.4 times the friction as its error, the motor current had a quarter of the weight of vision."""
    b, friction_n = bench(), transmission.friction_n
    b.run(0.3, lambda _: friction_n, lambda _: 0.0, free=True)
    b.run(2.0, lambda _: 5.0 + friction_n, lambda _: 5.0, gripping=True, holding=True)
    b.run(0.3, lambda _: 2.0 - friction_n, lambda _: 2.0, gripping=True, lowering=True)
    after = b.run(1.0, lambda _: 2.0, lambda _: 1.8, std_n=0.2, gripping=True, holding=True)
    share = after.bias_n / (1.8 - after.current_n)
    assert 0.4 < share < 0.6


def test_without_a_lowering_the_difference_stays(bench, transmission):
    b = bench()
    before = b.run(3.0, lambda _: 8.0 + transmission.friction_n, lambda _: 7.0)
    after = b.run(0.3, lambda _: 2.0 - transmission.friction_n)
    assert after.bias_n == pytest.approx(before.bias_n)


def grip(bench, transmission, force_n, ratio, time_s=2.0, **options):
    """One grasp: free travel, then a hold with a visual force that is too small by ``ratio``."""
    friction_n = transmission.friction_n
    bench.run(0.5, lambda _: friction_n, lambda _: 0.0)
    bench.run(0.3, lambda _: friction_n, lambda _: 0.0, free=True)
    bench.run(0.1, lambda _: force_n + friction_n, lambda _: force_n / ratio, gripping=True)
    return bench.run(
        time_s,
        lambda _: force_n + friction_n,
        lambda _: force_n / ratio,
        gripping=True,
        holding=True,
        **options,
    )


def test_the_next_grasp_uses_the_gain_of_this_one(bench, transmission):
    b = bench()
    first = grip(b, transmission, 4.0, 2.0)
    assert first.source == "current"  # vision differs too much
    assert first.object_gain == pytest.approx(2.0, rel=0.1)
    b.fusion.restart(was_held=True)
    second = grip(b, transmission, 3.0, 2.0)
    assert second.source == "fused"
    assert second.force_n == pytest.approx(3.0, abs=0.1)
    b.fusion.restart(was_held=True, new_object=True)
    assert b.run(0.1, lambda _: 0.0, lambda _: 0.0).object_gain == 0.0


def test_a_change_of_the_object_is_one_event(bench, transmission):
    b = bench()
    for ratio in (1.0, 2.0):
        grip(b, transmission, 4.0, ratio)
        b.fusion.restart(was_held=True)
    b.run(0.1, lambda _: 0.0)
    assert len([text for text in b.events if "another object" in text]) == 1


def test_a_gain_counts_only_after_a_grasp_that_was_held(bench, transmission):
    b = bench()
    grip(b, transmission, 4.0, 2.0)
    b.fusion.restart(was_held=False)
    assert b.run(0.1, lambda _: 0.0, lambda _: 0.0).object_gain == 0.0


def test_learning_can_be_off(bench, transmission):
    b = bench(learn_gain=False, object_ratio=(2.0, 0.05))
    estimate = grip(b, transmission, 4.0, 2.0)
    b.fusion.restart(was_held=True)
    assert (estimate.source, estimate.object_gain) == ("current", 0.0)
    assert grip(b, transmission, 3.0, 2.0).source == "current"


def test_an_implausible_gain_is_an_event_and_vision_is_not_used(bench, transmission):
    b = bench(object_ratio=(5.0, 0.05))
    estimate = grip(b, transmission, 4.0, 1.0)
    assert estimate.source == "current"
    assert b.events[0].startswith("vision is not used: motor current was 5.00 times the visual force")


def test_what_vision_and_current_share_stays_in_the_claim(bench, transmission):
    """After many grasps of a strange object, vision agrees with the current but has its torque constant's error."""
    b = bench(object_ratio=(2.0, 0.01))
    estimate = grip(b, transmission, 6.0, 2.0)
    assert estimate.source == "fused"
    assert estimate.std_n > 0.9 * transmission.torque_constant_std * 6.0


def test_a_changing_force_is_claimed_to_be_less_certain(bench, transmission):
    friction_n = transmission.friction_n
    b = bench(feedback="current")
    b.run(0.1, lambda _: friction_n, gripping=True)
    steady = b.run(1.9, lambda _: 1.0 + friction_n, gripping=True)
    rising = b.run(0.5, lambda t: 1.0 + friction_n + 6 * (t - 2.0), gripping=True)
    # The estimate lags by the time constant of its filter.
    assert rising.std_n > steady.std_n + 0.15
    held = b.run(1.0, lambda _: 4.0 + friction_n, gripping=True)
    assert held.std_n < rising.std_n
    assert held.friction_n == friction_n


def test_after_an_impact_friction_may_hold_the_jaws_until_the_force_has_risen(bench, transmission):
    friction_n = transmission.friction_n
    b = bench(feedback="current")
    b.run(0.5, lambda _: friction_n, free=True)
    b.run(0.5, lambda _: 0.4 + friction_n)
    impact = b.run(0.5, lambda _: 0.5 + friction_n, gripping=True)
    risen = b.run(1.0, lambda _: 1.5 + friction_n, gripping=True)
    assert 0.2 < impact.std_n < 0.35
    assert risen.std_n < 0.15


def test_a_bias_from_vision_is_in_doubt_once_vision_contradicts_the_current(bench, transmission):
    friction_n = transmission.friction_n
    b = bench()
    b.run(0.1, lambda _: friction_n, gripping=True)
    agreed = b.run(1.9, lambda _: 2.0 + friction_n, lambda _: 1.5, gripping=True)
    contradicted = b.run(1.0, lambda _: 2.0 + friction_n, lambda _: 7.0, gripping=True)
    assert agreed.bias_n < -0.25
    assert contradicted.source == "current"
    assert contradicted.std_n > agreed.std_n + 0.1


def test_the_force_of_free_jaws_is_zero_also_if_vision_sees_one(bench, transmission):
    b, friction_n = bench(), transmission.friction_n
    b.run(0.5, lambda _: friction_n, lambda _: 0.0)
    estimate = b.run(2.0, lambda _: friction_n, lambda _: 0.3, free=True)
    assert estimate.force_n == pytest.approx(0.0, abs=1e-6)
