"""Force estimator: camera frames in, contact force and its claimed error out."""

import math
from collections import deque
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from gripper_force.config import MAX_COVERED, VisionConfig, config_from
from gripper_force.errors import ConfigError, DataError, NonFiniteError, UnfamiliarFrameError
from gripper_force.profiles.correction import Correction, load_correction
from gripper_force.profiles.object_profile import find_object, read_object
from gripper_force.schema import as_path
from gripper_force.types import ForceEstimate, Gray
from gripper_force.vision.engines import Engine, Floats, Precision, StepOutput, open_engine
from gripper_force.vision.frame_checks import FrameChecks
from gripper_force.vision.header import RESIDUAL_HALF_N, Header, Model
from gripper_force.vision.known_views import view_score
from gripper_force.vision.model_files import read_model
from gripper_force.vision.ood import OodScore
from gripper_force.vision.preprocess import Normaliser, Region, downscale


class ForceEstimator:
    """Estimates the contact force from a stream of camera frames. Deterministic; not thread-safe.

    The first frames of a stream must show no contact: their mean is the reference that later frames are
    compared with. There is no estimate until the reference is complete. Each frame passes through crop and
    downscale, plausibility checks, subtraction of the reference, the networks, and the object profile.

    The estimate is the mean over the members of the ensemble, corrected by the object profile if there is
    one. Its standard deviation is that of the profile's interval. Without a profile, it combines the error
    measured in validation at that force with half of the members' spread, as independent errors, and
    grows with the frame's out-of-distribution score. It grows with the distance to the forces seen in
    validation or calibration. The limits of that score are the object profile's, if it has some, and otherwise the
    checkpoint's.

    Without a profile, the reference itself must be like the views that the network knows: a profile is of an object
    and a view that its user chose.
    """

    def __init__(
        self,
        engine: Engine,
        region: Region | None = None,
        correction: Correction | None = None,
        max_covered: float = MAX_COVERED,
    ) -> None:
        """Starts a stream on an engine that is open; `load` opens one.

        Args:
            engine: The ensemble.
            region: Region of interest of the frames in pixels: left, top, width, height. None: the whole
                frame.
            correction: Correction by an object profile.
            max_covered: Largest share of the image that may lose its fine detail, as behind a cover.
        """
        self._region, self._max_covered = region, max_covered
        self._engine = engine
        self._preprocess, members = engine.header.preprocess, engine.header.members
        self._sizes = len(members), sum(member.head for member in members)
        self._correction = correction
        object_frames = None if correction is None else correction.known
        self._ood = None if engine.header.ood is None else OodScore(engine.header.ood, object_frames)
        self._views = engine.header.views if correction is None else None
        self.reset()

    @classmethod
    def load(
        cls,
        checkpoint: str | Path = "default",
        *,
        region: Region | None = None,
        max_covered: float = MAX_COVERED,
        profile: str | Path | None = None,
        engine: str = "onnxruntime",
        precision: Precision = "float32",
        threads: int | None = None,
    ) -> Self:
        """Loads a network and returns an estimator for one camera.

        It needs no other device and no configuration, so it also works with other grippers. For accurate
        forces there, pass a checkpoint that was trained with that gripper (`gripper-force train`)::

            estimator = ForceEstimator.load("default", region=(40, 40, 400, 400))
            for frame in frames:  # (H, W) uint8; no contact in the first ones
                try:
                    estimate = estimator.update(frame)
                except DataError as error:  # an unfamiliar or covered view, a moved camera
                    print(error)
                    continue
                if estimate is not None:  # None while the reference is collected
                    print(f"{estimate.force_n:.2f} N +- {estimate.std_n:.2f} N")

        Args:
            checkpoint: ``default`` or ``small`` for a shipped network, the path of a checkpoint, or the path
                of a file that `gripper-force export network` wrote.
            region: Region of interest of the frames in pixels: left, top, width, height. None: the whole
                frame.
            max_covered: Largest share of the image that may lose its fine detail, as behind a cover: 0 to 0.5. Raise
                it for jaws that fill more of the view.
            profile: Object profile: a name such as ``sponge``, or the path of a YAML file. Its network must
                be this one; its camera settings are not checked.
            engine: ``onnxruntime``, ``openvino``, ``torch``, or an engine of another package: the name of an
                entry point in the group ``gripper_force.engines``, or ``package.module:Class``.
            precision: Precision of the arithmetic. Of the built-in engines only OpenVINO has ``bfloat16``.
            threads: CPU threads. With PyTorch this sets the threads of the whole process. None leaves that
                setting as it is, and gives ONNX Runtime one, and OpenVINO its default, all cores.

        Raises:
            CheckpointError: The network's file is missing or damaged.
            ConfigError: ``checkpoint`` is no path; the engine is unknown, not installed, or can't run this file or
                precision; the profile does not exist, is damaged, or belongs to another network; or ``max_covered`` is
                out of range.
        """
        vision = config_from({"vision": {"max_covered": max_covered}}, "ForceEstimator.load").vision
        model = read_model(as_path(checkpoint, "the network", "name a file, default or small"))
        correction = None if profile is None else _profile_correction(model, str(profile))
        return cls(open_engine(model, engine, precision, threads), region, correction, vision.max_covered)

    def reset(self) -> None:
        """Starts a new stream: the next frames must show no contact and become its reference."""
        self._frame_checks = FrameChecks(self._max_covered)
        self._normaliser = Normaliser(self._preprocess)
        self._engine.reset()
        if self._ood is not None:
            self._ood.reset()
        self._last: deque[Gray] = deque(maxlen=self._preprocess.reference_frames)
        self._attention: Floats | None = None
        self._knows_view: bool | None = None  # not compared so far
        self._shape: tuple[int, ...] | None = None  # None: no frame so far
        self._has_no_reference = False

    def renew_reference(self) -> None:
        """Starts a new stream whose reference is the last frames: of another object, or from a camera that was moved.

        They must show no contact.

        Raises:
            DataError: The last frames are flat, or unlike each other. Then no frame gives an estimate until the
                reference is renewed again: the next ones may show contact.
        """
        last, shape = self._last, self._shape
        self.reset()
        self._last, self._shape, self._has_no_reference = last, shape, True
        for image in last:
            self._steps(image)
        self._has_no_reference = False

    @property
    def reference(self) -> Gray | None:
        """Mean of the reference frames, (S, S) uint8; None until it is complete or if none is used."""
        return self._normaliser.reference_image

    def update(self, gray: Gray) -> ForceEstimate | None:
        """Processes the next frame.

        Args:
            gray: Camera frame, (H, W) uint8. The first frames of a stream must show no contact.

        Returns:
            The estimate for this frame, or None while the reference is being collected.

        Raises:
            DataError: The frame is not a gray image of bytes, has another size than the frames before it, or is
                implausible (see `FrameChecks`).
            UnfamiliarFrameError: The frame's out-of-distribution score exceeds the limit of the object profile or
                of the checkpoint, the network does not know the view before the contact, or the view is covered or
                blurred (see `FrameChecks`).
            ConfigError: The region of interest reaches beyond the frame.
            NonFiniteError: A network returned NaN or infinity.
        """
        image = downscale(gray, self._region, self._preprocess.size)
        # The region is in pixels, and the reference shows the view of another size.
        if self._shape not in (None, gray.shape):
            remedy = "keep the camera's resolution, or start a new stream"
            raise DataError(f"the frame is {gray.shape}, but the stream began with {self._shape}; {remedy}")
        self._last.append(image)
        if self._has_no_reference:
            raise DataError(
                "there is no reference: the view was flat or moved when it was renewed; renew it before a still view "
                "(grasp with new_object=True)"
            )
        steps = self._steps(image)
        self._shape = gray.shape
        return self._estimate(steps[-1]) if steps else None

    def _steps(self, image: Gray) -> list[StepOutput]:
        """Returns the networks' outputs for the frames that became ready with the next one, (S, S)."""
        self._frame_checks.check(image)
        return [self._engine.step(frame) for frame in self._normaliser.push(image)]

    def _estimate(self, step: StepOutput) -> ForceEstimate:
        """Returns the estimate for the networks' output."""
        if (sizes := (len(step.forces_n), len(step.features))) != self._sizes:
            raise ConfigError(f"the engine gave {sizes} forces and features, not {self._sizes}; correct it")
        forces: list[float] = step.forces_n.tolist()
        self._attention = step.attention
        if not all(math.isfinite(force) for force in forces):
            raise NonFiniteError(f"the network returned {forces} N; check the checkpoint and the image")
        force_n = sum(forces) / len(forces)
        if self._views is not None and (reference := self.reference) is not None:
            if self._knows_view is None:
                self._knows_view = view_score(self._views, reference) <= 1
            if not self._knows_view:
                raise UnfamiliarFrameError(
                    "the network does not know the view before the contact (object, camera, background); "
                    "calibrate the object",
                    force_n,
                )
        features, score = step.features[None], 0.0  # (1, F)
        if self._ood is not None:
            score = float(self._ood.score(features, np.array([force_n]))[0])
            if score > 1:
                raise UnfamiliarFrameError(
                    f"the frame's out-of-distribution score is {score:.2f} times {self._limit()}", force_n
                )
        if self._correction is not None:
            corrected_n = self._correction.force_n([force_n], features)
            return ForceEstimate(float(corrected_n[0]), float(self._correction.std_n(corrected_n)[0]))
        std_n = float(claimed_std_n(self._engine.header, step.forces_n[:, None])[0])
        factor = 1.0 if self._ood is None else float(self._ood.std_factor(score))
        return ForceEstimate(force_n, std_n * factor)

    def _limit(self) -> str:
        """Names the limit that a frame exceeds, and what to do."""
        if self._correction is None:
            return (
                "the network's limit: it shows what the network does not know; calibrate the object, or train a "
                "network with it"
            )
        name = repr(self._correction.profile.object)
        if self._correction.known is None:
            return f"the network's limit, and the object profile {name} has no limits of its own; calibrate again"
        return f"the limit of the object profile {name}; check that the object is the profile's, or calibrate again"

    def attention_map(self) -> Floats | None:
        """Returns SSAM's attention map of the newest frame, (h, w) in 0..1; None without SSAM or a frame."""
        return self._attention


