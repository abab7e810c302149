"""The force estimator of a run: camera frames in, newtons with a claimed error out."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from gripper_force.errors import DataError, NonFiniteError
from gripper_force.types import Gray
from gripper_force.vision.checkpoint import Checkpoint
from gripper_force.vision.correction import Correction
from gripper_force.vision.network import StreamState
from gripper_force.vision.plausible import Plausibility
from gripper_force.vision.preprocess import Normaliser, Region, shrink


@dataclass(frozen=True, slots=True)
class Estimate:
    """One estimate.

    Attributes:
        force_n: Contact force: the mean over the ensemble, corrected by the object's profile.
        std_n: Standard deviation claimed for it: as the profile's interval says, or, without a profile, the
            error measured in validation at that force, and half the spread of the members, as independent.
    """

    force_n: float
    std_n: float


class ForceEstimator:
    """Runs an ensemble over a stream of frames. Deterministic; one thread alone may call it."""

    def __init__(
        self,
        checkpoint: Checkpoint,
        region: Region | None = None,
        threads: int = 2,
        correction: Correction | None = None,
    ) -> None:
        """Makes the ensemble ready; the first estimate is as fast as any.

        Args:
            checkpoint: The ensemble.
            region: Region of interest of the camera's frame in pixels; None for the whole frame.
            threads: CPU threads of this process that PyTorch may use.
            correction: What the object's profile makes of the estimates.
        """
        torch.set_num_threads(threads)
        self._region = region
        self._preprocess = checkpoint.header.preprocess
        self._networks = checkpoint.networks
        self._correction = correction
        self._residual_forces = [residual.force_n for residual in checkpoint.header.residuals]
        self._residual_stds = [residual.std_n for residual in checkpoint.header.residuals]
        self.reset()
        self._infer(np.zeros((self._preprocess.size, self._preprocess.size), np.float32))
        self.reset()

    def reset(self) -> None:
        """Forgets the stream: the next frames are the first of a new run, and its reference."""
        self._plausibility = Plausibility()
        self._normaliser = Normaliser(self._preprocess)
        self._states: list[StreamState | None] = [None] * len(self._networks)

    @property
    def reference(self) -> Gray | None:
        """Mean of the no-contact reference frames, (S, S) uint8; None until they are there, or if unused."""
        return self._normaliser.reference_image

    def update(self, gray: Gray) -> Estimate | None:
        """Takes the next frame.

        Args:
            gray: Camera frame, (H, W) uint8. The first of a run must show no contact.

        Returns:
            The estimate for this frame, or None while the reference frames are being collected.

        Raises:
            DataError: The frame is not a gray image of bytes, not what a working camera would see, or too
                unlike all that the object's profile was calibrated with.
            ConfigError: The region of interest reaches beyond the frame.
            NonFiniteError: A network gave NaN or infinity.
        """
        forces: list[float] = []
        small = shrink(gray, self._region, self._preprocess.size)
        self._plausibility.check(small)
        for frame in self._normaliser.push(small):
            forces = self._infer(frame)
        if not forces:
            return None
        if not all(math.isfinite(force) for force in forces):
            raise NonFiniteError(f"the network gave {forces} N; check the checkpoint and the camera's image")
        force_n = sum(forces) / len(forces)
        if self._correction is not None:
            return self._corrected(self._correction, force_n)
        residual_n = float(np.interp(force_n, self._residual_forces, self._residual_stds))
        return Estimate(force_n, math.hypot(residual_n, (max(forces) - min(forces)) / 2))

    def attention_map(self) -> npt.NDArray[np.float32] | None:
        """Where SSAM looks in the newest frame, (h, w) in 0..1; None without SSAM or a frame."""
        for network, state in zip(self._networks, self._states, strict=True):
            if network.config.attention == "ssam" and state is not None and state.gates is not None:
                return np.asarray(state.gates[0, 0].numpy(), np.float32)
        return None

    def _corrected(self, correction: Correction, force_n: float) -> Estimate:
        read = [state.features[0].numpy() for state in self._states if state is not None]
        features = np.concatenate(read)[None]  # (1, F)
        strangeness = float(correction.strangeness(features)[0])
        if strangeness > 1:
            raise DataError(
                f"what is seen is {strangeness:.1f} times as unlike the touches of the profile "
                f"{correction.profile.object!r} as these are among each other; see whether it is that object"
            )
        corrected_n = correction.force_n([force_n], features)
        return Estimate(float(corrected_n[0]), float(correction.std_n(corrected_n)[0]))

    @torch.inference_mode()
    def _infer(self, frame: npt.NDArray[np.float32]) -> list[float]:
        inputs = torch.from_numpy(frame)[None, None]  # (1, 1, S, S)
        forces = []
        for i, network in enumerate(self._networks):
            force, self._states[i] = network.step(inputs, self._states[i])
            forces.append(force.item())
        return forces
