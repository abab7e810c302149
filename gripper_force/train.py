"""Training: many short clips a step, one backbone pass for all windows of a clip.

Diversity, not the number of labels, is what limits this task, so a step draws short clips from everywhere
instead of long ones from a few recordings.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
import numpy.typing as npt
import torch
from pydantic import Field, ValidationError, model_validator
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from gripper_force import metrics
from gripper_force.config import NonNegative, Positive, Section
from gripper_force.dataset import CONTACT_N, Clip, check_size, digest, split_by
from gripper_force.errors import CheckpointError, DataError, NonFiniteError
from gripper_force.vision.attention import Pooling
from gripper_force.vision.checkpoint import Checkpoint, Header, Residual, load_checkpoint, save_checkpoint
from gripper_force.vision.dense import normalise, predict
from gripper_force.vision.network import Attention, BackboneName, ForceNetwork, NetworkConfig
from gripper_force.vision.preprocess import Preprocess

STATE_EVERY_S: Final = 60.0

RESIDUAL_PRIOR: Final = 20
"""Frames that count as much as the error over all forces, in the error claimed for one force."""

Share = Annotated[float, Field(ge=0, le=1)]


class TrainConfig(Section):
    """The recipe.

    Attributes:
        attentions: One member of the ensemble each.
        earlier_frames: n of SSAM and SCAM.
        pooling: Of SSAM and SCAM: weighted or global average pooling.
        backbone: Of all members.
        width: Multiplier of the backbone's channels.
        preprocess: How frames are prepared.
        steps: Optimiser steps for each member.
        minutes: Time for the whole ensemble; stands in for ``steps`` where given.
        clips: Clips a step.
        clip_frames: Frames a clip; those from the window's length on carry a loss.
        short_share: Share of the training, from its start, on clips of `short_frames`, as many more as cost
            the same: what the backbone has to learn needs many scenes, not many moments of one.
        short_frames: Frames of such a clip; the window before it is copies of its first, as at a run's start.
        learning_rate: Peak of the one-cycle schedule.
        weight_decay: Of AdamW.
        warmup: Share of the training in which the learning rate rises.
        contact_share: Share of clips that end in contact.
        force_share: Share of clips whose last frame is drawn evenly over force, as high forces are rare.
        shift_px: Largest shift of a clip.
        light: Standard deviation of the logarithm of gain and gamma, drawn for each clip.
        noise: Largest standard deviation of pixel noise, of full scale.
        validation: Share of each object's sets that is held out for the error the checkpoint claims.
        seed: Of weights and draws.
        device: Where to train; ``auto`` takes CUDA where it is there.
        compile: Whether to compile the network; pays after some minutes on a GPU.
    """

    attentions: Annotated[tuple[Attention, ...], Field(min_length=1)] = ("ssam", "scam")
    earlier_frames: Annotated[int, Field(ge=0, le=20)] = 1
    pooling: Pooling = "wap"
    backbone: BackboneName = "vgg"
    width: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] = 1.0
    preprocess: Preprocess = Preprocess()
    steps: Annotated[int, Field(ge=1)] = 1000
    minutes: Positive | None = None
    clips: Annotated[int, Field(ge=1)] = 12
    clip_frames: Annotated[int, Field(ge=1)] = 22
    short_share: Share = 0.6
    short_frames: Annotated[int, Field(ge=1)] = 4
    learning_rate: Positive = 1e-3
    weight_decay: NonNegative = 0.01
    warmup: Annotated[float, Field(gt=0, lt=1)] = 0.25
    contact_share: Share = 0.3
    force_share: Share = 0.2
    shift_px: Annotated[int, Field(ge=0)] = 2
    light: NonNegative = 0.2
    noise: NonNegative = 0.02
    validation: Annotated[float, Field(gt=0, lt=1)] = 0.1
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    compile: bool = False

    @model_validator(mode="after")
    def _fits(self) -> Self:
        try:
            self.network(0)
        except ValidationError as error:
            raise ValueError(error.errors()[0]["msg"].removeprefix("Value error, ")) from error
        return self

    def network(self, member: int) -> NetworkConfig:
        """The shape of one member."""
        attention = self.attentions[member]
        return NetworkConfig(
            attention=attention,
            earlier_frames=self.earlier_frames,
            pooling=self.pooling if attention in ("ssam", "scam") else "wap",
            backbone=self.backbone,
            size=self.preprocess.size,
            width=self.width,
        )


def train(
    config: TrainConfig,
    clips: Sequence[Clip],
    out: Path,
    *,
    validation_clips: Sequence[Clip] | None = None,
    init: Checkpoint | None = None,
    resume: bool = False,
) -> Checkpoint:
    """Trains an ensemble and writes its checkpoint.

    Each member's state is kept beside ``out`` every minute, until the checkpoint is written. With ``steps``,
    on the CPU with one thread, a seed fixes the result to the bit, broken off and resumed or not.

    Args:
        config: The recipe.
        clips: Training data.
        out: The checkpoint to write.
        validation_clips: What the error that the checkpoint claims is measured on; None: sets that are held
            out of ``clips``.
        init: Checkpoint whose weights to begin with, instead of random ones.
        resume: Whether to go on from the states of a run that was broken off.

    Returns:
        The checkpoint as written.

    Raises:
        DataError: The data have no two sets of any object, hold no contact, or a recording is too short or of
            another size.
        NonFiniteError: The training diverged.
        CheckpointError: A state is of another recipe or other data, or a file can't be written.
    """
    device = config.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    training, held_out = clips, validation_clips
    if held_out is None:
        training, held_out = split_by(clips, "set", config.validation, config.seed)
    check_size([*training, *held_out], config.preprocess)
    data = _Data(training, config, device)
    start = init.digest if init is not None else ""
    identity = f"{config.model_dump_json(exclude={'device', 'compile'})} {digest(training)} {start}"
    states = [out.with_suffix(f".{i}.state") for i in range(len(config.attentions))]
    networks = []
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[loss]}"))
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as progress:
        for member, state in enumerate(states):
            run = _Run(config, member, device, state, identity)
            if init is not None:
                run.begin_with(init)
            if resume:
                run.restore()
            run.train(data, progress)
            networks.append(run.network)
    forces_n, measured_n = _estimates(held_out, networks, config.preprocess, device)
    header = Header(
        members=tuple(network.config for network in networks),
        preprocess=config.preprocess,
        residuals=tuple(_residuals(forces_n, measured_n)),
        data_digest=digest(clips),
        metrics={
            "mae_n": metrics.mae(forces_n, measured_n),
            "rmse_n": metrics.rmse(forces_n, measured_n),
            "bias_n": metrics.bias(forces_n, measured_n),
        },
    )
    save_checkpoint(out, networks, header)
    for state in states:
        state.unlink()
    return load_checkpoint(out)


class _Data:
    """All training frames on one device, and lists to draw clips from."""

    def __init__(self, clips: Sequence[Clip], config: TrainConfig, device: str) -> None:
        for clip in clips:
            if len(clip.frames) < config.preprocess.reference_frames:
                raise DataError(f"{clip.name} has {len(clip.frames)} frames, too few for its own reference")
        lengths = [len(clip.frames) for clip in clips]
        forces_n = np.concatenate([clip.forces_n for clip in clips])
        valid = np.concatenate([clip.valid for clip in clips])
        self._config = config
        self._device = device
        self._begin = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)  # (N,)
        frames = np.concatenate([clip.frames for clip in clips])  # (N, S, S)
        self._frames = torch.from_numpy(frames).to(device)
        self._labels = torch.from_numpy(forces_n).to(device)  # (N,)
        self._valid = torch.from_numpy(valid).to(device)  # (N,)
        self._all = np.flatnonzero(valid)
        self._contact = np.flatnonzero(valid & (forces_n > CONTACT_N))
        if not len(self._contact):
            raise DataError(
                f"no training frame shows a force over {CONTACT_N} N; record or simulate contacts"
            )
        newtons = np.floor(forces_n[self._contact])
        self._levels = [self._contact[newtons == n] for n in np.unique(newtons)]

    def batch(self, step: int, *, short: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Draws the clips of one step, which depend on the seed, the step and their length alone.

        Args:
            step: Number of the step.
            short: Whether to draw many short clips instead of fewer long ones.

        Returns:
            Inputs (B, T, 1, S, S), forces in N (B, T), and which of these are valid (B, T).
        """
        config = self._config
        length, count = config.clip_frames, config.clips
        if short:
            length, count = config.short_frames, config.clips * config.clip_frames // config.short_frames
        rng = np.random.default_rng((config.seed, step))
        ends = self._ends(rng, count)
        begin = self._begin[ends]
        # Frames before a recording's first are copies of it, as for the estimator.
        index = np.maximum(ends[:, None] + np.arange(1 - length, 1), begin[:, None])  # (B, T)
        # The reference goes through the same distortion as the clip: it shares the camera and the light.
        lead = begin[:, None] + np.arange(config.preprocess.reference_frames)  # (B, R)
        gray = self._distorted(rng, np.concatenate([lead, index], axis=1))  # (B, R + T, S, S)
        reference, frames = gray[:, : lead.shape[1]], gray[:, lead.shape[1] :]
        inputs = normalise(frames, reference if config.preprocess.reference else None)
        where = torch.from_numpy(index).to(self._device)
        return inputs, self._labels[where], self._valid[where]

    def _ends(self, rng: np.random.Generator, count: int) -> npt.NDArray[np.int64]:
        draws = rng.random(count)
        ends = rng.choice(self._all, count)
        by_force = draws < self._config.force_share
        in_contact = ~by_force & (draws < self._config.force_share + self._config.contact_share)
        ends[in_contact] = rng.choice(self._contact, int(in_contact.sum()))
        ends[by_force] = [
            rng.choice(self._levels[rng.integers(len(self._levels))]) for _ in range(by_force.sum())
        ]
        return ends

    def _distorted(self, rng: np.random.Generator, index: npt.NDArray[np.int64]) -> Tensor:
        """Frames (B, T) as gray levels (B, T, S, S), each clip with its own shift, light and noise."""
        config = self._config
        size = config.preprocess.size
        shifts = rng.integers(-config.shift_px, config.shift_px, (2, len(index), 1), endpoint=True)
        rows, columns = (np.arange(size) + shifts).clip(0, size - 1)  # (B, S) each
        light = rng.normal(0, config.light, (2, len(index))).astype(np.float32)
        noise = rng.uniform(0, config.noise, len(index)).astype(np.float32)

        def move(array: npt.NDArray[np.generic]) -> Tensor:
            return torch.from_numpy(array).to(self._device)

        where, down, right = move(index), move(rows), move(columns)
        gray = self._frames[where[:, :, None, None], down[:, None, :, None], right[:, None, None, :]]
        gain, gamma = move(np.exp(light))[:, :, None, None, None]  # (B, 1, 1, 1) each
        generator = torch.Generator(self._device).manual_seed(int(rng.integers(2**62)))
        grain = torch.randn(gray.shape, generator=generator, device=self._device)
        lit: Tensor = gain * (gray / 255) ** gamma + move(noise)[:, None, None, None] * grain
        return lit.clamp_(0, 1) * 255


