"""How well a checkpoint does on recordings it has not seen."""

from collections.abc import Callable, Iterable, Sequence
from typing import Final, TypedDict

import cv2
import numpy as np
import numpy.typing as npt
import torch
from rich.console import Console
from rich.progress import track

from gripper_force.errors import DataError
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import CONTACT_N, Clip, check_size, stiffness_floor_n
from gripper_force.profiles.correction import Correction
from gripper_force.vision.batch_inference import features, predict
from gripper_force.vision.checkpoint import Checkpoint

RIDGE_SIZE: Final = 32
RIDGE_COMPONENTS: Final = 20
RIDGE_PENALTY: Final = 0.2
"""For each frame; objects transfer best between 0.02 and 0.2."""


class ObjectResult(TypedDict):
    """Errors on one object; ``contact_mae_n`` is NaN where it was never touched."""

    mae_n: float
    rmse_n: float
    contact_mae_n: float
    floor_n: float
    frames: int


class EvaluationResult(TypedDict):
    """Errors over all frames, by object and by measured force.

    ``floor_n`` is the MAE that the spread of stiffness alone costs; NaN for recordings of real objects.
    """

    mae_n: float
    rmse_n: float
    bias_n: float
    floor_n: float
    frames: int
    per_object: dict[str, ObjectResult]
    per_bin: list[metrics.Bin]


def evaluate(
    checkpoint: Checkpoint, clips: Sequence[Clip], correct: Callable[[Clip], Correction] | None = None
) -> EvaluationResult:
    """Estimates the force at each frame as a run would, and compares it with the load cell.

    Args:
        checkpoint: The ensemble; computed on a GPU where there is one, or, with profiles, on the CPU.
        clips: Recordings, reduced to the checkpoint's size.
        correct: What the profile of a recording's object makes of the estimates.

    Raises:
        DataError: There are no clips, no labels, or frames of another size.
    """
    if correct is None:
        means_n = [members_n.mean(0) for members_n in estimates(checkpoint, clips)]
    else:
        means_n = [_corrected_n(checkpoint, clip, correct(clip)) for clip in _shown(clips)]
    return compare(clips, means_n, checkpoint.header.preprocess.lead_in)


