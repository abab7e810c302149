from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from gripper_calibration.setup import scan
from gripper_force.errors import ConfigError, DeviceNotFoundError
from gripper_force.jobs.checks import FoundServo


def test_a_named_port_that_does_not_exist_is_refused_and_no_other_is_searched() -> None:
    task = SimpleNamespace(given={"servo.port": "/dev/nope"})
    with pytest.raises(DeviceNotFoundError, match=r"there is no port /dev/nope; .* --set servo\.port=PATH"):
        scan._scan_ports(task)  # type: ignore[arg-type]


def found(port: str, id_: int) -> FoundServo:
    return FoundServo(port, 57_600, id_, "XM430-W350", 48, 1.2)


class Script:
    """Answers that a script gives; notes what it was told."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def tell(self, text: str) -> None:
        self.told.append(text)

    def choose(self, question: str, answers: Sequence[str], option: str) -> str:
        raise ConfigError(f"{question} {', '.join(answers)}: pass {option}")


@pytest.mark.parametrize(
    ("given", "servos"),
    [
        ({"servo.port": "/dev/a", "servo.id": 1}, [found("/dev/b", 7)]),
        ({"servo.id": 1}, [found("/dev/b", 7)]),
        ({"servo.port": "/dev/a"}, [found("/dev/b", 1), found("/dev/b", 7)]),
    ],
)
def test_a_servo_that_is_not_the_named_one_is_never_taken_by_itself(
    given: dict[str, Any], servos: list[FoundServo]
) -> None:
    person = Script()
    task = SimpleNamespace(given=given, person=person)
    with pytest.raises(ConfigError, match="Which id is the gripper's servo"):
        scan._gripper(task, servos, [])  # type: ignore[arg-type]
    assert "no servo answers with servo." in person.told[0]


def test_a_device_that_is_not_found_is_looked_for_again_by_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gripper_force.jobs.doctor.find_cameras", list)
    monkeypatch.setattr("gripper_force.jobs.doctor.find_load_cell", lambda *_: None)
    task = SimpleNamespace(given={}, person=Script(), config=None, progress=None)
    remarks: list[str] = []
    found = scan._real_sensors(task, [], "/dev/a", remarks)  # type: ignore[arg-type]
    assert (found["camera.backend"], found["load_cell.backend"]) == ("none", "none")
    assert [text.split(";")[0] for text in remarks] == [
        "no camera was found",
        "no serial load cell was found",
    ]
    assert all("`setup --step scan` looks again" in text for text in remarks)


def test_the_named_servo_is_taken_without_a_question() -> None:
    task = SimpleNamespace(given={"servo.port": "/dev/a", "servo.id": 7}, person=Script())
    servos = [found("/dev/a", 1), found("/dev/a", 7), found("/dev/b", 7)]
    assert scan._gripper(task, servos, []) is servos[1]  # type: ignore[arg-type]
