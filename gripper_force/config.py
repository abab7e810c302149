"""Configuration of a run: every key with its type, default and description, and how it is loaded."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import Field, PositiveInt, field_validator, model_validator

from gripper_force.errors import ConfigError
from gripper_force.fault_config import FaultConfig
from gripper_force.profiles.rig_profile import read_rig
from gripper_force.schema import (
    Finite,
    NonNegative,
    Positive,
    Section,
    Tree,
    as_path,
    assign,
    assign_value,
    check_keys,
    dump,
    merged,
    read_tree,
    tree_from,
    validated,
)

HARD_FORCE_LIMIT_N: Final = 70.0
"""Upper bound of control.force_limit_n: the lowest limit that is quoted for a clamped finger."""

VIRTUAL_PREFIX: Final = "virtual:"
"""Prefix of a servo.port that names a simulated bus in this process."""

_BACKEND: Final = "or package.module:Class, or a name that an installed package registers"


class SecondServoConfig(Section):
    """The servo of the second finger, of the same model and on the same bus as the first one's."""

    id: int | None = Field(
        None, ge=0, le=252, description="id of the second finger's servo; null: one servo drives both jaws"
    )
    mirrored: bool = Field(
        True, description="true if it turns the other way than the first servo while the jaws close"
    )
    offset_rad: Finite = Field(
        0.0,
        description="angle of the second servo when the first is at 0 rad and both fingers are equally far open; if "
        "they differ at the start, the error names the value to set",
    )
    max_difference_rad: Positive = Field(
        0.5,
        description="difference between the closing angles of the fingers above which the run ends as a fault; "
        "a run starts within half of it",
    )


class ServoConfig(Section):
    """The servo and its bus."""

    backend: str = Field("dynamixel", description=f"dynamixel, {_BACKEND} (gripper_force.servos)")
    options: Tree = Field({}, description="keys of a third-party servo backend")
    model: str = Field(
        "XM430-W350",
        description="model, e.g. XM430-W350 or XC330-T288-T, or the path of a YAML file (page Servos)",
    )
    port: str = Field("virtual:rig", description="device path; virtual:NAME: a simulated bus in this process")
    id: int = Field(1, ge=0, le=252, description="id of the servo on the bus")
    baud_rate: int = Field(1_000_000, gt=0, description="bits per second")
    current_limit_a: Positive = Field(1.2, description="Current Limit register of the servo")
    bus_watchdog_ms: int = Field(
        40, ge=20, le=2540, description="time without bus traffic after which the servo stops by itself"
    )
    retries: int = Field(2, ge=0, le=10, description="retries after a timeout or a corrupt reply")
    reply_margin_ms: Positive = Field(3.0, description="how late a reply may be before a retry")
    homing_offset: int = Field(
        0,
        ge=-1_044_479,
        le=1_044_479,
        description="Homing Offset register in ticks, for which gripper.open_position_rad was found; a servo "
        "with another one is refused",
    )
    second: SecondServoConfig = SecondServoConfig()

    @model_validator(mode="after")
    def _check_ids(self) -> Self:
        if self.second.id == self.id:
            raise ValueError(f"second.id {self.id} is servo.id, too; give each servo its own id")
        return self

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the gripper's servos: one, or one for each finger."""
        return (self.id,) if self.second.id is None else (self.id, self.second.id)

    @property
    def is_virtual(self) -> bool:
        """True if the servo is simulated in this process."""
        return self.backend == "dynamixel" and self.port.startswith(VIRTUAL_PREFIX)


class LinkageConfig(Section):
    """Geometry between the servo's horn and the jaws. Closing angles are from the open jaws."""

    kind: Literal["rack", "crank_slider", "four_bar", "finger", "fingers", "table"] = Field(
        "rack",
        description="rack: one pinion, two racks; crank_slider: two rods on one crank disc; four_bar: fingers "
        "on the rockers; finger: one finger on the horn, against a fixed one; fingers: two such fingers, on "
        "geared horns or on two servos; table: measured",
    )
    crank_m: Positive | None = Field(None, description="crank_slider, four_bar: length of the crank")
    rod_m: Positive | None = Field(None, description="crank_slider, four_bar: length of the rod or coupler")
    offset_m: Finite = Field(0.0, description="crank_slider: distance of the rail from the crank's axis")
    rocker_m: Positive | None = Field(None, description="four_bar: length of the rocker")
    base_m: Positive | None = Field(None, description="four_bar: distance between the two fixed pivots")
    finger_m: Positive | None = Field(
        None, description="four_bar, finger, fingers: distance from a finger's pivot to its tip"
    )
    open_crank_rad: Finite = Field(
        0.0,
        description="crank angle with open jaws; crank_slider: from the perpendicular of the rail, four_bar: "
        "from the base line",
    )
    open_finger_rad: Finite = Field(
        0.0,
        description="four_bar, finger, fingers: angle of an open finger from the direction in which it points "
        "closed",
    )
    table: tuple[tuple[Finite, Finite], ...] = Field(
        (), description="table: rows of closing angle (rad) and width (m), from the open jaws on"
    )


