"""Step ``scan``: finds servo, camera and load cell."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gripper_calibration.setup.step import Found, StepResult, Task
from gripper_force.config import VIRTUAL_PREFIX
from gripper_force.errors import DeviceNotFoundError
from gripper_force.jobs import doctor
from gripper_force.jobs.checks import FoundServo, PortScan
from gripper_force.schema import Tree

ORIGIN = "found by the scan"

_CHECK = (
    "The supply is on and has the servo's voltage: a servo's LED flashes once when power comes on.",
    "The adapter is plugged in (`ls -l /dev/serial/by-id`), and its cable has all wires: 3 for TTL, 4 for RS-485.",
    "You may open the port: you are in the group dialout (`groups`).",
    "No other program uses the port, such as DYNAMIXEL Wizard or a robot's driver.",
    "The servo speaks Protocol 2.0. X-series servos do, unless Protocol Type was changed.",
)


def scan(task: Task) -> StepResult:
    """Finds the gripper's servo on the serial ports, then a camera and a load cell, unless they are given.

    Nothing is written to any device. Other servos on the same bus are only pinged.

    Raises:
        ConfigError: Several servos or cameras could be meant, and a script can't choose.
        DeviceNotFoundError: No servo that can control force answers.
    """
    if task.config.servo.backend != "dynamixel":
        return StepResult(f"servo.backend={task.config.servo.backend} is not searched for")
    ports, scans = _scan_ports(task)
    servos = [servo for one in scans for servo in one.servos]
    for servo in servos:
        task.person.tell(_line(servo))
    remarks = [f"{one.port} was not searched: {one.problem}" for one in scans if one.problem]
    servo = _gripper(task, servos, scans)
    values = {"servo.port": servo.port, "servo.baud_rate": servo.baud_rate, "servo.id": servo.id}
    values["servo.model"] = servo.model
    assert servo.max_current_a is not None
    if "servo.current_limit_a" not in task.given and task.config.servo.current_limit_a > servo.max_current_a:
        values["servo.current_limit_a"] = servo.max_current_a
    own = {servo.id, task.config.servo.second.id}
    others = [one.id for one in servos if one.port == servo.port and one.id not in own]
    if others:
        remarks.append(f"other servos on this bus stay untouched: id {', '.join(map(str, sorted(others)))}")
    if (wanted := task.given.get("servo.model")) not in (None, servo.model):
        remarks.append(f"servo.model was {wanted}, but the servo is {servo.model}")
    sensors = {} if _is_virtual(servo.port) else _real_sensors(task, ports, servo.port, remarks)
    found = {key: Found(value, ORIGIN) for key, value in {**values, **sensors}.items()}
    return StepResult(
        f"{servo.model} with id {servo.id} on {servo.port} at {servo.baud_rate} baud",
        found,
        remarks,
        details={"servos": [asdict(one) for one in servos]},
    )


def _is_virtual(port: str) -> bool:
    return port.startswith(VIRTUAL_PREFIX)


def _line(servo: FoundServo) -> str:
    usable = "" if servo.max_current_a is not None else ", not supported: no current control, or unknown"
    return (
        f"found {servo.model}, id {servo.id}, firmware {servo.firmware}, on {servo.port} at {servo.baud_rate} baud"
        f"{usable}"
    )


def _scan_ports(task: Task) -> tuple[list[str], list[PortScan]]:
    """Returns all real ports, and what answers: on the given port, or else on all of them."""
    given, ports = task.given.get("servo.port"), doctor.serial_ports()
    if given is not None and not _is_virtual(given) and not Path(given).exists():
        raise DeviceNotFoundError(
            f"there is no port {given}; there are {', '.join(ports) or 'none'}: name one with --set servo.port=PATH, "
            "or leave servo.port out to search all of them"
        )
    first = [] if given is None else [given]
    scans = doctor.scan_servos(task.config, first, task.progress)
    if not any(one.servos for one in scans) and not (given and _is_virtual(given)):
        searched = {str(Path(one).resolve()) for one in first}
        rest = [port for port in ports if str(Path(port).resolve()) not in searched]
        scans += doctor.scan_servos(task.config, rest, task.progress)
    return ports, scans


def _gripper(task: Task, servos: list[FoundServo], scans: list[PortScan]) -> FoundServo:
    usable = [servo for servo in servos if servo.max_current_a is not None]
    if not usable:
        for text in _CHECK:
            task.person.tell(f"- {text}")
        where = ", ".join(one.port for one in scans) or "any port: no serial port is plugged in"
        found = f"; {', '.join(map(_line, servos))}" if servos else ""
        raise DeviceNotFoundError(
            f"no servo with current control answers on {where}, at any baud rate{found}; check supply, cable and "
            "permission, name the port with --set servo.port=PATH, or try without hardware: "
            "--set servo.port=virtual:rig"
        )
    named = {key: task.given[key] for key in ("servo.port", "servo.id") if key in task.given}
    fitting = [servo for servo in usable if _is_named(servo, named)]
    usable = fitting or usable
    if fitting and len(usable) == 1:
        return usable[0]
    if not fitting:  # the gripper may be without power, and these servos an arm's: never take one silently
        task.person.tell(
            f"no servo answers with {', '.join(f'{key}={value}' for key, value in named.items())}"
        )
    answers = {f"{servo.id} on {servo.port}": servo for servo in usable}
    if len({servo.port for servo in usable}) == 1:
        answers = {str(servo.id): servo for servo in usable}
    option = "--set servo.id=ID and, with several ports, --set servo.port=PATH"
    return answers[task.person.choose("Which id is the gripper's servo?", list(answers), option)]


def _is_named(servo: FoundServo, named: Mapping[str, Any]) -> bool:
    """Returns True if a servo has the port and the id that are given."""
    port = named.get("servo.port", servo.port)
    same_port = port == servo.port or Path(port).resolve() == Path(servo.port).resolve()
    return same_port and named.get("servo.id", servo.id) == servo.id


def _real_sensors(task: Task, ports: list[str], servo_port: str, remarks: list[str]) -> dict[str, Any]:
    """Keys of camera, load cell and clock of a real rig. What is given is kept."""
    found: Tree = {} if "clock" in task.given else {"clock": "realtime"}
    if "camera.backend" not in task.given:
        found |= _section("camera", _camera(task, remarks))
    if "load_cell.backend" not in task.given:
        used = str(Path(servo_port).resolve())
        free = [port for port in ports if str(Path(port).resolve()) != used]
        cell = doctor.find_load_cell(task.config, free, task.progress)
        if cell is None:
            remarks.append(
                "no serial load cell was found; once it is connected, `setup --step scan` looks again (a Phidget "
                "bridge is not searched for: --set load_cell.backend=phidget)"
            )
        found |= _section("load_cell", cell or {"backend": "none"})
    return found


def _camera(task: Task, remarks: list[str]) -> Tree:
    cameras = doctor.find_cameras()
    if not cameras:
        remarks.append(
            "no camera was found; once it is connected, `setup --step scan` looks again; without one, a grasp controls "
            "force by motor current alone"
        )
        return {"backend": "none"}
    names = {f"{one['backend']} {one['device']}": one for one in cameras}
    if len(names) == 1:
        return cameras[0]
    option = "--set camera.backend=oak, or --set camera.backend=uvc --set camera.device=/dev/videoN"
    return names[task.person.choose("Which camera looks at the jaws?", list(names), option)]


def _section(name: str, keys: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{name}.{key}": value for key, value in keys.items()}
