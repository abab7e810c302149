import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_calibration.fits import ood_fit
from gripper_calibration.fits.interval_fit import conformal_interval
from gripper_calibration.fits.object_fit import _select_simplest, fit_correction, learning_curve
from gripper_calibration.fits.touches import Floats, Touches
from gripper_force.errors import DataError

FEATURES = 40


def touched(
    count: int,
    *,
    gain: float = 1.0,
    offset_n: float = 0.0,
    bend: float = 0.0,
    scatter: float = 0.0,
    noise_n: float = 0.02,
    peak_n: float = 8.0,
    seed: int = 0,
) -> Touches:
    """Touches whose true force is a line through the network's estimate, or bent away from it."""
    rng = np.random.default_rng(seed)
    mix = np.random.default_rng(99).normal(size=(3, FEATURES))  # one network
    parts: list[tuple[Floats, Floats, Floats]] = []
    for _ in range(count):
        rise = np.sin(np.linspace(0, np.pi, 60)).clip(0) * rng.uniform(0.4, 1) * peak_n
        estimate_n = np.concatenate([np.zeros(15), rise, np.zeros(15)])
        own = gain * (1 + scatter * rng.normal())
        force_n = own * estimate_n + offset_n + bend * np.square(estimate_n) / peak_n
        hidden = np.column_stack([estimate_n, np.square(estimate_n) / peak_n, rng.normal(size=90)])
        features = np.tanh(0.1 * hidden @ mix) + 0.01 * rng.normal(size=(90, FEATURES))
        parts.append((features, estimate_n, force_n + noise_n * rng.normal(size=90)))
    features, estimate_n, force_n = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Touches(features.astype(np.float32), estimate_n, force_n, np.repeat(np.arange(count), 90))


@pytest.mark.parametrize("count", [1, 2, 4, 8])
@pytest.mark.parametrize("gain", [0.6, 1.5])
def test_wrong_gain_is_corrected_with_few_touches(count: int, gain: float) -> None:
    fitted = fit_correction(touched(count, gain=gain, scatter=0.01))
    new = touched(5, gain=gain, scatter=0.01, seed=1)
    before_n = np.abs(new.estimate_n - new.force_n).mean()
    after_n = np.abs(fitted.predict(new) - new.force_n).mean()
    assert after_n < 0.25 * before_n
    assert (fitted.after_n is None) == (count < 3)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("gain", [2.0, 3.5])
def test_prior_does_not_prevent_the_correction_of_a_new_kind_of_object(count: int, gain: float) -> None:
    """The touches scatter, so that a prior without tails would outweigh them."""
    after_n, before_n = [], []
    for seed in range(6):
        fitted = fit_correction(touched(count, gain=gain, scatter=0.15, peak_n=3.0, seed=seed))
        new = touched(5, gain=gain, scatter=0.15, peak_n=3.0, seed=50 + seed)
        after_n.append(np.abs(fitted.predict(new) - new.force_n).mean())
        before_n.append(np.abs(new.estimate_n - new.force_n).mean())
    assert np.mean(after_n) < 0.45 * np.mean(before_n)


def test_correct_network_is_not_changed() -> None:
    fitted = fit_correction(touched(8))
    assert fitted.candidate == "the network as it is"
    assert fitted.output.force_n == fitted.output.estimate_n


def test_nonlinear_error_is_corrected() -> None:
    fitted = fit_correction(touched(8, bend=-0.4))
    new = touched(5, bend=-0.4, seed=1)
    assert np.abs(fitted.predict(new) - new.force_n).mean() < 0.06
    assert fitted.candidate != "a line"


def test_scattered_touches_give_a_wide_interval() -> None:
    agreeing, torn = (fit_correction(touched(8, scatter=scatter, seed=3)) for scatter in (0.01, 0.4))
    assert torn.interval.share > 5 * agreeing.interval.share


@pytest.mark.parametrize("count", [1, 2])
def test_few_touches_have_a_wider_interval_than_many(count: int) -> None:
    few, many = (fit_correction(touched(n, gain=1.3, scatter=0.03)) for n in (count, 16))
    assert few.interval.share > many.interval.share


def test_load_cell_spikes_do_not_change_the_line() -> None:
    touches = touched(2, gain=0.7)
    spiky = touches.force_n.copy()
    spiky[np.random.default_rng(0).choice(len(spiky), 8, replace=False)] = -70.0
    fitted = fit_correction(Touches(touches.features, touches.estimate_n, spiky, touches.touch))
    assert fitted.output.force_n[1] / fitted.output.estimate_n[1] == pytest.approx(0.7, abs=0.06)


def test_interval_contains_new_touches_at_the_stated_coverage() -> None:
    within = []
    for seed in range(20):
        fitted = fit_correction(touched(8, gain=1.2, scatter=0.04, seed=2 * seed))
        new = touched(20, gain=1.2, scatter=0.04, seed=2 * seed + 1)
        predicted_n = fitted.predict(new)
        half_n = fitted.interval.half_width_n(predicted_n)
        within.append((np.abs(predicted_n - new.force_n) <= half_n).mean())
    assert np.mean(within) == pytest.approx(0.9, abs=0.03)


