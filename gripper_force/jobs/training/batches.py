"""Training batches: clips drawn from all recordings, with random shift, light and noise."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N, Clip
from gripper_force.jobs.training.parallel import TrainingProcess
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.vision.batch_inference import normalise


class Batch(NamedTuple):
    """Clips of one step.

    Attributes:
        inputs: Prepared frames, (B, T, 1, S, S).
        forces_n: Forces to learn, (B, T).
        valid: Mask of the frames with a label, (B, T).
        indentation_m: Travel of the jaws since contact, (B, T); NaN if unknown.
    """

    inputs: Tensor
    forces_n: Tensor
    valid: Tensor
    indentation_m: Tensor


class Batches:
    """All training frames on one device, from which clips are drawn.

    Args:
        clips: Training data.
        config: The recipe.
        process: This process among those that train together.

    Attributes:
        unseen: Mask of the recordings from which no clip has been drawn, (recordings,) bool.

    Raises:
        DataError: A recording is too short for its reference frames, or no frame shows contact.
    """

    def __init__(self, clips: Sequence[Clip], config: TrainConfig, process: TrainingProcess) -> None:
        for clip in clips:
            if len(clip.frames) < config.preprocess.reference_frames:
                raise DataError(
                    f"{clip.name} has {len(clip.frames)} frames, too few for its reference frames; leave it out"
                )
        lengths = [len(clip.frames) for clip in clips]
        forces_n = np.concatenate(
            [clip.nominal_n if config.labels == "nominal" else clip.forces_n for clip in clips]
        )
        valid = np.concatenate([clip.valid for clip in clips])
        self._config = config
        self._device = process.device
        self._share = process.own_clips
        self.unseen = np.array([clip.valid.any() for clip in clips])
        self._recording = np.repeat(np.arange(len(clips)), lengths)  # (N,)
        self._begin = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)  # (N,)
        # Not joined to one tensor, which would take the memory twice.
        self._frames = [torch.from_numpy(clip.frames).to(self._device) for clip in clips]  # (T, S, S) each
        self._labels = torch.from_numpy(forces_n).to(self._device)  # (N,)
        self._valid = torch.from_numpy(valid).to(self._device)  # (N,)
        indentation_m = np.concatenate([clip.indentation_m for clip in clips])
        self._indentation_m = torch.from_numpy(indentation_m).to(self._device)  # (N,)
        self._all = np.flatnonzero(valid)
        self._contact = np.flatnonzero(valid & (forces_n > CONTACT_N))
        if not len(self._contact):
            raise DataError(f"no training frame has a force above {CONTACT_N} N; record or simulate contacts")
        newtons = np.floor(forces_n[self._contact])
        self._levels = [self._contact[newtons == n] for n in np.unique(newtons)]
        self._pass = -1
        self._order = self._all

    @property
    def labels(self) -> int:
        """Number of frames with a label."""
        return len(self._all)

    def batch(self, step: int, count: int, length: int) -> Batch:
        """Draws the clips of one step. They depend only on the seed and on these arguments.

        Args:
            step: Number of the step.
            count: Number of clips, B. With several processes each gets its share of them.
            length: Frames per clip, T.
        """
        config = self._config
        rng = np.random.default_rng((config.seed, step))
        ends = self._ends(rng, step, count)
        self.unseen[self._recording[ends]] = False
        begin = self._begin[ends]
        # Frames before a recording's first are copies of it, as for the estimator.
        index = np.maximum(ends[:, None] + np.arange(1 - length, 1), begin[:, None])  # (B, T)
        # The reference frames get the same augmentation as the clip: they share the camera and the light.
        lead = begin[:, None] + np.arange(config.preprocess.reference_frames)  # (B, R)
        gray = self._augmented(rng, np.concatenate([lead, index], axis=1))  # (B, R + T, S, S)
        leading, frames = gray[:, : lead.shape[1]], gray[:, lead.shape[1] :]
        inputs = normalise(frames, leading, config.preprocess)
        where = torch.from_numpy(index[self._share]).to(self._device)
        return Batch(inputs, self._labels[where], self._valid[where], self._indentation_m[where])

    def _ends(self, rng: np.random.Generator, step: int, count: int) -> npt.NDArray[np.int64]:
        draws = rng.random(count)
        ends = np.array([self._from_pass(step * count + i) for i in range(count)])
        by_force = draws < self._config.force_share
        in_contact = ~by_force & (draws < self._config.force_share + self._config.contact_share)
        ends[in_contact] = rng.choice(self._contact, int(in_contact.sum()))
        ends[by_force] = [
            rng.choice(self._levels[rng.integers(len(self._levels))]) for _ in range(by_force.sum())
        ]
        return ends

    def _from_pass(self, i: int) -> int:
        """Returns frame i of endless passes over all frames with a label, each pass in another random order."""
        number, place = divmod(i, len(self._all))
        if number != self._pass:
            self._order = np.random.default_rng((self._config.seed, number, 1)).permutation(self._all)
            self._pass = number
        return int(self._order[place])

    def _augmented(self, rng: np.random.Generator, index: npt.NDArray[np.int64]) -> Tensor:
        """Returns this process's clips of frames (B, T) as gray levels (B, T, S, S), each with its augmentation."""
        config = self._config
        size = config.preprocess.size
        # Drawn for all clips, so that a step does not depend on the number of processes.
        shifts = rng.integers(-config.shift_px, config.shift_px, (2, len(index), 1), endpoint=True)
        rows, columns = (np.arange(size) + shifts).clip(0, size - 1)  # (B, S) each
        light = rng.normal(0, config.light, (2, len(index))).astype(np.float32)
        noise = rng.uniform(0, config.noise, len(index)).astype(np.float32)
        generator = torch.Generator(self._device).manual_seed(int(rng.integers(2**62)))
        grain = torch.randn((*index.shape, size, size), generator=generator, device=self._device)

        def move(array: npt.NDArray[np.generic]) -> Tensor:
            return torch.from_numpy(array[self._share]).to(self._device)

        where = index - self._begin[index]  # in their recording
        recordings = self._recording[index[:, 0]]
        parts = zip(recordings[self._share], move(where), move(rows), move(columns), strict=True)
        gray = torch.stack([self._frames[r][t[:, None, None], y[:, None], x] for r, t, y, x in parts])
        factor, gamma = (move(np.exp(part))[:, None, None, None] for part in light)  # (B, 1, 1, 1) each
        lit: Tensor = factor * (gray / 255) ** gamma + move(noise)[:, None, None, None] * grain[self._share]
        return lit.clamp_(0, 1) * 255


class Replay:
    """Batches of new recordings, mixed with those of an earlier training.

    Attributes:
        labels: Number of new frames with a label.
        unseen: Mask of the new recordings from which no clip has been drawn, (recordings,) bool.
    """

    def __init__(self, new: Batches, old: Batches, share: float) -> None:
        self._new, self._old, self._share = new, old, share
        self.labels = new.labels
        self.unseen = new.unseen

    def batch(self, step: int, count: int, length: int) -> Batch:
        """Draws the clips of one step, ``share`` of them from the earlier recordings; see `Batches.batch`."""
        old = round(self._share * count)
        parts = [
            batches.batch(step, clips, length)
            for batches, clips in ((self._new, count - old), (self._old, old))
            if clips
        ]
        return Batch(*(torch.cat(part) for part in zip(*parts, strict=True)))
