"""The force estimator of a run: camera frames in, newtons with a claimed error out."""

import math
from dataclasses import dataclass

import numpy as np

from gripper_force.config import VisionConfig
from gripper_force.errors import DataError, NonFiniteError
from gripper_force.profiles.correction import Correction
from gripper_force.types import Gray
from gripper_force.vision.engines import Engine, Floats, open_engine
from gripper_force.vision.frame_checks import FrameChecks
from gripper_force.vision.header import RESIDUAL_HALF_N, Model
from gripper_force.vision.preprocess import Normaliser, Region, downscale


@dataclass(frozen=True, slots=True)
class ForceEstimate:
    """One estimate.

    Attributes:
        force_n: Contact force: the mean over the ensemble, corrected by the object's profile.
        std_n: Standard deviation claimed for it: as the profile's interval says, or, without a profile, the
            error measured in validation at that force, and half the spread of the members, as independent.
            It grows by each newton beyond the forces that these know.
    """

    force_n: float
    std_n: float


class ForceEstimator:
    """Runs an ensemble over a stream of frames. Deterministic; one thread alone may call it."""

    def __init__(
        self,
        engine: Engine,
        region: Region | None = None,
        correction: Correction | None = None,
    ) -> None:
        """Begins a run.

        Args:
            engine: The ensemble.
            region: Region of interest of the camera's frame in pixels; None for the whole frame.
            correction: What the object's profile makes of the estimates.
        """
        self._region = region
        self._engine = engine
        self._preprocess = engine.header.preprocess
        self._correction = correction
        self._residual_forces = [residual.force_n for residual in engine.header.residuals]
        self._residual_stds = [residual.std_n for residual in engine.header.residuals]
        self.reset()

    def reset(self) -> None:
        """Forgets the stream: the next frames are the first of a new run, and its reference."""
        self._frame_checks = FrameChecks()
        self._normaliser = Normaliser(self._preprocess)
        self._engine.reset()
        self._attention: Floats | None = None

    @property
    def reference(self) -> Gray | None:
        """Mean of the no-contact reference frames, (S, S) uint8; None until they are there, or if unused."""
        return self._normaliser.reference_image

    def update(self, gray: Gray) -> ForceEstimate | None:
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
        step = None
        small = downscale(gray, self._region, self._preprocess.size)
        self._frame_checks.check(small)
        for frame in self._normaliser.push(small):
            step = self._engine.step(frame)
        if step is None:
            return None
        forces: list[float] = step.forces_n.tolist()
        self._attention = step.attention
        if not all(math.isfinite(force) for force in forces):
            raise NonFiniteError(f"the network gave {forces} N; check the checkpoint and the camera's image")
        force_n = sum(forces) / len(forces)
        if self._correction is not None:
            return self._corrected(self._correction, force_n, step.features)
        residual_n = float(np.interp(force_n, self._residual_forces, self._residual_stds))
        # Validation never saw such an estimate: all that is known is that the forces there end earlier.
        least_n = self._residual_forces[0] - RESIDUAL_HALF_N
        most_n = self._residual_forces[-1] + RESIDUAL_HALF_N
        beyond_n = max(least_n - force_n, force_n - most_n, 0.0)
        return ForceEstimate(force_n, math.hypot(residual_n + beyond_n, (max(forces) - min(forces)) / 2))

    def attention_map(self) -> Floats | None:
        """Where SSAM looks in the newest frame, (h, w) in 0..1; None without SSAM or a frame."""
        return self._attention

    def _corrected(self, correction: Correction, force_n: float, read: Floats) -> ForceEstimate:
        features = read[None]  # (1, F)
        ood_score = float(correction.ood_score(features)[0])
        if ood_score > 1:
            raise DataError(
                f"what is seen is {ood_score:.1f} times as unlike the touches of the profile "
                f"{correction.profile.object!r} as these are among each other; see whether it is that object"
            )
        corrected_n = correction.force_n([force_n], features)
        return ForceEstimate(float(corrected_n[0]), float(correction.std_n(corrected_n)[0]))


def open_estimator(
    model: Model, vision: VisionConfig, correction: Correction | None = None
) -> ForceEstimator:
    """The estimator of a run.

    Args:
        model: What ``vision.checkpoint`` names.
        vision: Nothing in it is left to ``auto``; see `gripper_force.vision.selection.resolve_auto`.
        correction: What the object's profile makes of the estimates.

    Raises:
        ConfigError: The engine is not there, or can't run this file.
        CheckpointError: The file is damaged.
    """
    engine = open_engine(model, vision.engine, vision.precision, vision.threads)
    return ForceEstimator(engine, vision.region, correction)