class GripperConfig(Section):
    """Transmission from the servo to the jaws."""

    linkage: LinkageConfig = Field(LinkageConfig(), description="geometry (page Grippers)")
    pinion_radius_m: Positive = Field(0.020, description="rack: travel of one jaw per radian of the servo")
    closing_sign: Literal[-1, 1] = Field(1, description="-1 if a falling servo position closes the jaws")
    open_position_rad: Finite = Field(0.0, description="servo angle with open jaws")
    open_width_m: Positive = Field(0.092, description="distance between the open jaws")
    nm_per_a: Positive | None = Field(
        None,
        description="torque constant at the horn, of both servos together if there are two; null: value of the "
        "servo model",
    )
    current_step_a: Positive | None = Field(
        None, description="resolution of the goal current; null: value of the servo model"
    )
    position_loop_a_per_rad: Positive | None = Field(
        None, description="motor current per radian of position error; null: value of the servo model"
    )
    position_loop_gain_per_s: Positive | None = Field(
        None, description="servo's position loop: no-load speed per radian of error; null: that of the model"
    )
    friction_n: NonNegative = Field(0.95, description="Coulomb friction of one jaw while closing")
    damping_n_s_m: NonNegative = Field(14.5, description="viscous friction of one jaw, including the motor")
    friction_std: NonNegative = Field(
        0.25, description="relative standard deviation of the true friction from friction_n"
    )
    gain_std: NonNegative = Field(
        0.06,
        description="relative standard deviation of the true torque constant from nm_per_a (uniform within "
        "+-10 % is 0.058)",
    )
    gain_bound: float = Field(
        1.4,
        ge=1.0,
        le=3.0,
        description="largest ratio of the true torque constant to nm_per_a that the force limit must allow for; 1.1 "
        "is enough after calibrate servo",
    )
    position_bound_rad: NonNegative = Field(
        0.5,
        description="with a linkage: largest error of open_position_rad that the limits of force and speed must allow "
        "for; calibrate jaws proposes a smaller one",
    )


class CameraConfig(Section):
    """The camera."""

    backend: str = Field(
        "simulated", description=f"simulated, oak, uvc, playback, none, {_BACKEND} (gripper_force.cameras)"
    )
    options: Tree = Field({}, description="keys of a third-party camera backend")
    rate_hz: float = Field(60.0, ge=0.1, le=1000, description="requested frames per second")
    path: Path | None = Field(None, description="playback: the log to play")
    speed: Literal["recorded", "full"] = Field(
        "recorded", description="playback: recorded: at the recorded pace; full: one frame per call"
    )
    device: int | str | None = Field(
        None, description="oak: id or address (null: the only one); uvc: index, /dev path or name"
    )
    sensor: str | None = Field(
        None,
        description="oak: socket (CAM_B) or name (OV7251); null: the mono sensor on the lowest socket, else the "
        "colour sensor there",
    )
    resolution_px: tuple[PositiveInt, PositiveInt] | None = Field(
        None,
        description="width and height of the sensor image; oak: a mode of the sensor (null: its largest of at "
        "most 1280x800 that reaches rate_hz); uvc: null: 640x480, if available",
    )
    fourcc: str | None = Field(
        None,
        pattern="^[ -~]{4}$",
        description="uvc: pixel format, e.g. MJPG, which most webcams need for 60 frames per second, or YUYV; "
        "null: chosen by OpenCV",
    )
    region: tuple[int, int, int, int] | None = Field(
        None,
        description="oak, uvc: region of the sensor image as left, top, width, height in pixels; its central "
        "square becomes the frame (vision.region is a region of that frame)",
    )
    side_px: int = Field(128, ge=16, le=800, description="oak, uvc: side of the square frame")
    exposure_us: int | None = Field(
        4000, gt=0, description="exposure time; null: automatic (simulated camera: as 4000)"
    )
    gain: int | None = Field(
        None,
        ge=0,
        description="sensitivity; oak: ISO (null: 100); uvc: in the driver's unit (null: unchanged); needs exposure_us",
    )
    lens_position: int | None = Field(
        None,
        ge=0,
        description="focus of a lens with autofocus, which is off; larger is nearer; oak: 0 to 255, needed by "
        "such a lens; uvc: in the driver's unit (null: unchanged)",
    )
    white_balance_k: int | None = Field(
        None,
        ge=1000,
        le=12_000,
        description="colour temperature of the white balance of a colour camera, which is not automatic; oak: "
        "null: 5000; uvc: null: unchanged",
    )
    timeout_ms: Positive | None = Field(
        None,
        description="oak, uvc: age of the newest frame after which the camera counts as lost; null: 250, or four frame "
        "periods if they are longer",
    )

    @model_validator(mode="after")
    def _check_lens(self) -> Self:
        if self.backend == "oak" and (self.lens_position or 0) > 255:
            raise ValueError(f"lens_position {self.lens_position} is above 255, the nearest focus of an OAK")
        return self


