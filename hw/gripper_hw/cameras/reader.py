"""What real cameras have in common: a thread that reads, keeps the newest frame, and finds the way back."""

import atexit
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import NamedTuple

from gripper_force.config import CameraConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceLostError
from gripper_force.interfaces import Clock
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, Gray

_FIRST_FRAME_NS = 5 * NS_PER_S
_RETRY_S = 0.5
_RATE_FRAMES = 120


class Shot(NamedTuple):
    """A picture from a device: the middle of its exposure, the device's number, and (H, W) uint8."""

    t_ns: int
    seq: int
    gray: Gray


Read = Callable[[], Shot | None]
"""Waits a short while for the next picture; None if there was none. Raises `DeviceError`."""


class BackgroundCamera(ABC):
    """A camera that a thread of its own opens, reads, and opens again after a loss.

    Args:
        config: Its section of the configuration.
        clock: The run's clock, which must be the host's.
    """

    def __init__(self, config: CameraConfig, clock: Clock) -> None:
        self._losses = 0
        self._config, self._clock = config, clock
        self._newest: Frame | None = None
        self._next_seq = 0
        self._times_ns: deque[int] = deque(maxlen=_RATE_FRAMES)
        self._lock = threading.Lock()
        self._failure: Exception | None = None
        self._begun, self._stop = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def rate_hz_measured(self) -> float:
        """Rate of the last frames, to compare with ``camera.rate_hz``; 0 before the second frame."""
        with self._lock:
            times_ns = list(self._times_ns)
        return (len(times_ns) - 1) * NS_PER_S / (times_ns[-1] - times_ns[0]) if len(times_ns) > 1 else 0.0

    def start(self) -> None:
        """Opens the device and returns when the first frame is there.

        Raises:
            ConfigError: The region reaches beyond the picture.
            DeviceError: The device is missing, in use, gives no frames or refuses a setting.
        """
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
            atexit.register(self.close)  # a device's library aborts a process that ends under its threads
            self._thread.start()
        self._begun.wait()
        if self._failure is not None:
            raise self._failure

    def newest(self) -> Frame | None:
        """The newest frame that was not handed out yet, or None, also while the camera is lost. Never blocks.

        A lost camera is no error; a defect in the camera's thread is raised here.
        """
        if self._failure is not None:
            raise self._failure
        with self._lock:
            frame, self._newest = self._newest, None
        return frame

    def counts(self) -> dict[str, int]:
        """How often the camera was gone, or gave no frame for ``camera.timeout_ms``."""
        return {"losses": self._losses}

    def close(self) -> None:
        """Stops capturing, once the device's library returns. May be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        atexit.unregister(self.close)
        self._newest = None

    @abstractmethod
    def _opened(self) -> AbstractContextManager[Read]:
        """Opens the device; raises `DeviceError`. The camera's thread alone enters, reads and leaves."""

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    self._capture()
                except (DeviceError, ConfigError):  # also one that comes back with another picture
                    if not self._begun.is_set():
                        raise
                self._stop.wait(_RETRY_S)
        except Exception as error:  # `start` or `newest` raises it in the caller's thread
            self._failure = error
        finally:
            self._begun.set()

    def _capture(self) -> None:
        """Opens the camera and keeps its newest frame until it is lost or closed. Raises what prevents it."""
        with self._opened() as read:
            shot = self._next_shot(read, _FIRST_FRAME_NS)
            # A camera that comes back counts from 0; a frame's number must stay its own.
            shift = max(0, self._next_seq - shot.seq) if shot is not None else 0
            with self._lock:
                self._times_ns.clear()
            try:
                while shot is not None:
                    self._keep(shot, shift)
                    shot = self._next_shot(read, round(self._config.timeout_ms * NS_PER_MS))
            except DeviceError:
                self._losses += 1

    def _next_shot(self, read: Read, patience_ns: int) -> Shot | None:
        """The next picture, or None if the camera is to be closed. Raises `DeviceLostError`."""
        deadline_ns = self._clock.now_ns() + patience_ns
        while not self._stop.is_set():
            if (shot := read()) is not None:
                return shot
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLostError(
                    f"the {self._config.backend} camera gave no frame for {patience_ns / NS_PER_MS:g} ms; "
                    "check its cable, and that no other program reads it"
                )
        return None

    def _keep(self, shot: Shot, shift: int) -> None:
        frame = Frame(shot.t_ns, self._clock.now_ns(), shot.seq + shift, shot.gray)
        self._next_seq = frame.seq + 1
        with self._lock:
            self._newest = frame
            self._times_ns.append(frame.t_ns)
        self._begun.set()


def square(config: CameraConfig, width: int, height: int) -> tuple[int, int, int]:
    """The part of a picture that becomes the frame: the largest square in the middle of ``camera.region``.

    Returns:
        Left, top and side in pixels, as are the picture's width and height.

    Raises:
        ConfigError: The region reaches beyond the picture.
    """
    left, top, columns, rows = config.region or (0, 0, width, height)
    if not (0 <= left < left + columns <= width and 0 <= top < top + rows <= height):
        raise ConfigError(
            f"camera.region {[left, top, columns, rows]} (left, top, width, height) must lie within "
            f"the camera's picture of {width}x{height} pixels"
        )
    side = min(columns, rows)
    return left + (columns - side) // 2, top + (rows - side) // 2, side
