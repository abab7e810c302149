"""A grasp that is killed or stopped in mid-motion, in a process of its own, on a servo in another."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import dynamixel_sdk as sdk
import pytest

from gripper_force.log import LogReader
from gripper_force.types import NS_PER_MS, ServoCommand, ServoState
from gripper_hw.dynamixel.control_table import REGISTERS
from gripper_hw.dynamixel.packets import Error

COMMAND = [sys.executable, "-c", "from gripper_force.cli import main; main()"]
PACKETS = sdk.PacketHandler(2.0)
STARVED_MS = 400
"""How late a busy machine may let a process come to its next cycle."""


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


@pytest.fixture(scope="module")
def device_path() -> Iterator[str]:
    with process("virtual-servo", "--json") as child:
        yield json.loads(child.stdout.readline())["port"]


def read(port: sdk.PortHandler, name: str) -> int:
    register = REGISTERS[name]
    data, result, _ = PACKETS.readTxRx(port, 1, register.address, register.size)
    assert result == sdk.COMM_SUCCESS
    return register.decode(bytes(data))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_the_servo_lets_go_by_itself_and_the_log_is_whole(device_path, quick, tmp_path: Path, number):
    settings = {
        "servo.port": device_path,
        "clock": "realtime",
        "load_cell.backend": "none",
        "servo.reply_margin_ms": STARVED_MS,
        "servo.bus_watchdog_ms": 2 * STARVED_MS,
        "gripper.open_width_m": 0.5,  # so far that it is on its way for ten seconds
        "control.timeout_s": 60,
        "log.directory": tmp_path,
        "log.report": "false",
    }
    sets = [*quick, *(f"{key}={value}" for key, value in settings.items())]
    with ExitStack() as stack:
        child = stack.enter_context(process("grasp", *(part for one in sets for part in ("--set", one))))
        assert any("approach" in line for line in child.stderr), child.stdout.read()
        time.sleep(1.0)  # some way
        assert child.poll() is None
        sent_ns = time.monotonic_ns()
        child.send_signal(number)
        time.sleep(3 * STARVED_MS / 1e3)  # in silence: any packet would feed the watchdog

        port = sdk.PortHandler(device_path)
        stack.callback(port.closePort)
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

    (path,) = tmp_path.glob("*.mcap")
    log = LogReader(path, recover=True)
    states, commands = list(log.records(ServoState)), list(log.records(ServoCommand))
    assert states[-1].position_rad > states[0].position_rad + 0.01  # it was on its way
    assert abs(len(states) - len(commands)) <= 1
    lost_ms = (sent_ns - states[-1].t_ns) / NS_PER_MS
    assert lost_ms < 100 + STARVED_MS