CAMERA_OTHER_KEYS: Final = {"options", "path", "speed", "device", "timeout_ms"}
"""Keys of the camera that do not change its images."""


class LoadCellConfig(Section):
    """The load cell: a force reference for calibration and checks."""

    backend: str = Field(
        "simulated",
        description=f"simulated, playback, serial, phidget, none, {_BACKEND} (gripper_force.load_cells)",
    )
    options: Tree = Field({}, description="keys of a third-party load cell backend")
    rate_hz: float = Field(
        200.0,
        ge=0.1,
        le=10_000,
        description="simulated, phidget (at most 122): samples per second; serial boards set their own",
    )
    port: str | None = Field(None, description="serial: device path")
    baud_rate: int = Field(115_200, gt=0, le=4_500_000, description="serial: bits per second")
    format: Literal["hx711", "cas"] = Field(
        "hx711", description="serial: counts of an HX711 board, or frames of a CAS weighing indicator"
    )
    channel: int = Field(0, ge=0, le=3, description="phidget: bridge input")
    tare_raw: Finite = Field(0.0, description="raw reading without load: counts, kg, or V/V")
    n_per_raw: Finite | None = Field(
        None,
        description="newtons per unit of the raw reading; null: 9.80665 for an indicator in kg; any other "
        "load cell is then uncalibrated and its samples are invalid",
    )
    path: Path | None = Field(None, description="playback: the log to play")
    speed: Literal["recorded", "full"] = Field(
        "recorded", description="playback: recorded: at the recorded pace; full: all samples at once"
    )

    @field_validator("n_per_raw")
    @classmethod
    def _is_a_scale(cls, n_per_raw: float | None) -> float | None:
        if n_per_raw == 0:
            raise ValueError("0 would make each force 0 N")
        return n_per_raw

    @property
    def sensor(self) -> str:
        """Sensor type that the raw unit belongs to: the backend, plus the format of a serial one."""
        return f"{self.backend} {self.format}" if self.backend == "serial" else self.backend


MAX_COVERED: Final = 0.15
"""Default of ``vision.max_covered``. Flat jaws cover up to 0.125 in simulation, the widest drawn ones 0.16."""


class VisionConfig(Section):
    """The force estimator and its input."""

    checkpoint: str = Field(
        "default",
        description="path of a checkpoint or of a file made by `gripper-force export network`; default or small "
        "(shipped); none; or auto: the cheapest shipped one within `budget`",
    )
    engine: str = Field(
        "onnxruntime",
        description="onnxruntime, openvino, torch; auto: the fastest one installed, with the best number of "
        f"threads, measured once per machine; {_BACKEND} (gripper_force.engines)",
    )
    precision: Literal["float32", "bfloat16"] = Field(
        "float32", description="arithmetic precision; bfloat16 only with openvino, and in `evaluate`"
    )
    threads: int = Field(1, ge=1, le=64, description="CPU threads; more than 1 only help on idle cores")
    region: tuple[int, int, int, int] | None = Field(
        None, description="region of interest of the camera frame as left, top, width, height in pixels"
    )
    max_covered: float = Field(
        MAX_COVERED,
        ge=0,
        le=0.5,
        description="largest share of the image that may lose its detail, as if covered; raise it for wide jaws",
    )
    lockstep_compute_ms: NonNegative = Field(
        12.0, description="simulated time that one estimate takes in a lockstep run"
    )


