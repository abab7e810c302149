import math
from base64 import urlsafe_b64encode
from contextlib import suppress
from dataclasses import replace
from datetime import date
from hashlib import sha256
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

from gripper_force.config import VisionConfig
from gripper_force.errors import ConfigError, DataError, NonFiniteError, UnfamiliarFrameError
from gripper_force.jobs.profile_files import pack, write_object
from gripper_force.profiles.correction import Correction, KnownFrames, ProfileArrays
from gripper_force.profiles.object_profile import Interval, ObjectProfile, OodLimit, OutputCurve
from gripper_force.types import ForceEstimate
from gripper_force.vision.batch_inference import features, predict
from gripper_force.vision.checkpoint import Checkpoint
from gripper_force.vision.engines import pytorch
from gripper_force.vision.estimator import ForceEstimator, open_estimator
from gripper_force.vision.header import (
    VIEW_LENGTH,
    Header,
    KnownViews,
    Model,
    NetworkConfig,
    OodModel,
    Residual,
)
from gripper_force.vision.known_views import describe_view
from gripper_force.vision.model_files import read_model
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess, Region, downscale

REGION = (10, 5, 40, 40)
RESIDUALS = (Residual(force_n=-100, std_n=0), Residual(force_n=100, std_n=2))


def ensemble(*attentions: str, reference: bool = True) -> Checkpoint:
    torch.manual_seed(0)
    configs = tuple(
        NetworkConfig.model_validate({"attention": a, "size": 32, "width": 0.25, "hidden": 6, "head": 7})
        for a in attentions
    )
    preprocess = Preprocess(size=32, reference=reference)
    header = Header(members=configs, preprocess=preprocess, residuals=RESIDUALS, data_digest="", metrics={})
    networks = tuple(ForceNetwork(config).eval().requires_grad_(False) for config in configs)
    return Checkpoint(networks, header, digest="")


def engine(checkpoint: Checkpoint) -> pytorch.TorchEngine:
    """An engine of networks that a file would round, or refuse."""
    model = Model(Path("unwritten.safetensors"), checkpoint.header, checkpoint.digest)
    with mock.patch.object(pytorch, "load_checkpoint", return_value=checkpoint):
        return pytorch.TorchEngine(model)


@pytest.fixture
def frames() -> np.ndarray:
    rng = np.random.default_rng(0)
    return (rng.integers(20, 236, (50, 60)) + rng.integers(-19, 20, (30, 50, 60))).astype(np.uint8)


def run(estimator: ForceEstimator, frames: np.ndarray) -> list[ForceEstimate | None]:
    return [estimator.update(frame) for frame in frames]


def test_streaming_equals_batch_inference(frames: np.ndarray) -> None:
    checkpoint = ensemble("ssam", "scam")
    estimates = run(ForceEstimator(engine(checkpoint), REGION), frames)
    small = np.stack([downscale(frame, REGION, 32) for frame in frames])
    members = predict(checkpoint.networks, checkpoint.header.preprocess, small)  # (2, 30)
    assert estimates[:3] == [None] * 3
    for estimate, (ssam, scam) in zip(estimates[3:], members.T[3:].tolist(), strict=True):
        assert estimate is not None
        mean = (ssam + scam) / 2
        assert estimate.force_n == pytest.approx(mean, abs=1e-4)
        residual = (mean + 100) / 100
        assert estimate.std_n == pytest.approx(math.hypot(residual, (ssam - scam) / 2), abs=1e-4)


def test_reset_starts_a_new_run(frames: np.ndarray) -> None:
    estimator = ForceEstimator(engine(ensemble("ssam")))
    first = run(estimator, frames)
    assert run(estimator, frames) != first
    estimator.reset()
    assert estimator.reference is None
    assert run(estimator, frames) == first


def test_without_a_reference_every_frame_counts(frames: np.ndarray) -> None:
    estimator = ForceEstimator(engine(ensemble("scam", reference=False)))
    assert None not in run(estimator, frames)
    assert estimator.reference is None


