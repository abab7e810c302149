"""The rig profile: what `gripper-force calibrate load-cell`, `servo` and `camera` found of one rig."""

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import AwareDatetime, Field, model_validator

from gripper_force.errors import ConfigError
from gripper_force.schema import (
    Finite,
    NonNegative,
    Positive,
    Section,
    Tree,
    dump,
    read_tree,
    validated,
)

FORMAT: Final = "gripper-force-rig/1"

Range = Annotated[tuple[NonNegative, NonNegative], Field(description="least and most")]


class Estimate(Section):
    """A calibrated value and its 95 % confidence interval; without one, the value was given, not measured."""

    value: Finite
    low: Finite | None = None
    high: Finite | None = None

    @model_validator(mode="after")
    def _is_in_order(self) -> Self:
        if (self.low is None) != (self.high is None):
            raise ValueError("low and high go together")
        if self.low is not None and self.high is not None and not self.low <= self.value <= self.high:
            raise ValueError(f"the value {self.value:g} must lie between low and high")
        return self


class LoadCellCalibration(Section):
    """A load cell's tare and scale.

    Attributes:
        date: When it was calibrated.
        sensor: Backend and, of a serial one, format: the raw readings' unit goes with them.
        tare_raw: Reading without load.
        n_per_raw: Newtons for one unit of the reading.
        force_n: Forces it holds for.
        noise_n: Standard deviation of a sample under a load that rests.
        drift_n_min: Drift without load, a minute.
    """

    date: AwareDatetime
    sensor: str
    tare_raw: Estimate
    n_per_raw: Estimate
    force_n: Range
    noise_n: NonNegative
    drift_n_min: Estimate


class ServoCalibration(Section):
    """A servo's torque, its friction, and the jaws' geometry.

    Attributes:
        date: When it was calibrated.
        model: The servo's model.
        nm_per_a: Torque constant at the horn.
        friction_n: Coulomb friction at each jaw.
        damping_n_s_m: Viscous friction at each jaw.
        pinion_radius_m: Pitch radius of the pinion, measured where gauges of two widths were pressed.
        open_position_rad: Servo angle with the jaws open by `open_width_m`.
        open_width_m: Distance between the jaws there.
        force_n: Forces it holds for.
        speed_m_s: Speeds of one jaw that it holds for.
        residual_n: Root mean square of what the fit leaves of the forces.
    """

    date: AwareDatetime
    model: str
    nm_per_a: Estimate
    friction_n: Estimate
    damping_n_s_m: Estimate
    pinion_radius_m: Estimate
    open_position_rad: Estimate
    open_width_m: Positive
    force_n: Range
    speed_m_s: Range
    residual_n: NonNegative


class CameraCalibration(Section):
    """What is known of the camera.

    Attributes:
        date: When it was calibrated.
    """

    date: AwareDatetime


class RigProfile(Section):
    """What is known of one rig; a section is there once its part was calibrated."""

    format: Literal["gripper-force-rig/1"] = FORMAT
    load_cell: LoadCellCalibration | None = None
    servo: ServoCalibration | None = None
    camera: CameraCalibration | None = None

    def settings(self) -> Tree:
        """The configuration keys that it sets."""
        tree: Tree = {}
        if (cell := self.load_cell) is not None:
            tree["load_cell"] = {"tare_raw": cell.tare_raw.value, "n_per_raw": cell.n_per_raw.value}
        if (servo := self.servo) is not None:
            tree["gripper"] = {
                "nm_per_a": servo.nm_per_a.value,
                "friction_n": servo.friction_n.value,
                "damping_n_s_m": servo.damping_n_s_m.value,
                "pinion_radius_m": servo.pinion_radius_m.value,
                "open_position_rad": servo.open_position_rad.value,
                "open_width_m": servo.open_width_m,
            }
        return tree


def read_rig(path: Path) -> RigProfile:
    """Reads a rig profile. Raises `ConfigError` that names the file and what is wrong with it."""
    tree = read_tree(path, "rig profile")
    if tree.get("format") != FORMAT:
        raise ConfigError(
            f"{path} is no rig profile of format {FORMAT}, it says {tree.get('format')!r}; make one with "
            "`gripper-force calibrate`"
        )
    return validated(RigProfile, tree, str(path), "rig profile")


def update_rig(path: Path, section: LoadCellCalibration | ServoCalibration | CameraCalibration) -> RigProfile:
    """Replaces one section of a rig profile, or begins one, and writes it.

    Raises:
        ConfigError: The file is there and no rig profile, or it can't be written.
    """
    profile = read_rig(path) if path.exists() else RigProfile()
    names = {LoadCellCalibration: "load_cell", ServoCalibration: "servo", CameraCalibration: "camera"}
    profile = profile.model_copy(update={names[type(section)]: section})
    unfinished = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.write_text(dump(profile), encoding="utf-8")
        unfinished.replace(path)
    except OSError as error:
        raise ConfigError(f"can't write the rig profile {path}: {error}") from error
    return profile