_DEFAULT_FRAME_HZ: Final = 60.0
_TIMEOUT_FRAMES: Final = 2.7
_MAX_LATENCY_MS: Final = 100.0 - 1e3 / _DEFAULT_FRAME_HZ
"""Limits on missing and late estimates: 45 ms without one, and an age of 100 ms, at 60 frames per second."""

_DEFAULT_PLANT: Final = (1.0, 60.0)
_DEFAULT_LATENCY_MS: Final = 60.0 - 0.5e3 / _DEFAULT_FRAME_HZ
"""Gain, lag in ms, and delay in ms without the wait for a frame, of an unidentified plant; slower than every object
measured so far."""


class BudgetConfig(Section):
    """Limits on time and error that choices by ``auto`` keep."""

    latency_ms: Positive | None = Field(None, description="99th percentile of the time of one estimate")
    error_n: Positive | None = Field(None, description="mean absolute error of the visual estimate")
    sim_error_n: Positive | None = Field(
        None, description="RMS error of a simulated object's force, against its finest level of detail"
    )
    sim_speed: Positive | None = Field(
        None, description="lowest speed of the physics, in simulated seconds per second (shipped table)"
    )


class ControlConfig(Section):
    """Fusion, force loop, phases and limits."""

    unknown_hint: ClassVar[str] = (
        "The gains of the force loop are not keys: they follow from plant_gain, plant_lag_ms and plant_delay_ms, which "
        "`gripper-force calibrate object` measures"
    )

    rate_hz: float = Field(200.0, ge=0.1, le=1000, description="rate of the control loop")
    feedback: Literal["fused", "current", "vision"] = Field(
        "fused", description="feedback of the force loop: vision fused with motor current, or one of them"
    )
    force_limit_n: float = Field(
        14.0,
        gt=0,
        le=HARD_FORCE_LIMIT_N,
        allow_inf_nan=False,
        description="above this force the current is reduced, and after 0.25 s the grasp ends as a fault; "
        "the largest target is 0.9 / gripper.gain_bound of it, and less with a linkage (gripper.position_bound_rad)",
    )
    approach_speed_m_s: Positive = Field(
        0.025,
        description="closing speed of one jaw before contact; a release is twice as fast. So that no impact exceeds "
        "force_limit_n, both are at most 3.6 mm/s per newton of it with a pinion of 20 mm radius",
    )
    approach_force_n: Positive = Field(0.5, description="largest grip force before contact")
    ramp_n_s: Positive = Field(8.0, description="rate at which the reference force rises after contact")
    settle_s: Positive = Field(1.0, description="time within tolerance after which a grasp counts as held")
    hold_s: NonNegative = Field(1.5, description="time for which `grasp` holds before it releases")
    timeout_s: Positive = Field(8.0, description="time within which a grasp must be held; slow jaws get more")
    vision_rate_hz: Positive | None = Field(
        None, description="estimates per second that the loop is tuned for; null: camera.rate_hz"
    )
    vision_timeout_ms: Positive | None = Field(
        None, description="time without an estimate after which vision drops out; null: 2.7 frame periods"
    )
    vision_age_ms: Positive | None = Field(
        None, description="frame age above which an estimate is rejected; null: 83 ms plus a frame period"
    )
    vision_std_n: Positive = Field(1.5, description="standard deviation above which an estimate is rejected")
    learn_gain: bool = Field(
        True,
        description="learn the object's gain (its stiffness over that of its kind) from motor current, from grasp to "
        "grasp, and multiply visual estimates by it",
    )
    object_ratio: tuple[Positive, Positive] | None = Field(
        None,
        description="ratio of motor current to vision in earlier grasps of the object, and its relative standard "
        "deviation without that of the torque constant; null: from the object profile, or unknown",
    )
    min_object_width_m: Finite = Field(
        0.002,
        ge=-0.01,
        description="width, computed from the servo's angle, below which closed jaws hold nothing; gear play and soft "
        "pads make it 1 to 3 mm less than the object's; negative for paper, which only the camera can then tell from "
        "no object",
    )
    slip_width_m: Positive = Field(0.004, description="closing of the jaws during hold that counts as slip")
    on_slip: Literal["regrip", "hold", "open"] = Field(
        "regrip",
        description="after the object has left the jaws: regrip: close again, and open if there is nothing; "
        "hold: keep the width; open: open the jaws",
    )
    on_fault: Literal["limp", "hold", "open"] = Field(
        "limp",
        description="after a fault or stop: limp: torque off; hold: keep the grip with a force that can only "
        "fall; open: open the jaws",
    )
    warm_c: Positive = Field(
        60.0, description="servo temperature above which the hold force is reduced, to 60 % at the limit"
    )
    temperature_limit_c: Positive = Field(70.0, description="servo temperature that ends a grasp as a fault")
    voltage_limits_v: tuple[Positive, Positive] | None = Field(
        None, description="lowest and highest supply voltage; null: range of the servo model"
    )
    plant_gain: Positive | None = Field(
        None, description="gain of the plant, contact over motor force; null: from the object profile, or 1"
    )
    plant_lag_ms: Positive | None = Field(
        None, description="lag from motor current to contact force; null: from the object profile, or 60"
    )
    plant_delay_ms: Positive | None = Field(
        None,
        description="delay from contact force to estimate (exposure to use, plus half a frame); null: from "
        "the object profile, or 52 plus half a frame period. With feedback=vision at least this default is "
        "used, and a lag of at most 60",
    )

    @model_validator(mode="after")
    def _check_order_of_limits(self) -> Self:
        above = {
            "warm_c": "temperature_limit_c",
            "settle_s": "timeout_s",
            "approach_force_n": "force_limit_n",
        }
        for low, high in above.items():
            if getattr(self, low) >= getattr(self, high):
                raise ValueError(f"{low} {getattr(self, low):g} must be below {high} {getattr(self, high):g}")
        if self.voltage_limits_v is not None and self.voltage_limits_v[0] >= self.voltage_limits_v[1]:
            raise ValueError("the first value of voltage_limits_v must be below the second")
        return self

    @property
    def frame_hz(self) -> float:
        """Estimates per second; 60 where nothing is known."""
        return _DEFAULT_FRAME_HZ if self.vision_rate_hz is None else self.vision_rate_hz

    @property
    def vision_gap_ms(self) -> float:
        """Time without an estimate after which vision drops out."""
        default_ms = _TIMEOUT_FRAMES * 1e3 / self.frame_hz
        return default_ms if self.vision_timeout_ms is None else self.vision_timeout_ms

    @property
    def max_frame_age_ms(self) -> float:
        """Frame age above which an estimate is rejected."""
        return _MAX_LATENCY_MS + 1e3 / self.frame_hz if self.vision_age_ms is None else self.vision_age_ms

    @property
    def plant(self) -> tuple[float, float, float]:
        """Gain, lag in s and delay in s of the force loop's plant; the defaults where nothing is known."""
        default_delay_ms = _DEFAULT_LATENCY_MS + 0.5e3 / self.frame_hz
        gain = _DEFAULT_PLANT[0] if self.plant_gain is None else self.plant_gain
        lag_ms = _DEFAULT_PLANT[1] if self.plant_lag_ms is None else self.plant_lag_ms
        delay_ms = default_delay_ms if self.plant_delay_ms is None else self.plant_delay_ms
        if self.feedback == "vision":
            # A press does not excite the oscillation of the jaws on the object's spring, and feedback from
            # vision alone would amplify it. So the loop is never tuned faster than for the default plant.
            lag_ms, delay_ms = min(lag_ms, _DEFAULT_PLANT[1]), max(delay_ms, default_delay_ms)
        return gain, lag_ms * 1e-3, delay_ms * 1e-3


