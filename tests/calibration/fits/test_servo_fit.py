from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gripper_calibration.fits.servo_fit import (
    MIN_PASSES,
    MIN_PRESSES,
    FreePass,
    Nominal,
    ServoPress,
    fit_servo,
)
from gripper_force.errors import DataError
from gripper_force.profiles.rig_profile import CalibratedValue

N_PER_A, FRICTION_N, DAMPING, RADIUS_M, OPEN_RAD = 44.0, 0.9, 14.0, 0.020, 0.03
NOMINAL = Nominal(pinion_radius_m=RADIUS_M, open_width_m=0.09)
RATES = (3.0, 6.0, 12.0, 3.0, 6.0, 12.0)
STEP_A = 2.69e-3

Floats = npt.NDArray[np.float64]


def press(
    rng: np.random.Generator, rate_n_s: float, gauge_m: float = 0.03, growth: float = 0.0
) -> ServoPress:
    """A motor against Coulomb friction and a spring, with quantised current readings."""
    rise_s, fall_s = 9.0 / rate_n_s, (9.0 + 2 * FRICTION_N + 1.0) / rate_n_s
    t_s = np.arange(0, rise_s + fall_s, 0.005)
    motor_force_n = FRICTION_N + rate_n_s * np.minimum(t_s, 2 * rise_s - t_s)
    force_n = np.zeros(len(t_s))
    for i in range(1, len(t_s)):
        friction_n = FRICTION_N + growth * force_n[i - 1]
        force_n[i] = max(
            min(max(force_n[i - 1], motor_force_n[i] - friction_n), motor_force_n[i] + friction_n), 0.0
        )
    measured_a = motor_force_n / N_PER_A + rng.normal(0, 3e-3, len(t_s))
    touch_rad = OPEN_RAD + (NOMINAL.open_width_m - gauge_m) / (2 * RADIUS_M)
    closing_rad = touch_rad + 5e-3 * force_n - 1e-4 * force_n**2
    return ServoPress(
        gauge_m=gauge_m,
        t_s=t_s,
        current_a=np.round(measured_a / STEP_A) * STEP_A,
        force_n=force_n + rng.normal(0, 0.01, len(t_s)),
        closing_rad=np.round(closing_rad * 652) / 652,
        turn=int(np.argmax(motor_force_n)),
    )


def free(rng: np.random.Generator, speed_m_s: float, side: int) -> FreePass:
    t_s = np.arange(0, 0.6, 0.005)
    rad_s = side * speed_m_s / RADIUS_M * (1 - 0.3 * np.exp(-t_s / 0.1))
    motor_force_n = side * FRICTION_N + DAMPING * RADIUS_M * rad_s + 1.2 * RADIUS_M * np.gradient(rad_s, t_s)
    current_a = motor_force_n / N_PER_A + rng.normal(0, 3e-3, len(t_s))
    return FreePass(t_s, current_a, np.cumsum(rad_s) * 0.005, rad_s)


def passes(rng: np.random.Generator) -> list[FreePass]:
    return [free(rng, speed, side) for speed in np.linspace(0.012, 0.052, 6) for side in (-1, 1)]


def presses(rng: np.random.Generator, gauge_m: float = 0.03, growth: float = 0.0) -> list[ServoPress]:
    return [press(rng, rate, gauge_m, growth) for rate in RATES]


def holds(estimate: CalibratedValue, truth: float) -> bool:
    return estimate.low is not None and estimate.high is not None and estimate.low <= truth <= estimate.high


def test_intervals_contain_the_true_values() -> None:
    held = np.zeros(4)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        fit = fit_servo(presses(rng), passes(rng), NOMINAL)
        truths = (
            (fit.nm_per_a, N_PER_A * 2 * RADIUS_M),
            (fit.friction_n, FRICTION_N),
            (fit.free_friction_n, FRICTION_N),
            (fit.damping_n_s_m, DAMPING),
        )
        held += [holds(estimate, truth) for estimate, truth in truths]
        assert fit.nm_per_a.half < 0.01 * fit.nm_per_a.value
        assert fit.open_position_rad.value == pytest.approx(OPEN_RAD, abs=3e-4)
        assert fit.pinion_radius_m == CalibratedValue(value=RADIUS_M)
    assert (held >= 35).all()


def test_two_gauges_determine_the_pinion_radius() -> None:
    rng = np.random.default_rng(0)
    both = [*presses(rng), *presses(rng, gauge_m=0.06)]
    fit = fit_servo(both, passes(rng), replace(NOMINAL, pinion_radius_m=0.024))
    assert holds(fit.pinion_radius_m, RADIUS_M)
    assert fit.pinion_radius_m.half < 1e-4
    assert fit.nm_per_a.value == pytest.approx(N_PER_A * 2 * RADIUS_M, rel=0.01)
    assert fit.damping_n_s_m.value == pytest.approx(DAMPING, rel=0.15)
    assert fit.open_position_rad.value == pytest.approx(OPEN_RAD, abs=2e-3)


