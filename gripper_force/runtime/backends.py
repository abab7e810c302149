"""Opens the devices that a configuration names.

A backend is a built-in name, ``package.module:Class``, or a name that an installed package registers as an
entry point. It is imported when a run names it. There is no silent fallback: what the configuration names is
opened, or an error says why not.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Final

from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.interfaces import Clock, Devices, SharedPort
from gripper_force.plugins import load_class
from gripper_force.runtime.process import keep_in_forks
from gripper_force.types import NS_PER_S

RIG: Final = "gripper_hw.sim.simulated_rig:SimulatedRig"
SERVOS: Final = {"dynamixel": "gripper_hw.dynamixel.servo:DynamixelServo"}
CAMERAS: Final = {
    "none": "",
    "simulated": RIG,
    "playback": "gripper_hw.playback:PlaybackCamera",
    "oak": "gripper_hw.cameras.oak:OakCamera",
    "uvc": "gripper_hw.cameras.uvc:UvcCamera",
}
LOAD_CELLS: Final = {
    "none": "",
    "simulated": RIG,
    "playback": "gripper_hw.playback:PlaybackLoadCell",
    "serial": "gripper_hw.load_cells.serial:SerialLoadCell",
    "phidget": "gripper_hw.load_cells.phidget:PhidgetLoadCell",
}
_SENSORS: Final = {"camera": CAMERAS, "load_cell": LOAD_CELLS}


class MonotonicClock:
    """The host's monotonic time."""

    def now_ns(self) -> int:
        """Returns the current time."""
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleeps until a time; returns at once if it has passed."""
        if (left_ns := t_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns / NS_PER_S)


def load_servo_class(config: Config) -> Any:
    """Imports the class of ``servo.backend``. Raises `ConfigError` if there is no such class."""
    return load_class("servos", SERVOS, config.servo.backend, "servo.backend")


def is_simulated(config: Config) -> bool:
    """Returns True if the run has a simulated world."""
    return "simulated" in (config.camera.backend, config.load_cell.backend) or config.servo.is_virtual


def resolve_simulation(config: Config) -> tuple[Config, str]:
    """Chooses the simulated world's level of detail where the configuration says ``auto``.

    Returns:
        The configuration without ``auto``, and the reason for the choice (empty if there was none).

    Raises:
        ConfigError: No level of detail keeps the budget.
    """
    if config.sim.detail != "auto" or not is_simulated(config):
        return config, ""
    resolved: tuple[Config, str] = _rig_class().resolve(config)
    return resolved


def with_camera_rate(config: Config) -> Config:
    """Sets ``camera.rate_hz`` to that of the log, if the camera plays one. Raises `GripperError` if it can't."""
    if config.camera.backend != "playback":
        return config
    camera = _sensor_class(config, "camera").resolve(config.camera)
    return config.with_values(camera=camera)


def check_devices(config: Config, port: SharedPort | None = None) -> None:
    """Checks that the configured backends exist and go together, without opening one. Raises `ConfigError`."""
    if port is not None and (config.servo.backend not in SERVOS or config.servo.is_virtual):
        raise ConfigError(
            f"a shared port works with servo.backend=dynamixel and a real servo.port, not with "
            f"{config.servo.backend} and {config.servo.port}; set servo.port to the device path of the port"
        )
    load_servo_class(config)
    servo = config.servo
    if servo.backend in SERVOS:
        key, value, simulated = "servo.port", servo.port, "servo.port=virtual:rig"
    else:
        key, value, simulated = "servo.backend", servo.backend, "servo.backend=dynamixel"
    if is_simulated(config):
        if not servo.is_virtual:
            raise ConfigError(
                f"{key} {value!r} is not virtual, but a simulated camera or load cell needs the simulated servo; "
                f"set camera.backend and load_cell.backend to real devices or none, or set {simulated}"
            )
    else:
        if config.clock == "lockstep":
            raise ConfigError(
                f"clock=lockstep needs a simulated servo, but {key} is {value!r}; set clock=realtime, or {simulated}"
            )
        if config.faults:
            raise ConfigError(
                f"faults are for simulated devices only, but {key} is {value!r}; set {simulated}, or faults=[]"
            )
    for unit in _SENSORS:
        name = getattr(config, unit).backend
        if name not in ("none", "simulated"):
            supports_lockstep = getattr(_sensor_class(config, unit), "supports_lockstep", False)
            if config.clock == "lockstep" and not supports_lockstep:
                raise ConfigError(f"{unit}.backend={name} cannot follow simulated time; set clock=realtime")


@contextmanager
def open_devices(config: Config, port: SharedPort | None = None) -> Iterator[Devices]:
    """Opens the configured devices and closes all of them at the end, whatever happens.

    Args:
        config: A resolved configuration (see `gripper_force.runtime.resolve`).
        port: Port of the servo that other code uses, too; None: ``servo.port`` is opened.

    Raises:
        ConfigError: A backend is unknown, or two cannot be combined.
        DeviceNotFoundError: A device is missing.
        SimulationError: The simulated scene cannot be built.
    """
    check_devices(config, port)
    with ExitStack() as stack:
        rig: Any = None
        if is_simulated(config):
            rig = _rig_class()(config)
            stack.callback(rig.close)
        clock: Clock = rig.clock if rig is not None else MonotonicClock()
        camera = _open_sensor(stack, "camera", config, rig, clock)
        load_cell = _open_sensor(stack, "load_cell", config, rig, clock)
        shared = () if port is None else (port,)
        servo = load_servo_class(config)(config.servo, clock.now_ns, *shared)
        stack.callback(_close, servo)
        if rig is not None:
            rig.start()
        keep_in_forks(stack)
        yield Devices(
            clock=clock,
            servo=servo,
            camera=camera,
            load_cell=load_cell,
            lockstep=config.clock == "lockstep",
            start_ns=rig.start_ns if rig is not None else clock.now_ns(),
            check=rig.check if rig is not None else lambda: None,
            notes=rig.notes() if rig is not None else {},
            render_under_light=rig.render_under_light if rig is not None else None,
            observe_world=rig.observe_world if rig is not None else None,
            wrap_estimator=rig.wrap_estimator if rig is not None else None,
            wrap_file=rig.wrap_file if rig is not None else None,
        )


def _rig_class() -> Any:
    return load_class("rigs", {"virtual:rig": RIG}, "virtual:rig", "servo.port")


def _sensor_class(config: Config, unit: str) -> Any:
    return load_class(f"{unit}s", _SENSORS[unit], getattr(config, unit).backend, f"{unit}.backend")


def _open_sensor(stack: ExitStack, unit: str, config: Config, rig: Any, clock: Clock) -> Any:
    section = getattr(config, unit)
    if section.backend == "none":
        return None
    simulated = section.backend == "simulated"
    device = getattr(rig, unit) if simulated else _sensor_class(config, unit)(section, clock)
    stack.callback(_close, device)
    return device


def _close(device: Any) -> None:
    """Closes a device. An error of it only warns, because it would hide the result or the error of the run."""
    try:
        device.close()
    except Exception as error:
        warnings.warn(f"a device was not closed: {error}", RuntimeWarning, stacklevel=2)
