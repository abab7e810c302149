import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import depthai as dai
import numpy as np
import pytest

from gripper_force.config import CameraConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceLostError, DeviceNotFoundError
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.types import NS_PER_MS, Frame, Gray
from gripper_hw.cameras import oak
from gripper_hw.cameras.oak import SENSOR_SIZE_PX, OakCamera, choose_sensor

Take = Callable[..., list[Frame]]
MakeOak = Callable[..., OakCamera]


@pytest.fixture
def scene() -> Gray:
    """A white square of 80 pixels at (700, 300), 700 pixels from the left."""
    width, height = SENSOR_SIZE_PX
    gray = np.zeros((height, width), np.uint8)
    gray[300:380, 700:780] = 255
    return gray


@pytest.mark.parametrize(
    ("region", "side_px", "square"),
    [
        (None, 128, (slice(48, 61), slice(74, 86))),  # the middle 800 pixels: 6.25 to one
        ((700, 300, 80, 80), 64, (slice(0, 64), slice(0, 64))),
        ((640, 300, 240, 80), 40, (slice(0, 40), slice(0, 10))),  # its middle begins at 720
        ((600, 200, 200, 200), 100, (slice(50, 90), slice(50, 90))),
    ],
)
def test_centre_square_of_region_becomes_frame(
    make_oak: MakeOak, take: Take, scene: Gray, region: Any, side_px: int, square: tuple[slice, slice]
) -> None:
    camera = make_oak(scene, region=region, side_px=side_px)
    camera.start()
    gray = take(camera, 1)[0].gray
    camera.close()
    assert gray.shape == (side_px, side_px)
    assert gray[square].mean() > 200


def test_colour_sensor_is_converted_to_gray(make_oak: MakeOak, take: Take, scene: Gray) -> None:
    images = []
    for colour in (False, True):
        camera = make_oak(scene // 2, colour=colour)
        camera.start()
        images.append(take(camera, 1)[0].gray.astype(int))
        camera.close()
    assert images[1].shape == (128, 128)
    assert np.abs(images[1] - images[0]).mean() < 2


def test_region_beyond_image_is_refused(make_oak: MakeOak) -> None:
    with pytest.raises(ConfigError, match=r"camera\.region \[1200, 0, 100, 100\] .*1280x800"):
        make_oak(region=(1200, 0, 100, 100)).start()


def test_frame_time_is_middle_of_exposure(make_oak: MakeOak, take: Take) -> None:
    camera = make_oak(exposure_us=400_000)
    camera.start()
    for frame in take(camera, 3):
        assert frame.received_ns - frame.t_ns >= 200 * NS_PER_MS
    camera.close()


def test_missing_device_is_one_line_and_environment_is_unchanged() -> None:
    if dai.Device.getAllAvailableDevices():
        pytest.skip("an OAK camera is connected")
    before = dict(os.environ)
    camera = OakCamera(CameraConfig(backend="oak"), MonotonicClock())
    with pytest.raises(DeviceNotFoundError, match=r"0 free OAK .*=null \(free: none\); ") as caught:
        camera.start()
    camera.close()
    assert "\n" not in str(caught.value)
    assert dict(os.environ) == before


def test_one_of_several_devices_must_be_named_by_id_or_address() -> None:
    first, second = dai.DeviceInfo("14442C10D13EABCE00"), dai.DeviceInfo("14442C10D13EABCE01")
    second.name = "169.254.1.222"
    both = [first, second]
    assert oak._find("14442C10D13EABCE00", both) is first
    assert oak._find("169.254.1.222", both) is second
    assert oak._find(None, [second]) is second
    with pytest.raises(DeviceNotFoundError, match=r"2 free .*=null .*14442C10D13EABCE01 at 169"):
        oak._find(None, both)
    with pytest.raises(DeviceNotFoundError, match=r"0 free .*=7 "):
        oak._find(7, both)


def test_mono_sensor_is_preferred_to_colour() -> None:
    def sensor(socket: dai.CameraBoardSocket, kind: dai.CameraSensorType) -> dai.CameraFeatures:
        features = dai.CameraFeatures()
        features.socket, features.supportedTypes = socket, [kind]
        return features

    sockets, kinds = dai.CameraBoardSocket, dai.CameraSensorType
    colour = sensor(sockets.CAM_A, kinds.COLOR)
    left, right = sensor(sockets.CAM_B, kinds.MONO), sensor(sockets.CAM_C, kinds.MONO)
    assert choose_sensor([colour, right, left]) is left
    assert choose_sensor([colour]) is colour
    with pytest.raises(DeviceNotFoundError, match="no sensor"):
        choose_sensor([])


def test_pipeline_that_cannot_be_built_or_run_is_a_device_error(make_oak: MakeOak) -> None:
    def with_device_node(node: Any) -> OakCamera:
        camera = make_oak()
        source = camera._source

        def source_with_node(config: CameraConfig, stack: ExitStack) -> tuple[Any, Any]:
            pipeline, output = source(config, stack)
            pipeline.create(node)
            return pipeline, output

        camera._source = source_with_node
        return camera

    with pytest.raises(DeviceError, match=r"cannot be used: .*host only"):
        with_device_node(dai.node.Script).start()
    with pytest.raises(DeviceLostError, match=r"pipeline failed: .*[Nn]o devices"):
        with_device_node(dai.node.Sync).start()


def test_ended_pipeline_is_a_loss_and_is_rebuilt(make_oak: MakeOak, take: Take) -> None:
    camera, pipelines = make_oak(), []
    source = camera._source

    def watched(config: CameraConfig, stack: ExitStack) -> tuple[Any, Any]:
        pipelines.append(source(config, stack))
        return pipelines[-1]

    camera._source = watched
    camera.start()
    take(camera, 2)
    pipelines[0][0].stop()
    deadline = time.monotonic() + 30
    while not camera.counts()["losses"]:
        assert time.monotonic() < deadline
        time.sleep(0.002)
    camera.newest()
    take(camera, 2)
    camera.close()
    assert len(pipelines) == 2


def test_camera_can_be_opened_repeatedly(make_oak: MakeOak, take: Take) -> None:
    for _ in range(5):
        camera = make_oak()
        camera.start()
        take(camera, 2)
        camera.close()
