import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gripper_force.spikes import HAMPEL_HALF_WINDOW, find_spikes
from gripper_force.types import NS_PER_S, LoadCellSample
from gripper_hw.load_cells.screening import (
    MAX_REJECTED_SHARE,
    MAX_WAIT_NS,
    REJECTION_WINDOW_SAMPLES,
    STUCK_NS,
    STUCK_SAMPLES,
    SampleValidator,
)

RATE_HZ = 80
PERIOD_NS = NS_PER_S // RATE_HZ
START_NS = 5 * NS_PER_S

Floats = npt.NDArray[np.float64]


def validated(
    validator: SampleValidator,
    raws: npt.ArrayLike,
    every: int = 1,
    period_ns: int = PERIOD_NS,
    *,
    rounded: bool = False,
) -> list[LoadCellSample]:
    """Adds readings, takes samples after every few of them, and takes the rest at the end."""
    t_ns, taken = START_NS, []
    for i, raw in enumerate(np.asarray(raws, np.float64)):
        t_ns += period_ns
        validator.add(t_ns, float(raw), rounded=rounded)
        if i % every == 0:
            taken += validator.take(t_ns)
    return taken + validator.take(t_ns + MAX_WAIT_NS + 1)


def calibrated() -> SampleValidator:
    return SampleValidator(0.0, 1.0)


raw_readings = st.floats(-1e9, 1e9) | st.sampled_from([math.nan, math.inf, -math.inf])
anything = st.lists(st.tuples(raw_readings, st.booleans()), max_size=40)
batches = st.integers(1, 9)


@given(anything, batches, st.floats(-1e6, 1e6), st.floats(-1e6, 1e6) | st.just(math.nan))
def test_every_reading_is_returned_once_in_order_and_unchanged(
    readings: list[tuple[float, bool]], every: int, tare_raw: float, n_per_raw: float
) -> None:
    validator, taken = SampleValidator(tare_raw, n_per_raw), []
    for i, (raw, saturated) in enumerate(readings):
        validator.add(i * PERIOD_NS, raw, saturated=saturated)
        if i % every == 0:
            taken += validator.take(i * PERIOD_NS)
    taken += validator.take(len(readings) * PERIOD_NS + MAX_WAIT_NS + 1)
    assert [s.t_ns for s in taken] == [i * PERIOD_NS for i in range(len(readings))]
    assert np.array_equal([s.raw for s in taken], [raw for raw, _ in readings], equal_nan=True)
    assert all(math.isfinite(s.force_n) for s in taken if s.valid)
    stats = validator.stats
    rejected = stats.saturated + stats.stuck + stats.not_finite + stats.spikes + stats.doubtful
    assert rejected == sum(not s.valid for s in taken)


@given(st.lists(st.floats(0.0, 60.0), max_size=40), batches)
def test_live_samples_are_checked_like_recorded_ones(forces_n: list[float], every: int) -> None:
    taken = validated(calibrated(), forces_n, every, rounded=True)
    expected = ~find_spikes(np.array(forces_n)) if forces_n else np.array([])
    assume((~expected.astype(bool)).sum() <= MAX_REJECTED_SHARE * REJECTION_WINDOW_SAMPLES)
    assert [s.valid for s in taken] == list(expected)


def ramp(rise: float, top_n: float) -> Floats:
    """No force, a ramp, a hold, and a release within one sample."""
    return np.interp(np.arange(60), [0, 10, 10 + rise, 45, 46], [0, 0, top_n, top_n, 0])


def wave(period: float, top_n: float) -> Floats:
    forces_n: Floats = top_n * np.sin(np.pi * np.arange(60) / period) ** 2
    return forces_n


@settings(max_examples=50)
@given(
    st.one_of(
        st.builds(ramp, st.floats(0.1, 30.0), st.floats(0.0, 60.0)),
        st.builds(wave, st.floats(20.0, 200.0), st.floats(0.0, 60.0)),
    ),
    batches,
    st.floats(0.01, 100.0),
    st.integers(-100_000, 100_000),
)
def test_smooth_forces_are_never_rejected(
    force_n: Floats, every: int, n_per_raw: float, tare_raw: float
) -> None:
    taken = validated(
        SampleValidator(tare_raw, n_per_raw), force_n / n_per_raw + tare_raw, every, rounded=True
    )
    assert all(s.valid for s in taken)
    assert [s.force_n for s in taken] == pytest.approx(list(force_n), abs=1e-5)


