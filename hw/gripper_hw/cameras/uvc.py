"""Driver for USB cameras (UVC) by Video4Linux2 and OpenCV.

Controls: https://docs.kernel.org/userspace-api/media/v4l/ext-ctrls-camera.html
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import cv2

from gripper_force.config import CameraConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceLostError, DeviceNotFoundError
from gripper_force.interfaces import Clock
from gripper_force.types import NS_PER_MS, NS_PER_S, Gray
from gripper_hw.cameras.reader import BackgroundCamera, RawFrame, ReadFrame, crop_square

_SYSFS = Path("/sys/class/video4linux")
_BUFFERS = 2
"""The driver fills one while the other is read; with a single buffer it drops frames."""

_EXPOSURE_MANUAL = 1
"""V4L2_EXPOSURE_MANUAL."""

_EXPOSURE_UNIT_US = 100
"""Unit of V4L2_CID_EXPOSURE_ABSOLUTE."""

_TOLERANCE = 0.1
"""Largest relative difference between a control's set and read value: drivers round to their own steps."""

_MAX_FRAME_AGE_NS = 10 * NS_PER_S
"""A frame that seems older, or from the future, has a timestamp of another clock."""


def _open_v4l2(path: str) -> Any:
    return cv2.VideoCapture(path, cv2.CAP_V4L2)


class UvcCamera(BackgroundCamera):
    """A USB camera with locked exposure, at the driver's default size (640x480 if available).

    The driver timestamps a frame when its first packet arrives, at the end of the exposure. OpenCV does not
    pass on the driver's frame number, so received frames are counted. If a camera hangs while connected,
    OpenCV waits for up to 10 s, and so does `close`; `newest` does not.

    Args:
        config: The camera section of the configuration.
        clock: The run's clock.
        open_capture: Opens a path as ``cv2.VideoCapture``; tests open a video file.

    Raises:
        ConfigError: ``camera.device`` is not set.
    """

    def __init__(
        self, config: CameraConfig, clock: Clock, open_capture: Callable[[str], Any] = _open_v4l2
    ) -> None:
        super().__init__(config, clock)
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
            capture.set(cv2.CAP_PROP_BUFFERSIZE, _BUFFERS)
            capture.set(cv2.CAP_PROP_FPS, self._config.rate_hz)
            if self._config.exposure_us is not None:
                _lock_exposure(capture, path, self._config.exposure_us, self._config.gain)
            numbers = count()
            yield lambda: self._read(capture, path, next(numbers))
        finally:
            capture.release()

    def _read(self, capture: Any, path: Path, seq: int) -> RawFrame:
        received, image = capture.read()
        if not received:
            raise DeviceLostError(
                f"{path} gives no frames; check its cable, and that no other program uses it"
            )
        stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * NS_PER_MS)
        if not 0 <= self._clock.now_ns() - stamp_ns < _MAX_FRAME_AGE_NS:
            raise DeviceError(
                f"{path} timestamps its frames with another clock than the host's monotonic clock; "
                "load its driver with that clock (uvcvideo: clock=CLOCK_MONOTONIC)"
            )
        height, width = image.shape[:2]
        left, top, side = crop_square(self._config, width, height)
        gray = cv2.cvtColor(image[top : top + side, left : left + side], cv2.COLOR_BGR2GRAY)
        small: Gray = cv2.resize(gray, (self._config.side_px,) * 2, interpolation=cv2.INTER_AREA)
        return RawFrame(stamp_ns - (self._config.exposure_us or 0) * 500, seq, small)


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
    # A camera has several nodes of one name: index 0 gives images, the others metadata.
    nodes = [node for node in sorted(sysfs.glob("video*")) if (node / "index").read_text().strip() == "0"]
    names = {node.name: (node / "name").read_text().strip() for node in nodes}
    matches = [node for node, name in names.items() if name == device]
    if len(matches) == 1:
        return Path("/dev", matches[0])
    known = ", ".join(f"{name!r} at /dev/{node}" for node, name in names.items()) or "none"
    raise DeviceNotFoundError(
        f"{len(matches)} cameras have the name {device!r}; set camera.device to one of: {known}"
    )


def _lock_exposure(capture: Any, path: Path, exposure_us: int, gain: int | None) -> None:
    controls = [
        ("automatic exposure off", cv2.CAP_PROP_AUTO_EXPOSURE, _EXPOSURE_MANUAL),
        (f"an exposure of {exposure_us} us", cv2.CAP_PROP_EXPOSURE, max(1, exposure_us // _EXPOSURE_UNIT_US)),
    ]
    if gain is not None:
        controls.append((f"a gain of {gain}", cv2.CAP_PROP_GAIN, gain))
    for what, control, value in controls:
        capture.set(control, value)
        if abs((got := capture.get(control)) - value) > _TOLERANCE * value:
            raise DeviceError(
                f"{path} refuses {what}: it was set to {value} and reads {got:g}; v4l2-ctl -L lists allowed "
                "values, and camera.exposure_us=null leaves the exposure automatic"
            )
