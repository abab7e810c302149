import numpy as np
import pytest
from scipy.stats import t as student

from gripper_calibration.fits.interval_fit import touch_interval
from gripper_force.profiles.object_profile import Interval


def errors_of(
    touches: int, frames: int, share: float, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predictions, forces and touch numbers; each frame has an independent error that grows with force."""
    rng = np.random.default_rng(seed)
    predicted_n = np.tile(np.linspace(0, 10, frames), touches)
    error_n = np.hypot(0.05, share * predicted_n) * rng.normal(size=len(predicted_n))
    return predicted_n, predicted_n - error_n, np.repeat(np.arange(touches), frames)


@pytest.mark.parametrize("share", [0.0, 0.1])
@pytest.mark.parametrize("touches", [3, 40])
def test_half_width_is_students_quantile_of_errors_that_grow_with_force(share: float, touches: int) -> None:
    interval = touch_interval(*errors_of(touches, 4000 // touches, share), 0.9)
    for at_n in (2.0, 5.0, 9.0):
        expected_n = student.ppf(0.95, touches - 1) * np.hypot(0.05, share * at_n)
        assert float(interval.half_width_n(at_n)) == pytest.approx(expected_n, rel=0.15)


def test_each_touch_has_the_same_weight() -> None:
    predicted_n, force_n, touch = errors_of(4, 200, 0.1)
    often = np.repeat(np.arange(len(touch)), np.where(touch == 0, 10, 1))
    once = touch_interval(predicted_n, force_n, touch, 0.9)
    repeated = touch_interval(predicted_n[often], force_n[often], touch[often], 0.9)
    assert repeated.base_n == pytest.approx(once.base_n, rel=1e-3)
    assert repeated.share == pytest.approx(once.share, rel=1e-3)


def test_frames_without_contact_do_not_narrow_the_interval() -> None:
    predicted_n, force_n, touch = errors_of(8, 100, 0.1)
    alone = touch_interval(predicted_n, force_n, touch, 0.9)

    def with_rest(rest_n: np.ndarray) -> Interval:
        zeros = np.zeros(len(rest_n))
        return touch_interval(
            np.concatenate([predicted_n, rest_n]),
            np.concatenate([force_n, zeros]),
            np.concatenate([touch, zeros.astype(int)]),
            0.9,
        )

    assert with_rest(np.zeros(3000)).half_width_n(5.0) == pytest.approx(alone.half_width_n(5.0), rel=1e-6)
    noise = with_rest(np.where(np.arange(3000) % 2, 0.5, -0.5))  # a scatter that only rests show
    assert noise.base_n > 2 * alone.base_n


@pytest.mark.parametrize("touches", [3, 8])
def test_interval_contains_new_touches_whose_own_errors_are_normal(touches: int) -> None:
    """Each touch has one gain error, so that its frames are one draw."""
    covered = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        force_n = np.tile(np.linspace(0.3, 8, 20), touches)
        touch = np.repeat(np.arange(touches), 20)
        gain = 1 + 0.05 * rng.normal(size=touches + 1)
        interval = touch_interval(force_n * gain[touch], force_n, touch, 0.9)
        new_n = 5 * gain[-1]
        covered.append(abs(new_n - 5) <= interval.half_width_n(new_n))
    assert np.mean(covered) == pytest.approx(0.9, abs=0.05)
