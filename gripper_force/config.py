"""The configuration: typed, with a default for everything, from YAML and ``--set key.path=value``."""

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from gripper_force.errors import ConfigError
from gripper_force.profiles.rig_profile import read_rig
from gripper_force.schema import (
    Finite,
    NonNegative,
    Positive,
    Section,
    Tree,
    assign,
    dump,
    merged,
    read_tree,
    tree_from,
    validated,
)

HARD_FORCE_LIMIT_N = 70.0
"""No configuration may allow more: the least finger limit that is quoted for hands."""


class ServoConfig(Section):
    """The servo and its bus."""

    model: str = Field("XM430-W350", description="XM430-W350, XM430-W210, XL330-M288 or XC330-T288")
    port: str = Field(
        "virtual:rig", description="a device path, or virtual:NAME for a bus in this process's memory"
    )
    id: int = Field(1, ge=0, le=252, description="the servo's number on the bus")
    baud_rate: int = Field(1_000_000, gt=0, description="bits a second")
    current_limit_a: Positive = Field(1.2, description="what the servo itself never goes beyond")
    bus_watchdog_ms: int = Field(
        40, ge=20, le=2540, description="silence on the bus after which the servo stops by itself"
    )
    retries: int = Field(2, ge=0, le=10, description="of a transaction without a sound answer")
    reply_margin_ms: Positive = Field(3.0, description="how long a reply may be late before a retry")


class GripperConfig(Section):
    """How the servo moves the jaws: one pinion, two racks."""

    pinion_radius_m: Positive = Field(0.020, description="travel of one jaw for a radian of the servo")
    closing_sign: Literal[-1, 1] = Field(1, description="-1 where a falling position closes")
    open_position_rad: Finite = Field(0.0, description="servo angle with the jaws open")
    open_width_m: Positive = Field(0.092, description="distance between the open jaws")
    nm_per_a: Positive | None = Field(None, description="torque constant at the horn; None: the model's own")
    current_step_a: Positive | None = Field(
        None, description="resolution of the goal current; None: the model's own"
    )
    friction_n: NonNegative = Field(0.95, description="jaw force that friction takes while closing")
    damping_n_s_m: NonNegative = Field(14.5, description="viscous friction of one jaw, motor included")
    friction_std: NonNegative = Field(0.25, description="standard deviation of true friction over friction_n")
    gain_std: NonNegative = Field(
        0.06, description="of the true torque constant over nm_per_a: +-10 % uniform is 0.058"
    )


class CameraConfig(Section):
    """The camera."""

    backend: str = Field("simulated", description="simulated, oak, uvc, playback, none")
    rate_hz: Positive = Field(60.0, description="frames a second that are asked for")
    path: Path | None = Field(None, description="the log that backend `playback` plays")
    speed: Literal["recorded", "full"] = Field("recorded", description="how fast it is played")
    device: int | str | None = Field(
        None, description="oak: id or address, None: the only one; uvc: index, /dev path or name"
    )
    region: tuple[int, int, int, int] | None = Field(
        None,
        description="oak, uvc: part of the sensor's picture whose middle square becomes the frame: left, "
        "top, width, height in pixels; vision.region is a part of that frame",
    )
    side_px: int = Field(128, ge=16, le=800, description="oak, uvc: side of the frame")
    exposure_us: int | None = Field(
        4000, gt=0, description="None: automatic, and of the simulated camera as at 4000"
    )
    gain: int | None = Field(
        None, ge=0, description="oak: ISO, None: 100; uvc: the driver's own unit, None: left as it is"
    )
    timeout_ms: Positive = Field(
        250.0, description="oak, uvc: age of the last frame over which the camera counts as lost"
    )