def estimates(checkpoint: Checkpoint, clips: Sequence[Clip]) -> list[npt.NDArray[np.float32]]:
    """Each member's estimate for each frame, so that ensembles can be put together afterwards.

    Args:
        checkpoint: The networks; computed on a GPU where there is one.
        clips: Recordings, reduced to the checkpoint's size.

    Returns:
        Forces in N of each clip, (members, T).

    Raises:
        DataError: Frames are of another size.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    preprocess = checkpoint.header.preprocess
    check_size(clips, preprocess)
    networks = [network.to(device) for network in checkpoint.networks]
    forces_n = [predict(networks, preprocess, clip.frames, device) for clip in _shown(clips)]
    for network in networks:
        network.cpu()
    return forces_n


def _corrected_n(checkpoint: Checkpoint, clip: Clip, correction: Correction) -> npt.NDArray[np.float32]:
    preprocess = checkpoint.header.preprocess
    check_size([clip], preprocess)
    forces_n, read_out = features(checkpoint.networks, preprocess, clip.frames)
    return correction.force_n(forces_n.mean(0), read_out).astype(np.float32)


def _shown(clips: Sequence[Clip]) -> Iterable[Clip]:
    return track(clips, "evaluating", console=Console(stderr=True))


def ridge_baseline(train_clips: Sequence[Clip], test_clips: Sequence[Clip]) -> EvaluationResult:
    """What a linear method gets: ridge regression on products of 20 principal components.

    The components are of 32x32 frames minus each recording's first frame.

    Raises:
        DataError: There are no clips or no labels.
    """
    labels_n, valid = _joined(train_clips)
    images = np.concatenate([_first_frame_difference(clip) for clip in train_clips])[valid]
    centre = images.mean(0)
    _, axes = np.linalg.eigh((images - centre).T @ (images - centre))
    axes = axes[:, -RIDGE_COMPONENTS:]  # (pixels, components)
    scale = ((images - centre) @ axes).std(0) + 1e-6

    def features(pixels: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        scores = ((pixels - centre) @ axes / scale).astype(np.float64)  # (N, components)
        first, second = np.triu_indices(scores.shape[1])
        return np.column_stack([scores, scores[:, first] * scores[:, second]])

    x, y = features(images), labels_n[valid].astype(np.float64)
    x_mean, y_mean = x.mean(0), y.mean()
    covariance = (x - x_mean).T @ (x - x_mean) / len(x)
    weights = np.linalg.solve(
        covariance + RIDGE_PENALTY * np.eye(x.shape[1]), (x - x_mean).T @ (y - y_mean) / len(x)
    )
    predictions = [
        (features(_first_frame_difference(clip)) - x_mean) @ weights + y_mean for clip in test_clips
    ]
    return compare(test_clips, predictions, lead_in=0)


def compare(
    clips: Sequence[Clip], predictions: Sequence[npt.NDArray[np.floating]], lead_in: int
) -> EvaluationResult:
    """Compares estimates with the load cell, over all frames that have a label.

    Args:
        clips: Recordings.
        predictions: Estimates for each clip's frames in N, (T,).
        lead_in: First frames of each clip to leave out: where they only serve as reference, a run gives no
            estimate for them.

    Raises:
        DataError: There are no clips or no labels.
    """
    measured_n, valid = _joined(clips)
    valid &= np.concatenate([np.arange(len(clip.frames)) >= lead_in for clip in clips])
    if not valid.any():
        raise DataError(f"no frame after a recording's first {lead_in} has a load-cell force to compare with")
    predicted_n = np.concatenate(predictions)
    floors_n = np.concatenate([stiffness_floor_n(clip.forces_n, clip.stiffness) for clip in clips])[valid]
    objects = np.concatenate([np.full(len(clip.frames), clip.object) for clip in clips])[valid]
    predicted_n, measured_n = predicted_n[valid], measured_n[valid]
    return EvaluationResult(
        mae_n=metrics.mae(predicted_n, measured_n),
        rmse_n=metrics.rmse(predicted_n, measured_n),
        bias_n=metrics.bias(predicted_n, measured_n),
        floor_n=float(floors_n.mean()),
        frames=len(measured_n),
        per_object={
            str(name): _object_result(
                *(part[objects == name] for part in (predicted_n, measured_n, floors_n))
            )
            for name in np.unique(objects)
        },
        per_bin=metrics.per_bin(predicted_n, measured_n),
    )


def _object_result(
    predicted_n: npt.NDArray[np.floating],
    measured_n: npt.NDArray[np.float32],
    floors_n: npt.NDArray[np.floating],
) -> ObjectResult:
    contact = measured_n > CONTACT_N
    return ObjectResult(
        mae_n=metrics.mae(predicted_n, measured_n),
        rmse_n=metrics.rmse(predicted_n, measured_n),
        contact_mae_n=metrics.mae(predicted_n[contact], measured_n[contact])
        if contact.any()
        else float("nan"),
        floor_n=float(floors_n.mean()),
        frames=len(measured_n),
    )


def _joined(clips: Sequence[Clip]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    if not any(clip.valid.any() for clip in clips):
        raise DataError("there is no frame with a label to compare with")
    return np.concatenate([clip.forces_n for clip in clips]), np.concatenate([clip.valid for clip in clips])


def _first_frame_difference(clip: Clip) -> npt.NDArray[np.float32]:
    """Frames minus the first, (T, 32 * 32), in 0..1."""
    size = (RIDGE_SIZE, RIDGE_SIZE)
    small = [cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in clip.frames]
    pixels = np.asarray(small, np.float32).reshape(len(small), -1) / 255
    difference: npt.NDArray[np.float32] = pixels - pixels[0]
    return difference
