import errno
import os
import pty
from pathlib import Path

import pytest
import serial

from gripper_force.errors import DeviceError, DeviceNotFoundError
from gripper_hw.serial_line import open_line


def test_open_errors_have_remedies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(name: str) -> str:
        with pytest.raises(DeviceError) as caught:
            open_line(name, 57_600, unit="load_cell", timeout_s=0)
        return str(caught.value)

    master, slave = pty.openpty()
    path = os.ttyname(slave)
    with open_line(path, 57_600, unit="servo", timeout_s=0):
        assert refused(path) == f"the load cell's port {path} is in use by another program; close that first"
    os.close(slave)
    os.close(master)

    missing, file = tmp_path / "missing", tmp_path / "file"
    assert "there is no port" in refused(str(missing))
    with pytest.raises(DeviceNotFoundError, match=r"set servo\.port to one of /dev/serial/by-id"):
        open_line(str(missing), 57_600, unit="servo", timeout_s=0)
    file.touch()
    assert refused(str(file)).startswith(f"can't open the load cell's port {file} (")

    for number, advice in ((errno.EACCES, "join the group dialout"), (errno.EBUSY, "is in use by another")):

        def forbid(*_: object, number: int = number, **__: object) -> None:
            raise serial.SerialException(number, os.strerror(number))

        monkeypatch.setattr(serial, "Serial", forbid)  # root may open any file
        assert advice in refused(str(file))
