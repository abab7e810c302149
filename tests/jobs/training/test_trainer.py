import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gripper_force.jobs import cpu
from gripper_force.jobs.dataset import CONTACT_N, Clip
from gripper_force.jobs.training.batches import Batches, Replay
from gripper_force.jobs.training.parallel import TrainingProcess
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.jobs.training.train import train
from gripper_force.jobs.training.trainer import Trainer, one_cycle, squared_error, step_decay
from gripper_force.vision.batch_inference import normalise
from gripper_force.vision.header import NetworkConfig
from gripper_force.vision.network import ForceNetwork

pytestmark = pytest.mark.usefixtures("one_thread")


def gradients(
    network: ForceNetwork, inputs: torch.Tensor, forces_n: torch.Tensor, valid: torch.Tensor
) -> tuple[float, list[torch.Tensor]]:
    """Loss of the training on complete windows, and its gradients."""
    network.zero_grad()
    first = network.config.context
    known = valid[:, first:]
    loss = squared_error(network(inputs, first), forces_n[:, first:], known) / known.sum()
    loss.backward()
    return loss.item(), [p.grad.clone() for p in network.parameters() if p.grad is not None]


@pytest.mark.parametrize("backbone", ["vgg", "resnet18", "mobile"])
@pytest.mark.parametrize(
    ("attention", "earlier_frames", "pooling"),
    [("none", 0, "wap"), ("ssam", 0, "wap"), ("ssam", 2, "gap"), ("scam", 1, "wap"), ("cbam", 0, "wap")],
)
def test_shared_windows_give_the_loss_and_gradients_of_separate_ones(
    backbone: str, attention: str, earlier_frames: int, pooling: str
) -> None:
    """With the same statistics of batch normalisation: the running ones."""
    torch.manual_seed(0)
    shape = {"attention": attention, "earlier_frames": earlier_frames, "pooling": pooling}
    config = NetworkConfig.model_validate(
        {**shape, "backbone": backbone, "size": 32, "width": 0.25, "window": 5, "hidden": 6, "head": 7}
    )
    network = ForceNetwork(config).double().eval()
    for name, tensor in network.state_dict().items():
        if name.endswith("running_var"):
            tensor.uniform_(0.01, 1)
    window = network.config.context + 1
    inputs = torch.randn(2, window + 4, 1, 32, 32, dtype=torch.float64)
    forces_n, valid = torch.rand(2, window + 4, dtype=torch.float64), torch.rand(2, window + 4) < 0.7

    def windows(whole: torch.Tensor) -> torch.Tensor:
        return whole.unfold(1, window, 1).movedim(-1, 2).flatten(0, 1)  # (2 * 5, window, ...)

    shared = gradients(network, inputs, forces_n, valid)
    separate = gradients(network, windows(inputs), windows(forces_n), windows(valid))
    assert shared[0] == pytest.approx(separate[0], rel=1e-10)
    assert len(shared[1]) == len(list(network.parameters()))
    for one, other in zip(shared[1], separate[1], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)
        assert other.abs().max() > 0


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("windows", ["shared", "separate"])
def test_every_precision_and_window_mode_trains(
    precision: str, windows: str, clips: list[Clip], small_recipe: TrainConfig
) -> None:
    recipe = {"precision": precision, "windows": windows, "short_share": 0.0, "steps": 21}
    config = small_recipe.model_copy(update=recipe)
    trainer = Trainer(config, 0, Batches(clips, config, TrainingProcess("cpu")), TrainingProcess("cpu"))
    errors_n = list(trainer.steps())
    assert len(errors_n) == 21
    assert errors_n[-1] < 0.95 * errors_n[0]
    assert not trainer.network.training
    assert all(p.dtype == torch.float32 for p in trainer.network.parameters())


