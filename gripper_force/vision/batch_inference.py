"""Inference on whole recordings in batches, on any device. Equals streaming frame by frame."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gripper_force.types import Gray
from gripper_force.vision.checkpoint import Member
from gripper_force.vision.preprocess import DIFFERENCE_GAIN, FLAT_STD, Preprocess

CHUNK = 256
"""Frames that pass the backbone together; limits memory."""


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
    context = max(network.config.context for network in networks)
    forces, all_features = [], []
    for begin in range(0, clip.shape[1], CHUNK):
        first = max(0, begin - context)
        inputs = normalise(clip[:, first : begin + CHUNK], leading, preprocess)
        part = [network.features(inputs, begin - first)[0] for network in networks]  # (chunk, head) each
        forces.append(torch.stack([n.force_n(f) for n, f in zip(networks, part, strict=True)]))
        all_features.append(torch.cat(part, dim=1))
    return torch.cat(forces, dim=1).cpu().numpy(), torch.cat(all_features).cpu().numpy()
