"""The rig profile: what `gripper-force calibrate load-cell`, `servo` and `camera` found of one rig."""

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import AwareDatetime, Field, model_validator

from gripper_force.schema import (
    Finite,
    NonNegative,
    Positive,
    Section,
    Tree,
    dump,
    read_section,
    write_all,
)

FORMAT: Final = "gripper-force-rig/1"

_GAIN_DRIFT: Final = 0.02
"""A magnet of neodymium gives 0.11 % less a kelvin, and a motor that works warms by 20 K and more."""

_FRICTION_DRIFT: Final = 0.1
"""What grease, wear and the place on the rack make of friction, as a share of it: an assumption."""

_NORMAL: Final = 1.96
"""Half of a 95 % interval in standard deviations."""

Range = Annotated[tuple[NonNegative, NonNegative], Field(description="least and most")]


class CalibratedValue(Section):
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

    @property
    def half(self) -> float:
        """Half of the interval's width; 0 where the value was given."""
        return 0.0 if self.low is None or self.high is None else (self.high - self.low) / 2


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
    tare_raw: CalibratedValue
    n_per_raw: CalibratedValue
    force_n: Range
    noise_n: NonNegative
    drift_n_min: CalibratedValue


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
    nm_per_a: CalibratedValue
    friction_n: CalibratedValue
    damping_n_s_m: CalibratedValue
    pinion_radius_m: CalibratedValue
    open_position_rad: CalibratedValue
    open_width_m: Positive
    force_n: Range
    speed_m_s: Range
    residual_n: NonNegative


class CameraCalibration(Section):
    """How a camera sees the jaws, and when.

    Attributes:
        date: When it was calibrated.
        backend: The camera's backend.
        side_px: Side of its frames.
        rate_hz: Its frame rate.
        gain: Its gain.
        exposure_us: The exposure at which the picture is neither dark nor clipped.
        mean: Mean gray value there.
        clipped: Share of clipped pixels there.
        region: Region of interest of the frame: left, top, width, height in pixels.
        markers: Whether markers on the jaws told the region.
        lag_ms: Time by which its timestamps are late against the load cell's.
        delay_ms: From the contact force to an estimate that can be used: exposure to use, and half a frame.
        reference: File beside the profile with the picture of open jaws.
    """

    date: AwareDatetime
    backend: str
    side_px: int
    rate_hz: Positive
    gain: int | None
    exposure_us: int
    mean: NonNegative
    clipped: NonNegative
    region: tuple[int, int, int, int]
    markers: bool
    lag_ms: CalibratedValue
    delay_ms: CalibratedValue
    reference: str

    def mismatches(self, camera: Tree) -> list[str]:
        """What differs between the calibration and a run's section ``camera``, in words."""
        mine = self.model_dump(mode="json")
        keys = ("backend", "side_px", "rate_hz", "gain", "exposure_us")
        return [f"camera.{key} {mine[key]}, not {camera[key]}" for key in keys if mine[key] != camera[key]]


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
                "friction_n": max(servo.friction_n.value, 0.0),
                "friction_std": _std(servo.friction_n, _FRICTION_DRIFT),
                "gain_std": _std(servo.nm_per_a, _GAIN_DRIFT),
                "damping_n_s_m": max(servo.damping_n_s_m.value, 0.0),
                "pinion_radius_m": servo.pinion_radius_m.value,
                "open_position_rad": servo.open_position_rad.value,
                "open_width_m": servo.open_width_m,
            }
        if (camera := self.camera) is not None:
            tree["camera"] = {"exposure_us": camera.exposure_us}
            tree["vision"] = {"region": list(camera.region)}
            tree["control"] = {"plant_delay_ms": camera.delay_ms.value}
        return tree

    def mismatches(self, model: str, sensor: str, camera: Tree) -> list[str]:
        """What a run has otherwise than the profile, in words.

        Args:
            model: The run's servo.
            sensor: Its load cell; one without raw readings is never another.
            camera: Its section ``camera``; a run without a camera has no other.
        """
        differ = []
        if self.servo is not None and self.servo.model != model:
            differ.append(f"a servo {self.servo.model}, and this one is {model}")
        real = sensor not in ("none", "simulated", "playback")
        if self.load_cell is not None and real and self.load_cell.sensor != sensor:
            differ.append(f"a load cell {self.load_cell.sensor}, and this one is {sensor}")
        if self.camera is not None and camera["backend"] != "none":
            differ += self.camera.mismatches(camera)
        return differ


def _std(estimate: CalibratedValue, drift: float) -> float:
    """Standard deviation in use, as a share of the value: the interval's, and at least what it drifts by."""
    share = estimate.half / (_NORMAL * abs(estimate.value)) if estimate.value else 0.0
    return min(max(share, drift), 1.0)


def read_rig(path: Path) -> RigProfile:
    """Reads a rig profile. Raises `ConfigError` that names the file and what is wrong with it."""
    return read_section(RigProfile, path, FORMAT, "rig profile")


def update_rig(path: Path, section: LoadCellCalibration | ServoCalibration | CameraCalibration) -> RigProfile:
    """Replaces one section of a rig profile, or begins one, and writes it.

    Raises:
        ConfigError: The file is there and no rig profile, or it can't be written.
    """
    profile = read_rig(path) if path.exists() else RigProfile()
    names = {LoadCellCalibration: "load_cell", ServoCalibration: "servo", CameraCalibration: "camera"}
    profile = profile.model_copy(update={names[type(section)]: section})
    write_all({path: dump(profile).encode()})
    return profile