def test_reference_is_mean_of_region(frames: np.ndarray) -> None:
    estimator = ForceEstimator(engine(ensemble("ssam")), REGION)
    run(estimator, frames)
    expected = np.mean([downscale(frame, REGION, 32) for frame in frames[:4]], axis=0).round()
    assert estimator.reference is not None
    np.testing.assert_array_equal(estimator.reference, expected)


def test_attention_map_is_of_newest_frame(frames: np.ndarray) -> None:
    estimator = ForceEstimator(engine(ensemble("scam", "ssam")))
    assert estimator.attention_map() is None
    run(estimator, frames[:5])
    earlier = estimator.attention_map()
    estimator.update(frames[5])
    newest = estimator.attention_map()
    assert earlier is not None
    assert newest is not None
    assert newest.shape == (2, 2)
    assert newest.dtype == np.float32
    assert 0 < newest.min() < newest.max() < 1
    assert not np.array_equal(earlier, newest)


def test_no_attention_map_without_ssam(frames: np.ndarray) -> None:
    estimator = ForceEstimator(engine(ensemble("scam", "none")))
    run(estimator, frames[:5])
    assert estimator.attention_map() is None


def test_nan_from_a_network_is_refused(frames: np.ndarray) -> None:
    checkpoint = ensemble("ssam", "scam")
    checkpoint.force_networks[1].out.bias.fill_(torch.nan)
    estimator = ForceEstimator(engine(checkpoint))
    with pytest.raises(NonFiniteError, match="nan"):
        run(estimator, frames)


@pytest.mark.parametrize("force_n", [-150.0, -100.6, -100.4, 0.0, 100.4, 100.6, 1e30])
def test_claimed_error_grows_beyond_validated_forces(frames: np.ndarray, force_n: float) -> None:
    checkpoint = ensemble("ssam")
    checkpoint.force_networks[0].out.weight.zero_()
    checkpoint.force_networks[0].out.bias.fill_(force_n / 20)
    estimate = run(ForceEstimator(engine(checkpoint)), frames[:4])[3]
    assert estimate is not None
    known_n = {-100.6: 0.0, -100.4: 0.0, -150.0: 0.0, 0.0: 1.0}.get(force_n, 2.0)
    assert estimate.std_n == pytest.approx(known_n + max(abs(force_n) - 100.5, 0), rel=1e-5, abs=1e-4)


def test_invalid_frame_or_region_is_refused(frames: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="region"):
        ForceEstimator(engine(ensemble("ssam")), (0, 0, 100, 100)).update(frames[0])
    with pytest.raises(DataError, match="gray"):
        ForceEstimator(engine(ensemble("ssam"))).update(frames)


@pytest.mark.parametrize("region", [None, REGION])
def test_a_frame_of_another_size_is_refused_until_a_reset(frames: np.ndarray, region: Region | None) -> None:
    """A region in pixels shows another part of it, and without one the network sees a view that was stretched."""
    estimator, undisturbed = (ForceEstimator(engine(ensemble("ssam")), region) for _ in range(2))
    run(estimator, frames[:6])
    for other in (frames[6, :48], np.ascontiguousarray(frames[6].T)):
        with pytest.raises(
            DataError, match=r"^the frame is \(\d+, \d+\), but the stream began with \(50, 60\); keep"
        ):
            estimator.update(other)
    assert estimator.update(frames[6]) == run(undisturbed, frames[:7])[-1]
    estimator.reset()
    assert run(estimator, frames[:6, :48])[-1] is not None


def limits_of(limit: float) -> tuple[OodLimit, ...]:
    return (OodLimit(force_n=0.0, typical=1.0, limit=limit),)


