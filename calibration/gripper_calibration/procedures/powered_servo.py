"""A servo under torque for the time of a procedure without a session."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from gripper_force.config import Config
from gripper_force.control.limits import Limits
from gripper_force.control.safety import SafetyLatch
from gripper_force.control.speed_limit import SpeedLimit
from gripper_force.control.transmission import Transmission
from gripper_force.errors import DeviceError
from gripper_force.interfaces import Devices, Servo
from gripper_force.runtime.process import deferred_signals
from gripper_force.runtime.reading import read_patiently
from gripper_force.runtime.resolve import position_loop
from gripper_force.types import NS_PER_MS, NS_PER_S, ServoCommand, ServoState

RATE_HZ: Final = 200.0


def servo_alone(config: Config) -> Config:
    """Returns a configuration without camera and load cell."""
    return config.with_values(camera={"backend": "none"}, load_cell={"backend": "none"})


@contextmanager
def torque_on(servo: Servo) -> Iterator[tuple[ServoState, Callable[[], None]]]:
    """Turns torque on, and off at every end.

    Signals wait until the procedure asks for them, so that none interrupts the end: a lost connection sends two.

    Yields:
        The state at the start, and a function that raises `KeyboardInterrupt` if a signal has come. To be called in
        each cycle.
    """
    signals: list[bool] = []

    def raise_if_interrupted() -> None:
        if signals:
            raise KeyboardInterrupt("the calibration was interrupted")

    with deferred_signals(signals.append):
        state = servo.start()  # if this raises, it has turned torque off itself
        try:
            yield state, raise_if_interrupted
        finally:
            servo.stop(hold=False)
    raise_if_interrupted()


class BusCycles:
    """Cycles of reading and writing a servo, at `RATE_HZ`, with the safety checks and the speed limit of a grasp.

    Attributes:
        transmission: By the configuration.
        limits: By the configuration.
        approach_m_s: Speed of a jaw on its way to an object, as in a grasp.
        state: The last reading.
    """

    def __init__(
        self, config: Config, devices: Devices, state: ServoState, raise_if_interrupted: Callable[[], None]
    ) -> None:
        gripper = config.gripper
        self.transmission = Transmission.from_config(
            gripper, gripper.nm_per_a or 0.0, gripper.current_step_a or 0.0
        )
        self.approach_m_s = min(
            config.control.approach_speed_m_s, self.transmission.impact_m_s(config.control.force_limit_n)
        )
        self.limits = Limits(config.control, self.transmission, config.servo.current_limit_a)
        self.state = state
        self._config, self._devices = config, devices
        self._raise_if_interrupted = raise_if_interrupted
        self._speed_limit = SpeedLimit(self.transmission, position_loop(gripper))
        self._safety = SafetyLatch(config.control)
        self._period_ns = round(NS_PER_S / RATE_HZ)
        self._due_ns = devices.clock.now_ns()
        self._goal_a = 0.0

    def read(self) -> ServoState:
        """Waits for the next cycle and reads the servo.

        Raises:
            DeviceError: The servo does not answer, or another device failed.
            KeyboardInterrupt: A signal has come.
        """
        devices = self._devices
        self._due_ns = max(self._due_ns + self._period_ns, devices.clock.now_ns())
        devices.clock.sleep_until_ns(self._due_ns)
        self._raise_if_interrupted()
        devices.check()
        self.state = read_patiently(
            devices.servo,
            devices.clock,
            self.state,
            period_ns=self._period_ns,
            patience_ns=self._config.servo.bus_watchdog_ms * NS_PER_MS,
        )
        return self.state

    def write(
        self, goal_rad: float, current_a: float, speed_m_s: float, *, over_force: bool = False, step: str = ""
    ) -> None:
        """Writes a goal angle and a current limit, so that a jaw is no faster than a speed.

        Args:
            goal_rad: Goal angle of the servo.
            current_a: Goal current.
            speed_m_s: Largest speed of a jaw.
            over_force: True if a load cell reads more than the force limit.
            step: Step of the procedure, for an error.

        Raises:
            DeviceError: The state that was read is not safe.
        """
        if self._safety.check(self.state, self._goal_a, 1 / RATE_HZ, over_force=over_force):
            where = f" in {step}" if step else ""
            raise DeviceError(f"stopped{where}: {self._safety.reason}; remove the cause and start again")
        self._goal_a = current_a
        command = ServoCommand(self._due_ns, goal_rad, current_a)
        self._devices.servo.write(self._speed_limit.apply(command, self.state, speed_m_s))