@pytest.mark.parametrize(
    ("flags", "same", "other"),
    [("avx512_bf16 amx_bf16", "bfloat16", "float32"), ("avx2", "float32", "bfloat16")],
)
def test_automatic_precision_is_the_one_that_the_cpu_computes(
    flags: str,
    same: str,
    other: str,
    clips: list[Clip],
    small_recipe: TrainConfig,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cpu, "cpu_info", lambda: ["processor: 0", f"flags: fpu {flags} sse2"])
    process = TrainingProcess("cpu")

    def errors_n(precision: str) -> list[float]:
        config = small_recipe.model_copy(update={"precision": precision, "steps": 1})
        return list(Trainer(config, 0, Batches(clips, config, process), process).steps())

    assert small_recipe.precision == "auto"
    assert errors_n("auto") == errors_n(same) != errors_n(other)


@pytest.fixture
def indented(clips: list[Clip]) -> list[Clip]:
    """The clips with the travel of the jaws, which is a square root of the force, for all but one."""
    travels_m = [np.float32(0.004) * np.sqrt(clip.forces_n) for clip in clips]
    return [clips[0], *(replace(c, indentation_m=m) for c, m in zip(clips[1:], travels_m[1:], strict=True))]


def test_indentation_and_contact_are_learned_beside_force(
    indented: list[Clip], small_recipe: TrainConfig, press: Callable[..., Clip]
) -> None:
    extra = {"indentation_weight": 0.5, "contact_weight": 0.1, "steps": 90, "clips": 4}
    network_size = {"hidden": 128, "head": 512}
    config = small_recipe.model_copy(update={**extra, **network_size, "precision": "float32"})
    trainer = Trainer(config, 0, Batches(indented, config, TrainingProcess("cpu")), TrainingProcess("cpu"))
    list(trainer.steps())
    network, unseen = trainer.network, press(99)
    assert network.config.outputs == ("force", "indentation", "contact")
    inputs = normalise(
        torch.from_numpy(unseen.frames)[None], torch.from_numpy(unseen.frames[None, :4]), config.preprocess
    )
    with torch.no_grad():
        features = network.features(inputs)[0]
        force, indentation, contact = network.outputs(features).numpy().T
        np.testing.assert_allclose(network(inputs)[0].numpy(), force * np.float32(20), rtol=1e-4, atol=1e-4)
    travel_m = 0.004 * np.sqrt(unseen.forces_n)
    error_m = np.abs(0.02 * indentation - travel_m).mean()
    assert error_m < 0.4 * np.abs(travel_m - travel_m.mean()).mean()
    assert np.mean((contact > 0) == (unseen.forces_n > CONTACT_N)) > 0.9


def test_new_outputs_leave_the_force_of_the_initial_network(
    indented: list[Clip], small_recipe: TrainConfig
) -> None:
    plain = Trainer(
        small_recipe, 0, Batches(indented, small_recipe, TrainingProcess("cpu")), TrainingProcess("cpu")
    ).network.eval()
    config = small_recipe.model_copy(update={"contact_weight": 1.0})
    trainer = Trainer(config, 0, Batches(indented, config, TrainingProcess("cpu")), TrainingProcess("cpu"))
    trainer.start_from(plain)
    inputs = torch.randn(2, 24, 1, 16, 16)
    with torch.no_grad():
        assert torch.equal(trainer.network.eval()(inputs, 19), plain(inputs, 19))
        assert not trainer.network.outputs(torch.randn(3, plain.config.head))[:, 1].any()


@pytest.mark.parametrize("frozen", [False, True])
def test_frozen_statistics_are_those_of_the_initial_network(
    frozen: bool, clips: list[Clip], small_recipe: TrainConfig
) -> None:
    config = small_recipe.model_copy(update={"freeze_statistics": frozen})
    trainer = Trainer(config, 0, Batches(clips, config, TrainingProcess("cpu")), TrainingProcess("cpu"))

    def statistics() -> torch.Tensor:
        state = trainer.network.state_dict()
        return torch.cat([tensor.flatten().clone() for name, tensor in state.items() if "running" in name])

    trainer.start_from(trainer.network)
    before, weight = statistics(), trainer.network.out.weight.clone()
    list(trainer.steps())
    assert torch.equal(statistics(), before) == frozen
    assert not torch.equal(trainer.network.out.weight, weight)


