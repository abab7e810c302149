"""A servo under torque for the time of a procedure without a session."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from gripper_force.interfaces import Servo
from gripper_force.runtime.process import deferred_signals
from gripper_force.types import ServoState


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

    with deferred_signals(lambda: signals.append(True)):
        state = servo.start()  # if this raises, it has turned torque off itself
        try:
            yield state, raise_if_interrupted
        finally:
            servo.stop(hold=False)
    raise_if_interrupted()
