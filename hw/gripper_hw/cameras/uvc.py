"""A USB camera by Video4Linux2, through OpenCV.

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
from gripper_hw.cameras.reader import BackgroundCamera, Read, Shot, square

_SYSFS = Path("/sys/class/video4linux")
_BUFFERS = 2
"""The least with which the driver fills one while the other is read; with one it drops frames."""

_MANUAL = 1
"""V4L2_EXPOSURE_MANUAL."""

_EXPOSURE_UNIT_US = 100
_TOLERANCE = 0.1
"""A driver rounds to its own steps."""

_OTHER_CLOCK_NS = 10 * NS_PER_S


def _open_v4l2(path: str) -> Any:
    return cv2.VideoCapture(path, cv2.CAP_V4L2)


class UvcCamera(BackgroundCamera):
    """A USB camera with its exposure locked, at the driver's default size (640x480 where it has that).

    The driver stamps a frame when its first packet arrives, at the end of the exposure. OpenCV keeps the
    driver's frame number to itself, so frames are counted as they come. A camera that hangs without being
    gone keeps OpenCV waiting for up to 10 s, and `close` with it; `newest` never.

    Args:
        config: Its section of the configuration.
        clock: The run's clock.
        open_capture: What opens a path; a test puts a video file here.

    Raises:
        ConfigError: No device is named.
    """

    def __init__(
        self, config: CameraConfig, clock: Clock, open_capture: Callable[[str], Any] = _open_v4l2
    ) -> None:
        super().__init__(config, clock)
        if config.device is None:
            raise ConfigError("camera.backend=uvc needs camera.device: an index, a /dev path or a name")
        self._device = config.device
        self._open_capture = open_capture

    @contextmanager
    def _opened(self) -> Iterator[Read]:
        path = find_device(self._device)
        capture = self._open_capture(str(path))
        try:
            if not capture.isOpened():
                raise DeviceError(
                    f"{path} can't be opened as a camera; check that no other program has it, "
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

    def _read(self, capture: Any, path: Path, seq: int) -> Shot:
        there, picture = capture.read()
        if not there:
            raise DeviceLostError(f"{path} gives no frames; check its cable, and that it is free")
        stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * NS_PER_MS)
        if not 0 <= self._clock.now_ns() - stamp_ns < _OTHER_CLOCK_NS:
            raise DeviceError(
                f"{path} stamps its frames with another clock than the host's monotonic one; "
                "load its driver with that clock (uvcvideo: clock=CLOCK_MONOTONIC)"
            )
        height, width = picture.shape[:2]
        left, top, side = square(self._config, width, height)
        gray = cv2.cvtColor(picture[top : top + side, left : left + side], cv2.COLOR_BGR2GRAY)
        small: Gray = cv2.resize(gray, (self._config.side_px,) * 2, interpolation=cv2.INTER_AREA)
        return Shot(stamp_ns - (self._config.exposure_us or 0) * 500, seq, small)


def find_device(device: int | str, sysfs: Path = _SYSFS) -> Path:
    """The path of a camera.

    Args:
        device: The number of a /dev/video, a path, or the camera's name as the kernel has it.
        sysfs: Where the kernel lists cameras.

    Raises:
        DeviceNotFoundError: There is none, or there are several of that name.
    """
    if isinstance(device, int) or device.startswith("/"):
        path = Path(f"/dev/video{device}" if isinstance(device, int) else device)
        if not path.exists():
            raise DeviceNotFoundError(f"there is no camera {path}; check its cable, or ls /dev/video*")
        return path
    # A camera has several nodes under one name; the first of them gives pictures, others its metadata.
    nodes = [node for node in sorted(sysfs.glob("video*")) if (node / "index").read_text().strip() == "0"]
    names = {node.name: (node / "name").read_text().strip() for node in nodes}
    fits = [node for node, name in names.items() if name == device]
    if len(fits) == 1:
        return Path("/dev", fits[0])
    known = ", ".join(f"{name!r} at /dev/{node}" for node, name in names.items()) or "none"
    raise DeviceNotFoundError(f"{len(fits)} cameras have the name {device!r}; there are: {known}")


def _lock_exposure(capture: Any, path: Path, exposure_us: int, gain: int | None) -> None:
    controls = [
        ("automatic exposure off", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL),
        (f"an exposure of {exposure_us} us", cv2.CAP_PROP_EXPOSURE, max(1, exposure_us // _EXPOSURE_UNIT_US)),
    ]
    if gain is not None:
        controls.append((f"a gain of {gain}", cv2.CAP_PROP_GAIN, gain))
    for what, control, value in controls:
        capture.set(control, value)
        if abs((got := capture.get(control)) - value) > _TOLERANCE * value:
            raise DeviceError(
                f"{path} refuses {what}: it was set to {value} and reads {got:g}; v4l2-ctl -L tells what it "
                "takes, and camera.exposure_us=null leaves the exposure automatic"
            )