class LoadCellConfig(Section):
    """The force reference; ``none`` where none is fitted."""

    backend: str = Field("simulated", description="simulated, playback, serial, phidget, none")
    rate_hz: Positive = Field(
        200.0, description="of `simulated` and `phidget` (at most 122); a board on a serial port has its own"
    )
    port: str | None = Field(None, description="the device path that backend `serial` reads")
    baud_rate: int = Field(115_200, gt=0, description="of the serial port, in bits a second")
    format: Literal["hx711", "cas"] = Field(
        "hx711", description="what `serial` reads: counts of an HX711 board, or a weighing indicator's frames"
    )
    channel: int = Field(0, ge=0, le=3, description="the bridge input that backend `phidget` reads")
    tare_raw: Finite = Field(0.0, description="the reading without load: counts, kg, or V/V")
    n_per_raw: Finite | None = Field(
        None,
        description="newtons for one unit of the reading; None: 9.80665 for an indicator's kg, and any other "
        "cell is not calibrated, so that none of its samples is valid",
    )
    path: Path | None = Field(None, description="the log that backend `playback` plays")
    speed: Literal["recorded", "full"] = Field("recorded", description="how fast it is played")

    @property
    def sensor(self) -> str:
        """What the unit of the reading goes with: the backend, and of a serial one the format."""
        return f"{self.backend} {self.format}" if self.backend == "serial" else self.backend


class VisionConfig(Section):
    """Estimator and its input."""

    checkpoint: str = Field(
        "default",
        description="a path; default or small, which are shipped; or auto: the cheapest of these that keeps "
        "`budget`. What `gripper-force export` wrote is one too",
    )
    engine: Literal["torch", "openvino", "onnxruntime", "auto"] = Field(
        "torch",
        description="what computes the network; auto: the fastest that is installed, with as many threads as "
        "serve it, measured once on each machine",
    )
    precision: Literal["float32", "bfloat16"] = Field(
        "float32", description="of the arithmetic; bfloat16 with openvino only"
    )
    threads: int = Field(
        1, ge=1, le=64, description="more help only on cores that nothing else uses: they wait for each other"
    )
    region: tuple[int, int, int, int] | None = Field(
        None, description="region of interest of the camera's frame in pixels: left, top, width, height"
    )
    lockstep_compute_ms: NonNegative = Field(
        12.0, description="time one estimate takes on the simulated clock of a lockstep run"
    )


_CAUTIOUS: Final = (1.0, 60.0, 60.0)
"""Gain, lag and delay in ms of a plant that was not identified."""


class BudgetConfig(Section):
    """What a scene may cost, and how far off it may be; what is chosen by ``auto`` keeps it."""

    latency_ms: Positive | None = Field(None, description="99th percentile of an estimate's time")
    error_n: Positive | None = Field(None, description="mean absolute error of the visual estimate")
    sim_error_n: Positive | None = Field(
        None, description="root mean square error of a simulated object's force, against its finest level"
    )
    sim_speed: Positive | None = Field(
        None, description="least speed of the physics, in simulated seconds a second, by the shipped table"
    )


