"""Search for servos on serial ports, at every baud rate of the X series. Only pings: nothing is written."""

from collections.abc import Iterable
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Final

from serial.tools import list_ports

from gripper_force.config import VIRTUAL_PREFIX, Config
from gripper_force.errors import ConfigError, GripperError
from gripper_force.jobs.checks import FoundServo, PortScan, keep_only
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.backends import open_devices
from gripper_hw.dynamixel.control_table import load_model, model_name
from gripper_hw.dynamixel.transport import Transport

BAUD_RATES: Final = {
    1_000_000: 3,
    57_600: 1,
    115_200: 2,
    2_000_000: 4,
    3_000_000: 5,
    4_000_000: 6,
    9_600: 0,
}
"""Baud rates and their values of the register Baud Rate, in the order of the search: usual ones first. The vendor's
SDK does not support the eighth, 4.5 million."""

FAST_BAUD_RATE: Final = 1_000_000
"""The lowest rate at which a cycle takes less than the 5 ms of 200 Hz, also with two servos."""

_BY_ID: Final = Path("/dev/serial/by-id")


def ports() -> list[str]:
    """Paths of the serial ports that are plugged in; those under ``/dev/serial/by-id`` stay after a restart."""
    stable = {str(link.resolve()): str(link) for link in sorted(_BY_ID.glob("*"))}
    return sorted(stable.get(port.device, port.device) for port in list_ports.comports())


def scan(config: Config, names: Iterable[str], progress: Progress = no_progress) -> list[PortScan]:
    """Returns the servos that answer on each port, or why the port can't be used.

    Args:
        config: The configuration; its model tells servos of a file of one's own.
        names: Ports to search.
        progress: Called with each port and baud rate.
    """
    return [_scan_port(config, name, progress) for name in names]


def _scan_port(config: Config, name: str, progress: Progress) -> PortScan:
    baud_rates = tuple(BAUD_RATES)
    servos: dict[int, FoundServo] = {}
    problems: list[str] = []
    with ExitStack() as stack:
        if name.startswith(VIRTUAL_PREFIX):
            port_config = keep_only(config.with_values(servo={"port": name}), "servo")
            stack.enter_context(open_devices(port_config))
            baud_rates = (config.servo.baud_rate,)  # bytes pass a virtual port at any rate
        for rate in baud_rates:
            progress(f"{name} at {rate} baud", 0)
            at_rate = config.servo.model_copy(update={"port": name, "baud_rate": rate, "retries": 0})
            try:
                with closing(Transport(at_rate)) as transport:
                    transport.open()
                    answers = transport.scan()
            except GripperError as error:  # not every adapter supports every rate
                problems.append(str(error))
                continue
            for id_, (number, firmware) in sorted(answers.items()):
                if id_ not in servos:  # a pseudo-terminal answers at every rate
                    servos[id_] = _servo(config, name, rate, id_, number, firmware)
    is_unusable = len(problems) == len(baud_rates)
    return PortScan(name, list(servos.values()), problems[0] if is_unusable else "")


def _servo(config: Config, port: str, baud_rate: int, id_: int, number: int, firmware: int) -> FoundServo:
    name = model_name(number) or f"model number {number}"
    with suppress(ConfigError):  # the configured model may not exist
        if load_model(config.servo.model).number == number:
            name = config.servo.model
    try:
        max_current_a = load_model(name).max_current_a
    except ConfigError:
        max_current_a = None
    return FoundServo(port, baud_rate, id_, name, firmware, max_current_a)
