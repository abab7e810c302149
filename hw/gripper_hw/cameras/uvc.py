"""Driver for USB cameras (UVC) by Video4Linux2 and OpenCV.

Controls: https://docs.kernel.org/userspace-api/media/v4l/ext-ctrls-camera.html and control.html there.
OpenCV's names: https://github.com/opencv/opencv/blob/4.x/modules/videoio/src/cap_v4l.cpp
"""

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import cv2

from gripper_force.config import CameraConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceLostError, DeviceNotFoundError
from gripper_force.interfaces import Clock
from gripper_force.types import NS_PER_MS, NS_PER_S, Gray
from gripper_hw.cameras.reader import BackgroundCamera, RawFrame, ReadFrame, Settings, crop_square

_SYSFS = Path("/sys/class/video4linux")
_BUFFERS = 2
"""The driver fills one while the other is read; with a single buffer it drops frames."""

_EXPOSURE_MANUAL = 1
"""V4L2_EXPOSURE_MANUAL."""

_EXPOSURES_FIXED = (_EXPOSURE_MANUAL, 2)
"""Modes with a fixed exposure time: manual, and V4L2_EXPOSURE_SHUTTER_PRIORITY, where only the iris is automatic."""

_EXPOSURES_AUTOMATIC = (3, 0)
"""V4L2_EXPOSURE_APERTURE_PRIORITY, which most cameras have, and V4L2_EXPOSURE_AUTO."""

_EXPOSURE_UNIT_US = 100
"""Unit of V4L2_CID_EXPOSURE_ABSOLUTE."""

_TOLERANCE = 0.1
"""Largest relative difference between a control's set and read value: drivers round to their own steps."""

_MISSING = -1.0
"""Value of a control that the device does not have."""

_CONTROLS = (
    ("exposure_us", cv2.CAP_PROP_EXPOSURE, _EXPOSURE_UNIT_US, cv2.CAP_PROP_AUTO_EXPOSURE, _EXPOSURE_MANUAL),
    ("gain", cv2.CAP_PROP_GAIN, 1, None, 0),
    ("lens_position", cv2.CAP_PROP_FOCUS, 1, cv2.CAP_PROP_AUTOFOCUS, 0),
    ("white_balance_k", cv2.CAP_PROP_WB_TEMPERATURE, 1, cv2.CAP_PROP_AUTO_WB, 0),
)
"""Key, its control and unit, and the control of its automatic function with the value that turns it off."""

_MAX_FRAME_AGE_NS = 10 * NS_PER_S
"""A frame that seems older, or from the future, has a timestamp of another clock."""


def _open_v4l2(path: str) -> Any:
    return cv2.VideoCapture(path, cv2.CAP_V4L2)


class UvcCamera(BackgroundCamera):
    """A USB camera whose exposure, focus and white balance do not change during a run.

    The driver timestamps a frame when its first packet arrives, at the end of the exposure. OpenCV does not
    pass on the driver's frame number, so received frames are counted. If a camera hangs while connected,
    OpenCV waits for up to 10 s, and so does `close`; `newest` does not.

    Args:
        config: The camera section of the configuration.
        clock: The run's clock.
        open_capture: Opens a path as ``cv2.VideoCapture``; tests open a video file.

    Raises:
        ConfigError: ``camera.device`` is not set, or the system is not Linux.
    """

    def __init__(
        self, config: CameraConfig, clock: Clock, open_capture: Callable[[str], Any] = _open_v4l2
    ) -> None:
        super().__init__(config, clock)
        if sys.platform != "linux" and open_capture is _open_v4l2:
            raise ConfigError(
                "camera.backend=uvc needs Video4Linux, which only Linux has; use an OAK camera, or one of a class of "
                "your own"
            )
        if config.device is None:
            raise ConfigError(
                "camera.backend=uvc needs camera.device; set it to an index, a /dev path or a name"
            )
        self._device = config.device
        self._open_capture = open_capture

    @contextmanager
    def _open(self) -> Iterator[ReadFrame]:
        path = find_device(self._device)
        capture = self._open_capture(str(path))
        try:
            if not capture.isOpened():
                raise DeviceError(
                    f"cannot open {path} as a camera; check that no other program uses it, "
                    "and that this user may read it (group video)"
                )
            fourcc, size_px = _set_format(capture, path, self._config)
            # Some drivers lose what was set before the stream began, and still read it back:
            # https://github.com/patjak/facetimehd/pull/329
            controls = _set_controls(capture, path, self._config)
            for _ in range(_BUFFERS):  # filled before the controls were set
                _image(capture, path)
            self._settings = {"fourcc": fourcc, "resolution_px": size_px, **controls}
            numbers = count(1 + _BUFFERS)  # the first image began the stream
            yield lambda: self._read(capture, path, next(numbers))
        finally:
            capture.release()

    def _read(self, capture: Any, path: Path, seq: int) -> RawFrame | None:
        if (image := _image(capture, path)) is None:
            return None
        stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * NS_PER_MS)
        if not 0 <= self._clock.now_ns() - stamp_ns < _MAX_FRAME_AGE_NS:
            raise DeviceError(
                f"{path} timestamps its frames with another clock than the host's monotonic clock; "
                "load its driver with that clock (uvcvideo: clock=CLOCK_MONOTONIC)"
            )
        height, width = image.shape[:2]
        left, top, side = crop_square(self._config, width, height)
        gray = cv2.cvtColor(image[top : top + side, left : left + side], cv2.COLOR_BGR2GRAY)
        resized: Gray = cv2.resize(gray, (self._config.side_px,) * 2, interpolation=cv2.INTER_AREA)
        return RawFrame(stamp_ns - (self._config.exposure_us or 0) * 500, seq, resized)


