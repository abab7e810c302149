from datetime import date
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.errors import ConfigError
from gripper_force.profiles.correction import (
    Correction,
    ProfileArrays,
    curve_n,
    load_correction,
    pack,
)
from gripper_force.profiles.object_profile import Interval, ObjectProfile, OutputCurve, weights_path


def profile(weights: str = "") -> ObjectProfile:
    return ObjectProfile(
        object="mug",
        date=date(2026, 1, 2),
        checkpoint="",
        camera={},
        touches=3,
        frames=30,
        force_n=6.0,
        output=OutputCurve(kind="monotone", estimate_n=(0.0, 2.0, 4.0), force_n=(0.5, 1.5, 4.5)),
        interval=Interval(coverage=0.9, base_n=0.3, share=0.1),
        ood_limit=0.5,
        before_n=0.5,
        weights=weights,
    )


def arrays(features: int = 5, spread: float = 2.0) -> ProfileArrays:
    axes = np.eye(features, 2, dtype=np.float32)
    zeros = np.zeros(features, np.float32)
    return ProfileArrays(zeros, np.zeros(1, np.float32), zeros, axes, np.array([spread], np.float32))


def written(path: Path, arrays: ProfileArrays) -> str:
    data = pack(arrays)
    weights_path(path).write_bytes(data)
    return sha256(data).hexdigest()


@given(st.floats(-20, 40))
def test_curve_is_extrapolated_linearly(at_n: float) -> None:
    value_n = float(curve_n(np.array([0.0, 2.0, 4.0]), np.array([0.5, 1.5, 4.5]), [at_n])[0])
    assert value_n == pytest.approx(0.5 + 0.5 * at_n if at_n < 2 else 1.5 + 1.5 * (at_n - 2))


def test_interval_grows_with_force_and_faster_beyond_calibrated_forces() -> None:
    correction = Correction(profile(), arrays())
    half_n = correction.half_width_n([-1.0, 0.0, 4.0, 6.0, 8.0])
    assert half_n[0] == pytest.approx(np.hypot(0.3, 0.1) + 0.7)
    assert half_n[1:4] == pytest.approx(np.hypot(0.3, [0.0, 0.4, 0.6]))
    assert half_n[4] == pytest.approx(np.hypot(0.3, 0.8) + 2)
    assert correction.std_n([4.0])[0] * 1.6449 == pytest.approx(half_n[2], rel=1e-4)


def test_ood_score_measures_distance_from_the_subspace() -> None:
    correction = Correction(profile(), arrays())
    on, off = np.array([[9, 9, 0, 0, 0], [9, 9, 0, 1, 1]], np.float32)
    assert correction.ood_score(np.stack([on, off])) == pytest.approx([0, 1 / 0.5])


def test_arrays_round_trip_and_must_match_the_profile(tmp_path: Path) -> None:
    path = tmp_path / "mug.yaml"
    weights = written(path, arrays())
    correction = load_correction(path, profile(weights), 5)
    features = np.random.default_rng(0).normal(size=(7, 5)).astype(np.float32)
    expected = Correction(profile(), arrays())
    np.testing.assert_array_equal(correction.ood_score(features), expected.ood_score(features))
    with pytest.raises(ConfigError, match="for another network: this one has 6"):
        load_correction(path, profile(weights), 6)
    with pytest.raises(ConfigError, match="does not belong to"):
        load_correction(path, profile("0" * 64), 5)
    weights_path(path).unlink()
    with pytest.raises(ConfigError, match="belongs to the object profile"):
        load_correction(path, profile(weights), 5)


@pytest.mark.parametrize("spread", [0.0, np.nan])
def test_invalid_spread_is_refused(tmp_path: Path, spread: float) -> None:
    path = tmp_path / "mug.yaml"
    weights = written(path, arrays(spread=spread))
    with pytest.raises(ConfigError, match="not finite"):
        load_correction(path, profile(weights), 5)
