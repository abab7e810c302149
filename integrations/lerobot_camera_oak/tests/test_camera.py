"""The camera against the interface of LeRobot, on the real driver whose pipeline runs on the host."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import timedelta
from itertools import pairwise
from types import ModuleType
from typing import Any

import depthai as dai
import numpy as np
import pytest

import gripper_force as gf
from gripper_hw.cameras import oak

Make = Callable[..., Any]


class CountingSensor(dai.node.ThreadedHostNode):
    """Gives 50 images per second, each a little brighter than the one before, while plugged in."""

    def __init__(self, plugged: threading.Event) -> None:
        dai.node.ThreadedHostNode.__init__(self)
        kind = dai.Node.DatatypeHierarchy(dai.DatatypeEnum.ImgFrame, False)
        self.output = self.createOutput(possibleDatatypes=[kind])
        self.plugged = plugged

    def run(self) -> None:
        seq = 0
        try:
            while self.isRunning():
                if self.plugged.is_set():
                    frame = dai.ImgFrame()
                    frame.setCvFrame(np.full((800, 1280), seq % 256, np.uint8), dai.ImgFrame.Type.GRAY8)
                    frame.setSequenceNum(seq)
                    frame.setTimestamp(timedelta(seconds=time.monotonic()))
                    self.output.send(frame)
                    seq += 1
                time.sleep(0.02)
        except Exception:
            return  # the pipeline is being stopped


@pytest.fixture
def plugged() -> threading.Event:
    event = threading.Event()
    event.set()
    return event


@pytest.fixture
def make_camera(cameras: ModuleType, plugged: threading.Event) -> Iterator[Make]:
    made: list[Any] = []

    def device(config: gf.CameraConfig) -> gf.Camera:
        def source(config: gf.CameraConfig, stack: ExitStack) -> oak.SensorOutput:
            pipeline = stack.enter_context(dai.Pipeline(createImplicitDevice=False))
            node = pipeline.create(CountingSensor, plugged)
            return pipeline, node.output, (1280, 800), "OV9282 at CAM_B"

        return oak.OakCamera(config, cameras.camera_oak.HostClock(), source)

    def make(**keys: Any) -> Any:
        made.append(cameras.OakCamera(cameras.OakCameraConfig(**{"timeout_ms": 5000, **keys}), device))
        return made[-1]

    yield make
    for camera in made:
        if camera.is_connected:
            camera.disconnect()


def test_lerobot_finds_the_camera_by_its_type(cameras: ModuleType) -> None:
    from lerobot.cameras import CameraConfig
    from lerobot.cameras.utils import make_cameras_from_configs

    config_class = CameraConfig.get_choice_class("oak")
    (camera,) = make_cameras_from_configs({"wrist": config_class(device="14442C10D13EABCE00")}).values()
    assert type(camera) is cameras.OakCamera
    assert (camera.fps, camera.width, camera.height) == (30, 128, 128)
    assert camera.settings.device == "14442C10D13EABCE00"


def test_frames_are_gray_in_three_channels(make_camera: Make) -> None:
    camera = make_camera(width=64, height=64)
    camera.connect()
    for image in (camera.read(), camera.async_read(20_000), camera.read_latest(60_000)):
        assert (image.shape, image.dtype) == ((64, 64, 3), np.uint8)
        assert (image == image[..., :1]).all()


def test_async_read_never_gives_a_frame_twice_and_read_latest_may(make_camera: Make) -> None:
    camera = make_camera()
    camera.connect()
    values = [int(camera.async_read(20_000)[0, 0, 0]) for _ in range(10)]
    assert all(0 < (after - value) % 256 < 128 for value, after in pairwise(values))
    before = camera.read_latest(60_000)[0, 0, 0]
    assert int(camera.read()[0, 0, 0]) != int(before)


def test_a_lost_camera_times_out(make_camera: Make, plugged: threading.Event) -> None:
    camera = make_camera(timeout_ms=60_000)
    camera.connect()
    plugged.clear()
    time.sleep(0.2)
    camera.read_latest(60_000)
    with pytest.raises(TimeoutError, match="gave no new frame for 50 ms"):
        for _ in range(10):
            camera.async_read(50)
    with pytest.raises(TimeoutError, match="ms old"):
        camera.read_latest(1)
    plugged.set()
    camera.async_read(20_000)


def test_states_of_the_connection_are_checked(make_camera: Make) -> None:
    from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

    camera = make_camera()
    for call in (camera.read, camera.async_read, camera.read_latest, camera.disconnect):
        with pytest.raises(DeviceNotConnectedError):
            call()
    camera.connect()
    with pytest.raises(DeviceAlreadyConnectedError):
        camera.connect()
    camera.disconnect()
    assert not camera.is_connected


def test_a_missing_device_is_an_error_and_nothing_stays_open(cameras: ModuleType) -> None:
    if cameras.OakCamera.find_cameras():
        pytest.skip("an OAK camera is connected")
    camera = cameras.OakCamera(cameras.OakCameraConfig())
    with pytest.raises(gf.DeviceNotFoundError, match="0 free OAK"):
        camera.connect()
    assert not camera.is_connected


def test_a_camera_that_fails_at_its_first_frame_is_closed(cameras: ModuleType) -> None:
    closed: list[bool] = []

    class Failing:
        def start(self) -> None:
            pass

        def newest(self) -> None:
            raise gf.DeviceLostError("the cable is out")

        def close(self) -> None:
            closed.append(True)

    camera = cameras.OakCamera(cameras.OakCameraConfig(), lambda config: Failing())
    with pytest.raises(gf.DeviceLostError):
        camera.connect()
    assert (camera.is_connected, closed) == (False, [True])


def test_wrong_configurations_are_named(cameras: ModuleType) -> None:
    with pytest.raises(ValueError, match="a square, not 640x480"):
        cameras.OakCameraConfig(width=640, height=480)
    with pytest.raises(gf.ConfigError, match=r"camera\.exposure_us"):
        cameras.OakCamera(cameras.OakCameraConfig(exposure_us=0))
