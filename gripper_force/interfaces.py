"""What the core asks of a device; `gripper_force.runtime.backends` picks the class by name."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from gripper_force.types import Frame, LoadCellSample, ServoCommand, ServoState


@dataclass(slots=True)
class BusStats:
    """Counters of one servo bus since it was opened."""

    cycles: int = 0
    retries: int = 0
    timeouts: int = 0
    corrupt: int = 0


class Progress(Protocol):
    """Callback that long work calls to report what it does."""

    def __call__(self, text: str, steps: int = 1) -> None:
        """Reports progress.

        Args:
            text: What is being done, for a person.
            steps: Steps of the announced total that were finished since the last call; 0 for none.
        """
        ...


class Prompt(Protocol):
    """Callback that asks a person to do something."""

    def __call__(self, text: str) -> None:
        """Shows an instruction and returns once the person has confirmed it."""
        ...


def no_progress(text: str, steps: int = 1) -> None:
    """Ignores progress reports."""


@dataclass(frozen=True, slots=True)
class ServoSpec:
    """Data of a servo model, known without a connection.

    Attributes:
        nm_per_a: Torque constant at the horn by the vendor's table: a prior, to be calibrated.
        current_step_a: Resolution of the goal current.
        voltage_range_v: Least and greatest supply voltage.
    """

    nm_per_a: float
    current_step_a: float
    voltage_range_v: tuple[float, float]


class Servo(Protocol):
    """The gripper's servo. One thread alone may call it.

    Every method may raise `DeviceLostError`, `DeviceTimeoutError` or `HardwareFaultError`.
    """

    @property
    def stats(self) -> BusStats:
        """Counters of retries and losses."""
        ...

    @property
    def nm_per_a(self) -> float:
        """Torque constant at the horn by the vendor's table: a prior, to be calibrated."""
        ...

    @property
    def current_step_a(self) -> float:
        """Resolution of the goal current."""
        ...

    @property
    def voltage_range_v(self) -> tuple[float, float]:
        """Least and greatest supply it works at, by the vendor's table."""
        ...

    def start(self) -> ServoState:
        """Checks the model, sets mode and limits, reads them back, arms the watchdog and turns torque on.

        The present position is the goal when torque comes on, so nothing moves.
        """
        ...

    def read(self) -> ServoState:
        """Reads all of a `ServoState` in one bus transaction."""
        ...

    def write(self, command: ServoCommand) -> None:
        """Writes goal current and goal position in one bus transaction. Raises `NonFiniteError`."""
        ...

    def stop(self, *, hold: bool) -> None:
        """Ends a run: torque off; with ``hold`` the goals are kept and the watchdog is disarmed."""
        ...

    def close(self) -> None:
        """Releases the port. Does not change the torque. May be called twice."""
        ...


class Camera(Protocol):
    """A gray camera."""

    def start(self) -> None:
        """Opens the device and begins to capture."""
        ...

    def newest(self) -> Frame | None:
        """The newest frame that was not handed out yet, or None. Never blocks."""
        ...

    def counts(self) -> dict[str, int]:
        """What went wrong since it was made: cause to how often."""
        ...

    def close(self) -> None:
        """Stops capturing. May be called twice."""
        ...


class LoadCell(Protocol):
    """A force reference, fitted to calibrate and to check; no decision depends on it."""

    def start(self) -> None:
        """Opens the device and begins to sample."""
        ...

    def drain(self) -> list[LoadCellSample]:
        """Every sample since the last call, oldest first. Never blocks."""
        ...

    def counts(self) -> dict[str, int]:
        """What went wrong since it was made: cause to how often."""
        ...

    def close(self) -> None:
        """Stops sampling. May be called twice."""
        ...


class Clock(Protocol):
    """Time as the session sees it."""

    def now_ns(self) -> int:
        """Monotonic time."""
        ...

    def sleep_until_ns(self, t_ns: int) -> None:
        """Returns at ``t_ns``. In lockstep this is what makes the simulated world go on."""
        ...


@dataclass(slots=True)
class Devices:
    """What a run drives, built by `gripper_force.runtime.backends.open_devices`.

    Attributes:
        clock: The run's time.
        servo: The gripper's servo.
        camera: The camera, or None.
        load_cell: The load cell, or None.
        lockstep: True where the clock is simulated and the run is deterministic.
        start_ns: The run's start on its clock.
        check: Raises what broke in a thread of the devices' own, if anything did.
        notes: Facts about the devices that the log should hold (a scene's drawn parameters, a serial number).
        render_under_light: Returns another camera of the same simulated world under another light, given in
            lux, and that camera's notes; None without a simulated world.
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
