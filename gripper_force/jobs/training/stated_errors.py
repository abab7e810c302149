"""Errors that a checkpoint states, measured on logs."""

import hashlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import Clip, label_mask
from gripper_force.vision.batch_inference import predict
from gripper_force.vision.checkpoint import Member, load_checkpoint
from gripper_force.vision.checkpoint_writer import replace_header
from gripper_force.vision.header import RESIDUAL_HALF_N, Residual
from gripper_force.vision.preprocess import Preprocess

RESIDUAL_PRIOR: Final = 20
"""Weight of the error over all forces, in frames, in the stated error at one force."""


def state_errors(
    checkpoints: Sequence[str | Path], read: Callable[[Preprocess], Sequence[Clip]], *, write: bool
) -> dict[str, dict[str, float]]:
    """Measures checkpoints on the same logs, so that their errors compare.

    Args:
        checkpoints: Paths of checkpoints, or ``default`` or ``small`` for a shipped one.
        read: Reads the logs for a preparation of frames.
        write: Write the errors into the headers. Weights and digests stay, so object profiles stay valid.

    Returns:
        The errors of each checkpoint; see `errors`.

    Raises:
        CheckpointError: A checkpoint can't be read or written.
        DataError: The logs can't be used.
    """
    clips: dict[Preprocess, Sequence[Clip]] = {}
    errors_by_checkpoint: dict[str, dict[str, float]] = {}
    for checkpoint in checkpoints:
        ensemble = load_checkpoint(checkpoint)
        preprocess = ensemble.header.preprocess
        if preprocess not in clips:
            clips[preprocess] = read(preprocess)
        forces_n, measured_n = labelled_estimates(clips[preprocess], ensemble.networks, preprocess, "cpu")
        errors_by_checkpoint[str(checkpoint)] = errors(forces_n, measured_n)
        if write:
            values = {
                "residuals": residuals(forces_n, measured_n),
                "metrics": ensemble.header.metrics | errors_by_checkpoint[str(checkpoint)],
                "test_digest": hashlib.sha256(measured_n.tobytes()).hexdigest(),
            }
            replace_header(checkpoint, ensemble.header.model_copy(update=values))
    return errors_by_checkpoint


def labelled_estimates(
    clips: Sequence[Clip], networks: Sequence[Member], preprocess: Preprocess, device: str
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Returns the ensemble's and the measured forces in N, (N,) each, over all frames with a label.

    The first frames of a clip are left out, for which a run gives no estimate.

    Raises:
        DataError: No frame has a label.
    """
    used = label_mask(clips, preprocess.lead_in)
    forces_n = [predict(networks, preprocess, clip.frames, device).mean(0) for clip in clips]
    return np.concatenate(forces_n)[used], np.concatenate([clip.forces_n for clip in clips])[used]


def errors(forces_n: npt.NDArray[np.float32], measured_n: npt.NDArray[np.float32]) -> dict[str, float]:
    """Returns the mean absolute error, the root mean squared error and the mean error of estimates, (N,) each."""
    return {
        "mae_n": metrics.mae(forces_n, measured_n),
        "rmse_n": metrics.rmse(forces_n, measured_n),
        "bias_n": metrics.bias(forces_n, measured_n),
    }


def residuals(forces_n: npt.NDArray[np.float32], measured_n: npt.NDArray[np.float32]) -> tuple[Residual, ...]:
    """Returns the root mean squared error in bins of 1 N of the estimate, the only force known in a run."""
    squared = np.square(forces_n - measured_n)
    newtons = np.floor(forces_n)
    result = []
    for newton in np.unique(newtons):
        part = squared[newtons == newton]
        variance = (part.sum() + RESIDUAL_PRIOR * squared.mean()) / (len(part) + RESIDUAL_PRIOR)
        result.append(Residual(force_n=float(newton) + RESIDUAL_HALF_N, std_n=math.sqrt(variance)))
    return tuple(result)
