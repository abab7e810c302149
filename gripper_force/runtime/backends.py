"""Names to classes. The core imports no device: a backend is a string here, imported when a run names it.

Nothing falls back silently: what the configuration names is opened, or an error says why not.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any, Final

from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.interfaces import Clock, Devices
from gripper_force.types import NS_PER_S

SERVO: Final = "gripper_hw.dynamixel.servo:DynamixelServo"
RIG: Final = "gripper_hw.sim.simulated_rig:SimulatedRig"
CAMERAS: Final = {
    "none": None,
    "simulated": RIG,
    "playback": "gripper_hw.playback:PlaybackCamera",
    "oak": "gripper_hw.cameras.oak:OakCamera",
    "uvc": "gripper_hw.cameras.uvc:UvcCamera",
}
LOAD_CELLS: Final = {
    "none": None,
    "simulated": RIG,
    "playback": "gripper_hw.playback:PlaybackLoadCell",
    "serial": "gripper_hw.load_cells.serial:SerialLoadCell",
    "phidget": "gripper_hw.load_cells.phidget:PhidgetLoadCell",
}
_ANY_TIME: Final = (RIG, CAMERAS["playback"], LOAD_CELLS["playback"])
"""What keeps simulated time as well as the host's."""


class MonotonicClock:
    """The host's monotonic time."""

    def now_ns(self) -> int:
        """Time since some start."""
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleeps until then; returns at once if it is past."""
        if (left_ns := t_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns / NS_PER_S)


@contextmanager
def open_devices(config: Config) -> Iterator[Devices]:
    """Opens what the configuration names, and closes all of it on the way out, whatever happens.

    Raises:
        ConfigError: A backend is unknown, or two do not go together.
        DeviceNotFoundError: A device is not there.
        SimulationError: The simulated scene can't be built.
    """
    camera_class = _known(CAMERAS, "camera", config.camera.backend)
    load_cell_class = _known(LOAD_CELLS, "load_cell", config.load_cell.backend)
    with ExitStack() as stack:
        rig: Any = None
        if config.servo.port.startswith("virtual:") or RIG in (camera_class, load_cell_class):
            rig = load(RIG)(config)
            stack.callback(rig.close)
        elif config.clock == "lockstep":
            raise ConfigError(
                f"clock=lockstep needs a simulated servo, and servo.port is {config.servo.port!r}; "
                "set clock=realtime, or servo.port=virtual:rig"
            )
        if config.faults and rig is None:
            raise ConfigError(
                f"faults are only injected into stand-ins, and servo.port is {config.servo.port!r}; set "
                "servo.port=virtual:rig, or faults=[]"
            )
        clock: Clock = rig.clock if rig is not None else MonotonicClock()
        camera = _open(stack, camera_class, rig, config, clock, "camera")
        load_cell = _open(stack, load_cell_class, rig, config, clock, "load_cell")
        servo = load(SERVO)(config.servo, clock.now_ns)
        stack.callback(servo.close)
        if rig is not None:
            rig.start()
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
        )


def _open(stack: ExitStack, backend: str | None, rig: Any, config: Config, clock: Clock, unit: str) -> Any:
    if backend is None:
        return None
    section = getattr(config, unit)
    if config.clock == "lockstep" and backend not in _ANY_TIME:
        raise ConfigError(f"{unit}.backend={section.backend} can't keep simulated time; set clock=realtime")
    device = getattr(rig, unit) if backend == RIG else load(backend)(section, clock)
    stack.callback(device.close)
    return device


def _known(backends: dict[str, str | None], unit: str, name: str) -> str | None:
    try:
        return backends[name]
    except KeyError:
        raise ConfigError(f"no {unit} backend {name!r}; there are {', '.join(backends)}") from None


def load(path: str) -> Any:
    """Imports what a string names: ``module:name``."""
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)