def profile_of(limit: float | None, checkpoint: str = "", weights: str = "") -> ObjectProfile:
    """An object profile that halves the force and adds 0.2 N."""
    return ObjectProfile(
        object="mug",
        date=date(2026, 1, 2),
        checkpoint=checkpoint,
        camera={"camera.rate_hz": 1.0},
        touches=3,
        frames=30,
        force_n=5.0,
        output=OutputCurve(kind="affine", estimate_n=(0.0, 2.0), force_n=(0.2, 1.2)),
        interval=Interval(coverage=0.9, base_n=0.3, share=0.1),
        ood_limits=None if limit is None else limits_of(limit),
        before_n=0.5,
        weights=weights,
    )


def arrays_of(mean: np.ndarray, limit: float | None = 1e6) -> ProfileArrays:
    """A head that adds 0.1 N and one feature, and a subspace of one dimension."""
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(len(mean), 1))
    head = np.zeros(len(mean), np.float32)
    head[3] = 2.0
    known = KnownFrames(mean, unit / np.linalg.norm(unit), 1e-6, limits_of(limit)) if limit else None
    return ProfileArrays(head, np.array([0.1], np.float32), known)


def correction(limit: float | None, mean: np.ndarray) -> Correction:
    return Correction(profile_of(limit), arrays_of(mean, limit))


def with_score(checkpoint: Checkpoint, limit: float) -> Checkpoint:
    """The checkpoint with a score of one dimension, which says little and rejects frames above the limit."""
    features = sum(member.head for member in checkpoint.header.members)
    model = OodModel(
        mean=urlsafe_b64encode(np.zeros(features, np.float32).tobytes()),
        axes=urlsafe_b64encode(np.eye(features, 1, dtype=np.float16).tobytes()),
        floor=1e-6,
        limits=limits_of(limit),
        std_base=1.0,
        std_growth=0.0,
    )
    return replace(checkpoint, header=checkpoint.header.model_copy(update={"ood": model}))


def test_profile_corrects_a_stream_like_a_batch(frames: np.ndarray) -> None:
    checkpoint = ensemble("ssam", "scam")
    small = np.stack([downscale(frame, REGION, 32) for frame in frames])
    forces, read = features(checkpoint.networks, checkpoint.header.preprocess, small)
    profile = correction(1e6, read.mean(0))
    estimates = run(ForceEstimator(engine(checkpoint), REGION, profile), frames)
    expected = 0.5 * forces.mean(0) + 0.2 + 2.0 * read[:, 3] + 0.1
    for estimate, force_n in zip(estimates[3:], expected[3:].tolist(), strict=True):
        assert estimate is not None
        assert estimate.force_n == pytest.approx(force_n, abs=1e-4)
        half_n = math.hypot(0.3, 0.1 * force_n) + max(force_n - 5, -0.3 - force_n, 0)
        assert estimate.std_n == pytest.approx(half_n / 1.6449, abs=1e-3)


@pytest.mark.parametrize(
    ("network", "own", "words"),
    [
        (1e6, 1e-6, r"limit of the object profile 'mug'; check that the object is the profile's"),
        (
            1e-6,
            None,
            r"network's limit, and the object profile 'mug' has no limits of its own; calibrate again",
        ),
        (1e-6, 1e6, None),
        (1e6, None, None),
    ],
)
def test_limits_of_a_profile_replace_those_of_the_network(
    frames: np.ndarray, network: float, own: float | None, words: str | None
) -> None:
    checkpoint = with_score(ensemble("ssam"), network)
    estimator = ForceEstimator(engine(checkpoint), REGION, correction(own, np.zeros(7, np.float32)))
    if words is None:
        assert run(estimator, frames)[-1] is not None
        return
    with pytest.raises(DataError, match=words):
        run(estimator, frames)


def test_a_network_without_a_score_rejects_no_frame(frames: np.ndarray) -> None:
    estimator = ForceEstimator(engine(ensemble("ssam")), REGION, correction(1e-6, np.zeros(7, np.float32)))
    assert run(estimator, frames)[-1] is not None