class ControlConfig(Section):
    """Fusion, force loop, phases and limits."""

    rate_hz: Positive = Field(200.0, description="of the loop")
    feedback: Literal["fused", "current", "vision"] = Field(
        "fused", description="what the loop goes by: vision and motor current together, or one of them alone"
    )
    force_limit_n: float = Field(
        10.0, gt=0, le=HARD_FORCE_LIMIT_N, allow_inf_nan=False, description="what ends a grasp as over_force"
    )
    approach_speed_m_s: Positive = Field(0.025, description="closing speed of one jaw before contact")
    approach_force_n: Positive = Field(0.5, description="grip force allowed before contact")
    ramp_n_s: Positive = Field(8.0, description="how fast the wanted force rises after contact")
    settle_s: Positive = Field(1.0, description="time within tolerance that makes a grasp `held`")
    hold_s: NonNegative = Field(1.5, description="how long to hold after it is held, before the run ends")
    timeout_s: Positive = Field(8.0, description="after which a grasp that is not held is given up")
    vision_timeout_ms: Positive = Field(
        45.0, description="time without an estimate after which vision drops out: two frames at 60 a second"
    )
    vision_age_ms: Positive = Field(100.0, description="age of its frame over which an estimate is refused")
    vision_std_n: Positive = Field(1.5, description="claimed error over which an estimate is uncertain")
    slip_width_m: Positive = Field(0.004, description="closing of the jaws during hold that means slip")
    on_fault: Literal["limp", "hold", "open"] = Field(
        "limp",
        description="after a fault or a stop: no torque; hold with a force that can only fall; open the jaws",
    )
    warm_c: Positive = Field(
        60.0, description="servo temperature from which a hold is eased, down to 60 % at the limit"
    )
    temperature_limit_c: Positive = Field(70.0, description="servo temperature that ends a grasp")
    voltage_limits_v: tuple[Positive, Positive] | None = Field(
        None, description="supply of the servo, least and most; None: what its model is made for"
    )
    plant_gain: Positive | None = Field(
        None, description="contact force for one newton of motor push; None: the object profile's, or 1"
    )
    plant_lag_ms: Positive | None = Field(
        None, description="lag from motor current to contact force; None: the object profile's, or 60"
    )
    plant_delay_ms: Positive | None = Field(
        None,
        description="delay from contact force to estimate: exposure to use, and half a frame; None: the "
        "object profile's, or 60. With feedback=vision never less than 60, nor the lag more",
    )

    @model_validator(mode="after")
    def _limits_are_in_order(self) -> Self:
        if self.warm_c >= self.temperature_limit_c:
            raise ValueError(f"warm_c {self.warm_c:g} must lie below temperature_limit_c")
        if self.voltage_limits_v is not None and self.voltage_limits_v[0] >= self.voltage_limits_v[1]:
            raise ValueError("the first of voltage_limits_v must lie below the second")
        return self

    @property
    def plant(self) -> tuple[float, float, float]:
        """Gain, lag in s and delay in s of the force loop's plant; cautious ones where nothing is known."""
        given = (self.plant_gain, self.plant_lag_ms, self.plant_delay_ms)
        gain, lag_ms, delay_ms = (
            known if one is None else one for one, known in zip(given, _CAUTIOUS, strict=True)
        )
        if self.feedback == "vision":
            # No press shows how the jaws swing on the object's spring, and vision alone would feed the swing:
            # it is never tuned to be faster than for the cautious plant, whatever was identified.
            lag_ms, delay_ms = min(lag_ms, _CAUTIOUS[1]), max(delay_ms, _CAUTIOUS[2])
        return gain, lag_ms * 1e-3, delay_ms * 1e-3


class SimConfig(Section):
    """The simulated world. Only read where a backend is simulated."""

    detail: Literal["coarse", "medium", "fine", "auto"] = Field(
        "medium",
        description="mesh and step; auto: the fastest of which `gripper-force bench --scene` found that it "
        "keeps budget.sim_error_n and budget.sim_speed",
    )
    lux: float | None = Field(None, description="350, 550, 750; None: drawn from the seed", gt=0)
    tool: Literal["pads", "rods"] = Field(
        "pads",
        description="what the jaws end in: flat pads; or round-tipped rods, which press a turned object on "
        "its wall, where the edge of a pad would meet its rim and catch there",
    )
    yaw_deg: float = Field(
        0.0, ge=-90, le=90, description="turn of the object about the vertical, on top of what is drawn"
    )
    randomise: bool = Field(
        True, description="draw size, pose, camera, texture, light and motor from the seed"
    )
    object_seed: int | None = Field(
        None,
        ge=0,
        description="draws what the object itself is: size, stiffness, texture; None: the run's seed does",
    )
    rig_seed: int | None = Field(
        None,
        ge=0,
        description="draws the gripper and what is around it: camera, light, noise, table, motor, friction, "
        "gears, rods; None: the run's seed does",
    )
    size_spread: float = Field(
        0.04, ge=0, le=0.15, description="half-width of the uniform spread of the object's size"
    )
    stiffness_spread: float = Field(
        0.05, ge=0, le=0.5, description="half-width of the uniform spread of the object's stiffness"
    )
    markers: bool = Field(False, description="whether each finger carries an ArUco marker beside its pad")
    changing_light: bool = Field(
        False, description="whether the light swells and fades during a run, by up to three tenths"
    )
    moving_background: bool = Field(False, description="whether things pass behind the object")
    camera_latency_ms: NonNegative = Field(15.0, description="from the middle of an exposure to its frame")
    exposure_ms: Positive = Field(4.0, description="at a camera.exposure_us of 4000")


