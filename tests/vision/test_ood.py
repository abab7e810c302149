import numpy as np
import pytest

from gripper_force.profiles.object_profile import OodLimit
from gripper_force.vision.engines.openvino import OpenVinoEngine
from gripper_force.vision.header import OodModel
from gripper_force.vision.model_files import read_model
from gripper_force.vision.ood import FRAMES, OodScore, orthonormal, residual_share

FEATURES, DIMENSIONS = 12, 3
MEAN = np.arange(FEATURES, dtype=np.float32)
AXES = orthonormal(np.random.default_rng(0).standard_normal((FEATURES, DIMENSIONS)).astype(np.float16))


def model() -> OodModel:
    from base64 import urlsafe_b64encode

    return OodModel(
        mean=urlsafe_b64encode(MEAN.tobytes()),
        axes=urlsafe_b64encode(AXES.astype(np.float16).tobytes()),
        floor=0.1,
        limits=(
            OodLimit(force_n=0.0, typical=0.01, limit=2.0),
            OodLimit(force_n=4.0, typical=0.01, limit=4.0),
        ),
        std_base=1.0,
        std_growth=2.0,
    )


def features(off_axis: float, frames: int = 1) -> np.ndarray:
    """Features that lie off the subspace by a share of their distance from the mean."""
    rng = np.random.default_rng(1)
    along = AXES @ rng.standard_normal((DIMENSIONS, frames))  # (F, N)
    across = rng.standard_normal((FEATURES, frames))
    across -= AXES @ (AXES.T @ across)
    across *= off_axis * np.linalg.norm(along, axis=0) / np.linalg.norm(across, axis=0)
    return (MEAN[:, None] + 10 * (along + across)).T.astype(np.float32)


def test_share_is_that_of_the_squared_distance_off_the_subspace() -> None:
    share = residual_share(features(0.5, 4), MEAN, AXES, 0.0)
    np.testing.assert_allclose(share, 0.25 / 1.25, rtol=1e-4)


def test_limit_depends_on_the_force_and_the_claim_grows_with_the_score() -> None:
    seen = features(0.2)
    low, high = (float(OodScore(model()).score(seen, np.array([force_n]))[0]) for force_n in (0.0, 4.0))
    assert low == pytest.approx(2 * high)
    np.testing.assert_allclose(OodScore(model()).std_factor([0.0, 1.0]), [1.0, 5**0.5])


def test_one_strange_frame_is_averaged_out_and_many_are_not() -> None:
    score = OodScore(model())
    estimate_n = np.zeros(1)
    for frame in features(0.01, 3 * FRAMES):
        assert score.score(frame[None], estimate_n)[0] < 1
    assert score.score(features(1.0), estimate_n)[0] < 1
    assert max(score.score(features(1.0), estimate_n)[0] for _ in range(FRAMES)) > 1
    score.reset()
    assert score.score(features(1.0), estimate_n)[0] < 1  # the first frame of a stream alone tells nothing


def test_bfloat16_has_no_score() -> None:
    shipped = read_model("small")
    assert shipped.header.ood is not None
    assert OpenVinoEngine(shipped, "float32").header.ood is not None
    assert OpenVinoEngine(shipped, "bfloat16").header.ood is None
