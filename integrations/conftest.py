"""Tests of the packages for LeRobot. Where it is not installed they are skipped."""

import warnings
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import gripper_force as gf

NEEDED = ("lerobot", "lerobot_robot_gripper_force", "lerobot_camera_oak")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    missing = [name for name in NEEDED if find_spec(name) is None]
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.lerobot)
            item.add_marker(pytest.mark.filterwarnings("default"))  # LeRobot's own are not ours
            if missing:
                reason = f"needs {', '.join(missing)}: run make test-lerobot"
                item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="session")
def robots() -> ModuleType:
    """The package `lerobot_robot_gripper_force`."""
    return _imported("lerobot_robot_gripper_force")


@pytest.fixture(scope="session")
def cameras() -> ModuleType:
    """The package `lerobot_camera_oak`."""
    return _imported("lerobot_camera_oak")


def _imported(name: str) -> ModuleType:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return import_module(name)


@pytest.fixture(autouse=True)
def _offline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """LeRobot's files go to a folder of the test, and it never asks the network."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))


QUICK = [
    "object=stapler",
    "sim.detail=coarse",
    "vision.checkpoint=none",
    "control.feedback=current",
]
"""The cheapest simulated gripper with a camera."""


@pytest.fixture
def make_robot(robots: ModuleType, tmp_path: Path) -> Iterator[Any]:
    """Makes robots on the simulated gripper, and disconnects them at the end."""
    made: list[Any] = []

    def make(*overrides: str, **keys: Any) -> Any:
        config = robots.GripperForceConfig(
            id="sim", calibration_dir=tmp_path / "lerobot", overrides=[*QUICK, *overrides], **keys
        )
        made.append(robots.GripperForce(config))
        return made[-1]

    yield make
    for robot in made:
        if robot.is_connected:
            try:
                robot.disconnect()
            except gf.GripperError:
                continue