def camera_names(sysfs: Path = _SYSFS) -> dict[str, str]:
    """Returns the cameras' names by node, such as ``video0``; of a camera's nodes only the one that gives images."""
    names = {}
    for node in sorted(sysfs.glob("video*")):
        with suppress(OSError):  # it is being unplugged
            if (node / "index").read_text().strip() == "0":  # the others are metadata
                names[node.name] = (node / "name").read_text().strip()
    return names


def find_device(device: int | str, sysfs: Path = _SYSFS) -> Path:
    """Returns the path of a camera.

    Args:
        device: Number of a /dev/video, a path, or the camera's name as the kernel lists it.
        sysfs: The kernel's list of cameras.

    Raises:
        DeviceNotFoundError: No camera, or several, match.
    """
    if isinstance(device, int) or device.startswith("/"):
        path = Path(f"/dev/video{device}" if isinstance(device, int) else device)
        if not path.exists():
            raise DeviceNotFoundError(
                f"camera {path} does not exist; check its cable, and camera.device (see ls /dev/video*)"
            )
        return path
    names = camera_names(sysfs)
    matches = [node for node, name in names.items() if name == device]
    if len(matches) == 1:
        return Path("/dev", matches[0])
    devices = ", ".join(f"{name!r} at /dev/{node}" for node, name in names.items()) or "none"
    raise DeviceNotFoundError(
        f"{len(matches)} cameras have the name {device!r}; set camera.device to one of: {devices}"
    )


def _set_format(capture: Any, path: Path, config: CameraConfig) -> tuple[str, str]:
    """Sets pixel format, size and rate, in this order, and returns format and size. Raises `DeviceError`.

    Each limits the next. Where the device does not have one, driver and OpenCV take another without an error.
    """
    capture.set(cv2.CAP_PROP_BUFFERSIZE, _BUFFERS)
    if config.fourcc is not None:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.fourcc))
    if config.resolution_px is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, config.resolution_px[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.resolution_px[1])
    capture.set(cv2.CAP_PROP_FPS, config.rate_hz)
    _image(capture, path)  # begins the stream
    width, height = (int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    code, rate_hz = int(capture.get(cv2.CAP_PROP_FOURCC)), capture.get(cv2.CAP_PROP_FPS)
    fourcc = (code & 0xFFFFFFFF).to_bytes(4, "little").decode("latin-1")
    rate_known = 0 < rate_hz < math.inf
    wrong = {
        "fourcc": config.fourcc not in (None, fourcc),
        "resolution_px": config.resolution_px not in (None, (width, height)),
        "rate_hz": rate_known and abs(rate_hz - config.rate_hz) > _TOLERANCE * config.rate_hz,
    }
    if any(wrong.values()):
        keys = ", ".join(f"camera.{key}={getattr(config, key)}" for key in wrong if wrong[key])
        raise DeviceError(
            f"{path} refuses {keys} and gives {rate_hz:g} frames per second of {width}x{height} pixels in {fourcc}; "
            f"v4l2-ctl -d {path} --list-formats-ext lists what it has, and MJPG is usually faster than YUYV"
        )
    return fourcc, f"{width}x{height}"


def _set_controls(capture: Any, path: Path, config: CameraConfig) -> Settings:
    """Turns off what is automatic, then sets what is configured; returns what the device has. Raises `DeviceError`."""
    settings: Settings = {}
    for key, control, unit, automatic, off in _CONTROLS:
        value = getattr(config, key)
        if key == "exposure_us" and value is None:
            for mode in _EXPOSURES_AUTOMATIC:  # a camera that is closed keeps what an earlier run has set
                if capture.get(automatic) in _EXPOSURES_FIXED:
                    capture.set(automatic, mode)
            if capture.get(automatic) in _EXPOSURES_FIXED:
                raise DeviceError(f"{path} refuses automatic exposure; set camera.exposure_us")
            settings[key] = "automatic"
            continue
        steps = []
        if automatic is not None and capture.get(automatic) != _MISSING:
            steps.append((automatic, off, 1, f"to stop automatic camera.{key}"))
        if value is not None:
            steps.append((control, value, unit, f"camera.{key}"))
        for control_id, target, scale, purpose in steps:
            capture.set(control_id, round(target / scale))
            if abs((got := capture.get(control_id)) * scale - target) > _TOLERANCE * target:
                text = "no such control" if got == _MISSING else f"{target} was set, {got * scale:g} is read"
                raise DeviceError(
                    f"{path} refuses {purpose}: {text}; set another value, or null (v4l2-ctl -d {path} -L lists its "
                    "controls and their ranges)"
                )
        if (got := capture.get(control)) != _MISSING:
            settings[key] = got * unit
    return settings


def _image(capture: Any, path: Path) -> Any:
    """Returns the next image, or None if it cannot be decoded. Raises `DeviceLostError`.

    A disturbed transfer gives a truncated or empty MJPG image: OpenCV has no result for the one, and an assertion fails
    for the other. The next image is good.
    """
    if not capture.grab():
        raise DeviceLostError(f"{path} gives no frames; check its cable, and that no other program uses it")
    try:
        received, image = capture.retrieve()
    except cv2.error:
        return None
    return image if received else None