Metre = Annotated[float, Field(ge=-1, le=1)]
Vector = tuple[Metre, Metre, Metre]
PadLength = Annotated[float, Field(ge=0.004, le=0.05)]
Share = Annotated[float, Field(ge=0, le=1)]
Colour = tuple[Share, Share, Share]


class SimCameraConfig(Section):
    """Place and image of the simulated camera; the point between the jaws' tips is the origin."""

    position_m: Vector = Field(
        (0.10, -0.30, 0.125), description="x: along the travel of the jaws, y: towards the wall, z: up"
    )
    aim_m: Vector = Field((0.0, 0.0, 0.0), description="point in the middle of the image")
    fov_deg: float = Field(17.0, ge=2, le=120, description="field of view from edge to edge of the image")
    roll_deg: float = Field(0.0, ge=-180, le=180, description="rotation of the camera about its optical axis")
    blur_px: float = Field(0.0, ge=0, le=10, description="standard deviation of the lens's blur")
    noise: Share | None = Field(None, description="photon noise of white pixels; null: drawn, 0.012 to 0.024")


class SimJawsConfig(Section):
    """Size and colour (red, green, blue) of the simulated jaws."""

    pad_m: tuple[PadLength, PadLength] = Field((0.024, 0.022), description="depth and height of a pad")
    finger_m: PadLength = Field(0.016, description="depth of a finger")
    pad_rgb: Colour = Field((0.16, 0.17, 0.19), description="colour of the pads")
    finger_rgb: Colour = Field((0.78, 0.78, 0.80), description="colour of the fingers")


