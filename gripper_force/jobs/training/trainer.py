"""Training loop of one network."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from gripper_force.errors import CheckpointError, NonFiniteError
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.training.batches import Batches, Replay
from gripper_force.jobs.training.parallel import Ranks, share_statistics
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.vision.batch_inference import predict
from gripper_force.vision.checkpoint import Member
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess


class Trainer:
    """Trains one member of an ensemble.

    Args:
        config: The recipe.
        member: Index of the member.
        batches: Training data.
        ranks: This process among those that train together.

    Attributes:
        network: The network.
        step: Number of completed steps.
    """

    def __init__(self, config: TrainConfig, member: int, batches: Batches | Replay, ranks: Ranks) -> None:
        torch.manual_seed(config.seed + member)
        self._config = config
        self._batches = batches
        self._ranks = ranks
        self._name = config.attentions[member]
        self._total_steps = config.steps
        if config.epochs is not None:
            self._total_steps = math.ceil(config.epochs * batches.labels / config.clips)
        self.network = ForceNetwork(config.network(member)).to(ranks.device)
        if ranks.count > 1:
            share_statistics(self.network)
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )
        self._forward = torch.compile(self.network) if config.compile else self.network
        self._freeze_statistics = False
        self.step = 0
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
            if self._freeze_statistics and isinstance(module, nn.BatchNorm2d):
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
            self.step += 1
            self._elapsed_s = self._ranks.as_first(time.monotonic() - began)
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
        inputs, forces_n, valid = self._batches.batch(self.step, count, length)
        labels = valid[:, first:].sum()
        self._ranks.add_up([labels])
        with torch.autocast(inputs.device.type, torch.bfloat16, enabled=config.precision == "bfloat16"):
            error = squared_error(self._forward, inputs, forces_n, valid, first)
        loss = error / self.network.config.label_scale_n**2 / labels.clamp_min(1)
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        total = loss.detach()
        self._ranks.add_up([*gradients, total])
        if config.gradient_limit is not None:
            nn.utils.clip_grad_norm_(self.network.parameters(), config.gradient_limit)
        self._optimizer.step()
        return total

    def start_from(self, member: Member) -> None:
        """Copies the weights of a network of the same shape, and keeps its batch normalisation's statistics."""
        self.network.load_state_dict(member.state_dict())
        self._freeze_statistics = True

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
        progress = {
            "step": str(self.step),
            "elapsed_s": str(self._elapsed_s),
            "smooth_n": str(self._smoothed_rmse_n),
            "identity": identity,
        }
        partial = path.with_suffix(".partial")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            save_file(tensors, partial, metadata=progress)
            partial.replace(path)
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
            with safe_open(path, framework="pt", device=self._ranks.device) as file:
                progress = file.metadata()
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        except (OSError, SafetensorError) as error:
            raise CheckpointError(
                f"can't read the training state {path}: {error}; delete it or train without --resume"
            ) from error
        if progress["identity"] != identity:
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


def squared_error(
    network: Callable[[Tensor, int], Tensor], inputs: Tensor, forces_n: Tensor, valid: Tensor, first: int
) -> Tensor:
    """Returns the sum of squared errors in N² over the frames with a label from ``first`` on."""
    error_n = network(inputs, first) - forces_n[:, first:]
    return (error_n.square() * valid[:, first:]).sum()


def one_cycle(done: float, warmup: float) -> float:
    """Returns the learning rate as a share of its peak: up and down along two half cosines."""
    if done < warmup:
        return 0.04 + 0.96 * (1 - math.cos(math.pi * done / warmup)) / 2
    return (1 + math.cos(math.pi * min(1.0, (done - warmup) / (1 - warmup)))) / 2


def step_decay(done: float) -> float:
    """Returns the learning rate as a share of its peak: a tenth per quarter (30 of the paper's 120 epochs)."""
    return float(0.1 ** math.floor(4 * done))


def estimates(
    clips: Sequence[Clip], networks: Sequence[ForceNetwork], preprocess: Preprocess, device: str
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Returns the ensemble's and the measured forces in N, (N,) each, over all frames with a label."""
    forces_n = [predict(networks, preprocess, clip.frames, device).mean(0)[clip.valid] for clip in clips]
    return np.concatenate(forces_n), np.concatenate([clip.forces_n[clip.valid] for clip in clips])
