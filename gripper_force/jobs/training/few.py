"""Fit of a Gaussian process to a few recordings, with every setting chosen on objects left out."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N, Clip
from gripper_force.progress import Progress, no_progress
from gripper_force.vision.batch_inference import normalise
from gripper_force.vision.gaussian_process import GaussianProcess, matern, pooled
from gripper_force.vision.header import GaussianProcessConfig
from gripper_force.vision.preprocess import Preprocess

GRID: Final = 32
"""Largest side of an averaged frame; the side of the input is a multiple of it."""

COMPONENTS: Final = 90
POINTS: Final = 1500
"""Frames that a process keeps: memory and time of the fit grow with their square and cube."""

PROGRESS_STEPS: Final = 100
"""Steps of progress that the training of one member of an ensemble reports."""

FOLDS: Final = 10
FOLD_POINTS: Final = 750
"""Most folds to choose the settings in, and frames that a process keeps there."""

CONTACT_POINTS: Final = 0.75
"""Share of these that are in contact, where there are as many."""

SLOPE: Final = 10.0
"""Weight of the linear kernel, with which a process extrapolates to larger forces."""

LENGTHS: Final = (4.0, 8.0, 16.0)
NOISES: Final = (0.05, 0.2)
"""Settings to choose from.

Length scale of the Matern kernel in standard deviations of the first component, and variance of the noise over that of
the process.
"""


class Setting(NamedTuple):
    """Settings of a process, see `LENGTHS`."""

    length: float
    noise: float


class Fit(NamedTuple):
    """A fitted Gaussian process.

    Attributes:
        model: The process, fitted to all recordings.
        setting: The settings with the smallest mean error over the folds.
        forces_n: Estimates for each recording by a process that was fitted without its fold, (T,) each.
    """

    model: GaussianProcess
    setting: Setting
    forces_n: list[npt.NDArray[np.float32]]


def fit(clips: Sequence[Clip], preprocess: Preprocess, progress: Progress = no_progress) -> Fit:
    """Chooses the settings by leaving out one object at a time, or one set if there are only two objects or one.

    Args:
        clips: Recordings, downscaled to ``preprocess.size``.
        preprocess: Preparation of frames.
        progress: Called after each fold.

    Raises:
        DataError: There is only one set, or no frame shows contact.
    """
    key = "object" if len({clip.object for clip in clips}) > 2 else "set"
    # Sets of two objects may have one name.
    names = [clip.object if key == "object" else f"{clip.object}, {clip.set}" for clip in clips]
    if len(set(names)) < 2:
        raise DataError(
            f"the settings are chosen on recordings left out, but there is only one {key}; add logs"
        )
    images = [_images(clip, preprocess) for clip in clips]
    settings = [Setting(*values) for values in itertools.product(LENGTHS, NOISES)]
    errors_n = np.zeros(len(settings))
    left_out: dict[int, list[npt.NDArray[np.float32]]] = {}
    unique = np.array(sorted(set(names)))
    folds = min(FOLDS, len(unique))
    for number in range(folds):
        held = set(unique[number::FOLDS])
        rest = [i for i, name in enumerate(names) if name not in held]
        fold = [i for i, name in enumerate(names) if name in held]
        data = _Data([images[i] for i in rest], [clips[i] for i in rest], FOLD_POINTS)
        scores = [data.features(images[i]) for i in fold]
        for setting, process in enumerate(data.processes(settings, preprocess.size)):
            forces_n = [process.force_n(part).numpy() for part in scores]
            for i, force_n in zip(fold, forces_n, strict=True):
                left_out.setdefault(i, []).append(force_n)
            errors_n[setting] += np.concatenate(
                [np.abs(f - clips[i].forces_n)[clips[i].valid] for i, f in zip(fold, forces_n, strict=True)]
            ).mean()
        done = [PROGRESS_STEPS * count // folds for count in (number, number + 1)]
        progress(f"without {'; '.join(sorted(held))}", done[1] - done[0])
    best = int(errors_n.argmin())
    process = fitted(clips, preprocess, settings[best])
    return Fit(process, settings[best], [left_out[i][best] for i in range(len(clips))])


def fitted(clips: Sequence[Clip], preprocess: Preprocess, setting: Setting) -> GaussianProcess:
    """Fits a process with given settings; arguments and errors are those of `fit`."""
    data = _Data([_images(clip, preprocess) for clip in clips], clips)
    return next(data.processes([setting], preprocess.size))


class _Data:
    """Recordings in the features of their own principal components, and the frames to keep."""

    def __init__(self, images: Sequence[Tensor], clips: Sequence[Clip], points: int = POINTS) -> None:
        forces_n = np.concatenate([clip.forces_n[clip.valid] for clip in clips])
        kept = _kept(forces_n, points)
        every = torch.cat([x[torch.from_numpy(c.valid)] for x, c in zip(images, clips, strict=True)])
        frames = every[torch.from_numpy(kept)]
        if not bool((frames != frames[0]).any()):
            raise DataError(
                "all frames with a label show the same image; check the camera, its light and vision.region"
            )
        self._centre, spread = frames.mean(0), frames.std(0) + 1e-3 * frames.std() + 1e-6
        centred = (frames - self._centre) / spread
        axes = torch.linalg.eigh(centred.T @ centred)[1].flip(1)[:, :COMPONENTS]
        # Rounded as they are stored, so that the weights fit the stored numbers.
        self._axes = (axes / (centred @ axes[:, 0]).std() / spread[:, None]).half().float()
        self._points = self.features(frames).half().float()
        self._forces_n = torch.from_numpy(forces_n[kept]).double()

    def features(self, images: Tensor) -> Tensor:
        features: Tensor = (images - self._centre) @ self._axes
        return features

    def processes(self, settings: Sequence[Setting], size: int) -> Iterator[GaussianProcess]:
        points = self._points.double()
        linear = SLOPE / COMPONENTS * points @ points.T
        for length, noise in settings:
            covariance = matern(points, points, length) + linear
            covariance.diagonal().add_(noise)
            weights = torch.cholesky_solve(self._forces_n[:, None], torch.linalg.cholesky(covariance))[:, 0]
            config = GaussianProcessConfig(
                size=size, grid=_grid(size), head=COMPONENTS, points=len(points), length=length
            )
            process = GaussianProcess(config)
            process.load_state_dict(
                {
                    "centre": self._centre,
                    "axes": self._axes,
                    "points": self._points,
                    "weights": weights.float(),
                    "slope": (SLOPE / COMPONENTS * points.T @ weights).float(),
                }
            )
            yield process.eval()


def _grid(size: int) -> int:
    return max(side for side in range(1, GRID + 1) if size % side == 0)


def _kept(forces_n: npt.NDArray[np.float32], points: int) -> npt.NDArray[np.int64]:
    """Returns the frames to keep, evenly over time: neighbours are nearly equal."""
    contact = np.flatnonzero(forces_n > CONTACT_N)
    if not len(contact):
        raise DataError(f"no training frame has a force above {CONTACT_N} N; record or simulate contacts")
    free = np.flatnonzero(forces_n <= CONTACT_N)
    contact = _spread(contact, max(round(CONTACT_POINTS * points), points - len(free)))
    return np.sort(np.concatenate([contact, _spread(free, points - len(contact))]))


def _spread(frames: npt.NDArray[np.int64], most: int) -> npt.NDArray[np.int64]:
    return frames[np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).astype(np.int64))]


@torch.inference_mode()
def _images(clip: Clip, preprocess: Preprocess) -> Tensor:
    frames = torch.from_numpy(clip.frames)[None]
    inputs = normalise(frames, frames[:, : preprocess.reference_frames], preprocess)[0]
    return pooled(inputs, _grid(preprocess.size))
