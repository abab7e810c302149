from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gripper_calibration.fits.object_fit import fit_correction, learning_curve
from gripper_calibration.fits.output_curve import fit_line
from gripper_calibration.fits.touches import Touches
from gripper_force.errors import DataError


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("gain", [0.6, 1.5])
def test_wrong_gain_is_corrected_with_few_touches(
    touched: Callable[..., Touches], count: int, gain: float
) -> None:
    fitted = fit_correction(touched(count, gain=gain, scatter=0.01))
    new = touched(5, gain=gain, scatter=0.01, seed=1)
    before_n = np.abs(new.estimate_n - new.force_n).mean()
    after_n = np.abs(fitted.predict(new) - new.force_n).mean()
    assert after_n < 0.25 * before_n
    assert (fitted.after_n is None) == (count < 3)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("gain", [2.0, 3.5])
def test_prior_does_not_prevent_the_correction_of_a_new_kind_of_object(
    touched: Callable[..., Touches], count: int, gain: float
) -> None:
    """The touches scatter, so that a prior without tails would outweigh them."""
    after_n, before_n = [], []
    for seed in range(6):
        fitted = fit_correction(touched(count, gain=gain, scatter=0.15, peak_n=3.0, seed=seed))
        new = touched(5, gain=gain, scatter=0.15, peak_n=3.0, seed=50 + seed)
        after_n.append(np.abs(fitted.predict(new) - new.force_n).mean())
        before_n.append(np.abs(new.estimate_n - new.force_n).mean())
    assert np.mean(after_n) < 0.45 * np.mean(before_n)


def test_correct_network_is_not_changed(touched: Callable[..., Touches]) -> None:
    fitted = fit_correction(touched(5))
    assert fitted.candidate == "the network as it is"
    assert fitted.output.force_n == fitted.output.estimate_n


def test_nonlinear_error_is_corrected(touched: Callable[..., Touches]) -> None:
    fitted = fit_correction(touched(5, bend=-0.4))
    new = touched(5, bend=-0.4, seed=1)
    assert np.abs(fitted.predict(new) - new.force_n).mean() < 0.06
    assert fitted.candidate != "a line"


def test_scattered_touches_give_a_wide_interval(touched: Callable[..., Touches]) -> None:
    agreeing, torn = (fit_correction(touched(5, scatter=scatter, seed=3)) for scatter in (0.01, 0.4))
    assert torn.interval.share > 5 * agreeing.interval.share


@pytest.mark.parametrize("count", [1, 2])
def test_few_touches_have_a_wider_interval_than_many(touched: Callable[..., Touches], count: int) -> None:
    few, many = (fit_correction(touched(n, gain=1.3, scatter=0.03)) for n in (count, 5))
    assert few.interval.share > many.interval.share


def test_load_cell_spikes_do_not_change_the_line(touched: Callable[..., Touches]) -> None:
    touches = touched(2, gain=0.7)
    spiky = touches.force_n.copy()
    spiky[np.random.default_rng(0).choice(len(spiky), 8, replace=False)] = -70.0
    fitted = fit_correction(Touches(touches.features, touches.estimate_n, spiky, touches.touch))
    assert fitted.output.force_n[1] / fitted.output.estimate_n[1] == pytest.approx(0.7, abs=0.06)


def test_learning_curve_tests_1_2_4_touches_on_the_others(touched: Callable[..., Touches]) -> None:
    rows = list(learning_curve(touched(5, gain=1.4, scatter=0.02), draws=2))
    assert {count for count, _, _ in rows} == {1, 2, 4}
    assert all(mae_n < 0.5 and 0 <= share <= 1 for _, mae_n, share in rows)