def claimed_std_n(header: Header, forces_n: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Returns the standard deviation that a checkpoint claims, (N,), for its members' forces (M, N).

    It does not include the factor of the out-of-distribution score.
    """
    force_n = forces_n.mean(0, dtype=np.float64)
    known_n = np.array([residual.force_n for residual in header.residuals])
    residual_n = np.interp(force_n, known_n, [residual.std_n for residual in header.residuals])
    # No error was measured beyond these forces.
    beyond_n = np.abs(force_n - force_n.clip(known_n[0] - RESIDUAL_HALF_N, known_n[-1] + RESIDUAL_HALF_N))
    std_n: npt.NDArray[np.float64] = np.hypot(residual_n + beyond_n, np.ptp(forces_n, axis=0) / 2)
    return std_n


def open_estimator(
    model: Model, vision: VisionConfig, correction: Correction | None = None, *, set_threads: bool = True
) -> ForceEstimator:
    """Returns the estimator that a configuration describes; see `open_configured_engine`."""
    engine = open_configured_engine(model, vision, set_threads=set_threads)
    return ForceEstimator(engine, vision.region, correction, vision.max_covered)


def open_configured_engine(model: Model, vision: VisionConfig, *, set_threads: bool = True) -> Engine:
    """Returns the engine that a configuration describes.

    Args:
        model: The network that ``vision.checkpoint`` names.
        vision: Configuration without ``auto``; see `gripper_force.vision.selection.resolve_auto`.
        set_threads: Sets PyTorch's threads, one setting of the whole process, to ``vision.threads``. OpenVINO
            and ONNX Runtime have their own threads and use that number in any case.

    Raises:
        ConfigError: The engine is unknown, not installed, or can't run this file or precision.
        CheckpointError: The file is damaged.
    """
    threads = None if vision.engine == "torch" and not set_threads else vision.threads
    return open_engine(model, vision.engine, vision.precision, threads)


def _profile_correction(model: Model, name: str) -> Correction:
    path = find_object(name)
    profile = read_object(path)
    if mismatches := profile.mismatches(model.digest, {}):
        raise ConfigError(
            f"the object profile {path} is of {'; '.join(mismatches)}; calibrate the object with this "
            "network, or use the network of the profile"
        )
    return load_correction(path, profile, sum(member.head for member in model.header.members))