def test_a_view_that_the_network_does_not_know_gives_no_estimate(frames: np.ndarray) -> None:
    def knowing(view: np.ndarray) -> Checkpoint:
        known = KnownViews(
            mean=urlsafe_b64encode(describe_view(view).astype(np.float32).tobytes()),
            axes=urlsafe_b64encode(np.eye(VIEW_LENGTH, 1, dtype=np.float16).tobytes()),
            limit=1e-3,
        )
        bare = ensemble("ssam")
        return replace(bare, header=bare.header.model_copy(update={"views": known}))

    plain = ForceEstimator(engine(ensemble("ssam")), REGION)
    expected = run(plain, frames)
    assert plain.reference is not None
    assert run(ForceEstimator(engine(knowing(plain.reference)), REGION), frames) == expected
    other = knowing(np.ascontiguousarray(plain.reference[::-1]))
    unknown = ForceEstimator(engine(other), REGION)
    assert run(unknown, frames[:3]) == [None] * 3
    for frame, estimate in zip(frames[3:], expected[3:], strict=True):
        with pytest.raises(UnfamiliarFrameError, match="does not know the view before") as caught:
            unknown.update(frame)
        assert estimate is not None
        assert caught.value.force_n == estimate.force_n
    own = ForceEstimator(engine(other), REGION, correction(1e6, np.zeros(7, np.float32)))
    assert run(own, frames)[-1] is not None, "the user of a profile has chosen the view"


def test_a_renewed_reference_is_that_of_the_last_frames(frames: np.ndarray) -> None:
    moved = np.roll(frames, 9, axis=2)  # the camera was moved by so many pixels
    large = ensemble("ssam")
    renewed, fresh = (ForceEstimator(engine(large), REGION) for _ in range(2))
    run(renewed, frames[:10])
    run(renewed, moved[:10])
    renewed.renew_reference()
    run(fresh, moved[6:10])
    assert renewed.reference is not None
    assert fresh.reference is not None
    assert np.array_equal(renewed.reference, fresh.reference)
    assert run(renewed, moved[10:]) == run(fresh, moved[10:])


def test_frames_that_are_no_reference_end_the_estimates_until_later_ones_are(frames: np.ndarray) -> None:
    """Otherwise the next frames became the reference, and they may show contact."""
    renewed, fresh = (ForceEstimator(engine(ensemble("ssam")), REGION) for _ in range(2))
    run(renewed, frames[:10])
    with pytest.raises(DataError, match="flat"):
        renewed.update(np.full_like(frames[0], 30))
    with pytest.raises(DataError, match="flat"):
        renewed.renew_reference()
    for frame in frames[10:18]:
        with pytest.raises(DataError, match="there is no reference"):
            renewed.update(frame)
    renewed.renew_reference()
    run(fresh, frames[14:18])
    assert run(renewed, frames[18:]) == run(fresh, frames[18:])


def test_a_renewed_reference_keeps_the_size_of_the_frames(frames: np.ndarray) -> None:
    estimator = ForceEstimator(engine(ensemble("ssam")), REGION)
    run(estimator, frames[:10])
    estimator.renew_reference()
    with pytest.raises(DataError, match="the stream began with"):
        estimator.update(np.pad(frames[10], 8))


def test_a_reference_that_is_renewed_at_once_takes_the_next_frames(frames: np.ndarray) -> None:
    estimator, fresh = (ForceEstimator(engine(ensemble("ssam")), REGION) for _ in range(2))
    run(estimator, frames[:2])
    estimator.renew_reference()
    assert run(estimator, frames[2:]) == run(fresh, frames)[2:]


def test_loads_a_network_by_name_or_path(tiny_checkpoint: Path, frames: np.ndarray) -> None:
    estimator = ForceEstimator.load(tiny_checkpoint, region=REGION)
    expected = open_estimator(read_model(tiny_checkpoint), VisionConfig(region=REGION))
    estimates = run(estimator, frames)
    assert estimates[:3] == [None] * 3
    assert estimates == run(expected, frames)
    assert ForceEstimator.load("small").reference is None