class _Run:
    """The training of one member."""

    def __init__(self, config: TrainConfig, member: int, device: str, state: Path, identity: str) -> None:
        torch.manual_seed(config.seed + member)
        self._config = config
        self._device = device
        self._state = state
        self._identity = identity
        self._member = member
        self._label = config.attentions[member]
        self.network = ForceNetwork(config.network(member)).to(device)
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )
        self._step = 0
        self._elapsed_s = 0.0

    @property
    def _done(self) -> float:
        """Share of the training that is done, in 0..1 and beyond."""
        if self._config.minutes is None:
            return self._step / self._config.steps
        return self._elapsed_s / (60 * self._config.minutes / len(self._config.attentions))

    def begin_with(self, checkpoint: Checkpoint) -> None:
        """Takes this member's weights from a checkpoint of the same networks."""
        wanted = [self._config.network(i) for i in range(len(self._config.attentions))]
        if [network.config for network in checkpoint.networks] != wanted:
            raise CheckpointError("the checkpoint to begin with holds other networks than this recipe trains")
        self.network.load_state_dict(checkpoint.networks[self._member].state_dict())

    def train(self, data: _Data, progress: Progress) -> None:
        """Steps until the budget is spent, then leaves the network in evaluation mode."""
        task = progress.add_task(self._label, total=1.0, loss="")
        forward = torch.compile(self.network) if self._config.compile else self.network
        self.network.train()
        began = time.monotonic() - self._elapsed_s
        saved = time.monotonic()
        smooth = float("nan")
        while self._done < 1:
            loss = self._update(forward, data)
            if self._step % 10 == 0:
                rmse_n = math.sqrt(loss.item()) * self.network.config.label_scale_n
                if not math.isfinite(rmse_n):
                    raise NonFiniteError(
                        f"the training of {self._label} diverged by step {self._step}; lower learning_rate"
                    )
                smooth = rmse_n if math.isnan(smooth) else 0.9 * smooth + 0.1 * rmse_n
                progress.update(task, completed=min(1.0, self._done), loss=f"RMSE {smooth:.3f} N")
            self._step += 1
            self._elapsed_s = time.monotonic() - began
            if time.monotonic() - saved > STATE_EVERY_S:
                self._save()
                saved = time.monotonic()
        progress.update(task, completed=1.0)
        self._save()
        self.network.eval()

    def _update(self, forward: Callable[[Tensor, int], Tensor], data: _Data) -> Tensor:
        for group in self._optimizer.param_groups:
            group["lr"] = self._config.learning_rate * one_cycle(self._done, self._config.warmup)
        inputs, forces_n, valid = data.batch(self._step, short=self._done < self._config.short_share)
        first = min(self.network.config.window, inputs.shape[1]) - 1
        with torch.autocast(self._device, torch.bfloat16):
            predicted_n = forward(inputs, first)
        error = (predicted_n - forces_n[:, first:]) / self.network.config.label_scale_n
        loss: Tensor = (error.square() * valid[:, first:]).sum() / valid[:, first:].sum().clamp_min(1)
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimizer.step()
        return loss.detach()

    def _save(self) -> None:
        tensors = {f"network.{name}": t.contiguous() for name, t in self.network.state_dict().items()}
        for i, moments in self._optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{i}.{name}": t.contiguous() for name, t in moments.items()}
        progress = {"step": str(self._step), "elapsed_s": str(self._elapsed_s), "identity": self._identity}
        partial = self._state.with_suffix(".partial")
        try:
            self._state.parent.mkdir(parents=True, exist_ok=True)
            save_file(tensors, partial, metadata=progress)
            partial.replace(self._state)
        except (OSError, SafetensorError) as error:
            raise CheckpointError(f"can't write the training state {self._state}: {error}") from error

    def restore(self) -> None:
        """Goes on from the saved state; a member that has none yet starts from the beginning."""
        if not self._state.exists():
            return
        try:
            with safe_open(self._state, framework="pt", device=self._device) as file:
                progress = file.metadata()
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        except (OSError, SafetensorError) as error:
            raise CheckpointError(f"can't read the training state {self._state}: {error}") from error
        if progress["identity"] != self._identity:
            raise CheckpointError(
                f"the training state {self._state} is of another recipe or other data; train without resuming"
            )
        weights: dict[str, Tensor] = {}
        moments: dict[int, dict[str, Tensor]] = {}
        for key, tensor in tensors.items():
            part, name = key.split(".", 1)
            if part == "network":
                weights[name] = tensor
            else:
                number, name = name.split(".")
                moments.setdefault(int(number), {})[name] = tensor
        self.network.load_state_dict(weights)
        for i, parameter in enumerate(self.network.parameters()):
            for name in ("exp_avg", "exp_avg_sq"):  # the fused optimiser wants the parameter's memory format
                moments[i][name] = torch.empty_like(parameter).copy_(moments[i][name])
        self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": moments})
        self._step, self._elapsed_s = int(progress["step"]), float(progress["elapsed_s"])