class SimLightConfig(Section):
    """Light and background of the simulated world, beside ``sim.lux``."""

    direction: Vector = Field(
        (-0.40, 0.55, -0.75), description="direction in which the light shines, of length about 1"
    )
    ambient: Share = Field(0.30, description="share of the light that comes from everywhere")
    background: float = Field(1.0, ge=0, le=2, description="factor on the brightness of table and wall")

    @field_validator("direction")
    @classmethod
    def _is_a_direction(cls, direction: Vector) -> Vector:
        if not any(direction):
            raise ValueError("0, 0, 0 is not a direction")
        return direction


class SimConfig(Section):
    """The simulated world; read only if a device is simulated."""

    camera: SimCameraConfig = SimCameraConfig()
    jaws: SimJawsConfig = SimJawsConfig()
    light: SimLightConfig = SimLightConfig()
    object: Path | None = Field(None, description="file of the object; object=FOLDER/mug.yaml sets it")
    detail: Literal["coarse", "medium", "fine", "auto"] = Field(
        "medium",
        description="mesh and time step; auto: the fastest level that keeps budget.sim_error_n and "
        "budget.sim_speed by the table of `gripper-force bench scene`",
    )
    lux: Positive | None = Field(None, description="light level in lux; null: 350, 550 or 750, drawn by seed")
    tool: Literal["pads", "discs", "rods"] = Field(
        "pads",
        description="jaw tips: flat pads, flat round discs, or rods with round tips, which press the wall of a turned "
        "object where the edge of a pad would catch on its rim",
    )
    yaw_deg: float = Field(0.0, ge=-90, le=90, description="rotation of the object, added to the drawn one")
    randomise: bool = Field(True, description="draw size, pose, camera, texture, light and motor by seed")
    object_seed: int | None = Field(None, ge=0, description="seed of size, stiffness and texture; null: seed")
    rig_seed: int | None = Field(
        None,
        ge=0,
        description="seed of the gripper and its surroundings (camera, light, table, motor, gears, rods); null: seed",
    )
    size_spread: float = Field(0.04, ge=0, le=0.15, description="half-width of the uniform spread of size")
    stiffness_spread: float = Field(0.05, ge=0, le=0.5, description="half-width of the spread of stiffness")
    stiffness_octaves: float = Field(
        0.0, ge=0, le=1, description="further, log-uniform spread; 1: factors 0.5 to 2"
    )
    view_spread: float = Field(
        1.0,
        ge=0,
        le=15,
        description="factor on the ranges from which place, aim and field of view of the camera, and light are "
        "drawn; 10: other mountings, lenses and zooms",
    )
    jaw_spread: float = Field(
        0.0,
        ge=0,
        le=1,
        description="spread of the jaws' looks, 0 to 1: width and height of the pads, width of the fingers, "
        "brightness of both",
    )
    markers: bool = Field(False, description="an ArUco marker on each finger, beside its pad")
    changing_light: bool = Field(False, description="light that changes slowly during a run, by up to 30 %")
    moving_background: bool = Field(False, description="things that move behind the object")
    camera_latency_ms: NonNegative = Field(15.0, description="time from mid-exposure to the frame")
    exposure_ms: Positive = Field(4.0, description="simulated exposure time at camera.exposure_us=4000")
    friction: Positive | None = Field(None, description="factor on the default rig's friction; null: drawn")
    gain: Positive | None = Field(None, description="factor on the model's torque constant; null: drawn")
    stiffness: Positive | None = Field(None, description="factor on the kind's stiffness; null: drawn")
    open_width_m: Positive | None = Field(None, description="true open width; null: gripper.open_width_m")
    hanging_mass_kg: NonNegative = Field(
        0.0, description="mass that pulls one jaw open; 0: none, and in `calibrate weight` the stated one"
    )


class CalibrationConfig(Section):
    """Profiles that apply to the run."""

    rig: Path | None = Field(
        None,
        description="rig profile made by `gripper-force calibrate`; its values replace defaults, and the "
        "configuration file and --set replace its values",
    )
    object: str | None = Field(
        None,
        description="object profile or bundle: a name or a path; own: the one named like `object`; none: no profile; "
        "null: the bundle that `gripper-force teach` made of `object`, if there is one",
    )
    on_mismatch: Literal["refuse", "warn"] = Field(
        "refuse", description="what to do if a profile belongs to another device than the run's"
    )


