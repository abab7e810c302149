from types import SimpleNamespace

import pytest

from gripper_calibration.setup import scan
from gripper_force.errors import DeviceNotFoundError


def test_a_named_port_that_does_not_exist_is_refused_and_no_other_is_searched() -> None:
    task = SimpleNamespace(given={"servo.port": "/dev/nope"})
    with pytest.raises(DeviceNotFoundError, match=r"there is no port /dev/nope; .* --set servo\.port=PATH"):
        scan._scan_ports(task)  # type: ignore[arg-type]
