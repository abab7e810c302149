"""Rig profile: calibration of one rig by `gripper-force calibrate load-cell`, `servo` and `camera`."""

from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, AwareDatetime, Field, PositiveInt, model_validator

from gripper_force.errors import ConfigError
from gripper_force.schema import Finite, NonNegative, Positive, Section, Tree, read_section

FORMAT: Final = "gripper-force-rig/1"

_GAIN_DRIFT: Final = 0.02
"""Relative drift of the torque constant: neodymium magnets lose 0.11 % per kelvin, and a motor under load
warms by 20 K and more."""

FRICTION_DRIFT: Final = 0.1
"""Relative variation of friction with grease, wear and position on the rack: an assumption."""

NORMAL: Final = 1.96
"""Half-width of a 95 % interval in standard deviations."""


def _in_order(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1] or bounds[1] == 0:
        raise ValueError("the second value must be above 0, and not below the first; calibrate again")
    return bounds


Range = Annotated[tuple[NonNegative, NonNegative], AfterValidator(_in_order)]


class CalibratedValue(Section):
    """A calibrated value and its 95 % confidence interval; no interval if it was given, not measured."""

    value: Finite
    low: Finite | None = None
    high: Finite | None = None

    @model_validator(mode="after")
    def _is_in_order(self) -> Self:
        if (self.low is None) != (self.high is None):
            raise ValueError("low and high must be given together")
        if self.low is not None and self.high is not None and not self.low <= self.value <= self.high:
            raise ValueError(f"value {self.value:g} must lie between low and high")
        return self

    @property
    def half(self) -> float:
        """Half of the interval's width; 0 if the value was given."""
        return 0.0 if self.low is None or self.high is None else (self.high - self.low) / 2


def _positive(calibrated: CalibratedValue) -> CalibratedValue:
    if calibrated.value <= 0:
        raise ValueError("value must be above 0; calibrate again")
    return calibrated


PositiveValue = Annotated[CalibratedValue, AfterValidator(_positive)]


class LoadCellCalibration(Section):
    """Tare and scale of a load cell.

    Attributes:
        date: Date of the calibration.
        sensor: Backend and, for a serial one, format. They determine the unit of the raw readings.
        tare_raw: Reading without load.
        n_per_raw: Newtons per unit of the reading.
        force_n: Least and greatest calibrated force.
        noise_n: Standard deviation of samples under a constant load.
        drift_n_min: Drift without load, per minute.
    """

    date: AwareDatetime
    sensor: str
    tare_raw: CalibratedValue
    n_per_raw: CalibratedValue
    force_n: Range
    noise_n: NonNegative
    drift_n_min: CalibratedValue

    @model_validator(mode="after")
    def _has_a_scale(self) -> Self:
        if self.n_per_raw.value == 0:
            raise ValueError("n_per_raw is 0: each force would be 0; calibrate the load cell again")
        return self


class ServoCalibration(Section):
    """Torque and friction of a servo, and the geometry of the jaws.

    Attributes:
        date: Date of the calibration.
        model: The servo's model.
        nm_per_a: Torque constant at the horn.
        friction_n: Coulomb friction at each jaw.
        damping_n_s_m: Viscous friction at each jaw.
        pinion_radius_m: Pitch radius of the pinion, measured with gauges of two widths.
        open_position_rad: Servo angle at the width ``open_width_m``.
        open_width_m: Distance between the jaws at that angle.
        force_n: Least and greatest calibrated force.
        speed_m_s: Least and greatest calibrated speed of one jaw.
        residual_n: Root mean square of the fit's residuals.
    """

    date: AwareDatetime
    model: str
    nm_per_a: PositiveValue
    friction_n: CalibratedValue
    damping_n_s_m: CalibratedValue
    pinion_radius_m: PositiveValue
    open_position_rad: CalibratedValue
    open_width_m: Positive
    force_n: Range
    speed_m_s: Range
    residual_n: NonNegative


