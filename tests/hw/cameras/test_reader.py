import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain, repeat

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import CameraConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceLostError, DeviceNotFoundError
from gripper_force.runtime.backends import MonotonicClock
from gripper_hw.cameras import reader
from gripper_hw.cameras.reader import BackgroundCamera, RawFrame, ReadFrame, crop_square

GRAY = np.zeros((1, 1), np.uint8)


class Camera(BackgroundCamera):
    """Reads frames from the function `read`."""

    read: Callable[[], RawFrame | None]

    @contextmanager
    def _open(self) -> Iterator[ReadFrame]:
        yield self.read


def test_start_fails_without_a_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_FIRST_FRAME_TIMEOUT_NS", 1_000_000)
    camera = Camera(CameraConfig(backend="oak"), MonotonicClock())
    camera.read = lambda: None
    with pytest.raises(DeviceLostError, match="the oak camera gave no frame for 1 ms; "):
        camera.start()
    camera.close()


def test_exception_of_thread_is_raised_by_start_and_newest() -> None:
    camera = Camera(CameraConfig(backend="oak"), MonotonicClock())
    camera.read = lambda: 1 // 0  # type: ignore[assignment, return-value]
    with pytest.raises(ZeroDivisionError):
        camera.start()
    with pytest.raises(ZeroDivisionError):
        camera.newest()
    camera.close()


@pytest.mark.parametrize("error", [DeviceError, DeviceLostError])
def test_error_after_start_is_a_loss_and_camera_is_reopened(
    monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    monkeypatch.setattr(reader, "_REOPEN_PERIOD_S", 0.0)
    camera = Camera(CameraConfig(backend="oak"), MonotonicClock())
    raw_frames: Iterator[RawFrame | None] = iter(())

    def read() -> RawFrame | None:
        nonlocal raw_frames
        try:
            return next(raw_frames)
        except StopIteration:
            raw_frames = iter([RawFrame(2, 0, GRAY)] * 10_000)
            raise error("something") from None

    raw_frames = iter([RawFrame(1, 0, GRAY)])
    camera.read = read
    camera.start()
    while (frame := camera.newest()) is None or frame.t_ns == 1:
        pass
    assert frame.seq > 0
    assert camera.counts()["losses"] >= 1
    camera.close()


@pytest.mark.parametrize(("rate_hz", "losses"), [(5.0, 0), (60.0, 1)])
def test_a_slow_camera_may_lose_two_frames(
    monkeypatch: pytest.MonkeyPatch, rate_hz: float, losses: int
) -> None:
    monkeypatch.setattr(reader, "_REOPEN_PERIOD_S", 0.0)

    class Now(MonotonicClock):
        t_ns = 0

        def now_ns(self) -> int:
            return self.t_ns

    def frames() -> Iterator[RawFrame | None]:
        yield RawFrame(1, 0, GRAY)
        yield from [None] * 30  # 0.6 s
        yield RawFrame(2, 1, GRAY)
        ended.wait()
        yield from repeat(None)

    def read() -> RawFrame | None:
        clock.t_ns += 20_000_000
        return next(coming)

    clock, ended, coming = Now(), threading.Event(), frames()
    camera = Camera(CameraConfig(backend="oak", rate_hz=rate_hz), clock)
    camera.read = read
    camera.start()
    while (frame := camera.newest()) is None or frame.t_ns == 1:
        pass
    assert camera.counts() == {"losses": losses}
    ended.set()
    camera.close()


def test_camera_with_another_image_size_stays_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_REOPEN_PERIOD_S", 0.0)
    tries = iter([None, ConfigError("the region"), DeviceNotFoundError("no camera"), None])

    class Changed(BackgroundCamera):
        @contextmanager
        def _open(self) -> Iterator[ReadFrame]:
            if (error := next(tries)) is not None:
                raise error
            raw_frames = iter([RawFrame(1, 0, GRAY)])
            yield lambda: next(raw_frames, None) or lose()

    def lose() -> RawFrame:
        if next(lost):
            raise DeviceLostError("gone")
        return RawFrame(2, 5, GRAY)

    lost = chain([True], repeat(False))
    camera = Changed(CameraConfig(backend="oak"), MonotonicClock())
    camera.start()
    while (frame := camera.newest()) is None or frame.t_ns == 1:
        pass
    assert camera.counts() == {"losses": 1}
    camera.close()


def test_device_is_released_at_exit_without_close() -> None:
    program = """
from contextlib import contextmanager
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.config import CameraConfig
from gripper_hw.cameras.reader import BackgroundCamera, RawFrame

class Camera(BackgroundCamera):
    @contextmanager
    def _open(self):
        yield lambda: RawFrame(0, 0, None)
        print("released")

Camera(CameraConfig(backend="oak"), MonotonicClock()).start()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stdout == "released\n"


numbers = st.integers(-20, 200)


@given(st.tuples(numbers, numbers, numbers, numbers), st.integers(1, 150), st.integers(1, 150))
def test_square_is_centred_in_region_within_image(
    region: tuple[int, int, int, int], width: int, height: int
) -> None:
    left, top, columns, rows = region
    inside = min(left, top) >= 0 < min(columns, rows) and left + columns <= width and top + rows <= height
    config = CameraConfig(region=region)
    if not inside:
        with pytest.raises(ConfigError, match=r"camera\.region"):
            crop_square(config, width, height)
        return
    x, y, side = crop_square(config, width, height)
    assert side == min(columns, rows)
    for start, low, size in ((x, left, columns), (y, top, rows)):
        assert low <= start
        assert start + side <= low + size
        assert abs((start - low) - (low + size - start - side)) <= 1


def test_default_region_is_whole_image() -> None:
    assert crop_square(CameraConfig(), 1280, 800) == (240, 0, 800)
