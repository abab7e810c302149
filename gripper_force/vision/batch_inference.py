"""Inference on whole recordings in batches, on any device. Equals streaming frame by frame."""

from collections.abc import Callable, Iterator, Sequence
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

CHUNK = 256
"""Frames of which the windows are read together; limits memory."""

BACKBONE_CHUNK = {"cpu": 32, "cuda": 256}
"""Frames that pass the backbone together. On a CPU, the maps of a few frames stay in its cache."""


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
    return _run(networks, len(frames), lambda begin, end: normalise(clip[:, begin:end], leading, preprocess))


@torch.inference_mode()
def prepared_features(
    networks: Sequence[Member], inputs: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Does the same as `features` for the prepared frames of a stream, (T, S, S), on the CPU."""
    clip = torch.from_numpy(inputs)[None, :, None]  # (1, T, 1, S, S)
    return _run(networks, len(inputs), lambda begin, end: clip[:, begin:end])


def _run(
    networks: Sequence[Member], length: int, inputs: Callable[[int, int], Tensor]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Runs the networks on the prepared frames that ``inputs(begin, end)`` returns, (1, end - begin, 1, S, S)."""
    forces, all_features = [], []
    for network in networks:
        found = torch.cat(list(_features(network, length, inputs)))  # (T, head)
        forces.append(network.force_n(found))
        all_features.append(found)
    return torch.stack(forces).cpu().numpy(), torch.cat(all_features, dim=1).cpu().numpy()


def _features(network: Member, length: int, inputs: Callable[[int, int], Tensor]) -> Iterator[Tensor]:
    context = network.config.context
    if not isinstance(network, ForceNetwork):
        for begin in range(0, length, CHUNK):
            first = max(0, begin - context)
            yield network.features(inputs(first, begin + CHUNK), begin - first)[0]
        return
    kept = network.config.maps_kept
    parts = []
    step = BACKBONE_CHUNK[network.out.weight.device.type]
    for begin in range(0, length, step):
        first = max(0, begin - kept)
        parts.append(network.pooled(inputs(first, begin + step))[:, begin - first :])
    pooled = torch.cat(parts, dim=1)  # (1, T, C)
    for begin in range(0, length, CHUNK):
        first = max(0, begin - context)
        yield network.read_windows(pooled[:, first : begin + CHUNK], begin - first)[0]
