"""Diagnostics of cameras for `doctor`: lists them, and measures rate and latency of the configured one."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gripper_force.config import Config
from gripper_force.jobs.checks import Check, clock_name, gather, judged, keep_only, rate_hz
from gripper_force.runtime.backends import open_devices
from gripper_force.schema import Tree
from gripper_force.types import NS_PER_MS, Frame
from gripper_hw.cameras import uvc

_SYSFS = Path("/sys")
_LUXONIS_USB_ID = "03e7"
_USB3_MBPS = 5000
"""Speed of the slowest USB 3 link."""

_CONTROLS = ("exposure_us", "gain", "lens_position", "white_balance_k")
_SETTING_TOLERANCE = 0.1
"""Largest relative difference between a configured and a reported value: devices round to their own steps."""

_MIN_RATE_SHARE = 0.9
"""Lowest measured rate that passes, as a share of ``camera.rate_hz``."""


def probe(config: Config, sysfs: Path = _SYSFS) -> Iterator[Check]:
    """Lists cameras, and captures from the configured one for a second.

    Args:
        config: The configuration to check.
        sysfs: The kernel's list of devices.

    Raises:
        ConfigError: ``vision.region`` reaches beyond the frames.
        GripperError: See `open_devices` and the camera's ``start``.
    """
    for name in (*_oak_devices(), *_video_devices(sysfs / "class/video4linux")):
        yield Check("camera", "listed", name, None)
    if config.camera.backend == "none":
        yield Check("camera", "backend", "none", None)
        return
    with open_devices(keep_only(config, "camera")) as devices:
        camera = devices.camera
        assert camera is not None
        camera.start()

        def take() -> list[Frame]:
            return [] if (frame := camera.newest()) is None else [frame]

        frames = gather(devices, take)
        if (settings := getattr(camera, "settings", None)) is not None:
            yield _settings_check(config, settings())
        if config.camera.backend == "oak":  # a device is listed as USB 2 until it is opened
            yield from _usb_checks(sysfs / "bus/usb/devices")
    yield from _frame_checks(config, frames)


def find(sysfs: Path = _SYSFS) -> list[Tree]:
    """Returns the section ``camera`` of each camera that is plugged in: OAK cameras, then USB cameras."""
    oaks: list[Tree] = [{"backend": "oak", "device": info.deviceId} for info in _oak_infos() or ()]
    return oaks + [
        {"backend": "uvc", "device": f"/dev/{node}"} for node in uvc.camera_names(sysfs / "class/video4linux")
    ]


def _settings_check(config: Config, settings: Mapping[str, float | str]) -> Check:
    """Shows the settings in force, and whether those that are configured are among them."""
    text = ", ".join(
        f"{key} {value:g}" if isinstance(value, float | int) else f"{key} {value}"
        for key, value in settings.items()
    )
    differing = [
        key
        for key, value in settings.items()
        if key in _CONTROLS
        and (setting := getattr(config.camera, key)) is not None
        and isinstance(value, float | int)
        and abs(value - setting) > _SETTING_TOLERANCE * setting
    ]
    advice = f"the device does not keep {', '.join(f'camera.{key}' for key in differing)}: set what it can do"
    return judged("camera", "settings", text, not differing, advice)


def _frame_checks(config: Config, frames: list[Frame]) -> Iterator[Check]:
    if len(frames) < 2:
        advice = "check its cable, or the log that it plays"
        yield Check("camera", "frames", f"{len(frames)} received", False, advice)
        return
    height, width = frames[0].gray.shape
    lost = frames[-1].seq - frames[0].seq + 1 - len(frames)
    yield Check("camera", "frames", f"{width}x{height} pixels, {lost} of {lost + len(frames)} lost", True)
    rate, configured_hz = rate_hz([frame.t_ns for frame in frames]), config.camera.rate_hz
    if config.camera.backend == "playback":
        yield Check("camera", "rate", f"{rate:.1f} Hz of playback", True)
    else:
        rate_text = f"{rate:.1f} Hz of {config.camera.backend}, in {clock_name(config)}"
        result = f"{rate_text}; {configured_hz:g} Hz configured"
        fast_enough = rate >= _MIN_RATE_SHARE * configured_hz
        advice = "set camera.rate_hz to the measured rate, shorten camera.exposure_us, or add light"
        yield judged("camera", "rate", result, fast_enough, advice)
    latency_ms = float(np.median([frame.received_ns - frame.t_ns for frame in frames])) / NS_PER_MS
    estimate_hz = config.control.vision_rate_hz or configured_hz
    limit_ms = config.control.model_copy(update={"vision_rate_hz": estimate_hz}).max_frame_age_ms
    result = f"median {latency_ms:.1f} ms from exposure to use"
    advice = f"every estimate would be older than control.vision_age_ms={limit_ms:.3g}: shorten the exposure"
    yield judged("camera", "latency", result, latency_ms < limit_ms, advice)
    if config.uses_vision:
        from gripper_force.vision.preprocess import downscale  # `doctor` of a servo alone needs no vision

        downscale(frames[0].gray, config.vision.region, 1)  # raises if the region reaches beyond the frame


def _oak_devices() -> Iterator[str]:
    if (infos := _oak_infos()) is None:
        yield "no OAK can be listed: pip install 'gripper-force[oak]'"
        return
    yield from (f"OAK {info.deviceId} at {info.name}" for info in infos)
    if not infos:
        yield "no free OAK"


def _oak_infos() -> Sequence[Any] | None:
    """Returns the free OAK devices; None if DepthAI is not installed or does not load."""
    try:
        import depthai as dai
    except ImportError:
        return None
    infos: Sequence[Any] = dai.Device.getAllAvailableDevices()
    return infos


def _video_devices(folder: Path) -> Iterator[str]:
    nodes = sorted(folder.glob("video*"))
    yield from (f"/dev/{node.name}: {(node / 'name').read_text().strip()}" for node in nodes)
    if not nodes:
        yield "no /dev/video*"


def _usb_checks(folder: Path) -> Iterator[Check]:
    for vendor in sorted(folder.glob("*/idVendor")):
        if vendor.read_text().strip() == _LUXONIS_USB_ID:
            mbps = float((vendor.parent / "speed").read_text())
            advice = "USB 2 link: a USB 3 cable and port have less latency"
            yield judged("camera", "USB", f"{mbps:g} Mb/s", mbps >= _USB3_MBPS, advice, harmless=True)
