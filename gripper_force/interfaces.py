"""Protocols of devices, which `gripper_force.runtime.backends` opens by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, Protocol

from gripper_force.types import Frame, LoadCellSample, ServoCommand, ServoState

if TYPE_CHECKING:
    from gripper_force.config import ServoConfig


@dataclass(slots=True)
class BusStats:
    """Counters of one servo bus since it was opened.

    Attributes:
        cycles: Successful reads.
        retries: Repeated attempts.
        timeouts: Attempts without a reply, or without the lock of a shared port.
        corrupt: Attempts with a corrupt reply.
    """

    cycles: int = 0
    retries: int = 0
    timeouts: int = 0
    corrupt: int = 0


@dataclass(frozen=True, slots=True)
class ServoSpec:
    """Data of a servo model, known without a connection.

    Attributes:
        nm_per_a: Torque constant at the horn by the vendor's table: a prior, to be calibrated.
        current_step_a: Resolution of the goal current.
        voltage_range_v: Least and greatest supply voltage.
        position_loop_a_per_rad: Motor current per radian between goal and present position, or None if unknown.
        position_loop_gain_per_s: Speed without load per radian between goal and present position, or None.
        position_range_rad: Positions that the servo reports after it was powered on, or None if any.
    """

    nm_per_a: float
    current_step_a: float
    voltage_range_v: tuple[float, float]
    position_loop_a_per_rad: float | None = None
    position_loop_gain_per_s: float | None = None
    position_range_rad: tuple[float, float] | None = None


class Lock(Protocol):
    """A lock such as `threading.Lock`."""

    def acquire(self, *, timeout: float) -> bool:
        """Waits up to ``timeout`` seconds for the lock, and returns whether it was acquired."""

    def release(self) -> None:
        """Releases the lock."""


@dataclass(frozen=True, slots=True)
class SharedPort:
    """An open port that another part of the program uses, too.

    Attributes:
        handler: A ``dynamixel_sdk.PortHandler``, or an object with the same methods.
        lock: Held by whoever uses the port, for one transaction: a request and its replies.
    """

    handler: Any
    lock: Lock


class Servo(Protocol):
    """The gripper's servo. One thread alone may call it.

    Constructed as ``Class(config.servo, now_ns)``: ``now_ns()`` returns the time on the run's clock. A
    `SharedPort` is a third argument.

    Every method may raise `DeviceLostError`, `DeviceTimeoutError` or `HardwareFaultError`.
    """

    @property
    def stats(self) -> BusStats:
        """Counters of cycles, retries and losses."""

    @staticmethod
    def spec(config: ServoConfig) -> ServoSpec:
        """Returns the data of the configured model, without a connection. Raises `ConfigError`."""

    def start(self) -> ServoState:
        """Checks the model, sets mode and limits, reads them back, arms the watchdog and turns torque on.

        The present position is the goal when torque turns on, so nothing moves. If this raises, torque is off.
        """

    def read(self) -> ServoState:
        """Reads a `ServoState`, in one bus transaction if all of it fits."""

    def write(self, command: ServoCommand) -> None:
        """Writes goal current and goal position in one bus transaction. Raises `NonFiniteError`."""

    def stop(self, *, hold: bool) -> None:
        """Ends a run: turns torque off, or with ``hold`` keeps the goals and disarms the watchdog."""

    def close(self) -> None:
        """Releases the port without changing the torque. May be called twice."""


class Camera(Protocol):
    """A gray camera. With the class attribute ``supports_lockstep = True`` it follows simulated time.

    Constructed as ``Class(config.camera, clock)``, with the run's `Clock`.

    A method ``settings() -> dict[str, float | str]`` is optional: the settings in force by key of the section
    ``camera``, for ``doctor`` and the log.
    """

    def start(self) -> None:
        """Opens the device and starts to capture."""

    def newest(self) -> Frame | None:
        """Returns the newest frame that was not returned before, or None. Never blocks.

        A camera that is lost returns None until it is back: the run goes on with motor current alone. An exception
        ends the run.
        """

    def counts(self) -> dict[str, int]:
        """Returns the number of problems since construction by cause."""

    def close(self) -> None:
        """Stops capturing. May be called twice."""


class LoadCell(Protocol):
    """A force reference for calibration and checks; no control decision depends on it.

    With the class attribute ``supports_lockstep = True`` it follows simulated time. Constructed as
    ``Class(config.load_cell, clock)``, with the run's `Clock`.
    """

    def start(self) -> None:
        """Opens the device and starts to sample."""

    def drain(self) -> list[LoadCellSample]:
        """Returns all samples since the last call, oldest first. Never blocks. An exception ends the run."""

    def counts(self) -> dict[str, int]:
        """Returns the number of problems since construction by cause."""

    def close(self) -> None:
        """Stops sampling. May be called twice."""


class Clock(Protocol):
    """The run's clock."""

    def now_ns(self) -> int:
        """Returns the monotonic time in nanoseconds."""

    def sleep_until_ns(self, t_ns: int) -> None:
        """Waits until ``t_ns``. In lockstep this advances the simulated world."""


class WorldState(NamedTuple):
    """True state of a simulated world, which no device measures.

    Attributes:
        t_ns: Time on the run's clock.
        force_n: Grip force: mean of the normal forces on the two jaws.
        closing_m_s: Speed of the drive as travel of one jaw, positive while it closes. Within the gear play a jaw
            can be faster for some milliseconds.
        has_object: False if there is no object, or it has left the jaws.
    """

    t_ns: int
    force_n: float
    closing_m_s: float
    has_object: bool


@dataclass(slots=True)
class Devices:
    """The devices of a run, opened by `gripper_force.runtime.backends.open_devices`.

    Attributes:
        clock: The run's time.
        servo: The gripper's servo.
        camera: The camera, or None.
        load_cell: The load cell, or None.
        lockstep: True if the clock is simulated and the run is deterministic.
        start_ns: The run's start on its clock.
        check: Re-raises an exception from a device's background thread, if there was one.
        notes: Facts about the devices for the log, such as the scene's parameters or a serial number.
        render_under_light: Returns another camera of the same simulated world under another light, given in
            lux, and that camera's notes; None without a simulated world.
        observe_world: Makes a simulated world call a function with its true state after each of its steps, in
            its thread; None without a simulated world.
        wrap_estimator: Makes an estimator fail as the key `faults` says; None without such a fault.
        wrap_file: The same for the log's file.
    """

    clock: Clock
    servo: Servo
    camera: Camera | None
    load_cell: LoadCell | None
    lockstep: bool
    start_ns: int
    check: Callable[[], None]
    notes: dict[str, str] = field(default_factory=dict)
    render_under_light: Callable[[float], tuple[Camera, dict[str, str]]] | None = None
    observe_world: Callable[[Callable[[WorldState], None]], None] | None = None
    wrap_estimator: Callable[[Any], Any] | None = None
    wrap_file: Callable[[BinaryIO], BinaryIO] | None = None