class LogConfig(Section):
    """Output of runs."""

    directory: Path = Field(Path("runs"), description="folder of logs and reports")
    report: bool = Field(True, description="write a report (PNG and HTML) after each run")


class Config(Section):
    """A whole run. `load_config` makes it; built directly, a wrong value is a ``pydantic.ValidationError``."""

    object: str = Field(
        "sponge",
        description="name of the grasped object; simulated: sponge, paper_cup, tube, stapler, ball, block, a kind "
        "(page Simulation), or the path of a file of your own (.yaml or .xml)",
    )
    target_n: Positive = Field(4.0, description="target force")
    seed: int = Field(0, ge=0, description="seed for all random draws")
    clock: Literal["lockstep", "realtime"] = Field(
        "lockstep",
        description="lockstep: simulated time that waits for the computer; realtime: needed by real devices",
    )
    on_exit: Literal["release", "hold"] = Field(
        "release", description="end of a run without fault: release: torque off; hold: keep the last goals"
    )
    servo: ServoConfig = ServoConfig()
    gripper: GripperConfig = GripperConfig()
    camera: CameraConfig = CameraConfig()
    load_cell: LoadCellConfig = LoadCellConfig()
    vision: VisionConfig = VisionConfig()
    budget: BudgetConfig = BudgetConfig()
    control: ControlConfig = ControlConfig()
    sim: SimConfig = SimConfig()
    calibration: CalibrationConfig = CalibrationConfig()
    log: LogConfig = LogConfig()
    faults: tuple[FaultConfig, ...] = Field(
        (), description="faults to inject into simulated devices: unit, kind, at_s, for_s, id"
    )

    @model_validator(mode="before")
    @classmethod
    def _split_object(cls, tree: Any) -> Any:
        """Splits a simulated object's file, given as ``object``, into its name and ``sim.object``."""
        path, sim = (tree.get("object"), tree.get("sim", {})) if isinstance(tree, dict) else (None, None)
        if not str(path).endswith((".yaml", ".xml")) or not isinstance(sim, dict | SimConfig):
            return tree
        return tree | {"object": Path(str(path)).stem, "sim": {**dict(sim), "object": path}}

    @model_validator(mode="after")
    def _check_sections(self) -> Self:
        if (open_m := self.gripper.open_width_m) <= self.control.min_object_width_m:
            raise ValueError(f"control.min_object_width_m must be below gripper.open_width_m, {open_m:g} m")
        if self.gripper.linkage.kind == "finger" and len(self.servo.ids) > 1:
            raise ValueError(
                "gripper.linkage.kind=finger has one moving finger, but servo.second.id names the servo of a "
                "second one; set the kind to fingers"
            )
        if unknown_ids := {fault.id for fault in self.faults} - {None, *self.servo.ids}:
            raise ValueError(f"a fault has the id {unknown_ids.pop()}, but no servo has it; correct it")
        return self

    @property
    def profile(self) -> str | None:
        """Name or path of the object profile, or None."""
        name = self.calibration.object
        return {"own": self.object, "none": None}.get(name, name) if name is not None else None

    @property
    def uses_vision(self) -> bool:
        """True if the run has a camera and a network."""
        return self.camera.backend != "none" and self.vision.checkpoint != "none"

    def with_values(self, **values: Any) -> Self:
        """Returns a copy with other values, not yet validated. A dict changes only the keys of that section.

        Raises:
            ConfigError: A key is unknown.
        """
        check_keys(Config, values, "with_values")
        parts = {k: getattr(self, k).model_copy(update=v) for k, v in values.items() if isinstance(v, dict)}
        return self.model_copy(update=values | parts)

    def rig_settings(self) -> Tree:
        """Keys and values of camera, view and gripper that networks and object profiles are bound to."""
        parts = {
            "camera": set(CameraConfig.model_fields) - CAMERA_OTHER_KEYS,
            "vision": {"region"},
            "gripper": {"linkage", "pinion_radius_m", "open_width_m"},
            "sim": {"tool", "view_spread", "jaw_spread", "camera", "jaws", "light"},
        }
        tree = self.model_dump(mode="json", include=dict(parts))
        for part, key in (("gripper", "linkage"), ("sim", "camera"), ("sim", "jaws"), ("sim", "light")):
            tree[f"{part}.{key}"] = tree[part].pop(key)
        return {f"{part}.{key}": value for part in tree for key, value in tree[part].items()}


Overrides = Sequence[str | tuple[str, Any]] | Mapping[str, Any]
"""Assignments ``key.path=value`` with YAML values, or pairs or a mapping of key paths and values."""

