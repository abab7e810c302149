"""Training loop of one network."""

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from gripper_force.errors import CheckpointError, NonFiniteError
from gripper_force.files import unfinished
from gripper_force.jobs.cpu import bfloat16_instructions
from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.jobs.training.batches import Batch, Batches, Replay
from gripper_force.jobs.training.parallel import TrainingProcess, share_statistics
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.vision.checkpoint import Member
from gripper_force.vision.header import INDENTATION_SCALE_M
from gripper_force.vision.network import ForceNetwork


class Trainer:
    """Trains one member of an ensemble.

    Args:
        config: The recipe.
        member: Index of the member.
        batches: Training data.
        process: This process among those that train together.
        teacher: Ensemble whose mean estimate is learned beside the labels, in evaluation mode; none if empty.

    Attributes:
        network: The network.
        step: Number of completed steps.
        losses: Steps and smoothed root mean squared errors in N, in turn: one pair for every tenth step.
    """

    def __init__(
        self,
        config: TrainConfig,
        member: int,
        batches: Batches | Replay,
        process: TrainingProcess,
        teacher: Sequence[Member] = (),
    ) -> None:
        torch.manual_seed(config.seed + member)
        self._config = config
        self._batches = batches
        self._process = process
        self._name = config.attentions[member]
        self._total_steps = config.steps
        if config.epochs is not None:
            replayed = config.replayed if isinstance(batches, Replay) else 0
            self._total_steps = math.ceil(config.epochs * batches.labels / (config.clips - replayed))
        self.network = ForceNetwork(config.network(member)).to(process.device)
        if process.world_size > 1:
            share_statistics(self.network)
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )
        self._features = torch.compile(self.network.features) if config.compile else self.network.features
        self._teacher = [network.to(process.device) for network in teacher]
        self._uses_bfloat16 = config.precision == "bfloat16" or (
            config.precision == "auto" and _computes_bfloat16(process.device)
        )
        self._freeze_statistics = False
        self.step = 0
        self.losses: list[float] = []
        self._elapsed_s = 0.0
        self._smoothed_rmse_n = math.nan

    @property
    def done(self) -> float:
        """Completed share of the training, from 0; 1 and more at the end."""
        if self._config.minutes is None:
            return self.step / self._total_steps
        return self._elapsed_s / (60 * self._config.minutes / len(self._config.attentions))

    def steps(self, until: float = 1.0) -> Iterator[float]:
        """Trains until this share of the schedule is done, then switches to evaluation mode.

        Args:
            until: Share of the schedule.

        Yields:
            Root mean squared error in N, smoothed over the last steps, after each step.

        Raises:
            NonFiniteError: The training diverged.
        """
        self.network.train()
        for module in self.network.modules():
            if self._freeze_statistics and isinstance(module, _BatchNorm):
                module.eval()
        began = time.monotonic() - self._elapsed_s
        while self.done < until:
            loss = self._update()
            if self.step % 10 == 0:  # not more often: it waits for the GPU
                rmse_n = math.sqrt(loss.item()) * self.network.config.label_scale_n
                if not math.isfinite(rmse_n):
                    raise NonFiniteError(
                        f"the training of {self._name} diverged by step {self.step}; reduce learning_rate"
                    )
                self._smoothed_rmse_n = (
                    rmse_n if self.step == 0 else 0.9 * self._smoothed_rmse_n + 0.1 * rmse_n
                )
                self.losses += [float(self.step), self._smoothed_rmse_n]
            self.step += 1
            self._elapsed_s = self._process.broadcast_from_first(time.monotonic() - began)
            yield self._smoothed_rmse_n
        self.network.eval()

    def _update(self) -> Tensor:
        config, window, done = self._config, self.network.config.window, self.done
        rate = one_cycle(done, config.warmup) if config.schedule == "one_cycle" else step_decay(done)
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * rate
        count, length = config.clips, config.clip_frames
        if config.windows == "separate":
            length = self.network.config.context + 1
        elif done < config.short_share:
            count, length = count * length // config.short_frames, config.short_frames
        first = length - 1 if config.windows == "separate" else min(window, length) - 1
        batch = self._batches.batch(self.step, count, length)
        labels = batch.valid[:, first:].sum()
        self._process.sum_over_all([labels])
        with torch.autocast(batch.inputs.device.type, torch.bfloat16, enabled=self._uses_bfloat16):
            features = self._features(batch.inputs, first)  # (B, T - first, head)
            learned_n = self._taught(batch, first) if self._teacher else batch.forces_n  # (B, T)
        force, *others = self.network.outputs(features.flatten(0, 1)).view(*features.shape[:2], -1).unbind(2)
        scale_n = self.network.config.label_scale_n
        error = squared_error(force * scale_n, learned_n[:, first:], batch.valid[:, first:])
        force_loss = error / scale_n**2 / labels.clamp_min(1)
        loss = force_loss + self._other_losses(others, batch, first) / labels.clamp_min(1)
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        total = force_loss.detach()
        self._process.sum_over_all([*gradients, total])
        if config.gradient_limit is not None:
            nn.utils.clip_grad_norm_(self.network.parameters(), config.gradient_limit)
        self._optimizer.step()
        return total

    @torch.no_grad()
    def _taught(self, batch: Batch, first: int) -> Tensor:
        """Returns the forces to learn, (B, T): labels mixed with the teacher's estimates from ``first`` on."""
        taught_n = torch.stack([network(batch.inputs, first) for network in self._teacher]).mean(0)
        forces_n = batch.forces_n.clone()
        forces_n[:, first:].lerp_(taught_n.to(forces_n.dtype), self._config.teacher_share)
        return forces_n

    def _other_losses(self, outputs: Sequence[Tensor], batch: Batch, first: int) -> Tensor:
        """Returns the weighted sum of the losses of the outputs but force, (B, T - first) each, over all frames."""
        total = batch.forces_n.new_zeros(())
        for quantity, output in zip(self._config.outputs[1:], outputs, strict=True):
            if quantity == "indentation":
                target = batch.indentation_m[:, first:] / INDENTATION_SCALE_M
                known = target.isfinite()  # also without a load-cell sample
                total = total + self._config.indentation_weight * squared_error(
                    output, target.nan_to_num(), known
                )
            else:
                touching = (batch.forces_n[:, first:] > CONTACT_N).to(output.dtype)
                entropy = F.binary_cross_entropy_with_logits(output, touching, reduction="none")
                total = total + self._config.contact_weight * (entropy * batch.valid[:, first:]).sum()
        return total

    def start_from(self, network: ForceNetwork) -> None:
        """Copies the weights of another network of the same shape. Outputs that it lacks start at 0.

        Random ones would change the features that the force depends on, before they have learned anything. The
        statistics of its batch normalisation are kept, unless ``freeze_statistics`` is false.
        """
        self._freeze_statistics = self._config.freeze_statistics is not False
        weights = network.state_dict()
        outputs = network.config.outputs
        for name in ("out.weight", "out.bias"):
            rows = torch.zeros_like(self.network.state_dict()[name])
            for i, quantity in enumerate(self._config.outputs):
                if quantity in outputs:
                    rows[i] = weights[name][outputs.index(quantity)]
            weights[name] = rows
        self.network.load_state_dict(weights)

    def save(self, path: Path, identity: str) -> None:
        """Saves the state of the training.

        Args:
            path: File to write.
            identity: Text that identifies the training; `restore` compares it.

        Raises:
            CheckpointError: The file can't be written.
        """
        tensors = {f"network.{name}": t.contiguous() for name, t in self.network.state_dict().items()}
        for i, moments in self._optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{i}.{name}": t.contiguous() for name, t in moments.items()}
        tensors["batches.unseen"] = torch.from_numpy(self._batches.unseen)
        tensors["losses.values"] = torch.tensor(self.losses, dtype=torch.float64)
        progress = {
            "step": str(self.step),
            "elapsed_s": str(self._elapsed_s),
            "smooth_n": str(self._smoothed_rmse_n),
            "identity": identity,
        }
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with unfinished(path) as part:
                save_file(tensors, part, metadata=progress)
        except (OSError, SafetensorError) as error:
            raise CheckpointError(
                f"can't write the training state {path}: {error}; check the folder and free space"
            ) from error

    def restore(self, path: Path, identity: str) -> None:
        """Restores a saved state. Without one, the training starts from the beginning.

        Args:
            path: File that `save` wrote, or that does not exist.
            identity: Text that identifies the training.

        Raises:
            CheckpointError: The state can't be read, or belongs to another training.
        """
        if not path.exists():
            return
        try:
            with safe_open(path, framework="pt", device=self._process.device) as file:
                progress = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        except (OSError, SafetensorError) as error:
            raise CheckpointError(
                f"can't read the training state {path}: {error}; delete it or train without --resume"
            ) from error
        if progress.get("identity") != identity:
            raise CheckpointError(
                f"the training state {path} belongs to another recipe or other data; train without --resume"
            )
        weights: dict[str, Tensor] = {}
        moments: dict[int, dict[str, Tensor]] = {}
        for key, tensor in tensors.items():
            part, name = key.split(".", 1)
            if part == "network":
                weights[name] = tensor
            elif part == "batches":
                self._batches.unseen &= tensor.cpu().numpy()
            elif part == "losses":
                self.losses = tensor.tolist()
            else:
                number, name = name.split(".")
                moments.setdefault(int(number), {})[name] = tensor
        self.network.load_state_dict(weights)
        for i, parameter in enumerate(self.network.parameters()):
            for name in ("exp_avg", "exp_avg_sq"):  # the fused optimiser needs the parameter's memory format
                moments[i][name] = torch.empty_like(parameter).copy_(moments[i][name])
        self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": moments})
        self.step, self._elapsed_s = int(progress["step"]), float(progress["elapsed_s"])
        self._smoothed_rmse_n = float(progress["smooth_n"])


def squared_error(estimates: Tensor, targets: Tensor, valid: Tensor) -> Tensor:
    """Returns the sum of squared errors over the frames that ``valid`` marks; all (B, T)."""
    return ((estimates - targets).square() * valid).sum()


def one_cycle(done: float, warmup: float) -> float:
    """Returns the learning rate as a share of its peak: up and down along two half cosines."""
    if done < warmup:
        return 0.04 + 0.96 * (1 - math.cos(math.pi * done / warmup)) / 2
    return (1 + math.cos(math.pi * min(1.0, (done - warmup) / (1 - warmup)))) / 2


def step_decay(done: float) -> float:
    """Returns the learning rate as a share of its peak: a tenth per quarter (30 of the paper's 120 epochs)."""
    return float(0.1 ** math.floor(4 * done))


def _computes_bfloat16(device: str) -> bool:
    """Returns True if a device has instructions for bfloat16. Others emulate it, slower than they compute float32."""
    if device == "cpu":
        return bfloat16_instructions() != ""
    return bool(torch.cuda.is_bf16_supported(including_emulation=False))