def one_cycle(done: float, warmup: float) -> float:
    """The learning rate's share of its peak: up and down along two half cosines."""
    if done < warmup:
        return 0.04 + 0.96 * (1 - math.cos(math.pi * done / warmup)) / 2
    return (1 + math.cos(math.pi * min(1.0, (done - warmup) / (1 - warmup)))) / 2


def _estimates(
    clips: Sequence[Clip], networks: Sequence[ForceNetwork], preprocess: Preprocess, device: str
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """The ensemble's and the measured forces in N over all valid frames of the clips."""
    forces_n = [predict(networks, preprocess, clip.frames, device).mean(0)[clip.valid] for clip in clips]
    return np.concatenate(forces_n), np.concatenate([clip.forces_n[clip.valid] for clip in clips])


def _residuals(forces_n: npt.NDArray[np.float32], measured_n: npt.NDArray[np.float32]) -> list[Residual]:
    """Root mean squared error by estimated force, which is what a run knows, in bins of 1 N."""
    squared = np.square(forces_n - measured_n)
    newtons = np.floor(forces_n)
    residuals = []
    for newton in np.unique(newtons):
        part = squared[newtons == newton]
        variance = (part.sum() + RESIDUAL_PRIOR * squared.mean()) / (len(part) + RESIDUAL_PRIOR)
        residuals.append(Residual(force_n=float(newton) + 0.5, std_n=math.sqrt(variance)))
    return residuals
