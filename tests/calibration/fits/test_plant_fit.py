from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from gripper_calibration.fits.plant_fit import PressSeries, crushing_touch, fit_plant, stiffness_n_m


def pressed(
    gain: float, lag_s: float, friction_n: float, seed: int = 0, noise_n: float = 0.01
) -> PressSeries:
    """A ramp with rounded ends, and a hold, through a first-order lag."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0, 1.4, 0.005) + rng.uniform(0, 0.001)
    motor_force_n = 5 * (1 - np.cos(np.pi * (t_s / 1.0).clip(0, 1))) / 2 + 0.5
    keep = np.exp(-0.005 / lag_s)
    late = lfilter([1 - keep], [1, -keep], motor_force_n, zi=[keep * motor_force_n[0]])[0]
    return PressSeries(t_s, motor_force_n, gain * late - friction_n + noise_n * rng.normal(size=len(t_s)))


@settings(max_examples=30, deadline=None)
@given(gain=st.floats(0.6, 1.5), lag_s=st.floats(0.01, 0.15), friction_n=st.floats(-0.4, 0.4))
def test_gain_and_lag_are_recovered_with_any_friction(gain: float, lag_s: float, friction_n: float) -> None:
    presses = [pressed(gain, lag_s, friction_n * s, seed) for seed, s in enumerate((1.0, 0.5, -1.0))]
    plant = fit_plant(presses, 0.04)
    assert plant is not None
    assert plant.gain == pytest.approx(gain, rel=0.03)
    assert plant.lag_ms == pytest.approx(1e3 * lag_s, abs=8)
    assert plant.delay_ms == pytest.approx(40)
    assert plant.phase_margin_deg == pytest.approx(61.4, abs=0.1)  # SIMC's own, by its choice of gains


@pytest.mark.parametrize("impact_n", [0.5, 1.5, 2.5])
def test_force_of_the_impact_that_friction_holds_does_not_change_the_plant(impact_n: float) -> None:
    press = pressed(1.0, 0.03, 0.0)
    held = replace(press, force_n=np.maximum(press.force_n, press.force_n[0] + impact_n))
    plant = fit_plant([held], 0.04)
    assert plant is not None
    assert plant.gain == pytest.approx(1.0, rel=0.02)
    assert plant.lag_ms == pytest.approx(30, abs=5)


def test_weak_presses_give_no_plant() -> None:
    still = PressSeries(np.arange(100, dtype=np.float64) * 0.005, np.full(100, 2.0), np.full(100, 1.0))
    assert fit_plant([], 0.04) is None
    assert fit_plant([still], 0.04) is None
    assert fit_plant([pressed(0.01, 0.03, 0.0)], 0.04) is None


def test_stiffness_is_the_slope_between_one_and_two_thirds() -> None:
    travel_m = np.linspace(0, 0.01, 200)
    force_n = 300 * travel_m + 1e6 * np.clip(travel_m - 0.0095, 0, None) ** 2
    slopes = stiffness_n_m([0.05 - travel_m, 0.05 - travel_m[:30]], [force_n, force_n[:30]])
    assert slopes == pytest.approx([300], rel=1e-6)


@given(st.lists(st.floats(-0.001, 0.001), min_size=8, max_size=8), st.integers(2, 5))
def test_crushing_touch_is_the_strongest_before_the_object_stays_narrower(
    lies_m: list[float], last: int
) -> None:
    peak_n = np.array([2.0, 5.0, 3.0, 4.0, 2.0, 3.0, 5.0, 1.0])
    peak_n[last] = 9.0
    contact_m = 0.05 + np.array(lies_m)
    contact_m[last + 1 :] -= 0.012
    assert crushing_touch(contact_m, peak_n) == last


def test_no_crushing_touch_if_the_object_springs_back() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        assert crushing_touch(0.05 + rng.uniform(-0.002, 0.002, 12), rng.uniform(1, 9, 12)) is None
    assert crushing_touch(np.array([0.05, 0.03]), np.array([1.0, 2.0])) is None
    assert crushing_touch(np.array([]), np.array([])) is None
