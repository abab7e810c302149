"""The settings in docs/cameras.md are valid, and the OAK sensors that they name have the modes."""

import re
from pathlib import Path
from typing import Any

import depthai as dai
import pytest
import yaml

from gripper_force.config import CameraConfig
from gripper_hw.cameras.oak import choose_size, set_controls

PAGE = Path(__file__).parents[3] / "docs" / "cameras.md"
SECTIONS: list[dict[str, Any]] = [
    yaml.safe_load(text) for text in re.findall(r"`(\{.*?\})`", PAGE.read_text())
]


def test_every_kind_of_camera_is_there() -> None:
    assert [section["backend"] for section in SECTIONS] == ["oak"] * 4 + ["uvc"] * 2


@pytest.mark.parametrize("section", SECTIONS)
def test_settings_are_valid(section: dict[str, Any]) -> None:
    config = CameraConfig.model_validate(section)
    if config.backend == "uvc":
        assert config.device is not None
        return
    assert config.resolution_px is not None
    mode, sensor = dai.CameraSensorConfig(), dai.CameraFeatures()
    mode.width, mode.height = config.resolution_px
    mode.maxFps = config.rate_hz
    mono = config.sensor == "CAM_B"
    sensor.configs, sensor.hasAutofocus = [mode], config.lens_position is not None
    sensor.supportedTypes = [dai.CameraSensorType.MONO if mono else dai.CameraSensorType.COLOR]
    assert choose_size(sensor, config) == config.resolution_px
    set_controls(dai.CameraControl(), sensor, config)