class CalibrationConfig(Section):
    """What is known of this rig and of the object."""

    rig: Path | None = Field(
        None,
        description="a rig profile of `gripper-force calibrate`: its values stand before the defaults and "
        "give way to the configuration file and to --set",
    )
    object: str | None = Field(
        None, description="an object profile's name or path; own: the one that has the object's name"
    )
    on_mismatch: Literal["refuse", "warn"] = Field(
        "refuse", description="what to do where a profile is of another device than the run's"
    )


class LogConfig(Section):
    """Where runs are written."""

    directory: Path = Field(Path("runs"), description="folder of logs and reports")
    report: bool = Field(True, description="whether a run ends with a picture and a page")


FAULTS: Final[dict[str, dict[str, str]]] = {
    "servo": {
        "off": "its power is cut; when that comes back, its RAM has been reset",
        "stuck": "its Bus Watchdog has tripped",
        "wrong": "it reports an overload",
        "intermittent": "its power is cut for 5 ms every 0.3 s",
    },
    "bus": {
        "off": "the adapter is unplugged",
        "garbage": "every answer is corrupted",
        "wrong": "every answer carries another id",
        "slow": "every answer comes after the driver has given it up",
        "delayed": "every answer is that of the request before",
        "intermittent": "half of the answers are lost",
    },
    "plant": {
        "wrong": "the motor gives more current than its goal asks, by 50 % more every second",
    },
    "camera": {
        "off": "no frame comes",
        "stuck": "the last picture comes again and again",
        "garbage": "every pixel is noise",
        "wrong": "six times the light falls in",
        "slow": "5 frames a second come",
        "delayed": "every frame comes 0.3 s late",
        "intermittent": "four of five frames are lost",
    },
    "load_cell": {
        "off": "no sample comes",
        "stuck": "the last reading comes again and again",
        "garbage": "readings anywhere within 200 N, or not finite",
        "wrong": "it reads its full scale",
        "slow": "2 samples a second come",
        "delayed": "every sample comes 0.5 s late",
        "intermittent": "every second 0.3 s lack all samples",
    },
    "estimator": {
        "off": "it raises an exception",
        "stuck": "it hangs",
        "garbage": "its estimates are not finite",
        "wrong": "it sees a third less force than there is",
        "intermittent": "it raises an exception at every second frame",
    },
    "clock": {
        "stuck": "the process is stopped, as by SIGSTOP",
        "wrong": "the wall clock jumps back by a day",
        "slow": "every cycle comes 15 ms late",
    },
    "disk": {
        "off": "it is full: no write succeeds",
        "slow": "every write takes 50 ms",
        "intermittent": "every second write fails",
    },
}
"""The faults that can be injected, in the vocabulary of PX4
(https://docs.px4.io/main/en/debug/failure_injection.html): unit, kind, and what it means there."""


class FaultConfig(Section):
    """A fault, on purpose: `FAULTS` says which there are and what each does."""

    unit: Literal["servo", "bus", "plant", "camera", "load_cell", "estimator", "clock", "disk"]
    kind: Annotated[
        Literal["ok", "off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"],
        BeforeValidator(lambda kind: "off" if kind is False else kind),  # what YAML makes of a bare off
    ]
    at_s: NonNegative = Field(0.0, description="when it begins, after the run's start")
    for_s: Annotated[float, Field(gt=0)] = Field(float("inf"), description="how long it lasts")

    @model_validator(mode="after")
    def _is_supported(self) -> Self:
        if self.kind != "ok" and self.kind not in FAULTS[self.unit]:
            known = ", ".join(("ok", *FAULTS[self.unit]))
            raise ValueError(f"a {self.unit} can't be made {self.kind}; known here: {known}")
        return self


