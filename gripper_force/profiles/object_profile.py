"""The object profile: what `gripper-force calibrate object` found of one object, for one camera and network.

A profile is a YAML file, with a safetensors file of the same name beside it for what is too long to read.
`gripper_force.profiles.correction` applies it to the network's estimates.
"""

import os
from datetime import date
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from gripper_force.errors import ConfigError
from gripper_force.schema import Finite, NonNegative, Positive, Section, dump, read_section, write_all

FORMAT: Final = "gripper-force-object/1"

SHIPPED: Final = "gripper_calibration"
"""Package whose folder ``objects`` has the profiles that are shipped."""

Forces = Annotated[tuple[Finite, ...], Field(min_length=2)]


class OutputCurve(Section):
    """What the network says, and what the load cell says then; straight in between, and on beyond the ends.

    Attributes:
        kind: How it was found.
        estimate_n: Estimates, rising.
        force_n: Forces, never falling.
    """

    kind: Literal["identity", "affine", "monotone"]
    estimate_n: Forces
    force_n: Forces

    @model_validator(mode="after")
    def _rises(self) -> Self:
        if len(self.estimate_n) != len(self.force_n):
            raise ValueError("estimate_n and force_n must be of one length")
        if any(b <= a for a, b in zip(self.estimate_n, self.estimate_n[1:], strict=False)):
            raise ValueError("estimate_n must rise")
        if any(b < a for a, b in zip(self.force_n, self.force_n[1:], strict=False)):
            raise ValueError("force_n must not fall")
        return self


class Interval(Section):
    """How far off an estimate is at most, with a stated probability.

    Attributes:
        coverage: That probability, over frames of touches that were not calibrated on.
        base_n: Half-width at no force.
        share: What is added with the force, as the root of the sum of squares: half-width per newton.
    """

    coverage: Annotated[float, Field(gt=0, lt=1)]
    base_n: Positive
    share: NonNegative

    def half_width_n(self, force_n: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Half-width about forces, (N,)."""
        width: npt.NDArray[np.float64] = np.hypot(self.base_n, self.share * np.asarray(force_n, np.float64))
        return width


class LoopPlant(Section):
    """The force loop's plant with this object, as `gripper_force.control.tuning` has it, and what follows.

    Attributes:
        gain: Newtons at the contact for one of the motor's push.
        lag_ms: From the motor's push to the contact force.
        delay_ms: From the contact force to an estimate that can be used.
        proportional: Gain of a PI controller by SIMC.
        integral_s: Its integral gain, a second.
        phase_margin_deg: Phase that it leaves.
    """

    gain: Positive
    lag_ms: Positive
    delay_ms: Positive
    proportional: NonNegative
    integral_s: Positive
    phase_margin_deg: Finite


class ObjectProfile(Section):
    """What is known of one object.

    Attributes:
        object: Its name.
        date: When it was calibrated.
        checkpoint: SHA-256 of the network's file.
        camera: The camera's settings, by key of the configuration.
        touches: Touches it was calibrated on.
        frames: Their frames.
        force_n: Largest force that the object was pressed with and sprang back from. It holds up to there.
        output: Correction of the network's output.
        interval: How far off it is at most.
        ood_limit: Highest out-of-distribution score at which an estimate is used, 0 to 1 (see
            `gripper_force.profiles.correction`). Version 0.1 called it ``gate``.
        stiffness_n_m: Force over travel of both jaws, at half of the largest force.
        plant: The force loop's plant; None where the logs hold no servo.
        before_n: MAE of the network alone on these touches.
        after_n: MAE of the corrected estimate on each touch, corrected by all others.
        weights: SHA-256 of the file beside it.
    """

    format: Literal["gripper-force-object/1"] = FORMAT
    object: str
    date: date
    checkpoint: str
    camera: dict[str, Any]
    touches: Annotated[int, Field(ge=1)]
    frames: Annotated[int, Field(ge=1)]
    force_n: Positive
    output: OutputCurve
    interval: Interval
    ood_limit: Positive
    stiffness_n_m: Positive | None = None
    plant: LoopPlant | None = None
    before_n: NonNegative
    after_n: NonNegative | None = None
    weights: str

    @model_validator(mode="before")
    @classmethod
    def _read_version_0_1(cls, tree: Any) -> Any:
        if isinstance(tree, dict) and "gate" in tree and "ood_limit" not in tree:
            return {("ood_limit" if key == "gate" else key): value for key, value in tree.items()}
        return tree

    def mismatches(self, checkpoint: str, camera: dict[str, Any]) -> list[str]:
        """What differs between the calibration and a run, in words."""
        differ = []
        if checkpoint != self.checkpoint:
            differ.append(f"network {self.checkpoint[:12]}, not {checkpoint[:12]}")
        for key, value in self.camera.items():
            if key in camera and camera[key] != value:
                differ.append(f"{key} {value}, not {camera[key]}")
        return differ


def weights_path(path: Path) -> Path:
    """The file beside a profile."""
    return path.with_suffix(".safetensors")


def read_object(path: Path) -> ObjectProfile:
    """Reads an object profile. Raises `ConfigError` that names the file and what is wrong with it."""
    return read_section(ObjectProfile, path, FORMAT, "object profile")


def check_place(path: Path) -> None:
    """Makes a profile's folder. Raises `ConfigError` where none can be written to that path."""
    if path.suffix != ".yaml":
        raise ConfigError(f"an object profile is a file that ends in .yaml, and {path} does not")
    place = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        place.touch()
        place.unlink()
    except OSError as error:
        raise ConfigError(f"can't write {path}: {error.strerror}, {error.filename}") from error


def write_object(path: Path, profile: ObjectProfile, weights: bytes) -> None:
    """Writes an object profile and the file beside it. Raises `ConfigError` where it can't."""
    write_all({weights_path(path): weights, path: dump(profile).encode()})


def user_folder() -> Path:
    """Where a user's own profiles are (https://specifications.freedesktop.org/basedir-spec/latest/)."""
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share"
    return Path(base) / "gripper-force" / "objects"


def find_object(name: str) -> Path:
    """The profile of that name, one's own before one that is shipped, or at that path.

    Args:
        name: A name such as ``sponge``, or a path that ends in ``.yaml``.

    Raises:
        ConfigError: There is none of that name. The sentence names those there are.
    """
    if name.endswith(".yaml"):
        return Path(name)
    with as_file(files(SHIPPED) / "objects") as shipped:
        folders = (user_folder(), shipped)
        for folder in folders:
            if (path := folder / f"{name}.yaml").is_file():
                return path
        known = sorted({path.stem for folder in folders for path in folder.glob("*.yaml")})
    raise ConfigError(
        f"no object profile {name!r}; there are {', '.join(known) or 'none'}; make one with "
        f"`gripper-force calibrate object {name}`"
    )
