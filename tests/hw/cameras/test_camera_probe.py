from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gripper_force.config import Config
from gripper_force.jobs import checks
from gripper_force.jobs.checks import Check
from gripper_force.jobs.dataset import Clip
from gripper_force.types import NS_PER_S, Frame
from gripper_hw.cameras import camera_probe as probe
from gripper_hw.cameras import oak, uvc

QUICK = {"object": "stapler", "sim": {"detail": "coarse"}}
REAL = {"clock": "realtime", "servo": {"port": "/dev/nowhere"}, "load_cell": {"backend": "none"}}


def rows(config: dict[str, Any], sysfs: Path = Path("/sys")) -> dict[str, Check]:
    checks = probe.probe(Config.model_validate(config), sysfs)
    return {check.name: check for check in checks if check.name != "listed"}


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measures for a fifth of a second only."""
    monkeypatch.setattr(checks, "_MEASURE_NS", NS_PER_S // 5)


@pytest.mark.usefixtures("short")
def test_simulated_camera_is_measured_in_simulated_time() -> None:
    found = rows(QUICK | {"camera": {"rate_hz": 50.0}})
    assert all(check.ok for check in found.values())
    assert found["frames"].found.startswith("128x128 pixels, 0 of ")
    assert found["rate"].found == "50.0 Hz of simulated, in simulated time; 50 Hz configured"
    assert found["latency"].found == "median 15.0 ms from exposure to use"


@pytest.mark.usefixtures("short")
def test_latency_at_which_a_run_rejects_every_frame_is_a_problem() -> None:
    late = rows(QUICK | {"control": {"vision_age_ms": 10.0}})["latency"]
    assert late.ok is False
    assert "control.vision_age_ms=10" in late.advice
    # The longest time between estimates says nothing about their age.
    assert rows(QUICK | {"control": {"vision_timeout_ms": 10.0}})["latency"].ok is True


@pytest.mark.usefixtures("short")
def test_rate_of_playback_is_shown(
    write_log: Callable[[Clip, Path], Path], press: Callable[[int], Clip], tmp_path: Path
) -> None:
    log = write_log(press(0), tmp_path)
    found = rows(REAL | {"camera": {"backend": "playback", "path": str(log), "rate_hz": 1000.0}})
    assert found["rate"].ok is True
    assert found["rate"].found.endswith(" Hz of playback")


@pytest.mark.usefixtures("short")
def test_rate_below_configured_is_a_problem(
    make_uvc: Callable[..., uvc.UvcCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uvc, "UvcCamera", lambda section, clock: make_uvc())
    rate = rows(REAL | {"camera": {"backend": "uvc", "device": 0, "rate_hz": 1000.0}})["rate"]
    assert rate.ok is False
    assert "set camera.rate_hz to the measured rate" in rate.advice


@pytest.mark.usefixtures("short")
def test_settings_in_force_are_shown(
    make_uvc: Callable[..., uvc.UvcCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uvc, "UvcCamera", lambda section, clock: make_uvc(exposure_us=8000))
    settings = rows(REAL | {"camera": {"backend": "uvc", "device": 0, "exposure_us": 8000}})["settings"]
    assert settings.ok is True
    shown = (
        "fourcc YUYV, resolution_px 320x240, exposure_us 8000, gain 8, lens_position 35, white_balance_k 4300"
    )
    assert settings.found == shown


@pytest.mark.usefixtures("short")
def test_setting_that_the_device_does_not_keep_is_a_problem(
    make_oak: Callable[..., oak.OakCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    gray = np.random.default_rng(0).integers(0, 256, (800, 1280), np.uint8)
    monkeypatch.setattr(oak, "OakCamera", lambda section, clock: make_oak(gray, exposure_us=4000, gain=100))
    settings = rows(REAL | {"camera": {"backend": "oak", "exposure_us": 4000, "gain": 1600}})["settings"]
    assert (settings.ok, "exposure_us 4000, gain 100" in settings.found) == (False, True)
    assert "does not keep camera.gain:" in settings.advice


@pytest.mark.usefixtures("short")
def test_usb_speed_of_oak_is_shown(
    make_oak: Callable[..., oak.OakCamera], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name, vendor, speed in (("1-1", "03e7", 480), ("2-1", "03e7", 5000), ("3-1", "1d6b", 12)):
        (tmp_path / "bus/usb/devices" / name).mkdir(parents=True)
        (tmp_path / "bus/usb/devices" / name / "idVendor").write_text(f"{vendor}\n")
        (tmp_path / "bus/usb/devices" / name / "speed").write_text(f"{speed}\n")
    gray = np.random.default_rng(0).integers(0, 256, (800, 1280), np.uint8)
    monkeypatch.setattr(oak, "OakCamera", lambda section, clock: make_oak(gray))
    config = Config.model_validate(REAL | {"camera": {"backend": "oak", "rate_hz": 1.0}})
    speeds = [check for check in probe.probe(config, tmp_path) if check.name == "USB"]
    assert [(check.found, check.ok) for check in speeds] == [("480 Mb/s", True), ("5000 Mb/s", True)]
    assert "USB 3 cable" in speeds[0].advice
    assert not speeds[1].advice


def test_camera_without_frames_is_a_problem() -> None:
    frame = Frame(0, 1, 0, np.zeros((8, 8), np.uint8))
    (check,) = probe._frame_checks(Config(), [frame])
    assert (check.found, check.ok) == ("1 received", False)
    assert check.advice


def test_lost_frames_are_counted() -> None:
    frames = [Frame(i * 10_000_000, i * 10_000_000, i, np.zeros((6, 8), np.uint8)) for i in (0, 1, 4)]
    check = next(iter(probe._frame_checks(Config(), frames)))
    assert check.found == "8x6 pixels, 2 of 5 lost"


def test_devices_are_listed_without_a_configured_camera(tmp_path: Path) -> None:
    node = tmp_path / "class/video4linux/video2"
    node.mkdir(parents=True)
    (node / "name").write_text("HD Webcam\n")
    listed = list(probe.probe(Config.model_validate({"camera": {"backend": "none"}}), tmp_path))
    assert {check.ok for check in listed} == {None}
    assert "/dev/video2: HD Webcam" in [check.found for check in listed]
