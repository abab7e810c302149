"""Inference on whole recordings in batches, on any device. Equals streaming frame by frame."""

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gripper_force.types import Gray
from gripper_force.vision.checkpoint import Checkpoint, Member, load_checkpoint
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import DIFFERENCE_GAIN, FLAT_STD, Preprocess

BATCH = {"cpu": 32, "cuda": 256}
"""Frames that pass the backbone together. On a CPU, the maps of a few frames stay in its cache, and the process
keeps their memory: where larger maps go back to the system each time, a batch takes a third longer."""

CHUNK = 256
"""Frames whose windows are read together; limits memory."""


@lru_cache(maxsize=2)
def kept_checkpoint(source: str | Path, digest: str) -> Checkpoint:
    """Loads a checkpoint once for all logs that a process computes; ``digest`` tells a changed file."""
    return load_checkpoint(source)


def normalise(frames: Tensor, leading: Tensor, preprocess: Preprocess) -> Tensor:
    """Prepares the frames of recordings as `preprocess.Normaliser` does.

    Args:
        frames: Gray levels, (B, T, S, S), uint8 or float32.
        leading: First frames of each recording, which show no contact, (B, R, S, S).
        preprocess: Settings; ``R`` is ``reference_frames``.

    Returns:
        The network's input, (B, T, 1, S, S) float32.
    """
    inputs = _standardise(frames)
    if preprocess.reference:
        inputs = DIFFERENCE_GAIN * (inputs - _standardise(leading).mean(1, keepdim=True))
    if preprocess.magnitude:
        inputs = inputs.abs()
    return inputs[:, :, None]


def _standardise(frames: Tensor) -> Tensor:
    frames = frames.float()
    std, mean = torch.std_mean(frames, dim=(-2, -1), correction=0, keepdim=True)
    return (frames - mean) / std.clamp_min(FLAT_STD)


def predict(
    networks: Sequence[Member], preprocess: Preprocess, frames: Gray, device: str = "cpu"
) -> npt.NDArray[np.float32]:
    """Estimates the force for every frame of one recording.

    Args:
        networks: Members of the ensemble, in evaluation mode, on ``device``.
        preprocess: Preparation that the networks were trained with.
        frames: The recording, cropped and resized, (T, S, S) uint8.
        device: Device of the networks.

    Returns:
        Each member's forces in N, (M, T).
    """
    return features(networks, preprocess, frames, device)[0]


@torch.inference_mode()
def features(
    networks: Sequence[Member], preprocess: Preprocess, frames: Gray, device: str = "cpu"
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Estimates the force for every frame, and returns the inputs of the members' last layers too.

    Arguments are those of `predict`.

    Returns:
        Each member's forces in N, (M, T), and the members' concatenated features, (T, F).
    """
    clip = torch.from_numpy(frames)[None].to(device)  # (1, T, S, S)
    leading = clip[:, : preprocess.reference_frames]
    batches = (normalise(part, leading, preprocess) for part in _batches(clip))
    return _run(networks, batches)


@torch.inference_mode()
def prepared_features(
    networks: Sequence[Member], inputs: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Computes `features` on the CPU, for frames of a stream that are prepared already, (T, S, S)."""
    clip = torch.from_numpy(inputs)[None, :, None]  # (1, T, 1, S, S)
    return _run(networks, _batches(clip))


def _batches(clip: Tensor) -> Iterator[Tensor]:
    size = BATCH[clip.device.type]
    return (clip[:, begin : begin + size] for begin in range(0, clip.shape[1], size))


def _run(
    networks: Sequence[Member], batches: Iterable[Tensor]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Runs the networks on consecutive batches of a recording's prepared frames, (1, N, 1, S, S) each."""
    parts: list[list[Tensor]] = [[] for _ in networks]
    maps: list[Tensor | None] = [None for _ in networks]
    for batch in batches:
        for i, network in enumerate(networks):
            if isinstance(network, ForceNetwork):
                part, maps[i] = network.pooled(batch, maps[i])
            else:
                part = network.features(batch)
            parts[i].append(part[0])
    features = [_read(network, torch.cat(part)) for network, part in zip(networks, parts, strict=True)]
    forces = [network.force_n(part) for network, part in zip(networks, features, strict=True)]
    return torch.stack(forces).cpu().numpy(), torch.cat(features, dim=1).cpu().numpy()


def _read(network: Member, pooled: Tensor) -> Tensor:
    """Returns the inputs of a network's last layer, (T, head), for its output of the batches, (T, C)."""
    if not isinstance(network, ForceNetwork):
        return pooled
    begins = range(0, len(pooled), CHUNK)
    return torch.cat([network.read_pooled(pooled, begin, begin + CHUNK) for begin in begins])