def test_speeds_of_free_travel_are_those_of_the_fitted_radius() -> None:
    rng = np.random.default_rng(0)
    both = [*presses(rng), *presses(rng, gauge_m=0.06)]
    fit = fit_servo(both, passes(rng), replace(NOMINAL, pinion_radius_m=0.024))
    speed_m_s, motor_force_n = fit.travelled.T
    assert fit.speed_m_s[1] == np.abs(speed_m_s).max() == pytest.approx(0.052, rel=0.02)
    expected_n = FRICTION_N * np.sign(speed_m_s) + DAMPING * speed_m_s
    assert np.abs(motor_force_n - expected_n).mean() < 0.1


def test_friction_growing_with_force_is_fitted() -> None:
    rng = np.random.default_rng(0)
    fit = fit_servo(presses(rng, growth=0.05), passes(rng), NOMINAL)
    assert fit.friction_share.value == pytest.approx(0.05, abs=0.01)
    assert fit.n_per_a.value == pytest.approx(N_PER_A, rel=0.01)


def test_uncertain_load_cell_scale_widens_the_intervals() -> None:
    rng = np.random.default_rng(0)
    data = presses(rng), passes(rng)
    fit = fit_servo(*data, replace(NOMINAL, scale_share=0.03))
    assert fit.nm_per_a.half > 0.03 * fit.nm_per_a.value > fit_servo(*data, NOMINAL).nm_per_a.half


def test_spikes_are_rejected() -> None:
    rng = np.random.default_rng(1)
    clean = presses(rng), passes(rng)
    plain = fit_servo(*clean, NOMINAL)
    for one in clean[0]:
        one.current_a[30::97] += 0.4
        one.current_a[60::197] = np.nan
    fit = fit_servo(*clean, NOMINAL)
    assert fit.outliers > 30
    assert fit.nm_per_a.value == pytest.approx(plain.nm_per_a.value, rel=5e-3)


Spoil = Callable[[list[ServoPress], list[FreePass]], tuple[list[ServoPress], list[FreePass]]]


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda p, q: (p[: MIN_PRESSES - 1], q), "only 4 presses slid in both directions, and 5 are needed"),
        (lambda p, q: (p, q[: MIN_PASSES - 1]), "the jaws travelled freely only 7 times, and 8 are needed"),
        (lambda p, q: ([replace(one, force_n=0 * one.force_n) for one in p], q), "force does not rise with"),
        (lambda p, q: ([replace(one, turn=len(one.t_s)) for one in p], q), "force does not fall with"),
        (lambda p, q: ([replace(one, current_a=-one.current_a) for one in p], q), "gripper.closing_sign"),
        (
            lambda p, q: ([replace(one, current_a=0 * one.current_a) for one in p], q),
            "the force does not grow with the current",
        ),
        (lambda p, q: (p[:1] * 6, q), "too much alike"),
        (lambda p, q: (p, q[1::2] * 2), "too much alike"),
        (
            lambda p, q: ([*p[:3], *(replace(one, gauge_m=0.06) for one in p[3:])], q),
            "the angles at the gauges do not match their widths",
        ),
    ],
)
def test_insufficient_data_are_refused_with_a_message(spoil: Spoil, sentence: str) -> None:
    rng = np.random.default_rng(2)
    with pytest.raises(DataError, match=sentence) as caught:
        fit_servo(*spoil(presses(rng), passes(rng)), NOMINAL)
    assert "\n" not in str(caught.value)


numbers = st.floats(-1e3, 1e3) | st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1e300])


@st.composite
def odd_presses(draw: st.DrawFn) -> ServoPress:
    count = draw(st.sampled_from([0, 1, 30, 60]))
    columns = [draw(arrays(np.float64, count, elements=numbers)) for _ in range(3)]
    if draw(st.booleans()):
        ramp = np.concatenate([np.linspace(0, 9, count // 2), np.linspace(9, 0, count - count // 2)])
        columns[1] = ramp
    current_a, force_n, closing_rad = columns
    gauge_m = draw(st.sampled_from([0.03, 0.06]))
    return ServoPress(gauge_m, np.arange(count) / 100, current_a, force_n, closing_rad, turn=count // 2)


@st.composite
def odd_passes(draw: st.DrawFn) -> FreePass:
    count = draw(st.sampled_from([0, 1, 9, 40]))
    return FreePass(
        np.arange(count) / 100, *(draw(arrays(np.float64, count, elements=numbers)) for _ in range(3))
    )


@settings(max_examples=40, deadline=None)
@given(st.lists(odd_presses(), max_size=7), st.lists(odd_passes(), max_size=9), st.booleans())
def test_arbitrary_data_are_refused_or_fitted_within_the_interval_limit(
    some: list[ServoPress], others: list[FreePass], good: bool
) -> None:
    rng = np.random.default_rng(3)
    try:
        fit = fit_servo([*some, *presses(rng)] if good else some, [*others, *passes(rng)], NOMINAL)
    except DataError:
        return
    assert fit.nm_per_a.value > 0
    assert fit.nm_per_a.half <= 0.3 * fit.nm_per_a.value
