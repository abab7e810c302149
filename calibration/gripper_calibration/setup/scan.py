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
    own_ids = {servo.id, task.config.servo.second.id}
    other_ids = [one.id for one in servos if one.port == servo.port and one.id not in own_ids]
    if other_ids:
        remarks.append(
            f"other servos on this bus stay untouched: id {', '.join(map(str, sorted(other_ids)))}"
        )
    if (given_model := task.given.get("servo.model")) not in (None, servo.model):
        remarks.append(f"servo.model was {given_model}, but the servo is {servo.model}")
    sensors = {} if _is_virtual(servo.port) else _real_sensors(task, ports, servo.port, remarks)
    result = {key: Found(value, ORIGIN) for key, value in {**values, **sensors}.items()}
    return StepResult(
        f"{servo.model} with id {servo.id} on {servo.port} at {servo.baud_rate} baud",
        result,
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
    given_port, ports = task.given.get("servo.port"), doctor.serial_ports()
    if given_port is not None and not _is_virtual(given_port) and not Path(given_port).exists():
        raise DeviceNotFoundError(
            f"there is no port {given_port}; there are {', '.join(ports) or 'none'}: name one with --set "
            "servo.port=PATH, or leave servo.port out to search all of them"
        )
    given_ports = [] if given_port is None else [given_port]
    scans = doctor.scan_servos(task.config, given_ports, task.progress)
    if not any(one.servos for one in scans) and not (given_port and _is_virtual(given_port)):
        searched = {str(Path(one).resolve()) for one in given_ports}
        other_ports = [port for port in ports if str(Path(port).resolve()) not in searched]
        scans += doctor.scan_servos(task.config, other_ports, task.progress)
    return ports, scans


def _gripper(task: Task, servos: list[FoundServo], scans: list[PortScan]) -> FoundServo:
    usable_servos = [servo for servo in servos if servo.max_current_a is not None]
    if not usable_servos:
        for text in _CHECK:
            task.person.tell(f"- {text}")
        port_names = ", ".join(one.port for one in scans) or "any port: no serial port is plugged in"
        found_text = f"; {', '.join(map(_line, servos))}" if servos else ""
        raise DeviceNotFoundError(
            f"no servo with current control answers on {port_names}, at any baud rate{found_text}; check supply, "
            "cable and permission, name the port with --set servo.port=PATH, or try without hardware: "
            "--set servo.port=virtual:rig"
        )
    given_keys = {key: task.given[key] for key in ("servo.port", "servo.id") if key in task.given}
    fitting = [servo for servo in usable_servos if _is_named(servo, given_keys)]
    usable_servos = fitting or usable_servos
    if fitting and len(usable_servos) == 1:
        return usable_servos[0]
    if not fitting:  # the gripper may be without power, and these servos an arm's: never take one silently
        task.person.tell(
            f"no servo answers with {', '.join(f'{key}={value}' for key, value in given_keys.items())}"
        )
    answers = {f"{servo.id} on {servo.port}": servo for servo in usable_servos}
    if len({servo.port for servo in usable_servos}) == 1:
        answers = {str(servo.id): servo for servo in usable_servos}
    option = "--set servo.id=ID and, with several ports, --set servo.port=PATH"
    return answers[task.person.choose("Which id is the gripper's servo?", list(answers), option)]


def _is_named(servo: FoundServo, given_keys: Mapping[str, Any]) -> bool:
    """Returns True if a servo has the port and the id that are given."""
    port = given_keys.get("servo.port", servo.port)
    same_port = port == servo.port or Path(port).resolve() == Path(servo.port).resolve()
    return same_port and given_keys.get("servo.id", servo.id) == servo.id


def _real_sensors(task: Task, ports: list[str], servo_port: str, remarks: list[str]) -> dict[str, Any]:
    """Keys of camera, load cell and clock of a real rig. What is given is kept."""
    settings: Tree = {} if "clock" in task.given else {"clock": "realtime"}
    if "camera.backend" not in task.given:
        settings |= _section("camera", _camera(task, remarks))
    if "load_cell.backend" not in task.given:
        used_port = str(Path(servo_port).resolve())
        free = [port for port in ports if str(Path(port).resolve()) != used_port]
        cell = doctor.find_load_cell(task.config, free, task.progress)
        if cell is None:
            remarks.append(
                "no serial load cell was found; once it is connected, `setup --step scan` looks again (a Phidget "
                "bridge is not searched for: --set load_cell.backend=phidget)"
            )
        settings |= _section("load_cell", cell or {"backend": "none"})
    return settings


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
