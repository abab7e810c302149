"""Writer of checkpoints: one safetensors file with the header in its metadata."""

from collections.abc import Sequence
from pathlib import Path

from safetensors.torch import load, save
from torch import Tensor

from gripper_force.errors import CheckpointError
from gripper_force.files import make_folder_of, unfinished
from gripper_force.vision.checkpoint import Member
from gripper_force.vision.header import FORMAT, Header, digest_of, read_checkpoint


def save_checkpoint(path: Path, networks: Sequence[Member], header: Header) -> None:
    """Writes an ensemble: matrices as float16 where its range allows, vectors as float32.

    Half precision halves the file and changes the force by less than 1e-3 of its value.

    Raises:
        CheckpointError: The file can't be written.
        DataError: Another process or thread writes it.
    """
    tensors = {
        f"{i}.{name}": _stored(tensor)
        for i, network in enumerate(networks)
        for name, tensor in network.state_dict().items()
    }
    _write(path, tensors, header)


def check_writable(path: Path) -> None:
    """Creates the folder of a checkpoint, before hours of work for it.

    Raises:
        CheckpointError: The file can't be written, or has another ending than ``.safetensors``.
    """
    if path.is_dir():
        raise CheckpointError(f"can't write the checkpoint {path}: it is a folder; name a file")
    if path.suffix != ".safetensors":  # such as that of an exported network, or of the figure drawn beside it
        raise CheckpointError(f"can't write a checkpoint to {path}; name a file that ends in .safetensors")
    try:
        make_folder_of(path)
    except OSError as error:
        raise CheckpointError(
            f"can't write the checkpoint {path}: {error.strerror}; name another file"
        ) from error


def replace_header(source: str | Path, header: Header, out: Path | None = None) -> None:
    """Writes a checkpoint with another header. It keeps its weights, bit for bit, and its digest.

    Args:
        source: Path or name of the checkpoint.
        header: The header to write. Its ``identity`` is ignored.
        out: Checkpoint to write; None for the same file.

    Raises:
        CheckpointError: A file can't be read or written.
        DataError: Another process or thread writes the checkpoint.
    """
    path, data, old_header = read_checkpoint(source)
    identity = digest_of(data, old_header)
    _write(out or path, load(data), header.model_copy(update={"identity": identity}))


def _write(path: Path, tensors: dict[str, Tensor], header: Header) -> None:
    data = save(tensors, metadata={FORMAT: header.model_dump_json(exclude_none=True)})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished(path) as part:
            part.write_bytes(data)  # a full disk must not damage the file that it replaces
    except OSError as error:
        raise CheckpointError(
            f"can't write the checkpoint {path}: {error.strerror}; name another file"
        ) from error


def _stored(tensor: Tensor) -> Tensor:
    full = tensor.detach().cpu().contiguous()
    # Vectors take little space, and running variances can lie below the smallest float16.
    if full.dim() < 2:
        return full
    half = full.half()
    # float16 has eleven bits between 6e-5 and 65504, and loses them outside.
    fits = (half - full).abs().max() <= full.abs().max() * 2**-11
    return half if fits else full
