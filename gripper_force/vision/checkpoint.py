"""One safetensors file holds a whole ensemble: weights, and in its header all that is needed to use them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from gripper_force.errors import CheckpointError
from gripper_force.vision.header import FORMAT, Header, NetworkConfig, digest_of, read_checkpoint
from gripper_force.vision.network import ForceNetwork

_RENAMED = {"blstm.onward.": "blstm.forward_lstm.", "blstm.backward_gates.": "blstm.backward_linear."}
"""Weights by their names in checkpoints of version 0.1, and by their names now."""


@dataclass(frozen=True)
class Checkpoint:
    """A loaded ensemble.

    Attributes:
        networks: The members, in evaluation mode, on the CPU, in float32.
        header: What the file says about them.
        digest: SHA-256 of the file.
    """

    networks: tuple[ForceNetwork, ...]
    header: Header
    digest: str


def save_checkpoint(path: Path, networks: Sequence[ForceNetwork], header: Header) -> None:
    """Writes an ensemble, matrices as float16 where that can hold them, and vectors as float32.

    Half precision halves the file and costs less than 1e-3 of the force.

    Raises:
        CheckpointError: The file can't be written.
    """
    tensors = {
        f"{i}.{name}": _stored(tensor)
        for i, network in enumerate(networks)
        for name, tensor in network.state_dict().items()
    }
    data = save(tensors, metadata={FORMAT: header.model_dump_json()})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise CheckpointError(f"can't write the checkpoint {path}: {error.strerror}") from error


def load_checkpoint(source: str | Path = "default") -> Checkpoint:
    """Reads an ensemble.

    Args:
        source: A path, or ``default`` or ``small`` for one that is shipped.

    Raises:
        CheckpointError: The file is missing, damaged, or of another network.
    """
    path, data, header = read_checkpoint(source)
    try:
        tensors = load(data)
    except SafetensorError as error:
        raise CheckpointError(f"{path} is damaged or no safetensors file: {error}") from error
    networks = tuple(_member(path, i, config, tensors) for i, config in enumerate(header.members))
    return Checkpoint(networks, header, digest_of(data))


def _current_name(name: str) -> str:
    for old, new in _RENAMED.items():
        name = name.replace(old, new)
    return name


def _stored(tensor: Tensor) -> Tensor:
    kept = tensor.detach().cpu().contiguous()
    # Biases and running variances are few, and the latter can lie below the smallest float16.
    if kept.dim() < 2:
        return kept
    half = kept.half()
    # Beyond 65504 and below 6e-5 it has no digits left; what it holds has eleven bits.
    fits = (half - kept).abs().max() <= kept.abs().max() * 2**-11
    return half if fits else kept


def _member(path: Path, index: int, config: NetworkConfig, tensors: dict[str, Tensor]) -> ForceNetwork:
    prefix = f"{index}."
    with torch.device("meta"):  # a header may claim any size: only what the weights confirm takes memory
        network = ForceNetwork(config)
    dtypes = {name: tensor.dtype for name, tensor in network.state_dict().items()}
    own = {
        _current_name(name.removeprefix(prefix)): t for name, t in tensors.items() if name.startswith(prefix)
    }
    # A copy, as what was read lies in the bytes of the file, which can't be written to.
    state = {name: t.to(dtypes.get(name, t.dtype), copy=True) for name, t in own.items()}
    try:
        network.load_state_dict(state, assign=True)
    except RuntimeError as error:
        raise CheckpointError(f"{path}: the weights of member {index} don't fit its header") from error
    if not all(bool(tensor.isfinite().all()) for tensor in state.values()):
        raise CheckpointError(f"{path}: the weights of member {index} hold NaN or infinity")
    return network.in_fast_layout().eval().requires_grad_(False)
