"""Reading of a servo, with further attempts if it does not answer."""

from collections.abc import Callable

from gripper_force.errors import DeviceTimeoutError
from gripper_force.interfaces import Clock, Servo
from gripper_force.types import ServoState


def read_patiently(
    servo: Servo,
    clock: Clock,
    last: ServoState | None,
    *,
    period_ns: int,
    patience_ns: int,
    before_retry: Callable[[], None] = lambda: None,
) -> ServoState:
    """Reads a servo. If it does not answer, tries again for as long as its watchdog waits.

    Meanwhile the servo follows the last command, which was within the limits.

    Args:
        servo: The servo.
        clock: The clock of the run.
        last: The reading before, or None for the first one, which is not repeated.
        period_ns: Time between two attempts.
        patience_ns: Time from the last reading after which the servo's watchdog trips.
        before_retry: Called before each further attempt.

    Raises:
        DeviceError: The servo is lost, or does not answer for that long.
    """
    while True:
        try:
            state = servo.read()
            # Without its time nothing would end: every deadline of the controller is on it.
            if last and state.t_ns <= last.t_ns and clock.now_ns() - last.t_ns > patience_ns:
                raise DeviceTimeoutError("the servo's t_ns stands still; it must be the time of the reading")  # noqa: TRY301
            return state  # noqa: TRY300
        except DeviceTimeoutError:
            next_ns = clock.now_ns() + period_ns
            if last is None or next_ns - last.t_ns > patience_ns:
                raise
            clock.sleep_until_ns(next_ns)
            before_retry()