def test_interval_is_the_quantile_with_equal_weight_for_each_touch() -> None:
    """Ten touches with one error each; the last is longer and has the same weight."""
    error_n = np.linspace(0.1, 1.0, 10)
    counts = np.array([10] * 9 + [1000])
    touch = np.repeat(np.arange(10), counts)
    for coverage, expected_n in ((0.5, 0.5), (0.8, 0.8), (0.9, 0.9)):
        interval = conformal_interval(
            np.zeros(len(touch)), np.repeat(error_n, counts), touch, coverage - 1e-9
        )
        assert float(interval.half_width_n(0.0)) == pytest.approx(expected_n * np.sqrt(1 + 1 / 10), rel=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_interval_grows_with_force_like_the_errors(share: float) -> None:
    rng = np.random.default_rng(0)
    force_n = np.tile(np.linspace(0, 10, 50), 40)
    predicted_n = force_n + np.hypot(0.05, share * force_n) * rng.normal(size=len(force_n))
    interval = conformal_interval(predicted_n, force_n, np.repeat(np.arange(40), 50), 0.9)
    for at_n in (2.0, 5.0, 9.0):
        expected_n = 1.645 * np.hypot(0.05, share * at_n)
        assert float(interval.half_width_n(at_n)) == pytest.approx(expected_n, rel=0.15)


def test_ood_limit_follows_the_scores_of_left_out_touches() -> None:
    ood_score = [np.linspace(0, top, 2001) for top in (0.1, 0.3, 0.2)]
    assert ood_fit.fit_ood_limit(ood_score) == pytest.approx(1.5 * (1 + 2 / 3) * 0.3 * 0.995, rel=1e-3)
    assert ood_fit.fit_ood_limit([*ood_score] * 100) == pytest.approx(1.5 * 0.3 * 0.995, rel=0.01)
    assert ood_fit.fit_ood_limit(ood_score[:2]) == ood_fit.DEFAULT_LIMIT
    assert ood_fit.fit_ood_limit([]) == ood_fit.DEFAULT_LIMIT


def test_simplest_candidate_within_one_standard_error_is_selected() -> None:
    better = np.array([0.3, 0.1, 0.2, 0.4])  # of each touch, mean 0.25, standard error 0.065
    base = np.array([1.0, 1.2, 0.8, 1.1])
    for by_n, chosen in ((0.0, 1), (0.06, 1), (0.07, 2)):
        # The third is the best; the second is worse by as much in the mean, scattered by `better`.
        error_n = np.column_stack([base + 1.0, base + by_n + better - 0.25, base])
        assert _select_simplest(error_n) == chosen


def test_ood_score_separates_another_object_from_new_touches() -> None:
    fitted = fit_correction(touched(8))
    new, other = touched(5, seed=1), touched(5, seed=1)
    other.features[:, ::2] *= -1
    assert (fitted.arrays.ood_score(new.features) > fitted.ood_limit).mean() < 0.02
    assert (fitted.arrays.ood_score(other.features) > fitted.ood_limit).mean() > 0.5


def test_learning_curve_tests_1_2_4_8_touches_on_the_others() -> None:
    rows = list(learning_curve(touched(9, gain=1.4, scatter=0.02), draws=2))
    assert {count for count, _, _ in rows} == {1, 2, 4, 8}
    assert all(mae_n < 0.5 and 0 <= share <= 1 for _, mae_n, share in rows)


@pytest.mark.parametrize(
    ("touches", "sentence"),
    [
        (touched(3, peak_n=0.3), "no more than"),
        (touched(3, gain=-1.0), "no more than"),
        (touched(1).only([7]), "0 frames"),
        (
            Touches(*(lambda t: (t.features, np.full_like(t.force_n, 2.0), t.force_n, t.touch))(touched(3))),
            "corr",
        ),
        (touched(4, noise_n=20.0), "correlation"),
        (touched(4, gain=0.1, peak_n=40.0), "0.1[0-9] N for each"),
    ],
    ids=["light", "wrong sign", "none", "constant", "noise", "another quantity"],
)
def test_insufficient_touches_are_refused(touches: Touches, sentence: str) -> None:
    with pytest.raises(DataError, match=sentence):
        fit_correction(touches)


def test_nonfinite_values_are_refused() -> None:
    touches = touched(2)
    touches.force_n[3] = np.nan
    with pytest.raises(DataError, match="not finite"):
        fit_correction(touches)


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
def test_any_fit_is_refused_or_finite_and_monotone(
    count: int, gain: float, offset_n: float, scatter: float, noise_n: float, repeat: bool, seed: int
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
        assert fitted.after_n <= fitted.errors_n["the network as it is"] + 3 * noise_n + 0.1
