import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.control.object_gain import KIND_STD, GainEstimate, ObjectGain

ratios = st.floats(0.2, 5.0)
stds = st.floats(0.02, 0.5)
measurements = st.lists(st.tuples(ratios, stds), min_size=1, max_size=20)
torque_constant_stds = st.floats(0.005, 0.2)


def learned(torque_constant_std: float, pairs: list[tuple[float, float]]) -> ObjectGain:
    gain = ObjectGain(torque_constant_std)
    for pair in pairs:
        gain.add(*pair)
    return gain


def posterior(gain: ObjectGain, *, with_present: bool = False) -> GainEstimate:
    estimate = gain.estimate(with_present=with_present)
    assert estimate is not None
    return estimate


def ratio_of(gain: ObjectGain) -> float:
    assert gain.ratio is not None
    return gain.ratio[0]


def hold(gain: ObjectGain, current_n: float, visual_n: float, frames: int = 60) -> None:
    for _ in range(frames):
        gain.observe(current_n, visual_n, 0.02)


@given(torque_constant_stds, measurements)
def test_the_posterior_is_never_narrower_than_torque_constant_and_kind_together(torque_constant_std, pairs):
    estimate = posterior(learned(torque_constant_std, pairs))
    least = 1 / math.sqrt(1 / torque_constant_std**2 + 1 / KIND_STD**2)
    assert estimate.std >= least * (1 - 1e-9)
    assert estimate.shared_std <= min(estimate.std, torque_constant_std) * (1 + 1e-9)


def test_a_thousand_grasps_do_not_average_out_the_torque_constant():
    estimate = posterior(learned(0.06, [(1.5, 0.05)] * 1000))
    assert estimate.std == pytest.approx(0.06, rel=0.05)
    assert estimate.gain == pytest.approx(1.5, rel=0.05)


@given(torque_constant_stds, measurements, st.randoms())
def test_the_order_of_the_grasps_does_not_matter(torque_constant_std, pairs, random):
    mixed = list(pairs)
    random.shuffle(mixed)
    one, other = (
        posterior(learned(torque_constant_std, pairs)),
        posterior(learned(torque_constant_std, mixed)),
    )
    assert other.gain == pytest.approx(one.gain, rel=1e-9)
    assert other.std == pytest.approx(one.std, rel=1e-6)


@given(torque_constant_stds, ratios, stds)
def test_the_gain_lies_between_that_of_the_kind_and_what_was_measured(torque_constant_std, ratio, std):
    estimate = posterior(learned(torque_constant_std, [(ratio, std)]))
    assert min(1.0, ratio) <= estimate.gain <= max(1.0, ratio)


def test_a_usual_object_keeps_its_kinds_gain_and_an_unusual_one_gets_its_own():
    assert posterior(learned(0.06, [(1.05, 0.05)])).gain == pytest.approx(1.0, abs=0.012)
    for ratio in (0.5, 2.0):
        estimate = posterior(learned(0.06, [(ratio, 0.05)] * 3))
        assert math.log(estimate.gain / ratio) == pytest.approx(0.0, abs=0.05)
        assert estimate.std < 0.08


@given(st.lists(st.tuples(*[st.floats()] * 3), max_size=80))
def test_numbers_that_are_not_finite_do_no_harm(frames):
    gain = ObjectGain(0.06)
    hold(gain, 3.0, 2.0)
    before = posterior(gain, with_present=True)
    for frame in frames:
        if not all(abs(value) < 1e9 for value in frame):
            gain.observe(math.nan, frame[1], frame[2])
            gain.observe(frame[0], math.inf, frame[2])
    assert gain.estimate(with_present=True) == before
    assert math.isfinite(before.gain + before.std + before.shared_std)


def test_nothing_is_known_before_the_first_grasp_that_counts():
    gain = ObjectGain(0.06)
    hold(gain, 3.0, 2.0, frames=29)
    assert (gain.estimate(with_present=True), gain.ratio, gain.problem) == (None, None, "")
    hold(gain, 3.0, 2.0)
    assert gain.finish_grasp(counts=False) == ""
    assert (gain.estimate(with_present=True), gain.ratio) == (None, None)
    hold(gain, 0.1, 2.0)
    gain.finish_grasp(counts=True)
    assert gain.ratio is None


def test_a_finished_grasp_and_a_known_ratio_are_the_same():
    gain = ObjectGain(0.06)
    hold(gain, 3.0, 2.0)
    present = posterior(gain, with_present=True)
    gain.finish_grasp(counts=True)
    known = ObjectGain(0.06, gain.ratio)
    assert ratio_of(gain) == pytest.approx(1.5)
    for again in (posterior(gain), posterior(known)):
        assert again.gain == pytest.approx(present.gain)
        assert again.std == pytest.approx(present.std)
    known.reset()
    assert known.estimate() is None


def test_another_object_is_noticed_and_learned_anew():
    gain = ObjectGain(0.06)
    for _ in range(3):
        hold(gain, 3.0, 2.0)
        assert gain.finish_grasp(counts=True) == ""
    hold(gain, 3.0, 6.0)
    assert "another object" in gain.finish_grasp(counts=True)
    assert ratio_of(gain) == pytest.approx(0.5)


def test_a_better_grasp_after_a_weak_one_is_of_the_same_object():
    gain = ObjectGain(0.06)
    hold(gain, 0.4, 0.4)
    gain.finish_grasp(counts=True)
    assert ratio_of(gain) == pytest.approx(1.0)
    hold(gain, 6.0, 4.8)
    assert gain.finish_grasp(counts=True) == ""
    assert ratio_of(gain) == pytest.approx(1.25, abs=0.01)


def test_a_ratio_that_no_object_explains_is_a_problem():
    for ratio in (0.35, 1.0, 3.0):
        assert learned(0.06, [(ratio, 0.05)]).problem == ""
    assert "4.50 times" in learned(0.06, [(4.5, 0.05)]).problem
    assert learned(0.06, [(0.2, 0.05)]).problem


def test_a_correction_scales_force_and_claim():
    force_n, std_n = GainEstimate(1.5, 0.06, 0.06).corrected(2.0, 0.2)
    assert force_n == 3.0
    assert std_n == pytest.approx(math.sqrt(0.3**2 + 9 * (0.06**2 - KIND_STD**2)))
    assert GainEstimate(1.0, 0.0, 0.0).corrected(100.0, 0.2)[1] == pytest.approx(0.1)