Layers = Mapping[str, Overrides]
"""Overrides by their origin; those of a later one count."""


def load_config(path: str | Path | None = None, overrides: Overrides | None = None) -> Config:
    """Loads a configuration from defaults, a rig profile, a YAML file and overrides, in that order.

    Args:
        path: YAML file; None: defaults.
        overrides: Assignments such as ``["control.rate_hz=100"]``, or ``{"control.rate_hz": 100}``.

    Returns:
        The configuration, with each ``auto`` still open: `Gripper.config` has what a run uses.

    Raises:
        ConfigError: A file, key or value is wrong. The message names it.
    """
    return load_with_options(path, overrides, {})


def load_with_options(
    path: str | Path | None, overrides: Overrides | None, options: Layers, *, new_rig: bool = False
) -> Config:
    """Loads the configuration of a command, as `load_config`.

    Args:
        path: YAML file; None: defaults.
        overrides: Assignments, as of `load_config`.
        options: Further overrides, which come last, by the name that an error gives to them.
        new_rig: True if ``calibration.rig`` may name a file that does not exist, because it is yet to be written.

    Raises:
        ConfigError: A file, key or value is wrong. The message names it.
    """
    where = str(path) if path else "--set"
    tree = {} if path is None else read_tree(as_path(path, "the configuration", "or pass keys as overrides"))
    if not tree.keys().isdisjoint({"format", "family"}):
        raise ConfigError(
            f"{path} is not a configuration; pass a rig profile with --set calibration.rig={path}, an object "
            f"profile with --profile {path}, or a simulated object with --object {path}"
        )
    return _validated(lambda keys, name: _rig_settings(keys, name, new_rig), tree, where, overrides, options)


def config_from(tree: Tree, where: str) -> Config:
    """Validates a tree of keys without reading any file. Raises `ConfigError` that names ``where``."""
    return validated(Config, tree, where)


def config_from_text(text: str, where: str, overrides: Overrides | None = None) -> Config:
    """Reads a configuration that `dump_config` wrote, such as that of a log.

    The text already contains the settings of its rig profile. A rig profile that ``overrides`` names is
    applied over the text and under the other overrides.

    Raises:
        ConfigError: A key or value is wrong. The message names it and ``where``.
    """
    override_tree: Tree = {}
    _assign_all(override_tree, overrides)
    tree = merged(_upgraded(tree_from(text, where)), _rig_settings(override_tree, "--set"))
    return _validated(lambda *_: {}, tree, where, overrides, {})


def dump_config(config: Config) -> str:
    """The complete configuration as YAML."""
    return dump(config)


def _upgraded(tree: Tree) -> Tree:
    """Replaces values that only version 0.1 had."""
    vision = tree.get("vision")
    if isinstance(vision, dict) and vision.get("engine") == "compiled":  # it computed the same as torch
        return {**tree, "vision": {**vision, "engine": "torch"}}
    return tree


def _assign_all(tree: Tree, overrides: Overrides | None) -> None:
    if isinstance(overrides, str):
        raise ConfigError(f"overrides are a list or a mapping; pass [{overrides!r}] instead of the text")
    try:
        for item in overrides.items() if isinstance(overrides, Mapping) else overrides or ():
            if isinstance(item, str):
                assign(tree, item)
            else:
                assign_value(tree, *item)
    except TypeError as error:
        raise ConfigError(f"overrides are a list of assignments, or a mapping, not {overrides!r}") from error


def _validated(
    rig: Callable[[Tree, str], Tree], tree: Tree, where: str, overrides: Overrides | None, options: Layers
) -> Config:
    """Validates a tree with overrides. The message blames the first of them with which the tree is not valid."""
    layers = {where: (), "overrides" if isinstance(overrides, Mapping) else "--set": overrides, **options}
    copy = deepcopy(tree)
    try:
        for layer in layers.values():
            _assign_all(copy, layer)
        return config_from(merged(rig(copy, where), copy), where)
    except ConfigError:
        for name, layer in layers.items():
            _assign_all(tree, layer)
            config_from(merged(rig(tree, name), tree), name)
        raise


def _rig_settings(tree: Tree, where: str, new_rig: bool = False) -> Tree:
    """Settings of the rig profile that the tree names; none if it is new and does not exist."""
    rig = validated(Config, {k: v for k, v in tree.items() if k == "calibration"}, where).calibration.rig
    return {} if rig is None or (new_rig and not rig.exists()) else read_rig(rig).settings()
