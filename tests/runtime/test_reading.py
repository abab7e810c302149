"""Reading of a servo that does not answer."""

from unittest.mock import Mock

import pytest

from gripper_force.errors import DeviceError, DeviceLostError, DeviceTimeoutError
from gripper_force.runtime.reading import read_patiently
from gripper_force.types import NS_PER_MS, ServoState


@pytest.mark.parametrize(
    ("last", "error"),
    [
        (None, DeviceTimeoutError("no valid reply")),
        (ServoState(0, 0.0, 0.0, 0.0, 30.0, 12.0, 0), DeviceLostError("the port is gone")),
    ],
)
def test_neither_the_first_reading_nor_that_of_a_lost_servo_is_repeated(
    last: ServoState | None, error: DeviceError
) -> None:
    servo = Mock(**{"read.side_effect": error})
    clock = Mock(**{"now_ns.return_value": 0})
    with pytest.raises(type(error)):
        read_patiently(servo, clock, last, period_ns=5 * NS_PER_MS, patience_ns=40 * NS_PER_MS)
    assert servo.read.call_count == 1
