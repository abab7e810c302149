"""Base class of real cameras: a thread reads the device, keeps the newest frame and reopens a lost device."""

import atexit
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import NamedTuple

from gripper_force.config import CameraConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceLostError
from gripper_force.interfaces import Clock
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, Gray

_FIRST_FRAME_TIMEOUT_NS = 5 * NS_PER_S
"""Longest wait for the first frame after the device was opened; later frames have ``camera.timeout_ms``."""

_REOPEN_PERIOD_S = 0.5
"""Pause between two attempts to open a lost camera."""


class RawFrame(NamedTuple):
    """A frame as the device delivers it.

    Attributes:
        t_ns: Host time at the middle of the exposure.
        seq: The device's frame number; it restarts when the device is opened again.
        gray: Image, (H, W) uint8.
    """

    t_ns: int
    seq: int
    gray: Gray


Settings = dict[str, float | str]
"""Camera settings in force, by key of the section ``camera``."""

ReadFrame = Callable[[], RawFrame | None]
"""Waits a short time for the next frame; returns None if none came. Raises `DeviceError`."""


class BackgroundCamera(ABC):
    """A camera that a background thread opens, reads, and reopens after a loss.

    Args:
        config: The camera section of the configuration.
        clock: The run's clock, which must be the host's.

    Raises:
        ConfigError: ``camera.gain`` is set, but the exposure is automatic.
    """

    def __init__(self, config: CameraConfig, clock: Clock) -> None:
        if config.gain is not None and config.exposure_us is None:
            raise ConfigError(
                "camera.gain is set, but camera.exposure_us=null makes exposure and gain automatic; set both, "
                "or none"
            )
        self._losses = 0
        self._settings: Settings = {}
        self._config, self._clock = config, clock
        self._newest: Frame | None = None
        self._next_seq = 0
        self._lock = threading.Lock()
        self._failure: Exception | None = None
        self._ready, self._stop = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    def settings(self) -> Settings:
        """Settings in force as the device reports them; empty before `start`."""
        return dict(self._settings)

    def start(self) -> None:
        """Opens the device and returns after the first frame.

        Raises:
            ConfigError: The region reaches beyond the image.
            DeviceError: The device is missing, in use, gives no frames or refuses a setting.
        """
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
            atexit.register(self.close)  # device libraries abort a process that exits while their threads run
            self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def newest(self) -> Frame | None:
        """Returns the newest frame that was not returned yet, or None. Never blocks.

        A lost camera is not an error: the result is None until it is back. An unexpected exception of the
        camera's thread is raised here.
        """
        if self._failure is not None:
            raise self._failure
        with self._lock:
            frame, self._newest = self._newest, None
        return frame

    def counts(self) -> dict[str, int]:
        """Number of losses: the camera was gone, or gave no frame for ``camera.timeout_ms``."""
        return {"losses": self._losses}

    def close(self) -> None:
        """Stops capturing; returns when the device's library does. May be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        atexit.unregister(self.close)
        self._newest = None

    @abstractmethod
    def _open(self) -> AbstractContextManager[ReadFrame]:
        """Opens the device. Called and used by the camera's thread only. Raises `DeviceError`."""

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    self._capture()
                except (DeviceError, ConfigError):  # ConfigError: it is back with another image size
                    if not self._ready.is_set():
                        raise
                self._stop.wait(_REOPEN_PERIOD_S)
        except Exception as error:  # `start` or `newest` raises it in the caller's thread
            self._failure = error
        finally:
            self._ready.set()

    def _capture(self) -> None:
        """Opens the camera and stores its frames until it is lost or closed. Raises if opening fails."""
        timeout_ms = self._config.timeout_ms or max(250.0, 4e3 / self._config.rate_hz)
        with self._open() as read:
            raw = self._next_frame(read, _FIRST_FRAME_TIMEOUT_NS)
            # A reopened camera counts from 0 again; frame numbers must keep rising.
            seq_offset = max(0, self._next_seq - raw.seq) if raw is not None else 0
            try:
                while raw is not None:
                    self._store(raw, seq_offset)
                    raw = self._next_frame(read, round(timeout_ms * NS_PER_MS))
            except DeviceError:
                self._losses += 1

    def _next_frame(self, read: ReadFrame, timeout_ns: int) -> RawFrame | None:
        """Returns the next frame, or None if the camera is to be closed. Raises `DeviceLostError`."""
        deadline_ns = self._clock.now_ns() + timeout_ns
        while not self._stop.is_set():
            if (raw := read()) is not None:
                return raw
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLostError(
                    f"the {self._config.backend} camera gave no frame for {timeout_ns / NS_PER_MS:g} ms; "
                    "check its cable, and that no other program uses it"
                )
        return None

    def _store(self, raw: RawFrame, seq_offset: int) -> None:
        frame = Frame(raw.t_ns, self._clock.now_ns(), raw.seq + seq_offset, raw.gray)
        self._next_seq = frame.seq + 1
        with self._lock:
            self._newest = frame
        self._ready.set()


def crop_square(config: CameraConfig, width: int, height: int) -> tuple[int, int, int]:
    """Returns the part of an image that becomes the frame: the largest centred square of ``camera.region``.

    Args:
        config: The camera section of the configuration.
        width: Width of the image in pixels.
        height: Height of the image in pixels.

    Returns:
        Left, top and side of the square in pixels.

    Raises:
        ConfigError: The region reaches beyond the image.
    """
    left, top, columns, rows = config.region or (0, 0, width, height)
    if not (0 <= left < left + columns <= width and 0 <= top < top + rows <= height):
        raise ConfigError(
            f"camera.region {[left, top, columns, rows]} (left, top, width, height) reaches beyond the "
            f"camera's image of {width}x{height} pixels; choose a region within it"
        )
    side = min(columns, rows)
    return left + (columns - side) // 2, top + (rows - side) // 2, side