@pytest.mark.parametrize("by_path", [True, False])
def test_loads_an_object_profile_of_the_same_network(
    tiny_checkpoint: Path, frames: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by_path: bool
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    path = tmp_path / "gripper-force" / "objects" / "mug.yaml"
    model = read_model(tiny_checkpoint)
    weights = pack(arrays_of(np.zeros(14, np.float32)))
    digest = sha256(weights).hexdigest()
    write_object(path, profile_of(1e6, model.digest, digest), weights)
    plain = run(ForceEstimator.load(tiny_checkpoint), frames)[-1]
    corrected = run(ForceEstimator.load(tiny_checkpoint, profile=path if by_path else "mug"), frames)[-1]
    assert plain is not None
    assert corrected is not None
    assert abs(corrected.force_n - (0.5 * plain.force_n + 0.3)) < 2.01  # the head adds 2 N times tanh
    write_object(path, profile_of(1e6, "a" * 64, digest), weights)
    with pytest.raises(
        ConfigError, match=r"mug\.yaml is of network aaaaaaaaaaaa, not .*; calibrate the object"
    ):
        ForceEstimator.load(tiny_checkpoint, profile=path)


def test_load_names_what_is_unknown(tiny_checkpoint: Path) -> None:
    with pytest.raises(ConfigError, match="no object profile 'no_such_object'"):
        ForceEstimator.load(tiny_checkpoint, profile="no_such_object")
    with pytest.raises(ConfigError, match=r"unknown vision\.engine 'tensorrt'"):
        ForceEstimator.load(tiny_checkpoint, engine="tensorrt")
    with pytest.raises(ConfigError, match="the network must be a path, not 3; name a file, default or small"):
        ForceEstimator.load(3)  # type: ignore[arg-type]


@pytest.mark.parametrize("max_covered", [-0.1, 0.51, float("nan"), "wide"])
def test_load_refuses_a_covered_share_that_the_configuration_refuses(
    tiny_checkpoint: Path, max_covered: float
) -> None:
    with pytest.raises(ConfigError, match=r"vision\.max_covered.* \(from ForceEstimator\.load\)"):
        ForceEstimator.load(tiny_checkpoint, max_covered=max_covered)


def test_pytorchs_threads_are_set_unless_switched_off(tiny_checkpoint: Path) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        ForceEstimator.load(tiny_checkpoint)
        open_estimator(
            read_model(tiny_checkpoint), VisionConfig(engine="torch", threads=2), set_threads=False
        )
        assert torch.get_num_threads() == 3
        open_estimator(read_model(tiny_checkpoint), VisionConfig(engine="torch", threads=2))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def covered_frames() -> np.ndarray:
    """Returns five frames of one texture, the last with a gray disc over a fifth of it, (5, 128, 128)."""
    rng = np.random.default_rng(0)
    texture = rng.integers(20, 236, (128, 128)).astype(np.uint8)
    y, x = np.mgrid[:128, :128]
    covered = np.where(np.hypot(x - 64, y - 64) < 32, 110, texture).astype(np.uint8)
    return np.stack([texture] * 4 + [covered])


@pytest.mark.parametrize("max_covered", [0.15, 0.5])
def test_jaws_that_hide_more_of_the_view_are_configured(max_covered: float) -> None:
    vision = VisionConfig(checkpoint="small", max_covered=max_covered)
    model = read_model("small")
    for estimator in (
        open_estimator(model, vision, set_threads=False),
        ForceEstimator.load("small", max_covered=max_covered),
    ):
        *first, last = covered_frames()
        for frame in first:
            with suppress(
                UnfamiliarFrameError
            ):  # the network does not know this scene, which is no matter here
                estimator.update(frame)
        try:
            estimator.update(last)
        except DataError as error:
            problem = str(error)
        else:
            problem = ""
        assert ("over vision.max_covered" in problem) == (max_covered == 0.15)
