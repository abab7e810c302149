"""Tests that every `gripper_force.interfaces.Camera` must pass.

Subclass `CameraContract` in a test module and override the fixture ``camera``::

    class TestMyCamera(CameraContract):
        @pytest.fixture
        def camera(self, clock):
            return MyCamera(gf.CameraConfig(backend="my_package.cameras:MyCamera"), clock)

The camera must deliver frames while the tests wait. If it needs help to do so (a trigger, a simulated clock),
override ``wait`` too.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest

from gripper_force.interfaces import Camera, Clock
from gripper_force.testing.sensor_contract import SensorContract, check_counts, check_second_object, collect
from gripper_force.types import NS_PER_S, Frame

_SLOW_PERIODS = 5
"""Frame periods between two calls of a slow reader."""


class CameraContract(SensorContract):
    """Contract tests of a camera.

    Override the fixture `camera`; override `clock` if the camera is not on the host's clock, and
    `second_camera` to test a second user of the same device.
    """

    @pytest.fixture
    def camera(self) -> Camera:
        """A camera that was constructed and not started yet."""
        raise NotImplementedError("override the fixture camera")

    @pytest.fixture
    def second_camera(self) -> Camera | None:
        """Another object for the same device, not started; None skips its test."""
        return None

    @pytest.fixture(autouse=True)
    def _close(self, camera: Camera, second_camera: Camera | None) -> Iterator[None]:
        yield
        camera.close()
        if second_camera is not None:
            second_camera.close()

    # Frames.

    def test_no_frame_before_start(self, camera: Camera, wait: Callable[[float], None]) -> None:
        """``newest`` returns None before ``start``."""
        wait(0.1)
        assert camera.newest() is None

    def test_frames_are_gray_and_of_one_size(self, camera: Camera, wait: Callable[[float], None]) -> None:
        """Frames are (H, W) uint8, and their size does not change."""
        camera.start()
        frames = _take(camera, 8, wait)
        assert {frame.gray.dtype.name for frame in frames} == {"uint8"}
        shapes = {frame.gray.shape for frame in frames}
        assert len(shapes) == 1
        (shape,) = shapes
        assert len(shape) == 2
        assert min(shape) > 0

    def test_times_and_numbers_increase(
        self, camera: Camera, clock: Clock, wait: Callable[[float], None]
    ) -> None:
        """Times and ``seq`` increase from frame to frame, and ``t_ns <= received_ns <= now``."""
        camera.start()
        frames = []
        for _ in range(8):
            (frame,) = _take(camera, 1, wait)
            frames.append(frame)
            assert frame.t_ns <= frame.received_ns <= clock.now_ns()
        for older, newer in pairwise(frames):
            assert older.t_ns < newer.t_ns
            assert older.received_ns < newer.received_ns
            assert older.seq < newer.seq
        assert {type(number) for f in frames for number in (f.t_ns, f.received_ns, f.seq)} == {int}

    def test_frames_are_not_overwritten(self, camera: Camera, wait: Callable[[float], None]) -> None:
        """A frame's image stays the same while later frames arrive."""
        camera.start()
        (frame,) = _take(camera, 1, wait)
        before = frame.gray.tobytes()
        _take(camera, 5, wait)
        assert frame.gray.tobytes() == before

    def test_newest_returns_none_between_frames(self, camera: Camera, wait: Callable[[float], None]) -> None:
        """``newest`` does not wait for the next frame: called in a fast loop, it returns None."""
        camera.start()
        _take(camera, 1, wait)
        assert any(camera.newest() is None for _ in range(50))

    def test_slow_reader_skips_old_frames(self, camera: Camera, wait: Callable[[float], None]) -> None:
        """``newest`` returns the newest frame and drops the frames before it; ``seq`` shows the gap."""
        camera.start()
        frames = _take(camera, 4, wait)
        period_s = (frames[-1].t_ns - frames[0].t_ns) / NS_PER_S / (frames[-1].seq - frames[0].seq)
        seqs = [frames[-1].seq]
        for _ in range(15):  # a busy machine may skip no frame once or twice
            wait(_SLOW_PERIODS * period_s)
            seqs.append(_take(camera, 1, wait)[0].seq)
            if seqs[-1] > seqs[-2] + 1:
                return
        pytest.fail(f"no frame was skipped by a slow reader; frame numbers: {seqs}")

    def test_counts_are_not_negative_and_never_decrease(
        self, camera: Camera, wait: Callable[[float], None]
    ) -> None:
        """``counts`` maps causes to numbers, before ``start``, while capturing and after ``close``."""
        counts = [camera.counts()]
        camera.start()
        _take(camera, 2, wait)
        counts.append(camera.counts())
        camera.close()
        counts.append(camera.counts())
        check_counts(counts)

    def test_settings_are_numbers_or_texts(self, camera: Camera, wait: Callable[[float], None]) -> None:
        """``settings``, which is optional, maps keys to numbers or texts, before ``start`` and while capturing."""
        settings = getattr(camera, "settings", None)
        if settings is None:
            pytest.skip("the camera has no method settings")
        found = [settings()]
        camera.start()
        _take(camera, 2, wait)
        found.append(settings())
        for values in found:
            assert all(type(key) is str and type(value) in (int, float, str) for key, value in values.items())

    # Start and close.

    def test_second_start_has_no_effect(self, camera: Camera, wait: Callable[[float], None]) -> None:
        """``start`` may be called twice; frames keep coming in order."""
        camera.start()
        camera.start()
        frames = _take(camera, 3, wait)
        assert frames[0].seq < frames[1].seq < frames[2].seq

    def test_no_frame_after_close(self, camera: Camera, wait: Callable[[float], None]) -> None:
        """After ``close``, which may be called twice, ``newest`` returns None, also for a waiting frame."""
        camera.start()
        _take(camera, 2, wait)
        wait(0.1)
        camera.close()
        camera.close()
        assert camera.newest() is None
        wait(0.1)
        assert camera.newest() is None

    def test_close_before_start(self, camera: Camera) -> None:
        """A camera that was never started can be closed, twice."""
        camera.close()
        camera.close()
        assert camera.newest() is None

    def test_second_camera_does_not_disturb_the_first(
        self, camera: Camera, second_camera: Camera | None, wait: Callable[[float], None]
    ) -> None:
        """A second object for the same device works too, or its ``start`` raises `DeviceError`."""
        check_second_object(camera, second_camera, lambda one, count: _take(one, count, wait))


def _take(camera: Camera, count: int, wait: Callable[[float], None]) -> list[Frame]:
    """Waits for ``count`` frames and returns them."""
    return collect(lambda: [] if (frame := camera.newest()) is None else [frame], count, wait)
