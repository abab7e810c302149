"""Object profile: calibration of one object with one camera and network, by `gripper-force calibrate object`.

A profile is a YAML file, with a safetensors file of the same name beside it for the arrays.
`gripper_force.profiles.correction` applies it to the network's estimates.
"""

from datetime import date
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from gripper_force.errors import ConfigError
from gripper_force.folders import xdg_folder
from gripper_force.schema import Finite, NonNegative, Positive, Section, Tree, differences, read_section

FORMAT: Final = "gripper-force-object/1"

BUNDLED: Final = "profile.yaml"
"""Profile in the folder of a bundle, which also holds the network that was taught the object."""

SHIPPED: Final = "gripper_calibration"
"""Package whose folder ``objects`` holds the shipped profiles."""

Forces = Annotated[tuple[Finite, ...], Field(min_length=2)]


class OutputCurve(Section):
    """Piecewise linear curve from the network's estimate to the load cell's force, extrapolated linearly.

    Attributes:
        kind: Type of fit.
        estimate_n: Estimates at the knots, rising.
        force_n: Forces at the knots, never falling.
    """

    kind: Literal["identity", "affine", "monotone"]
    estimate_n: Forces
    force_n: Forces

    @model_validator(mode="after")
    def _rises(self) -> Self:
        if len(self.estimate_n) != len(self.force_n):
            raise ValueError("estimate_n and force_n must have the same length")
        if any(b <= a for a, b in zip(self.estimate_n, self.estimate_n[1:], strict=False)):
            raise ValueError("estimate_n must rise")
        if any(b < a for a, b in zip(self.force_n, self.force_n[1:], strict=False)):
            raise ValueError("force_n must not fall")
        return self

    def at(self, estimate_n: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Returns the forces, (N,), for estimates (N,)."""
        knots_n, force_n = np.array(self.estimate_n, np.float64), np.array(self.force_n, np.float64)
        at_n = np.asarray(estimate_n, np.float64)
        segment = np.clip(np.searchsorted(knots_n, at_n) - 1, 0, len(knots_n) - 2)
        slope = np.diff(force_n) / np.diff(knots_n)
        return force_n[segment] + slope[segment] * (at_n - knots_n[segment])


class Interval(Section):
    """Interval that contains the force with a stated probability.

    Attributes:
        coverage: That probability, over frames of touches that were not calibrated on.
        base_n: Half-width at zero force.
        share: Half-width per newton, added to ``base_n`` as the root of the sum of squares.
    """

    coverage: Annotated[float, Field(gt=0, lt=1)]
    base_n: Positive
    share: NonNegative

    def half_width_n(self, force_n: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Returns the half-width, (N,), for forces (N,)."""
        width: npt.NDArray[np.float64] = np.hypot(self.base_n, self.share * np.asarray(force_n, np.float64))
        return width


class OodLimit(Section):
    """Out-of-distribution limit at one estimated force (see `gripper_force.vision.ood`).

    Attributes:
        force_n: The force.
        typical: Median share of the residual in known frames.
        limit: Highest smoothed ratio to ``typical`` at which a frame is used.
    """

    force_n: Finite
    typical: Positive
    limit: Positive


class LoopPlant(Section):
    """Plant of the force loop with this object (see `gripper_force.control.tuning`), and its PI controller.

    Attributes:
        gain: Contact force per newton of motor force.
        lag_ms: Time constant from motor force to contact force.
        delay_ms: Time from the contact force to an estimate that can be used.
        proportional: Proportional gain of the PI controller by SIMC.
        integral_s: Its integral gain in 1/s.
        phase_margin_deg: Its phase margin.
    """

    gain: Positive
    lag_ms: Positive
    delay_ms: Positive
    proportional: NonNegative
    integral_s: Positive
    phase_margin_deg: Finite


class ObjectProfile(Section):
    """Calibration of one object.

    Attributes:
        object: The object's name.
        date: Date of the calibration.
        checkpoint: SHA-256 of the network's file.
        camera: Settings of camera, view and gripper, by key of the configuration.
        touches: Number of touches of the calibration.
        frames: Number of their frames.
        force_n: Largest force that the object was pressed with and recovered from. The profile holds up to
            it.
        output: Correction of the network's output.
        interval: Interval of the error of the corrected estimate.
        ood_limits: The object's own out-of-distribution limits, in order of rising force; None if the network has no
            score, or in a profile of an earlier version, whose score is no longer used. The network's limits then
            count.
        stiffness_n_m: Stiffness, force over travel of both jaws, at half of the largest force.
        plant: The force loop's plant; None if the logs hold no servo.
        before_n: MAE of the network alone on these touches.
        after_n: MAE of the corrected estimate on each touch, with a correction fitted to the others.
        ratio: Motor current over the corrected estimate in earlier grasps, and its relative standard deviation without
            that of the torque constant (see `gripper_force.control.object_gain`); None if it was not learned.
        weights: SHA-256 of the file beside it.
        network: File beside it with the network, if it is the profile of a bundle (see `BUNDLED`).
        logs: SHA-256 of each log of the touches.
        version: Version of this software that made it; empty in profiles of version 0.1 and in the shipped ones.
        file: Path of the simulated object's file if the profile is that of a bundle; None if the object has none.
    """

    format: Literal["gripper-force-object/1"] = FORMAT
    object: str
    date: date
    checkpoint: str
    camera: Tree
    touches: Annotated[int, Field(ge=1)]
    frames: Annotated[int, Field(ge=1)]
    force_n: Positive
    output: OutputCurve
    interval: Interval
    ood_limits: Annotated[tuple[OodLimit, ...], Field(min_length=1)] | None = None
    stiffness_n_m: Positive | None = None
    plant: LoopPlant | None = None
    before_n: NonNegative
    after_n: NonNegative | None = None
    ratio: tuple[Positive, Positive] | None = None
    weights: str
    network: str | None = None
    logs: tuple[str, ...] = ()
    version: str = ""
    file: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _read_earlier_version(cls, tree: Any) -> Any:
        if isinstance(tree, dict):  # the limits of earlier scores
            return {key: value for key, value in tree.items() if key not in ("gate", "ood_limit")}
        return tree

    def mismatches(self, checkpoint: str, rig: Tree) -> list[str]:
        """Returns the differences between the calibration and a run, as text.

        Args:
            checkpoint: SHA-256 of the run's network.
            rig: The run's `Config.rig_settings`; missing keys are not compared.
        """
        settings = {"network": self.checkpoint[:12], **self.camera}
        return differences(settings, {"network": checkpoint[:12], **rig})


def weights_path(path: Path) -> Path:
    """Returns the path of the safetensors file beside a profile."""
    return path.with_suffix(".safetensors")


def read_object(path: Path) -> ObjectProfile:
    """Reads an object profile. Raises `ConfigError` if the file is missing or invalid."""
    return read_section(ObjectProfile, path, FORMAT, "object profile")


def user_folder() -> Path:
    """Returns the folder of the user's profiles. Raises `ConfigError` if there is none."""
    return xdg_folder("XDG_DATA_HOME", ".local/share") / "objects"


def find_object(name: str) -> Path:
    """Returns the path of an object profile. The user's profiles come before the shipped ones.

    Args:
        name: A name such as ``sponge``, or the path of a bundle, or one that ends in ``.yaml``.

    Raises:
        ConfigError: No profile has that name.
    """
    if name.endswith(".yaml"):
        return Path(name)
    if (bundle := (Path(name) if "/" in name else user_folder() / name) / BUNDLED).is_file():
        return bundle
    with as_file(files(SHIPPED) / "objects") as shipped:
        folders = (user_folder(), shipped)
        for folder in folders:
            if (path := folder / f"{name}.yaml").is_file():
                return path
        known = sorted({path.stem for folder in folders for path in folder.glob("*.yaml")})
    raise ConfigError(
        f"no object profile {name!r}; known: {', '.join(known) or 'none'}; make one with "
        f"`gripper-force calibrate object {name}`"
    )