class CameraCalibration(Section):
    """Exposure, region of interest and delay of a camera.

    Attributes:
        date: Date of the calibration.
        backend: The camera's backend.
        side_px: Side of the frames.
        rate_hz: Frame rate.
        gain: Sensitivity of the sensor, as ``camera.gain``.
        image: The other keys of the camera on which its images depend; none in profiles of version 0.1.
        exposure_us: Exposure at which the image is neither dark nor clipped; None for an automatic one.
        mean: Mean gray value at that exposure.
        clipped: Share of clipped pixels at that exposure.
        region: Region of interest of the frame: left, top, width, height in pixels.
        markers: True if the region was found by markers on the jaws.
        lag_ms: Delay of the camera's timestamps against the load cell's.
        delay_ms: Time from the contact force to an estimate that can be used: from exposure to use, plus half
            a frame period.
        reference: File beside the profile with an image of the open jaws.
    """

    date: AwareDatetime
    backend: str
    side_px: int
    rate_hz: Positive
    gain: int | None
    image: dict[str, Any] = Field({})
    exposure_us: PositiveInt | None
    mean: NonNegative
    clipped: NonNegative
    region: tuple[int, int, int, int]
    markers: bool
    lag_ms: CalibratedValue
    delay_ms: PositiveValue
    reference: str

    def mismatches(self, camera: Tree) -> list[str]:
        """Returns the differences between the calibration and a run's section ``camera``, as text."""
        keys = {"backend", "side_px", "rate_hz", "gain", "exposure_us"}
        settings = {**self.model_dump(mode="json", include=keys), **self.image}
        different = [(key, value) for key, value in settings.items() if value != camera.get(key)]
        return [f"camera.{key} {value}, not {camera.get(key)}" for key, value in different]


class RigProfile(Section):
    """Calibration of one rig. The section of a part that was not calibrated is None."""

    format: Literal["gripper-force-rig/1"] = FORMAT
    load_cell: LoadCellCalibration | None = None
    servo: ServoCalibration | None = None
    camera: CameraCalibration | None = None

    def settings(self) -> Tree:
        """Returns the configuration keys that the profile sets, and their values."""
        tree: Tree = {}
        if (cell := self.load_cell) is not None:
            tree["load_cell"] = {"tare_raw": cell.tare_raw.value, "n_per_raw": cell.n_per_raw.value}
        if (servo := self.servo) is not None:
            tree["gripper"] = {
                **torque_settings(servo.nm_per_a, servo.friction_n),
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
        """Returns the differences between the profile's devices and a run's, as text.

        Args:
            model: The run's servo model.
            sensor: The run's load cell. One without raw readings is not compared.
            camera: The run's section ``camera``. Without a camera it is not compared.
        """
        differ = []
        if self.servo is not None and self.servo.model != model:
            differ.append(f"servo {self.servo.model}, not {model}")
        real = sensor not in ("none", "simulated", "playback")
        if self.load_cell is not None and real and self.load_cell.sensor != sensor:
            differ.append(f"load cell {self.load_cell.sensor}, not {sensor}")
        if self.camera is not None and camera["backend"] != "none":
            differ += self.camera.mismatches(camera)
        return differ


def torque_settings(nm_per_a: CalibratedValue, friction_n: CalibratedValue) -> Tree:
    """Returns the keys of the section `gripper` that follow from a torque constant and the friction at each jaw."""
    return {
        "nm_per_a": nm_per_a.value,
        "friction_n": max(friction_n.value, 0.0),
        "friction_std": _std(friction_n, FRICTION_DRIFT),
        "gain_std": _std(nm_per_a, _GAIN_DRIFT),
    }


def _std(estimate: CalibratedValue, drift: float) -> float:
    """Returns the relative standard deviation in use: the interval's, but at least the drift."""
    share = estimate.half / (NORMAL * abs(estimate.value)) if estimate.value else 0.0
    return min(max(share, drift), 1.0)


def read_rig(path: Path) -> RigProfile:
    """Reads a rig profile. Raises `ConfigError` if the file is missing or invalid."""
    if not path.exists():
        raise ConfigError(
            f"there is no rig profile {path} yet; `calibrate load-cell` or `calibrate servo` writes it"
        )
    return read_section(RigProfile, path, FORMAT, "rig profile")
