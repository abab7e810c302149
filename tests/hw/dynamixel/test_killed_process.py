"""Grasp processes that are killed or stopped in motion."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import dynamixel_sdk as sdk
import pytest

from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import NS_PER_MS, ServoCommand, ServoState
from gripper_hw.dynamixel.control_table import REGISTERS
from gripper_hw.dynamixel.packets import Error
from gripper_hw.dynamixel.pty_server import serve_virtual_servo

COMMAND = [sys.executable, "-c", "from gripper_force.cli import main; main()"]
SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
PACKETS = sdk.PacketHandler(2.0)
STARVED_MS = 400
"""Longest delay of a cycle on a busy machine."""


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    child = subprocess.Popen(
        [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    with child:
        try:
            yield child
        finally:
            child.kill()


def read(port: sdk.PortHandler, name: str) -> int:
    register = REGISTERS[name]
    data, result, _ = PACKETS.readTxRx(port, 1, register.address, register.size)
    assert result == sdk.COMM_SUCCESS
    return register.decode(bytes(data))


def grasp(port: str, folder: Path, quick: list[str]) -> list[str]:
    settings = {
        "servo.port": port,
        "clock": "realtime",
        "load_cell.backend": "none",
        "servo.reply_margin_ms": STARVED_MS,
        "servo.bus_watchdog_ms": 2 * STARVED_MS,
        "gripper.pinion_radius_m": 0.04,
        "gripper.open_width_m": 0.2,
        "control.approach_speed_m_s": 0.005,  # 20 s of motion
        "control.timeout_s": 60,
        "log.directory": folder,
        "log.report": "false",
    }
    sets = [*quick, *(f"{key}={value}" for key, value in settings.items())]
    return ["grasp", *(part for one in sets for part in ("--set", one))]


def test_watchdog_stops_the_motor_and_the_log_is_readable(quick, tmp_path):
    for attempt in range(3):
        try:
            kill_both(quick, tmp_path / str(attempt))
        except BusyError as error:
            why = error
        else:
            return
    pytest.skip(f"this machine is too busy for real time: {why}")


class BusyError(Exception):
    """A grasp ended with an error before it was killed."""


def kill_both(quick: list[str], tmp_path: Path) -> None:
    with ExitStack() as stack:
        ports, children = [], []
        for number in SIGNALS:
            ports.append(stack.enter_context(serve_virtual_servo("XM430-W350")).device_path)
            folder = tmp_path / number.name
            children.append(stack.enter_context(process(*grasp(ports[-1], folder, quick))))
        for child in children:
            assert child.stderr is not None
            if not any("approach" in line for line in child.stderr):
                check_busy(child)
        time.sleep(0.5)  # of motion
        for child in children:
            if child.poll() is not None:
                check_busy(child)
        sent_ns = time.monotonic_ns()
        for number, child in zip(SIGNALS, children, strict=True):
            child.send_signal(number)
        time.sleep(3 * STARVED_MS / 1e3)  # without packets, which would feed the watchdog
        for port in ports:
            check_servo(port)
    for number in SIGNALS:
        check_log(tmp_path / number.name, sent_ns)


def check_busy(child: subprocess.Popen[str]) -> None:
    assert child.stdout is not None
    assert child.stderr is not None
    said = child.stdout.read() + child.stderr.read()
    assert any(sentence in said for sentence in ("no valid reply", "watchdog tripped")), said
    raise BusyError(said)


def check_servo(device_path: str) -> None:
    port = sdk.PortHandler(device_path)
    assert port.openPort()
    assert read(port, "bus_watchdog") == -1
    assert read(port, "goal_current") != 0
    assert read(port, "present_current") == 0
    goal = REGISTERS["goal_current"].address
    assert PACKETS.write2ByteTxRx(port, 1, goal, 100) == (sdk.COMM_SUCCESS, Error.DATA_RANGE)
    stopped_at = read(port, "present_position")
    time.sleep(0.1)
    assert read(port, "present_position") == stopped_at
    assert read(port, "goal_position") != stopped_at
    port.closePort()


def check_log(folder: Path, sent_ns: int) -> None:
    (path,) = folder.glob("*.mcap")
    log = LogReader(path, recover=True)
    states, commands = list(log.records(ServoState)), list(log.records(ServoCommand))
    assert states[-1].position_rad > states[0].position_rad + 0.01  # it was moving
    assert abs(len(states) - len(commands)) <= 1
    assert (sent_ns - states[-1].t_ns) / NS_PER_MS < 100 + STARVED_MS
