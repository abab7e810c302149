from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gripper_force import train as train_module
from gripper_force.config import section_from
from gripper_force.dataset import Clip, digest
from gripper_force.errors import CheckpointError, ConfigError, DataError, NonFiniteError
from gripper_force.train import TrainConfig, one_cycle, train
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.dense import normalise, predict
from gripper_force.vision.preprocess import Preprocess

QUICK = TrainConfig(
    attentions=("ssam",),
    width=0.25,
    preprocess=Preprocess(size=16),
    steps=4,
    clips=3,
    device="cpu",
    validation=0.3,
)


def press(seed: int, frames: int = 60) -> Clip:
    """A dark disc that grows with the force on a random background."""
    rng = np.random.default_rng(seed)
    forces_n = 8 * np.maximum(0, np.sin(np.linspace(-0.6, 3.4, frames))).astype(np.float32)
    y, x = np.mgrid[:16, :16]
    radius = np.hypot(y - 7.5, x - 7.5)
    background = rng.integers(90, 220, (16, 16))
    edge = 1 + 0.7 * forces_n[:, None, None] - radius
    images = np.where(edge > 0, 40, background) + (5 * edge).clip(0, 20)
    return Clip(images.astype(np.uint8), forces_n, np.ones(frames, np.bool_), f"p{seed}", "disc", f"s{seed}")


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Sums split over threads differ in their last bits, and threads contend where tests run side by side."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def clips() -> list[Clip]:
    return [press(seed) for seed in range(6)]


def test_it_learns(clips: list[Clip], tmp_path: Path) -> None:
    config = QUICK.model_copy(update={"steps": 120, "clips": 8})
    checkpoint = train(config, clips, tmp_path / "out.safetensors")
    unseen = press(99)
    error = predict(checkpoint.networks, config.preprocess, unseen.frames)[0] - unseen.forces_n
    constant = np.abs(unseen.forces_n - unseen.forces_n.mean()).mean()
    assert np.abs(error).mean() < 0.4 * constant


def test_the_checkpoint_tells_where_it_comes_from(clips: list[Clip], tmp_path: Path) -> None:
    config = QUICK.model_copy(update={"attentions": ("ssam", "scam")})
    out = tmp_path / "folder" / "out.safetensors"
    header = train(config, clips, out).header
    assert [member.attention for member in header.members] == ["ssam", "scam"]
    assert header.preprocess == config.preprocess
    assert header.data_digest == digest(clips)
    assert {"mae_n", "rmse_n", "bias_n"} == header.metrics.keys()
    assert [r.force_n for r in header.residuals] == sorted(r.force_n for r in header.residuals)
    assert all(r.std_n > 0 for r in header.residuals)
    assert list(out.parent.iterdir()) == [out]


@pytest.mark.parametrize("attention", ["none", "ssam", "scam", "se", "cbam"])
@pytest.mark.parametrize(("backbone", "pooling"), [("vgg", "gap"), ("resnet18", "wap"), ("mobile", "wap")])
def test_every_network_can_be_trained(
    attention: str, backbone: str, pooling: str, clips: list[Clip], tmp_path: Path
) -> None:
    recipe = {"attentions": [attention], "backbone": backbone, "pooling": pooling, "steps": 2, "clips": 2}
    config = TrainConfig.model_validate({**QUICK.model_dump(), **recipe, "preprocess": {"size": 32}})
    larger = [replace(clip, frames=clip.frames.repeat(2, axis=1).repeat(2, axis=2)) for clip in clips]
    checkpoint = train(config, larger, tmp_path / "out.safetensors")
    (member,) = checkpoint.header.members
    assert (member.attention, member.backbone) == (attention, backbone)
    assert member.pooling == (pooling if attention in ("ssam", "scam") else "wap")


def test_networks_that_cannot_be_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"resnet18: take a multiple of 32"):
        section_from(TrainConfig, ["backbone=resnet18", "preprocess.size=48"])
    with pytest.raises(ConfigError, match="attentions"):
        section_from(TrainConfig, ["attentions=[]"])


