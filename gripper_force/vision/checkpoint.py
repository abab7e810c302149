"""One safetensors file holds a whole ensemble: weights, and in its header all that is needed to use them."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch
from pydantic import ValidationError, model_validator
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from gripper_force.errors import CheckpointError
from gripper_force.schema import Finite, NonNegative, Section
from gripper_force.vision.network import ForceNetwork, NetworkConfig
from gripper_force.vision.preprocess import Preprocess

FORMAT: Final = "gripper-force-network/1"
"""Key of the header in the file's metadata: the only one, as safetensors keeps no order of keys."""

DEFAULT_PATH: Final = Path(__file__).with_name("default.safetensors")


class Residual(Section):
    """How far off the ensemble was on validation data where it said about ``force_n``."""

    force_n: Finite
    std_n: NonNegative


class Header(Section):
    """What a checkpoint says about itself.

    Attributes:
        members: Shapes of the networks whose mean is the estimate.
        preprocess: How frames are prepared for them.
        residuals: Error by estimated force, measured on validation data, by rising force.
        data_digest: SHA-256 of the training set.
        metrics: Figures on the validation data, such as ``mae_n``.
    """

    members: tuple[NetworkConfig, ...]
    preprocess: Preprocess
    residuals: tuple[Residual, ...]
    data_digest: str
    metrics: dict[str, float]

    @model_validator(mode="after")
    def _fits(self) -> "Header":
        if not self.members or not self.residuals:
            raise ValueError("an ensemble has at least one member and one residual")
        if any(member.size != self.preprocess.size for member in self.members):
            raise ValueError("preprocess.size and the networks' size must agree")
        return self


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
    """Writes an ensemble, matrices as float16 and vectors as float32.

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
        source: A path, or ``default`` for the checkpoint that is shipped.

    Raises:
        CheckpointError: The file is missing, damaged, or of another network.
    """
    path = DEFAULT_PATH if source == "default" else Path(source)
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}; train one with `gripper-force train`")
    try:
        data = path.read_bytes()
        tensors = load(data)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} is damaged or no safetensors file: {error}") from error
    metadata = _metadata(data)
    if FORMAT not in metadata:
        raise CheckpointError(f"{path} is not a {FORMAT} file; train one with `gripper-force train`")
    try:
        header = Header.model_validate_json(metadata[FORMAT])
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise CheckpointError(f"the header of {path} is wrong at {key!r}: {first['msg']}") from error
    networks = tuple(_member(path, i, config, tensors) for i, config in enumerate(header.members))
    return Checkpoint(networks, header, hashlib.sha256(data).hexdigest())


def _metadata(data: bytes) -> dict[str, str]:
    """What a sound safetensors file says about itself: a length in 8 bytes, then JSON.

    Its own `safe_open` tells as well, but leaks 7 kB each time (in 0.8), which a day of grasps would feel.
    """
    length = int.from_bytes(data[:8], "little")
    metadata: dict[str, str] = json.loads(data[8 : 8 + length]).get("__metadata__", {})
    return metadata


def _stored(tensor: Tensor) -> Tensor:
    # Biases and running variances are few, and the latter can lie below the smallest float16.
    dtype = torch.float16 if tensor.dim() > 1 else tensor.dtype
    return tensor.detach().to("cpu", dtype).contiguous()


def _member(path: Path, index: int, config: NetworkConfig, tensors: dict[str, Tensor]) -> ForceNetwork:
    prefix = f"{index}."
    with torch.device("meta"):  # a header may claim any size: only what the weights confirm takes memory
        network = ForceNetwork(config)
    dtypes = {name: tensor.dtype for name, tensor in network.state_dict().items()}
    own = {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
    # A copy, as what was read lies in the bytes of the file, which can't be written to.
    state = {name: t.to(dtypes.get(name, t.dtype), copy=True) for name, t in own.items()}
    try:
        network.load_state_dict(state, assign=True)
    except RuntimeError as error:
        raise CheckpointError(f"{path}: the weights of member {index} don't fit its header") from error
    if not all(bool(tensor.isfinite().all()) for tensor in state.values()):
        raise CheckpointError(f"{path}: the weights of member {index} hold NaN or infinity")
    return network.in_fast_layout().eval().requires_grad_(False)
