from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.signal import lfilter

from gripper_calibration.fits.load_cell_fit import MIN_READINGS, Rest, allan_deviation, fit_load_cell
from gripper_force.errors import DataError

COUNT = 800
FORCE_N = 10.0
N_PER_RAW = -2e-4
TARE = 81_234.0

Draws = npt.NDArray[np.float64]


def rest(rng: np.random.Generator, force_n: float, drift_n_min: float = 0.0, noise_n: float = 0.01) -> Rest:
    """HX711 counts at 80 Hz with autocorrelated noise."""
    t_s = np.arange(COUNT) / 80
    noise = lfilter([1.0], [1.0, -0.8], rng.normal(0, noise_n, COUNT))
    load_n = force_n + drift_n_min * t_s / 60 + noise
    return Rest(t_s, np.round(TARE + load_n / N_PER_RAW), np.ones(COUNT, np.bool_))


def rests(seed: int) -> tuple[Rest, Rest, Rest]:
    rng = np.random.default_rng(seed)
    return rest(rng, 0.0), rest(rng, FORCE_N), rest(rng, 0.0)


def test_intervals_contain_the_true_values() -> None:
    held = np.zeros(3)
    for seed in range(100):
        fit = fit_load_cell(*rests(seed), FORCE_N)
        truths = ((fit.tare_raw, TARE), (fit.n_per_raw, N_PER_RAW), (fit.drift_n_min, 0.0))
        held += [e.low <= truth <= e.high for e, truth in truths]  # type: ignore[operator]
        assert fit.n_per_raw.value == pytest.approx(N_PER_RAW, rel=0.005)
    assert (held >= 92).all()


def test_drift_is_measured() -> None:
    rng = np.random.default_rng(0)
    fit = fit_load_cell(rest(rng, 0.0, 0.5), rest(rng, FORCE_N, 0.5), rest(rng, 0.0, 0.5), FORCE_N)
    assert fit.drift_n_min.value == pytest.approx(0.5, abs=0.15)


def test_spikes_and_invalid_readings_are_rejected() -> None:
    plain, spiky = rests(1), rests(1)
    for one in spiky:
        one.raw[50:750:70] += 40 / N_PER_RAW
        one.raw[80:750:70] -= 40 / N_PER_RAW
        one.raw[100:750:70] = np.nan
        one.valid[0:30:10] = False
        one.raw[0:30:10] = 8_388_607
    fit = fit_load_cell(*spiky, FORCE_N)
    assert fit.rejected >= 3 * 33
    assert fit.n_per_raw.value == pytest.approx(fit_load_cell(*plain, FORCE_N).n_per_raw.value, rel=2e-4)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda e, u, a: (e, e, a),
            r"the load changes the reading by [\d.]+ units of the reading, and the readings are only kno",
        ),
        (
            lambda e, u, a: (e, u, u),
            r"the empty reading after the load differs from the one before it by [\d.]+ % of the load",
        ),
        (
            lambda e, u, a: (e, Rest(u.t_s, u.raw + 9000 * u.t_s / 10, u.valid), a),
            r"the reading does not settle under load: it varies by 17\.8 % of the load",
        ),
        (
            lambda e, u, a: (e, Rest(u.t_s, u.raw, ~u.valid), a),
            "under load, only 0 of 800 readings are usable, and 40 are needed",
        ),
        (lambda e, u, a: (e, Rest(u.t_s, u.raw, u.t_s < 7), a), "240 of 800 readings were rejected"),
        (
            lambda e, u, a: (e, Rest(0 * u.t_s, u.raw, u.valid), a),
            "under load, the times of the readings do not increase",
        ),
        (
            lambda e, u, a: (Rest(e.t_s[:9], e.raw[:9], e.valid[:9]), u, a),
            "without load, only 9 of 9 readings are usable, and 40 are needed",
        ),
    ],
)
def test_unusable_rests_are_refused_with_a_message(
    change: Callable[[Rest, Rest, Rest], tuple[Rest, Rest, Rest]], sentence: str
) -> None:
    with pytest.raises(DataError, match=sentence) as caught:
        fit_load_cell(*change(*rests(2)), FORCE_N)
    assert "\n" not in str(caught.value)


def test_constant_reading_has_an_interval_of_its_last_digit() -> None:
    def shows(kg: float) -> Rest:
        return Rest(np.arange(100) / 10, np.full(100, kg), np.ones(100, np.bool_))

    fit = fit_load_cell(shows(0.0), shows(1.02), shows(0.0), 10.0)
    assert fit.tare_raw.low == pytest.approx(-0.05)
    fit = fit_load_cell(shows(0.01), shows(1.02), shows(0.01), 10.0)
    assert fit.tare_raw.low == pytest.approx(0.005)
    with pytest.raises(DataError, match="only known to within"):
        fit_load_cell(shows(0.0), shows(0.5), shows(0.0), 5.0)
    assert fit_load_cell(
        shows(0.0), shows(0.5), shows(0.0), 5.0, step_raw=0.001
    ).tare_raw.high == pytest.approx(0.0005)


numbers = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-1e6, 1e6)


@st.composite
def odd_rests(draw: st.DrawFn) -> Rest:
    count = draw(st.sampled_from([0, 1, MIN_READINGS, 3 * MIN_READINGS]))
    step = draw(st.sampled_from([0.0, 0.1, -0.1]))
    flat = draw(numbers)
    raw = draw(arrays(np.float64, count, elements=numbers) | st.just(np.full(count, flat)))
    return Rest(
        step * np.arange(count, dtype=np.float64), raw, draw(arrays(np.bool_, count)) | draw(st.booleans())
    )


@settings(max_examples=100, deadline=None)
@given(odd_rests(), odd_rests(), odd_rests(), st.floats(1e-6, 1e3))
def test_arbitrary_data_are_refused_or_fitted_within_the_interval_limit(
    e: Rest, u: Rest, a: Rest, force_n: float
) -> None:
    try:
        fit = fit_load_cell(e, u, a, force_n)
    except DataError:
        return
    value, low, high = fit.n_per_raw.value, fit.n_per_raw.low, fit.n_per_raw.high
    assert low is not None
    assert high is not None
    assert low <= value <= high
    assert high - low <= 0.2 * abs(value)


def test_allan_deviation_of_white_noise_falls_with_the_square_root_of_time() -> None:
    raw = np.random.default_rng(0).normal(0, 1, 4096)
    tau_s, deviation = allan_deviation(Rest(np.arange(4096) / 80, raw, np.ones(4096, np.bool_)), raw < 9)
    assert tau_s[:6] == pytest.approx(np.array([1, 2, 4, 8, 16, 32]) / 80)
    assert deviation[:6] == pytest.approx(1 / np.sqrt(80 * tau_s[:6]), rel=0.15)
