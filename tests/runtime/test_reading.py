"""Reading of a servo that does not answer for a moment."""

from dataclasses import dataclass, field

import pytest

from gripper_force.errors import DeviceLostError, DeviceTimeoutError
from gripper_force.interfaces import Servo
from gripper_force.runtime.reading import read_patiently
from gripper_force.types import NS_PER_MS, ServoState

PERIOD_NS = 5 * NS_PER_MS


@dataclass
class FakeClock:
    t_ns: int = 0

    def now_ns(self) -> int:
        return self.t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        self.t_ns = t_ns


@dataclass
class SilentServo:
    """Answers from a time on."""

    clock: FakeClock
    answers_ns: int
    error: Exception = field(default_factory=lambda: DeviceTimeoutError("no valid reply"))
    tries: int = 0

    def read(self) -> ServoState:
        self.tries += 1
        if self.clock.t_ns < self.answers_ns:
            raise self.error
        return state_at(self.clock.t_ns)


def state_at(t_ns: int) -> ServoState:
    return ServoState(t_ns, 0.0, 0.0, 0.0, 30.0, 12.0, 0)


def read(servo: SilentServo, last: ServoState | None) -> tuple[ServoState, int]:
    retries: list[int] = []
    patient: Servo = servo  # type: ignore[assignment]
    state = read_patiently(
        patient,
        servo.clock,
        last,
        period_ns=PERIOD_NS,
        patience_ns=40 * NS_PER_MS,
        before_retry=lambda: retries.append(1),
    )
    return state, len(retries)


def test_a_silence_shorter_than_the_watchdog_is_waited_out() -> None:
    servo = SilentServo(FakeClock(), answers_ns=30 * NS_PER_MS)
    assert read(servo, state_at(0)) == (state_at(30 * NS_PER_MS), 6)


def test_a_silence_as_long_as_the_watchdog_ends_the_run() -> None:
    servo = SilentServo(FakeClock(), answers_ns=50 * NS_PER_MS)
    with pytest.raises(DeviceTimeoutError):
        read(servo, state_at(0))
    assert servo.clock.t_ns == 40 * NS_PER_MS


def test_the_first_reading_is_not_repeated() -> None:
    servo = SilentServo(FakeClock(), answers_ns=1)
    with pytest.raises(DeviceTimeoutError):
        read(servo, None)
    assert servo.tries == 1


def test_a_lost_servo_is_not_asked_again() -> None:
    servo = SilentServo(FakeClock(), answers_ns=1, error=DeviceLostError("the port is gone"))
    with pytest.raises(DeviceLostError):
        read(servo, state_at(0))
    assert servo.tries == 1
