import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_force.spikes import HAMPEL_FLOOR_N, IMPOSSIBLE_N, find_spikes


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(0.0, 60.0), min_size=1, max_size=60), st.integers(0, 60))
def test_smooth_press_has_no_spike(steps: list[float], peak: int) -> None:
    rise = np.sort(steps)
    force_n = np.concatenate([rise, np.full(4 + peak, rise[-1]), rise[::-1]])
    assert not find_spikes(force_n).any()


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 58), st.floats(max(3.0, HAMPEL_FLOOR_N), 500.0), st.sampled_from([-1, 1]))
def test_single_outlier_in_a_hold_is_always_found(index: int, height_n: float, sign: int) -> None:
    force_n = np.full(60, 5.0) + 0.02 * np.sin(np.arange(60))
    force_n[index] += sign * height_n
    assert list(np.flatnonzero(find_spikes(force_n))) == [index]


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-100, 100), max_size=40))
def test_samples_below_the_plausible_force_are_always_rejected(values: list[float]) -> None:
    force_n = np.array(values)
    assert find_spikes(force_n)[force_n < IMPOSSIBLE_N].all()
