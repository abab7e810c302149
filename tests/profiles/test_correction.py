from dataclasses import replace
from datetime import date
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.errors import ConfigError
from gripper_force.jobs.profile_files import pack
from gripper_force.profiles.correction import (
    Correction,
    KnownFrames,
    ProfileArrays,
    load_correction,
)
from gripper_force.profiles.object_profile import (
    Interval,
    ObjectProfile,
    OodLimit,
    OutputCurve,
    weights_path,
)
from gripper_force.vision.ood import orthonormal, residual_share

LIMITS = (OodLimit(force_n=0.0, typical=0.01, limit=2.0), OodLimit(force_n=4.0, typical=0.02, limit=3.0))


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
        ood_limits=LIMITS,
        before_n=0.5,
        weights=weights,
    )


def arrays(features: int = 5, floor: float = 2.0) -> ProfileArrays:
    axes = np.linalg.qr(np.random.default_rng(3).normal(size=(features, 2)))[0]
    zeros = np.zeros(features, np.float32)
    return ProfileArrays(zeros, np.zeros(1, np.float32), KnownFrames(zeros + 1, axes, floor, LIMITS))


def written(path: Path, arrays: ProfileArrays) -> str:
    data = pack(arrays)
    weights_path(path).write_bytes(data)
    return sha256(data).hexdigest()


@given(st.floats(-20, 40))
def test_curve_is_extrapolated_linearly(at_n: float) -> None:
    curve = OutputCurve(kind="monotone", estimate_n=(0.0, 2.0, 4.0), force_n=(0.5, 1.5, 4.5))
    value_n = float(curve.at([at_n])[0])
    assert value_n == pytest.approx(0.5 + 0.5 * at_n if at_n < 2 else 1.5 + 1.5 * (at_n - 2))


def test_interval_grows_with_force_and_faster_beyond_calibrated_forces() -> None:
    correction = Correction(profile(), arrays())
    half_n = correction.half_width_n([-1.0, 0.0, 4.0, 6.0, 8.0])
    assert half_n[0] == pytest.approx(np.hypot(0.3, 0.1) + 0.7)
    assert half_n[1:4] == pytest.approx(np.hypot(0.3, [0.0, 0.4, 0.6]))
    assert half_n[4] == pytest.approx(np.hypot(0.3, 0.8) + 2)
    assert correction.std_n([4.0])[0] * 1.6449 == pytest.approx(half_n[2], rel=1e-4)


def test_arrays_round_trip_and_must_match_the_profile(tmp_path: Path) -> None:
    path = tmp_path / "mug.yaml"
    weights = written(path, arrays())
    correction = load_correction(path, profile(weights), 5)
    features = np.random.default_rng(0).normal(size=(7, 5)).astype(np.float32)
    known, expected = correction.known, arrays().known
    assert known is not None
    assert expected is not None
    assert known.limits == LIMITS
    shares = [residual_share(features, k.mean, orthonormal(k.axes), k.floor) for k in (known, expected)]
    np.testing.assert_allclose(shares[0], shares[1], rtol=0.01)  # the axes are stored in half precision
    with pytest.raises(ConfigError, match="for another network: this one has 6"):
        load_correction(path, profile(weights), 6)
    with pytest.raises(ConfigError, match="does not belong to"):
        load_correction(path, profile("0" * 64), 5)
    weights_path(path).unlink()
    with pytest.raises(ConfigError, match="belongs to the object profile"):
        load_correction(path, profile(weights), 5)


def test_arrays_of_known_frames_are_needed_only_with_limits(tmp_path: Path) -> None:
    path = tmp_path / "mug.yaml"
    weights = written(path, replace(arrays(), known=None))
    with pytest.raises(ConfigError, match="mean"):
        load_correction(path, profile(weights), 5)
    without = profile(weights).model_copy(update={"ood_limits": None})
    assert load_correction(path, without, 5).known is None


@pytest.mark.parametrize("floor", [0.0, np.nan])
def test_invalid_floor_is_refused(tmp_path: Path, floor: float) -> None:
    path = tmp_path / "mug.yaml"
    weights = written(path, arrays(floor=floor))
    with pytest.raises(ConfigError, match="not finite"):
        load_correction(path, profile(weights), 5)
