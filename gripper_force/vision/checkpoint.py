"""Checkpoints: one safetensors file per ensemble, with the weights and a header."""

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from gripper_force.errors import CheckpointError, ConfigError
from gripper_force.vision.gaussian_process import GaussianProcess
from gripper_force.vision.header import (
    GaussianProcessConfig,
    Header,
    NetworkConfig,
    digest_of,
    read_checkpoint,
)
from gripper_force.vision.network import ForceNetwork

Member = ForceNetwork | GaussianProcess
"""A member of an ensemble."""

_RENAMED = {"blstm.onward.": "blstm.forward_lstm.", "blstm.backward_gates.": "blstm.backward_linear."}
"""Names of weights in checkpoints of version 0.1, and their present names."""


@dataclass(frozen=True)
class Checkpoint:
    """A loaded ensemble.

    Attributes:
        networks: The members, in evaluation mode, on the CPU, in float32.
        header: The file's header.
        digest: Its digest; see `header.digest_of`.
    """

    networks: tuple[Member, ...]
    header: Header
    digest: str

    @property
    def force_networks(self) -> list[ForceNetwork]:
        """The members, for callers that need a network's layers. Raises `ConfigError` for a Gaussian process."""
        networks = [member for member in self.networks if isinstance(member, ForceNetwork)]
        if len(networks) < len(self.networks):
            raise ConfigError("the checkpoint is a Gaussian process; name a network, such as default")
        return networks


def load_checkpoint(source: str | Path = "default") -> Checkpoint:
    """Loads an ensemble.

    Args:
        source: A path, or ``default`` or ``small`` for a shipped checkpoint.

    Raises:
        CheckpointError: The file is missing, damaged, or of another network.
    """
    path, data, header = read_checkpoint(source)
    try:
        tensors = load(data)
    except SafetensorError as error:
        raise CheckpointError(
            f"{path} is damaged or not a safetensors file: {error}; copy or train it again"
        ) from error
    networks = tuple(_member(path, i, config, tensors) for i, config in enumerate(header.members))
    return Checkpoint(networks, header, digest_of(data, header))


def _current_name(name: str) -> str:
    for old, new in _RENAMED.items():
        name = name.replace(old, new)
    return name


def _member(
    path: Path, index: int, config: NetworkConfig | GaussianProcessConfig, tensors: dict[str, Tensor]
) -> Member:
    prefix = f"{index}."
    with torch.device("meta"):  # a malformed header may claim any size; this allocates nothing
        network = (
            GaussianProcess(config) if isinstance(config, GaussianProcessConfig) else ForceNetwork(config)
        )
    dtypes = {name: tensor.dtype for name, tensor in network.state_dict().items()}
    weights = {
        _current_name(name.removeprefix(prefix)): t for name, t in tensors.items() if name.startswith(prefix)
    }
    # A copy, because the tensors share the file's bytes, which are read-only.
    state = {name: t.to(dtypes.get(name, t.dtype), copy=True) for name, t in weights.items()}
    try:
        network.load_state_dict(state, assign=True)
    except RuntimeError as error:
        raise CheckpointError(
            f"{path}: the weights of member {index} do not fit its header; copy or train the checkpoint again"
        ) from error
    if not all(bool(tensor.isfinite().all()) for tensor in state.values()):
        raise CheckpointError(f"{path}: the weights of member {index} hold NaN or infinity; train it again")
    if isinstance(network, ForceNetwork):
        network.to_channels_last()
    return network.eval().requires_grad_(False)