class Config(Section):
    """A whole run."""

    object: str = Field(
        "sponge", description="what is grasped; simulated: sponge, paper_cup, tube, stapler, ball or block"
    )
    target_n: Positive = Field(4.0, description="wanted force")
    seed: int = Field(0, ge=0, description="of everything that is drawn")
    clock: Literal["lockstep", "realtime"] = Field(
        "lockstep", description="lockstep: the simulated world waits for the computer; devices need realtime"
    )
    on_exit: Literal["release", "hold"] = Field(
        "release", description="release: torque off on every way out; hold: keep the last goals"
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
        (), description="faults to inject into the stand-ins: unit, kind, at_s, for_s"
    )

    @property
    def profile(self) -> str | None:
        """Name or path of the object profile, or None."""
        return self.object if self.calibration.object == "own" else self.calibration.object

    def camera_settings(self) -> Tree:
        """What an object profile is bound to: keys of how the camera looks, and their values."""
        camera = self.camera.model_dump(
            mode="json", include={"backend", "rate_hz", "region", "side_px", "exposure_us", "gain"}
        )
        settings = {f"camera.{key}": value for key, value in camera.items()}
        return {**settings, "vision.region": self.vision.region and list(self.vision.region)}


def load_config(path: Path | None = None, overrides: list[str] | None = None) -> Config:
    """Builds the configuration from defaults, a rig profile, a YAML file, and overrides, in that order.

    Args:
        path: YAML file, or None for the defaults.
        overrides: Assignments ``key.path=value``; the value is read as YAML.

    Raises:
        ConfigError: A file, key or value is wrong. The sentence names it.
    """
    where = str(path) if path else "--set"
    tree = read_tree(path) if path is not None else {}
    if "format" in tree:
        raise ConfigError(
            f"{path} is no configuration but a {tree['format']}; a rig profile goes with --set "
            f"calibration.rig={path}, and an object profile with --profile {path}"
        )
    return _with_overrides(lambda given: merged(_rig_settings(given, where), given), tree, where, overrides)


def config_from(tree: Tree, where: str) -> Config:
    """Validates a tree of keys, and reads nothing else. Raises `ConfigError` that names ``where``."""
    return validated(Config, tree, where)


def config_from_text(text: str, where: str, overrides: list[str] | None = None) -> Config:
    """Reads a configuration that `dump_config` wrote.

    It holds what a rig profile set; one that the overrides name stands before it and gives way to them.

    Raises:
        ConfigError: A key or value is wrong. The sentence names it and ``where``.
    """
    given: Tree = {}
    for assignment in overrides or []:
        assign(given, assignment)
    tree = merged(tree_from(text, where), _rig_settings(given, "--set"))
    return _with_overrides(lambda tree: tree, tree, where, overrides)


def _with_overrides(
    complete: Callable[[Tree], Tree], tree: Tree, where: str, overrides: list[str] | None
) -> Config:
    """Validates a tree with overrides. The sentence blames them only where the tree is sound without."""
    changed = deepcopy(tree)
    for assignment in overrides or []:
        assign(changed, assignment)
    try:
        return config_from(complete(changed), where)
    except ConfigError:
        config_from(complete(tree), where)
        config_from(complete(changed), "--set")
        raise


def dump_config(config: Config) -> str:
    """The whole configuration as YAML."""
    return dump(config)


def _rig_settings(tree: Tree, where: str) -> Tree:
    """What the rig profile sets that the tree names."""
    section = tree.get("calibration")
    if not isinstance(section, dict) or section.get("rig") is None:
        return {}
    calibration = validated(Config, {"calibration": section}, where).calibration
    return read_rig(calibration.rig).settings() if calibration.rig is not None else {}
