from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gripper_calibration.fits.candidates import LINE
from gripper_calibration.fits.cross_validation import Measured, coverages, cross_validate, select_simplest
from gripper_calibration.fits.object_fit import fit_correction
from gripper_calibration.fits.touches import Touches


def test_a_touch_takes_no_part_in_its_own_estimate_and_interval(touched: Callable[..., Touches]) -> None:
    """With other forces in one touch, its estimates and its interval stay: nothing that made them saw it."""
    touches = touched(5, gain=1.3, scatter=0.05, bend=0.2)
    own = touches.touch == 2
    changed = replace(touches, force_n=np.where(own, 3 * touches.force_n + 1, touches.force_n))
    before, after = cross_validate(touches, 0.9), cross_validate(changed, 0.9)
    np.testing.assert_array_equal(before.estimates_n[own], after.estimates_n[own])
    assert not np.array_equal(before.estimates_n[~own], after.estimates_n[~own])
    assert before.within is not None
    assert after.within is not None
    assert before.within[own].mean() > 0.5
    assert not after.within[own & (touches.force_n > 1)].any()


def test_three_touches_are_too_few_to_choose(touched: Callable[..., Touches]) -> None:
    tested = cross_validate(touched(3, bend=-0.4), 0.9)
    assert tested.selected == LINE
    assert tested.within is None
    assert fit_correction(touched(3)).coverages == ()


def test_simplest_candidate_within_one_standard_error_is_selected() -> None:
    better = np.array([0.3, 0.1, 0.2, 0.4])  # of each touch, mean 0.25, standard error 0.065
    base = np.array([1.0, 1.2, 0.8, 1.1])
    for by_n, chosen in ((0.0, 1), (0.06, 1), (0.07, 2)):
        # The third is the best; the second is worse by as much in the mean, scattered by `better`.
        error_n = np.column_stack([base + 1.0, base + by_n + better - 0.25, base])
        assert select_simplest(error_n) == chosen


def test_coverage_has_equal_weight_for_each_touch_and_level() -> None:
    force_n = np.array([0.1, 0.5, 0.6, 3.0, 0.1, 0.5, 9.0])
    touch = np.array([0, 0, 0, 0, 1, 1, 1])
    within = np.array([False, True, False, True, False, True, False])
    contact, *levels = coverages(Measured(force_n, touch), within)
    assert (contact.from_n, contact.to_n, contact.touches) == (0.25, None, 2)
    assert contact.covered == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert [(level.from_n, level.to_n, level.touches, level.covered) for level in levels] == [
        (0.25, 1.0, 2, 0.75),
        (2.0, 4.0, 1, 1.0),
        (8.0, None, 1, 0.0),
    ]


def test_interval_contains_new_touches_in_contact_and_not_far_more_than_stated(
    touched: Callable[..., Touches],
) -> None:
    within, below = [], 0
    for seed in range(10):
        fitted = fit_correction(touched(6, gain=1.2, scatter=0.04, seed=2 * seed))
        new = touched(20, gain=1.2, scatter=0.04, seed=2 * seed + 1)
        predicted_n = fitted.predict(new)
        inside = np.abs(predicted_n - new.force_n) <= fitted.interval.half_width_n(predicted_n)
        within.append(inside[new.force_n > 0.25].mean())
        below += within[-1] < 0.8
    assert 0.87 < np.mean(within) < 0.96
    assert below <= 2