@pytest.mark.parametrize(
    ("weak", "sentence"),
    [
        (lambda make: make(3, peak_n=0.3), "no more than"),
        (lambda make: make(3, gain=-1.0), "no more than"),
        (lambda make: make(1).only([7]), "0 frames"),
        (
            lambda make: replace(make(3), estimate_n=np.full_like(make(3).force_n, 2.0)),
            "corr",
        ),
        (lambda make: make(4, noise_n=20.0), "correlation"),
        (lambda make: make(4, gain=0.1, peak_n=40.0), "0.1[0-9] N for each"),
    ],
    ids=["light", "wrong sign", "none", "constant", "noise", "another quantity"],
)
def test_insufficient_touches_are_refused(
    touched: Callable[..., Touches], weak: Callable[[Callable[..., Touches]], Touches], sentence: str
) -> None:
    with pytest.raises(DataError, match=sentence):
        fit_correction(weak(touched))


def test_nonfinite_values_are_refused(touched: Callable[..., Touches]) -> None:
    touches = touched(2)
    touches.force_n[3] = np.nan
    with pytest.raises(DataError, match="not finite"):
        fit_correction(touches)


def test_touches_of_a_fold_that_the_network_sees_upside_down_do_not_end_the_fit(
    touched: Callable[..., Touches],
) -> None:
    touches = touched(4, peak_n=8.0)
    falls = touches.touch >= 2  # a fold without the first two touches has a falling line
    estimate_n = np.where(falls, 1.5 - 0.2 * touches.estimate_n, touches.estimate_n)
    fitted = fit_correction(replace(touches, estimate_n=estimate_n))
    assert np.isfinite(fitted.predict(touches)).all()
    assert (np.diff(fitted.output.force_n) >= 0).all()
    only = replace(touches, estimate_n=estimate_n).only([2, 3])
    assert fit_line(only).gain > 0
    with pytest.raises(DataError, match="do not follow the load cell"):
        fit_correction(only)


@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(1, 5),
    gain=st.floats(0.3, 3.0),
    offset_n=st.floats(-0.5, 0.5),
    scatter=st.floats(0, 0.5),
    noise_n=st.floats(0, 1.0),
    repeat=st.booleans(),
    seed=st.integers(0, 100),
)
@example(count=3, gain=1.0, offset_n=0.0, scatter=0.5, noise_n=0.0, repeat=False, seed=0)
@example(count=3, gain=1.0, offset_n=0.0, scatter=0.0, noise_n=0.0, repeat=False, seed=0)
@example(count=3, gain=1.0, offset_n=0.0, scatter=0.5, noise_n=0.0, repeat=False, seed=49)
@example(count=5, gain=2.0, offset_n=0.0, scatter=0.5, noise_n=0.0, repeat=False, seed=0)
def test_any_fit_is_refused_or_finite_and_monotone(
    touched: Callable[..., Touches],
    count: int,
    gain: float,
    offset_n: float,
    scatter: float,
    noise_n: float,
    repeat: bool,
    seed: int,
) -> None:
    touches = touched(count, gain=gain, offset_n=offset_n, scatter=scatter, noise_n=noise_n, seed=seed)
    if repeat:  # a stuck camera: features without variance
        touches.features[:] = touches.features[0]
    try:
        fitted = fit_correction(touches)
    except DataError:
        return
    predicted_n = fitted.predict(touches)
    assert np.isfinite(predicted_n).all()
    assert (np.diff(fitted.output.force_n) >= 0).all()
    assert 0 < fitted.interval.base_n < 100
    if fitted.after_n is not None:
        as_it_is_n = fitted.errors_n["the network as it is"]
        # Touches that differ mislead it: by up to twice the scatter in 400 draws.
        assert fitted.after_n <= as_it_is_n + 3 * noise_n + 3 * max(1.0, gain) * scatter + 0.1


@pytest.mark.parametrize("count", [3, 6])
def test_touches_that_contradict_each_other_leave_the_network_as_it_is(
    touched: Callable[..., Touches], count: int
) -> None:
    left = 0
    for seed in range(4):
        fit = fit_correction(touched(count, scatter=0.5, seed=seed))
        assert fit.after_n is not None
        assert fit.after_n <= fit.before_n + 1e-9
        left += fit.candidate == "the network as it is"
    assert left > 0