def test_validation_clips_can_be_given(clips: list[Clip], tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    checkpoint = train(QUICK, clips[:-1], out, validation_clips=clips[-1:])
    forces_n = predict(checkpoint.networks, QUICK.preprocess, clips[-1].frames)[0]
    claimed = checkpoint.header.metrics["mae_n"]
    assert claimed == pytest.approx(np.abs(forces_n - clips[-1].forces_n).mean(), rel=0.01)
    with pytest.raises(DataError, match="p5 has frames of 16 px"):
        train(
            QUICK.model_copy(update={"preprocess": Preprocess(size=32)}),
            clips[-1:],
            out,
            validation_clips=clips[-1:],
        )


def test_a_seed_fixes_the_result(clips: list[Clip], tmp_path: Path) -> None:
    a, b = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    train(QUICK, clips, a)
    train(QUICK, clips, b)
    assert a.read_bytes() == b.read_bytes()
    train(QUICK.model_copy(update={"seed": 1}), clips, b)
    assert a.read_bytes() != b.read_bytes()


def test_a_broken_run_goes_on_to_the_same_result(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = QUICK.model_copy(update={"attentions": ("ssam", "scam")})
    whole, broken = tmp_path / "whole.safetensors", tmp_path / "broken.safetensors"
    train(config, clips, whole)
    monkeypatch.setattr(train_module, "STATE_EVERY_S", 0.0)
    update = train_module._Run._update
    steps = iter(range(100))

    def failing(*args: object) -> torch.Tensor:
        if next(steps) == 6:  # in the second member
            raise KeyboardInterrupt
        return update(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(train_module._Run, "_update", failing)
    with pytest.raises(KeyboardInterrupt):
        train(config, clips, broken)
    assert not broken.exists()
    train(config, clips, broken, resume=True)
    assert next(steps) == 9  # 8 steps and the failed one, none twice
    assert broken.read_bytes() == whole.read_bytes()
    assert not list(tmp_path.glob("*.state"))


def test_a_state_of_another_recipe_is_refused(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.safetensors"
    monkeypatch.setattr(train_module, "save_checkpoint", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train(QUICK, clips, out)
    with pytest.raises(CheckpointError, match="another recipe"):
        train(QUICK.model_copy(update={"steps": 5}), clips, out, resume=True)
    with pytest.raises(CheckpointError, match="other data"):
        train(QUICK, clips[:-1], out, resume=True)
    out.with_suffix(".0.state").write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match="can't read"):
        train(QUICK, clips, out, resume=True)


def test_a_time_budget_ends_the_training(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = iter(range(10_000))
    monkeypatch.setattr(train_module.time, "monotonic", lambda: float(next(seconds)))
    learning_rates = []
    update = train_module._Run._update

    def spying(run: train_module._Run, *args: object) -> torch.Tensor:
        learning_rates.append(run._done)
        return update(run, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(train_module._Run, "_update", spying)
    train(QUICK.model_copy(update={"minutes": 0.5}), clips, tmp_path / "out.safetensors")
    assert len(learning_rates) > 4
    assert learning_rates == sorted(learning_rates)
    assert learning_rates[0] == 0
    assert learning_rates[-1] < 1


def test_divergence_is_named(clips: list[Clip], tmp_path: Path) -> None:
    clips[0].forces_n[:] = clips[1].forces_n[:] = clips[2].forces_n[:] = np.inf
    with pytest.raises(NonFiniteError, match="ssam diverged"):
        train(QUICK, clips, tmp_path / "out.safetensors")


def test_data_without_contact_or_split_are_refused(clips: list[Clip], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="two"):
        train(QUICK, clips[:1], tmp_path / "out.safetensors")
    with pytest.raises(DataError, match="too few"):
        train(QUICK, [*clips, press(7, frames=3), press(8, frames=3)], tmp_path / "out.safetensors")
    for clip in clips:
        clip.forces_n[:] = 0
    with pytest.raises(DataError, match="contact"):
        train(QUICK, clips, tmp_path / "out.safetensors")


def test_batches_hold_what_a_run_would_see(clips: list[Clip]) -> None:
    plain = QUICK.model_copy(update={"shift_px": 0, "light": 0.0, "noise": 0.0, "clips": 40})
    inputs, forces_n, valid = train_module._Data(clips, plain, "cpu").batch(step=0, short=False)
    assert inputs.shape == (40, plain.clip_frames, 1, 16, 16)
    assert valid.all()
    frames = torch.from_numpy(np.stack([clip.frames for clip in clips]))
    images = normalise(frames, frames[:, :4]).flatten(0, 1)  # (6 * 60, 1, 16, 16)
    labels = np.concatenate([clip.forces_n for clip in clips])
    for image, force_n in zip(inputs[:, -1], forces_n[:, -1], strict=True):
        same = (images - image).abs().amax((1, 2, 3)) < 1e-4
        assert force_n.item() in labels[same]


def test_frames_without_label_carry_no_loss(clips: list[Clip]) -> None:
    for clip in clips:
        clip.valid[::2] = False
        clip.forces_n[::2] = 1e9
    _, forces_n, valid = train_module._Data(clips, QUICK, "cpu").batch(step=0, short=False)
    assert valid[:, -1].all()
    assert not valid.all()
    assert (forces_n[valid] < 10).all()


def test_rare_forces_are_drawn_more_often(clips: list[Clip]) -> None:
    config = QUICK.model_copy(update={"clips": 300, "force_share": 1.0})
    _, forces_n, _ = train_module._Data(clips, config, "cpu").batch(step=0, short=False)
    counts = np.bincount(forces_n[:, -1].int().numpy(), minlength=8)
    assert counts.min() > 20
    none = QUICK.model_copy(update={"clips": 300, "force_share": 0.0, "contact_share": 0.0})
    _, forces_n, _ = train_module._Data(clips, none, "cpu").batch(step=0, short=False)
    assert (forces_n[:, -1] == 0).float().mean() > 0.15


def test_the_learning_rate_rises_then_falls() -> None:
    values = [one_cycle(x / 100, 0.25) for x in range(101)]
    assert values[0] == pytest.approx(0.04)
    assert values[25] == pytest.approx(1)
    assert values[100] == pytest.approx(0, abs=1e-9)
    assert values[:26] == sorted(values[:26])
    assert values[25:] == sorted(values[25:], reverse=True)


def test_a_checkpoint_in_evaluation_mode_is_as_good_as_in_training(clips: list[Clip], tmp_path: Path) -> None:
    config = QUICK.model_copy(update={"steps": 60, "clips": 8})
    train(config, clips, tmp_path / "out.safetensors")
    (network,) = load_checkpoint(tmp_path / "out.safetensors").networks
    inputs, forces_n, _ = train_module._Data(clips, config, "cpu").batch(step=1000, short=False)
    with torch.no_grad():
        evaluated = (network(inputs, 19) - forces_n[:, 19:]).abs().mean()
        trained = (network.train()(inputs, 19) - forces_n[:, 19:]).abs().mean()
    assert evaluated < 2 * trained + 0.2
