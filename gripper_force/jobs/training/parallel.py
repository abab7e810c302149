"""Training of one network in several processes, on one machine or more, started by `torchrun`.

Each process takes its share of a step's clips. Gradients are summed, and batch normalisation uses the
statistics of all clips, so that a step equals that of one process, except for rounding.
"""

import itertools
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.rendezvous import rendezvous

from gripper_force.errors import ConfigError


@dataclass(frozen=True, slots=True)
class TrainingProcess:
    """This process among those that train together.

    Attributes:
        device: Device that it computes on.
        rank: Its number. The first process, 0, writes files and shows progress.
        world_size: Number of processes.
    """

    device: str
    rank: int = 0
    world_size: int = 1

    @property
    def first(self) -> bool:
        """True for the process that writes files and shows progress."""
        return self.rank == 0

    @property
    def own_clips(self) -> slice:
        """Slice of a step's clips that this process takes."""
        return slice(self.rank, None, self.world_size)

    def sum_over_all(self, tensors: Iterable[Tensor]) -> None:
        """Replaces tensors, all of one type, by their sums over all processes."""
        if self.world_size == 1:
            return
        tensors = list(tensors)
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        dist.all_reduce(flat)
        for tensor, total in zip(tensors, torch.split(flat, [t.numel() for t in tensors]), strict=True):
            tensor.copy_(total.view_as(tensor))

    def broadcast_from_first(self, value: float) -> float:
        """Returns the first process's value, for quantities that every process measures itself."""
        if self.world_size == 1:
            return value
        shared = torch.tensor([value], dtype=torch.float64, device=self.device)
        dist.broadcast(shared, 0)
        return shared.item()

    def wait(self) -> None:
        """Waits for all processes."""
        if self.world_size > 1:
            dist.barrier()

    def check_equal(self, text: str, what: str) -> None:
        """Raises `ConfigError` unless all processes pass the same text."""
        if self.world_size == 1:
            return
        texts: list[Any] = [None] * self.world_size
        dist.all_gather_object(texts, text)
        if len(set(texts)) > 1:
            raise ConfigError(
                f"the training processes have different {what}; start all with the same files and keys"
            )


@contextmanager
def join_training_processes(device: str) -> Iterator[TrainingProcess]:
    """Joins the processes that `torchrun` has started, if any, and leaves them at the end.

    Args:
        device: ``cpu``, ``cuda``, or ``auto`` for CUDA if it is available. With CUDA each process of a
            machine uses another GPU.

    Raises:
        ConfigError: The other processes can't be joined, or there are fewer GPUs than processes.
    """
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield TrainingProcess(device)
        return
    if device == "cuda":
        local, gpus = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if local >= gpus:
            raise ConfigError(
                f"{gpus} GPUs are too few for this machine's training processes; start that many with "
                "`torchrun --nproc-per-node`, or use --set device=cpu"
            )
        device = f"cuda:{local}"
        torch.cuda.set_device(local)
    try:
        store, rank = _rendezvous()
        # A new name for each training: keys of an earlier one would let a process continue alone.
        named = dist.PrefixStore(f"{next(_GROUP_NUMBERS)}", store)  # type: ignore[attr-defined]
        backend = "gloo" if device == "cpu" else "nccl"
        dist.init_process_group(backend, store=named, rank=rank, world_size=count)
    except (RuntimeError, ValueError) as error:
        raise ConfigError(
            f"can't join the other training processes: {error}; start all of them with torchrun"
        ) from error
    try:
        yield TrainingProcess(device, rank, count)
    finally:
        dist.destroy_process_group()


_GROUP_NUMBERS: Final = itertools.count()


@cache
def _rendezvous() -> tuple[Any, int]:
    """Returns the store shared by all processes, and this process's rank, from `torchrun`'s environment."""
    store, rank, _ = next(iter(rendezvous("env://")))
    return store, rank


class _AllReduceSum(torch.autograd.Function):
    @staticmethod
    def forward(_: Any, part: Tensor) -> Tensor:
        total = part.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(_: Any, gradient: Tensor) -> Tensor:
        total = gradient.clone()
        dist.all_reduce(total)
        return total


def _total(part: Tensor) -> Tensor:
    """Returns the sum over all processes, with its gradient."""
    total: Tensor = _AllReduceSum.apply(part)  # type: ignore[no-untyped-call]
    return total


class _SyncBatchNorm(nn.BatchNorm2d):
    """Batch normalisation with the statistics of all processes; PyTorch's does not support CPUs."""

    def forward(self, maps: Tensor) -> Tensor:
        if not self.training:
            return super().forward(maps)
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        x = maps.float()  # (B, C, H, W)
        size = _total(x.new_tensor(x[:, 0].numel()))
        mean = _total(x.sum((0, 2, 3))) / size  # (C,)
        centred = x - mean[:, None, None]
        variance = _total(centred.square().sum((0, 2, 3))) / size
        with torch.no_grad():
            self.num_batches_tracked.add_(1)
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * size / (size - 1), self.momentum)
        scale = self.weight * (variance + self.eps).rsqrt()
        return (centred * scale[:, None, None] + self.bias[:, None, None]).to(maps.dtype)


def share_statistics(network: nn.Module) -> None:
    """Makes a network's batch normalisation use the statistics of all processes in training."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.__class__ = _SyncBatchNorm
