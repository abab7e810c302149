import errno
import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import serial

from gripper_force.errors import DeviceError, DeviceNotFoundError
from gripper_hw import serial_line
from gripper_hw.serial_line import open_line


def test_open_errors_have_remedies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(name: str) -> str:
        with pytest.raises(DeviceError) as caught:
            open_line(name, 57_600, unit="load_cell", timeout_s=0)
        return str(caught.value)

    master, slave = pty.openpty()
    path = os.ttyname(slave)
    with open_line(path, 57_600, unit="servo", timeout_s=0):
        user = "this program, or one that it can't see"
        assert refused(path) == f"the load cell's port {path} is in use by {user}; close that first"
    os.close(slave)
    os.close(master)

    missing, file = tmp_path / "missing", tmp_path / "file"
    assert "there is no port" in refused(str(missing))
    with pytest.raises(DeviceNotFoundError, match=r"set servo\.port to one of /dev/serial/by-id"):
        open_line(str(missing), 57_600, unit="servo", timeout_s=0)
    file.touch()
    assert refused(str(file)).startswith(f"can't open the load cell's port {file} (")

    for number, advice in ((errno.EACCES, "join the group dialout"), (errno.EBUSY, "is in use by")):

        def forbid(*_: object, number: int = number, **__: object) -> None:
            raise serial.SerialException(number, os.strerror(number))

        monkeypatch.setattr(serial_line, "ExclusiveSerial", forbid)  # root may open any file
        assert advice in refused(str(file))


@pytest.fixture
def path() -> Iterator[str]:
    """Path of a pseudo-terminal that nobody has open, except this process as its server."""
    master, slave = pty.openpty()
    yield os.ttyname(slave)
    os.close(slave)
    os.close(master)


@contextmanager
def user(path: str, open_it: str) -> Iterator[str]:
    """Runs another program that has a port open. Yields how error messages name it."""
    program = f"import os, serial, time; line = {open_it}; print(flush=True); time.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield f"{Path(f'/proc/{process.pid}/comm').read_text().strip()} (process {process.pid})"
        process.kill()


@pytest.mark.parametrize("kind", ["without a lock", "with pyserial's lock"])
def test_a_port_that_another_program_has_open_is_refused_and_the_program_named(path: str, kind: str) -> None:
    open_it = f"serial.Serial({path!r}, exclusive={kind.startswith('with pyserial')})"
    with (
        user(path, open_it) as name,
        pytest.raises(DeviceError, match="is in use by") as caught,
    ):
        open_line(path, 57_600, unit="servo", timeout_s=0)
    assert str(caught.value) == f"the servo's port {path} is in use by {name}; close that first"
    open_line(path, 57_600, unit="servo", timeout_s=0).close()


def test_a_port_in_exclusive_mode_is_refused_even_to_root(path: str) -> None:
    exclusive = f"import fcntl, termios; fcntl.ioctl(os.open({path!r}, os.O_RDWR), termios.TIOCEXCL)"
    subprocess.run([sys.executable, "-c", f"import os; {exclusive}"], check=True)  # a pty keeps the mode
    for _ in range(2):
        with pytest.raises(DeviceError, match="is in use by"):
            open_line(path, 57_600, unit="servo", timeout_s=0)


OPEN_AS_NOBODY = """
import os, sys
if os.getuid() == 0:
    os.setuid(65534)
os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
"""


def test_no_other_program_can_open_the_port_until_it_is_closed(path: str) -> None:
    with suppress(PermissionError):
        Path(path).chmod(0o666)

    def opens() -> bool:
        return not subprocess.run(
            [sys.executable, "-c", OPEN_AS_NOBODY, path], check=False, stderr=subprocess.DEVNULL
        ).returncode

    assert opens()
    line = open_line(path, 57_600, unit="servo", timeout_s=0)
    assert not opens()
    line.close()
    assert opens()
