from datetime import UTC, datetime
from pathlib import Path
from threading import Thread

import pytest
import yaml

from gripper_force.config import load_config
from gripper_force.errors import ConfigError
from gripper_force.jobs import profile_files
from gripper_force.jobs.profile_files import update_rig
from gripper_force.profiles.rig_profile import (
    CalibratedValue,
    LoadCellCalibration,
    RigProfile,
    ServoCalibration,
    read_rig,
)
from gripper_force.schema import dump

NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
CELL = LoadCellCalibration(
    date=NOW,
    sensor="serial hx711",
    tare_raw=CalibratedValue(value=8000, low=7990, high=8010),
    n_per_raw=CalibratedValue(value=1e-4, low=0.99e-4, high=1.01e-4),
    force_n=(0, 19.6),
    noise_n=0.01,
    drift_n_min=CalibratedValue(value=0.0, low=-0.01, high=0.01),
)


def test_update_replaces_only_its_section(servo_calibration: ServoCalibration, tmp_path: Path) -> None:
    path = tmp_path / "rigs" / "rig.yaml"
    update_rig(path, CELL)
    update_rig(path, servo_calibration)
    newer = servo_calibration.model_copy(update={"force_n": (2, 8)})
    assert update_rig(path, newer) == RigProfile(load_cell=CELL, servo=newer) == read_rig(path)
    assert [file.name for file in path.parent.iterdir()] == ["rig.yaml"]


def test_settings_are_keys_of_the_configuration(servo_calibration: ServoCalibration, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    update_rig(path, CELL)
    update_rig(path, servo_calibration)
    config = load_config(None, [f"calibration.rig={path}"])
    assert (config.gripper.nm_per_a, config.gripper.open_width_m) == (1.7, 0.09)
    assert config.load_cell.tare_raw == 8000
    assert config.gripper.friction_std == pytest.approx(0.1, abs=0.05)
    assert config.gripper.gain_std == 0.02


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{}", r".* does not have the rig profile format gripper-force-rig/1 \(it is None\)"),
        (
            "format: gripper-force-rig/2",
            r".* does not have the rig profile format gripper-force-rig/1 \(it is 'gripper-force-rig/2'\)",
        ),
        (
            "format: gripper-force-rig/1\nsevro: {}",
            "unknown rig profile key 'sevro'.*load_cell, servo, camera",
        ),
        (
            "format: gripper-force-rig/1\nservo: {}",
            r"rig profile key 'servo.date' \(from .*\): Field required",
        ),
        ("format: [", "can't read the rig profile"),
    ],
)
def test_invalid_file_is_refused_and_kept(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    for use in (lambda: read_rig(path), lambda: update_rig(path, CELL)):
        with pytest.raises(ConfigError, match=sentence) as caught:
            use()
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    assert path.read_text() == text


def test_a_section_that_another_calibration_writes_meanwhile_is_kept(
    servo_calibration: ServoCalibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rig.yaml"
    update_rig(path, CELL.model_copy(update={"sensor": "old"}))
    other = Thread(target=update_rig, args=(path, servo_calibration))

    def dump_late(profile: RigProfile) -> str:
        if not other.ident:
            other.start()
            other.join(0.5)  # without a lock it writes here, and its section is lost
        return dump(profile)

    monkeypatch.setattr(profile_files, "dump", dump_late)
    update_rig(path, CELL)
    other.join()
    assert read_rig(path) == RigProfile(load_cell=CELL, servo=servo_calibration)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("nm_per_a", {"value": -1.0}),
        ("pinion_radius_m", {"value": 0.0}),
        ("force_n", [9, 0]),
        ("force_n", [0, 0]),
        ("speed_m_s", [0.03, 0.01]),
    ],
)
def test_a_value_that_no_configuration_takes_is_blamed_on_the_profile(
    servo_calibration: ServoCalibration, tmp_path: Path, key: str, value: object
) -> None:
    path = tmp_path / "rig.yaml"
    servo = servo_calibration.model_dump(mode="json") | {key: value}
    path.write_text(yaml.safe_dump({"format": "gripper-force-rig/1", "servo": servo}))
    with pytest.raises(ConfigError, match=rf"rig profile key 'servo\.{key}' \(from .*rig\.yaml\)"):
        load_config(None, [f"calibration.rig={path}"])


def test_unwritable_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"can't write .*rig\.yaml: File exists, .*file"):
        update_rig(tmp_path / "file" / "rig.yaml", CELL)


@pytest.mark.parametrize("bounds", [{"low": 2.0, "high": 3.0}, {"low": 0.0}, {"low": 0.0, "high": 0.5}])
def test_value_must_lie_within_its_interval(bounds: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"low and high|must lie between"):
        CalibratedValue(value=1.0, **bounds)
