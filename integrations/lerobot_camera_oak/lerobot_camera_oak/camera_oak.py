"""The camera ``oak``: OAK cameras by the driver of gripper-force, with the interface of LeRobot's cameras."""

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from lerobot.cameras import Camera
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

import gripper_force as gf
from gripper_hw.cameras import oak
from lerobot_camera_oak.config_oak import OakCameraConfig

_POLL_S = 0.001
_READ_TIMEOUT_MS = 10_000.0
"""Longest wait of `OakCamera.read`: a lost camera may be back within it."""

Image = npt.NDArray[np.uint8]
"""A gray image in three equal channels, (H, W, 3) uint8."""


class HostClock:
    """The host's monotonic time, in which the driver gives the times of frames."""

    def now_ns(self) -> int:
        """Returns the current time."""
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleeps until a time; returns at once if it has passed."""
        time.sleep(max(0, t_ns - time.monotonic_ns()) / 1e9)


def open_device(config: gf.CameraConfig) -> gf.Camera:
    """Makes the driver of an OAK camera; its ``start`` opens the device."""
    return oak.OakCamera(config, HostClock())


class OakCamera(Camera):
    """An OAK camera, or its colour sensor converted to gray.

    Args:
        config: The configuration.
        device: Makes the driver; tests pass one without a device.

    Raises:
        ConfigError: A value of the configuration is wrong.
    """

    def __init__(
        self, config: OakCameraConfig, device: Callable[[gf.CameraConfig], gf.Camera] = open_device
    ) -> None:
        self._camera: gf.Camera | None = None
        super().__init__(config)
        self.config, self._device = config, device
        keys = {
            "backend": "oak",
            "rate_hz": config.fps,
            "side_px": config.height,
            "device": config.device,
            "sensor": config.sensor,
            "resolution_px": config.resolution_px,
            "region": config.region,
            "exposure_us": config.exposure_us,
            "gain": config.gain,
            "lens_position": config.lens_position,
            "white_balance_k": config.white_balance_k,
            "timeout_ms": config.timeout_ms,
        }
        self.settings = gf.load_config(None, {f"camera.{key}": value for key, value in keys.items()}).camera
        self._lock = threading.Lock()
        self._newest: gf.Frame | None = None
        self._is_unread = False

    def __str__(self) -> str:
        return f"OakCamera({self.config.device or 'any'})"

    @property
    def is_connected(self) -> bool:
        """True from `connect` to `disconnect`."""
        return self._camera is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Lists the OAK cameras that no program uses. ``id`` is the value for the key ``device``."""
        import depthai as dai

        return [
            {
                "name": info.name,
                "type": "oak",
                "id": info.deviceId,
                "protocol": info.protocol.name,
            }
            for info in dai.Device.getAllAvailableDevices()
        ]

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Opens the camera, and returns after its first frame.

        Args:
            warmup: Has no effect: exposure and focus are fixed, so the first frame is a good one.

        Raises:
            DeviceError: The camera is missing, in use, gives no frame or refuses a setting.
        """
        camera = self._device(self.settings)
        try:
            camera.start()
            self._newest, self._is_unread, self._camera = None, False, camera
            self._take()
        except BaseException:
            self._camera = None
            camera.close()
            raise

    @check_if_not_connected
    def read(self) -> Image:
        """Waits for the next frame.

        Raises:
            TimeoutError: There is none within 10 seconds.
            DeviceError: The camera failed.
        """
        self._take()
        self._is_unread = False
        image: Image = self.async_read(_READ_TIMEOUT_MS)
        return image

    @check_if_not_connected
    def async_read(self, timeout_ms: float = 200) -> Image:
        """Returns the newest frame that was not read yet, and waits for it if there is none.

        Args:
            timeout_ms: Longest wait.

        Raises:
            TimeoutError: There is no such frame in time.
            DeviceError: The camera failed.
        """
        deadline_s = time.monotonic() + 1e-3 * timeout_ms
        while True:
            newest = self._take()
            if newest is not None and self._is_unread:
                self._is_unread = False
                return _channels(newest)
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"{self} gave no new frame for {timeout_ms:g} ms; check cable and power")
            time.sleep(_POLL_S)

    @check_if_not_connected
    def read_latest(self, max_age_ms: int = 500) -> Image:
        """Returns the newest frame at once, whether it was read before or not.

        Args:
            max_age_ms: Largest age since the middle of its exposure.

        Raises:
            TimeoutError: It is older.
            DeviceError: The camera failed.
        """
        newest = self._take()
        if newest is None:
            raise RuntimeError(f"{self} has no frame yet; call read() first")
        age_ms = 1e-6 * (time.monotonic_ns() - newest.t_ns)
        if age_ms > max_age_ms:
            raise TimeoutError(f"the newest frame of {self} is {age_ms:.0f} ms old; check cable and power")
        return _channels(newest)

    @check_if_not_connected
    def disconnect(self) -> None:
        """Closes the camera."""
        camera, self._camera = self._camera, None
        assert camera is not None
        camera.close()

    def _take(self) -> gf.Frame | None:
        """Takes the driver's newest frame if there is one, and returns the newest of all."""
        camera = self._camera
        with self._lock:
            if camera is not None and (frame := camera.newest()) is not None:
                self._newest, self._is_unread = frame, True
            return self._newest


def _channels(frame: gf.Frame) -> Image:
    return np.repeat(frame.gray[:, :, None], 3, axis=2)  # (H, W, 3)
