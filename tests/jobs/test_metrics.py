import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.jobs import metrics

PREDICTED, MEASURED = [1.0, 2.0, 4.0, 9.0], [0.0, 2.5, 4.5, 4.9]


def test_mae_rmse_and_bias() -> None:
    assert metrics.mae(PREDICTED, MEASURED) == pytest.approx((1 + 0.5 + 0.5 + 4.1) / 4)
    assert metrics.rmse(PREDICTED, MEASURED) == pytest.approx(np.sqrt((1 + 0.25 + 0.25 + 16.81) / 4))
    assert metrics.bias(PREDICTED, MEASURED) == pytest.approx((1 - 0.5 - 0.5 + 4.1) / 4)


def test_bins_use_measured_force() -> None:
    bins = metrics.per_bin(PREDICTED, MEASURED)
    assert [(b.from_n, b.to_n, b.frames) for b in bins] == [(0, 1, 1), (2, 3, 1), (4, 5, 2)]
    assert bins[2].mae_n == pytest.approx((0.5 + 4.1) / 2)
    assert bins[2].bias_n == pytest.approx((-0.5 + 4.1) / 2)


@pytest.mark.filterwarnings("error")
def test_a_force_beyond_every_integer_has_its_bin() -> None:
    (one,) = metrics.per_bin([0.0], [1e30])
    assert (one.from_n, one.frames) == (1e30, 1)


@pytest.mark.parametrize(("predicted", "measured"), [([], []), ([1.0], [1.0, 2.0]), ([[1.0]], [[1.0]])])
def test_series_must_match(predicted: list[float], measured: list[float]) -> None:
    with pytest.raises(ValueError, match="one length"):
        metrics.mae(predicted, measured)


@given(st.integers(-200, 200))
def test_lag_is_found_across_sample_rates(lag_ms: int) -> None:
    def press(t_s: np.ndarray) -> np.ndarray:
        return np.exp(-(((t_s - 2.0) / 0.2) ** 2)) + 0.5 * np.exp(-(((t_s - 3.1) / 0.1) ** 2))

    t_s, reference_t_s = np.arange(0, 5, 1 / 60), np.arange(0.1, 5, 1 / 200)
    lag = metrics.lag_s(t_s, 3 + 2 * press(t_s - lag_ms / 1000), reference_t_s, press(reference_t_s))
    assert lag == pytest.approx(lag_ms / 1000, abs=0.003)


def test_no_lag_without_movement_or_overlap() -> None:
    t_s = np.arange(0, 1, 0.01)
    assert np.isnan(metrics.lag_s(t_s, np.ones(100), t_s, np.sin(t_s)))
    assert np.isnan(metrics.lag_s(t_s, np.sin(t_s), t_s + 5, np.sin(t_s)))


def test_a_lag_that_nothing_estimated_has_is_nan() -> None:
    t_s = np.arange(0, 20, 0.01)
    early, late = np.exp(-((t_s - 3) ** 2)), np.exp(-((t_s - 17) ** 2))
    assert np.isnan(metrics.lag_s(t_s, late, t_s, early))


def test_lag_with_damaged_time_is_nan() -> None:
    t_s = np.array([0.0, 1.0, 1e9])
    assert np.isnan(metrics.lag_s(t_s, t_s, t_s, t_s))