@settings(max_examples=50)
@given(st.integers(1, 58), st.floats(3.0, 500.0), st.sampled_from([-1, 1]), batches)
def test_only_the_spike_within_a_hold_is_rejected(index: int, height_n: float, sign: int, every: int) -> None:
    force_n = np.full(60, 5.0) + 0.02 * np.sin(np.arange(60))
    force_n[index] += sign * height_n
    validator = calibrated()
    assert [i for i, s in enumerate(validated(validator, force_n, every)) if not s.valid] == [index]
    assert validator.stats.spikes == 1


def test_a_wide_dip_below_zero_is_rejected() -> None:
    force_n = np.full(60, 2.0)
    force_n[20:28] = [-3, -20, -60, -70, -70, -50, -10, -4]
    validator = calibrated()
    invalid = [i for i, s in enumerate(validated(validator, force_n, rounded=True)) if not s.valid]
    assert invalid == list(range(20, 28))
    assert validator.stats.spikes == 8


def test_sample_waits_for_its_followers_for_a_limited_time() -> None:
    validator = calibrated()
    for i in range(HAMPEL_HALF_WINDOW):
        validator.add(START_NS + i, float(i))
        assert validator.take(START_NS + i) == []
    validator.add(START_NS + 3, 3.0)
    assert [s.raw for s in validator.take(START_NS + 3)] == [0.0]
    assert validator.take(START_NS + MAX_WAIT_NS) == []
    assert [s.raw for s in validator.take(START_NS + 3 + MAX_WAIT_NS)] == [1.0, 2.0]
    assert [s.raw for s in validator.take(START_NS + 4 + MAX_WAIT_NS)] == [3.0]


def test_constant_reading_of_converter_is_stuck() -> None:
    raws = np.concatenate([np.arange(10), np.full(2 * RATE_HZ, 9.0), [10, 11]])
    validator = calibrated()
    taken = validated(validator, raws)
    since_ns, least_ns = taken[9].t_ns, max(STUCK_NS, (STUCK_SAMPLES - 1) * PERIOD_NS)
    assert all(s.valid for s in taken if s.t_ns - since_ns <= least_ns)
    assert not any(s.valid for s in taken if s.raw == 9.0 and s.t_ns - since_ns > least_ns)
    assert validator.stats.stuck > 1.8 * RATE_HZ


def test_most_samples_among_garbage_are_rejected() -> None:
    rng = np.random.default_rng(0)
    raws = np.concatenate(
        [5 + 0.02 * rng.normal(size=30), rng.uniform(-200, 200, 200), 5 + 0.02 * rng.normal(size=60)]
    )
    validator = calibrated()
    taken = validated(validator, raws)
    accepted = [i for i, s in enumerate(taken) if s.valid and 30 + REJECTION_WINDOW_SAMPLES <= i < 225]
    assert len(accepted) < 175 / 3
    assert validator.stats.doubtful > 50
    assert all(s.valid for s in taken[260:])


def test_constant_reading_of_indicator_is_valid() -> None:
    assert all(s.valid for s in validated(calibrated(), np.full(3 * RATE_HZ, 0.135), rounded=True))


def test_same_reading_after_gap_is_not_stuck() -> None:
    assert all(s.valid for s in validated(calibrated(), np.full(50, 7.0), period_ns=MAX_WAIT_NS + 1))


def test_saturated_reading_is_kept_and_next_spike_is_detected() -> None:
    validator = calibrated()
    for i in range(20):
        raw = {10: 8_388_607.0, 11: 50.0}.get(i, 5.0 + 0.01 * (i % 3))
        validator.add(START_NS + i, raw, saturated=i == 10)
    taken = validator.take(START_NS + NS_PER_S * 2)
    assert [i for i, s in enumerate(taken) if not s.valid] == [10, 11]
    assert taken[10].raw == 8_388_607.0
    assert (validator.stats.saturated, validator.stats.spikes) == (1, 1)


def test_without_scale_all_samples_are_invalid() -> None:
    validator = SampleValidator(0.0, math.nan)
    taken = validated(validator, np.arange(10))
    assert [s.raw for s in taken] == list(range(10))
    assert not any(s.valid for s in taken)
    assert validator.stats.not_finite == 10