class Teacher(torch.nn.Module):
    """Says of each frame how much it differs from the reference."""

    def forward(self, inputs: torch.Tensor, start: int) -> torch.Tensor:
        return inputs[:, start:].abs().mean((2, 3, 4))


@pytest.mark.parametrize("short_share", [0.0, 1.0])
def test_forces_of_a_teacher_are_learned_like_labels(
    clips: list[Clip], small_recipe: TrainConfig, short_share: float
) -> None:
    unchanged = {"shift_px": 0, "light": 0.0, "noise": 0.0, "contact_share": 0.0, "force_share": 0.0}
    one_step = {"steps": 1, "short_share": short_share, "clip_frames": 40, "teacher_share": 0.7}
    config = small_recipe.model_copy(update={**unchanged, **one_step})
    process = TrainingProcess("cpu")

    def errors_n(labelled: list[Clip], *teachers: Teacher) -> list[float]:
        batches = Batches(labelled, config, process)
        return list(Trainer(config, 0, batches, process, teachers).steps())  # type: ignore[arg-type]

    mixed = []
    for clip in clips:
        frames = torch.from_numpy(clip.frames)[None]
        taught_n = Teacher()(normalise(frames, frames[:, :4], config.preprocess), 0)[0].numpy()
        mixed.append(replace(clip, forces_n=np.float32(0.3) * clip.forces_n + np.float32(0.7) * taught_n))
    assert errors_n(clips, Teacher()) == pytest.approx(errors_n(mixed), rel=1e-5)
    assert errors_n(clips, Teacher()) != pytest.approx(errors_n(clips), rel=0.05)


def test_training_in_parts(clips: list[Clip], small_recipe: TrainConfig) -> None:
    batches = Batches(clips, small_recipe, TrainingProcess("cpu"))
    whole, parts = (Trainer(small_recipe, 0, batches, TrainingProcess("cpu")) for _ in range(2))
    assert len(list(whole.steps())) == 4
    assert [len(list(parts.steps(until))) for until in (0.5, 0.5, 1.0)] == [2, 0, 2]
    for one, other in zip(whole.network.parameters(), parts.network.parameters(), strict=True):
        assert torch.equal(one, other)


def test_epochs_count_passes(clips: list[Clip], small_recipe: TrainConfig) -> None:
    config = small_recipe.model_copy(update={"epochs": 0.1, "clips": 9})
    batches = Batches(clips, config, TrainingProcess("cpu"))
    assert batches.labels == 360
    assert len(list(Trainer(config, 0, batches, TrainingProcess("cpu")).steps())) == 4
    mixed = Replay(batches, batches, config.replay_share)  # 4 of 9 clips
    assert len(list(Trainer(config, 0, mixed, TrainingProcess("cpu")).steps())) == 8


def test_time_budget_ends_training(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_recipe: TrainConfig
) -> None:
    seconds = iter(range(10_000))
    monkeypatch.setattr(time, "monotonic", lambda: float(next(seconds)))
    learning_rates = []
    update = Trainer._update

    def spying(trainer: Trainer) -> torch.Tensor:
        learning_rates.append(trainer.done)
        return update(trainer)

    monkeypatch.setattr(Trainer, "_update", spying)
    train(small_recipe.model_copy(update={"minutes": 0.5}), clips, tmp_path / "out.safetensors", figure=False)
    assert len(learning_rates) > 4
    assert learning_rates == sorted(learning_rates)
    assert learning_rates[0] == 0
    assert learning_rates[-1] < 1


def test_learning_rate_rises_then_falls() -> None:
    values = [one_cycle(x / 100, 0.25) for x in range(101)]
    assert values[0] == pytest.approx(0.04)
    assert values[25] == pytest.approx(1)
    assert values[100] == pytest.approx(0, abs=1e-9)
    assert values[:26] == sorted(values[:26])
    assert values[25:] == sorted(values[25:], reverse=True)


def test_learning_rate_of_the_paper_falls_every_30_of_120_epochs() -> None:
    rates = [step_decay(epoch / 120) for epoch in (0, 29.9, 30, 60, 90, 119.9)]
    assert rates == pytest.approx([1, 1, 0.1, 0.01, 0.001, 0.001])
