import subprocess
import sys
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
    """Reads what it is given."""

    read: Callable[[], RawFrame | None]

    @contextmanager
    def _open(self) -> Iterator[ReadFrame]:
        yield self.read


def test_a_camera_that_gives_no_frame_at_all_can_not_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_FIRST_FRAME_TIMEOUT_NS", 1_000_000)
    camera = Camera(CameraConfig(backend="oak"), MonotonicClock())
    camera.read = lambda: None
    with pytest.raises(DeviceLostError, match="the oak camera gave no frame for 1 ms; "):
        camera.start()
    camera.close()


def test_a_defect_in_the_thread_is_raised_to_who_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera(CameraConfig(backend="oak"), MonotonicClock())
    camera.read = lambda: 1 // 0  # type: ignore[assignment, return-value]
    with pytest.raises(ZeroDivisionError):
        camera.start()
    with pytest.raises(ZeroDivisionError):
        camera.newest()
    camera.close()


@pytest.mark.parametrize("error", [DeviceError, DeviceLostError])
def test_whatever_goes_wrong_later_is_a_loss_and_the_camera_comes_back(
    monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    monkeypatch.setattr(reader, "_REOPEN_PERIOD_S", 0.0)
    camera = Camera(CameraConfig(backend="oak"), MonotonicClock())
    shots: Iterator[RawFrame | None] = iter(())

    def read() -> RawFrame | None:
        nonlocal shots
        try:
            return next(shots)
        except StopIteration:
            shots = iter([RawFrame(2, 0, GRAY)] * 10_000)
            raise error("something") from None

    shots = iter([RawFrame(1, 0, GRAY)])
    camera.read = read
    camera.start()
    while (frame := camera.newest()) is None or frame.t_ns == 1:
        pass
    assert frame.seq > 0
    assert camera.counts()["losses"] >= 1
    camera.close()


def test_a_camera_that_comes_back_with_another_picture_is_still_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_REOPEN_PERIOD_S", 0.0)
    tries = iter([None, ConfigError("the region"), DeviceNotFoundError("no camera"), None])

    class Changed(BackgroundCamera):
        @contextmanager
        def _open(self) -> Iterator[ReadFrame]:
            if (error := next(tries)) is not None:
                raise error
            shots = iter([RawFrame(1, 0, GRAY)])
            yield lambda: next(shots, None) or lose()

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


def test_a_program_that_forgets_to_close_still_releases_the_device() -> None:
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
def test_the_square_lies_in_the_middle_of_a_region_that_lies_in_the_picture(
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


def test_without_a_region_the_whole_picture_counts() -> None:
    assert crop_square(CameraConfig(), 1280, 800) == (240, 0, 800)
