"""Estimates of a checkpoint on whole recordings, in batches."""

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
import torch

from gripper_force.jobs.dataset import Clip, check_size
from gripper_force.profiles.correction import Correction
from gripper_force.types import Gray
from gripper_force.vision.batch_inference import predict, stream_features
from gripper_force.vision.checkpoint import Checkpoint
from gripper_force.vision.engines import Precision
from gripper_force.vision.engines.pytorch import restored_threads


def estimate_clips(checkpoint: Checkpoint, clips: Sequence[Clip]) -> list[npt.NDArray[np.float32]]:
    """Returns each member's estimate for each frame, from which any ensemble of members can be formed.

    Args:
        checkpoint: The networks, computed on a GPU if there is one.
        clips: Recordings, downscaled to the checkpoint's size.

    Returns:
        Forces in N of each clip, (members, T).

    Raises:
        DataError: Frames are of another size.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    preprocess = checkpoint.header.preprocess
    check_size(clips, preprocess)
    networks = [network.to(device) for network in checkpoint.networks]
    forces_n = [predict(networks, preprocess, clip.frames, device) for clip in clips]
    for network in networks:
        network.cpu()
    return forces_n


def estimate_frames(
    checkpoint: Checkpoint,
    frames: Iterable[Gray],
    correction: Correction | None,
    precision: Precision = "float32",
) -> npt.NDArray[np.floating]:
    """Returns the ensemble's estimate for each frame of a recording, with one thread: the last digits depend on it.

    Args:
        checkpoint: The networks, computed on a GPU if there is one and no correction.
        frames: Frames of the checkpoint's size, (S, S) each; they are not kept.
        correction: That of an object profile; None for none.
        precision: See `stream_features`.

    Returns:
        Forces in N, (T,).
    """
    device = "cuda" if torch.cuda.is_available() and correction is None else "cpu"
    networks = [network.to(device) for network in checkpoint.networks]
    parts: list[npt.NDArray[np.floating]] = [np.empty(0, np.float32)]  # a recording may hold no frames
    try:
        with restored_threads():
            torch.set_num_threads(1)
            for members_n, features in stream_features(
                networks, checkpoint.header.preprocess, frames, device, precision
            ):
                mean_n = members_n.mean(0)
                if correction is not None:
                    mean_n = correction.force_n(mean_n, features).astype(np.float32)
                parts.append(mean_n)
    finally:
        for network in networks:
            network.cpu()  # they are kept for the next log, and for a replay
    return np.concatenate(parts)
