import os
import subprocess
import sys
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
from gripper_hw.cameras.oak import OakCamera, SensorOutput, choose_sensor, choose_size, set_controls

Take = Callable[..., list[Frame]]
MakeOak = Callable[..., OakCamera]


@pytest.fixture
def scene() -> Gray:
    """A white square of 80 pixels at (700, 300) of an OV9282's image."""
    gray = np.zeros((800, 1280), np.uint8)
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


def features(
    socket: str, name: str, kind: str, modes: dict[tuple[int, int], float], autofocus: bool = False
) -> dai.CameraFeatures:
    """Features of one sensor as a device reports them."""
    sensor = dai.CameraFeatures()
    sensor.socket, sensor.sensorName = dai.CameraBoardSocket.__members__[socket], name
    sensor.supportedTypes = [dai.CameraSensorType.__members__[kind]]
    sensor.hasAutofocus = autofocus
    sensor.width, sensor.height = max(modes, default=(1280, 800))
    configs = []
    for (width, height), rate_hz in modes.items():
        config = dai.CameraSensorConfig()
        config.width, config.height, config.maxFps = width, height, rate_hz
        configs.append(config)
    sensor.configs = configs
    return sensor


# Modes of OV9282 and OV7251: https://docs.luxonis.com/hardware/sensors/OV7251
OV9282 = {(1280, 720): 143.1, (1280, 800): 129.6, (640, 400): 255.7}
OV7251 = {(640, 480): 99.0, (640, 400): 117.0}
IMX378 = {(1920, 1080): 59.94, (3840, 2160): 42.0, (4056, 3040): 30.0}
LEFT, RIGHT = features("CAM_B", "OV7251", "MONO", OV7251), features("CAM_C", "OV7251", "MONO", OV7251)
WIDE = features("CAM_B", "OV9282", "MONO", OV9282)
COLOUR = features("CAM_A", "IMX378", "COLOR", IMX378, autofocus=True)


def test_mono_sensor_on_lowest_socket_is_preferred() -> None:
    assert choose_sensor([COLOUR, RIGHT, LEFT], None) is LEFT
    assert choose_sensor([COLOUR], None) is COLOUR
    with pytest.raises(DeviceNotFoundError, match="no sensor connected"):
        choose_sensor([], None)


def test_sensor_is_found_by_socket_and_by_name() -> None:
    device = [COLOUR, LEFT, RIGHT]
    assert choose_sensor(device, "CAM_C") is RIGHT
    assert choose_sensor(device, "ov7251") is LEFT
    assert choose_sensor(device, "IMX378") is COLOUR
    known = "IMX378 at CAM_A, OV7251 at CAM_B, OV7251 at CAM_C"
    with pytest.raises(DeviceNotFoundError, match=rf"camera\.sensor=OV9282; .* socket of: {known}"):
        choose_sensor(device, "OV9282")


@pytest.mark.parametrize(
    ("sensor", "keys", "size_px"),
    [
        (WIDE, {}, (1280, 800)),
        (WIDE, {"rate_hz": 140}, (1280, 720)),
        (WIDE, {"rate_hz": 200}, (640, 400)),
        (WIDE, {"resolution_px": (640, 400)}, (640, 400)),
        (LEFT, {}, (640, 480)),
        (LEFT, {"rate_hz": 110}, (640, 400)),
        (COLOUR, {}, (1920, 1080)),
        (COLOUR, {"rate_hz": 30, "resolution_px": (4056, 3040)}, (4056, 3040)),
        (features("CAM_B", "NEW", "MONO", {}), {}, (1280, 800)),
    ],
)
def test_mode_is_the_configured_or_the_largest_small_one_that_is_fast_enough(
    sensor: dai.CameraFeatures, keys: dict[str, Any], size_px: tuple[int, int]
) -> None:
    assert choose_size(sensor, CameraConfig(**keys)) == size_px


@pytest.mark.parametrize(
    ("keys", "wanted"),
    [
        ({"resolution_px": (1280, 800)}, "rate_hz=60 with camera.resolution_px=[1280, 800]"),
        ({"rate_hz": 200}, "rate_hz=200 with camera.resolution_px=null"),
        ({"resolution_px": (640, 480), "rate_hz": 110}, "rate_hz=110 with camera.resolution_px=[640, 480]"),
    ],
)
def test_mode_that_the_sensor_does_not_have_is_refused(keys: dict[str, Any], wanted: str) -> None:
    message = (
        f"the sensor OV7251 at CAM_B has no mode for camera.{wanted}; set them to one of its modes: "
        "640x480 at up to 99, 640x400 at up to 117"
    )
    with pytest.raises(DeviceError) as caught:
        choose_size(LEFT, CameraConfig(**keys))
    assert str(caught.value) == message


def test_modes_that_need_more_than_a_size_are_left_out() -> None:
    sensor = features("CAM_A", "IMX586", "COLOR", {(1280, 720): 240.0, (1920, 1080): 60.0})
    fast, _ = modes = sensor.configs
    fast.hfr = True
    sensor.configs = modes
    assert choose_size(sensor, CameraConfig()) == (1920, 1080)


def commands(sensor: dai.CameraFeatures, **keys: Any) -> tuple[dai.CameraControl, set[str]]:
    """A sensor's controls, and the names of those that are set."""
    control = dai.CameraControl()
    set_controls(control, sensor, CameraConfig(**keys))
    known = dai.CameraControl.Command.__members__.items()
    return control, {name for name, command in known if control.getCommand(command)}


def test_only_exposure_of_a_mono_sensor_is_set() -> None:
    control, names = commands(WIDE, exposure_us=2500, gain=400)
    assert names == {"AE_MANUAL"}
    assert control.getExposureTime().total_seconds() == pytest.approx(2.5e-3)
    assert control.getSensitivity() == 400
    assert commands(WIDE)[0].getSensitivity() == 100
    assert commands(WIDE, exposure_us=None)[1] == set()


def test_nothing_of_a_colour_sensor_is_automatic() -> None:
    control, names = commands(COLOUR, lens_position=130, white_balance_k=4200)
    assert names == {"AE_MANUAL", "AF_MODE", "MOVE_LENS", "WB_COLOR_TEMP"}
    assert control.autoFocusMode == dai.CameraControl.AutoFocusMode.OFF
    assert (control.getLensPosition(), control.wbColorTemp) == (130, 4200)
    fixed = features("CAM_A", "OV9782", "COLOR", OV9282)
    control, names = commands(fixed)
    assert names == {"AE_MANUAL", "WB_COLOR_TEMP"}
    assert control.wbColorTemp == 5000


@pytest.mark.parametrize(
    ("sensor", "keys", "why"),
    [
        (
            COLOUR,
            {},
            r"IMX378 at CAM_A has a lens with autofocus.*lens_position is null; set it to 0 \(far\) to 255",
        ),
        (
            LEFT,
            {"lens_position": 100},
            "OV7251 at CAM_B has a lens with fixed focus; set camera.lens_position=null",
        ),
        (
            LEFT,
            {"white_balance_k": 5000},
            "is mono and has no white balance; set camera.white_balance_k=null",
        ),
    ],
)
def test_control_that_the_sensor_lacks_or_needs_is_named(
    sensor: dai.CameraFeatures, keys: dict[str, Any], why: str
) -> None:
    with pytest.raises(DeviceError, match=why):
        set_controls(dai.CameraControl(), sensor, CameraConfig(**keys))


def test_settings_in_force_are_those_of_the_frames(make_oak: MakeOak, take: Take) -> None:
    camera = make_oak(exposure_us=3000, gain=200, lens_position=140, white_balance_k=4200)
    assert camera.settings() == {}
    camera.start()
    take(camera, 3)
    camera.close()
    assert camera.settings() == {
        "sensor": "OV9282 at CAM_B",
        "resolution_px": "1280x800",
        "exposure_us": 3000,
        "gain": 200,
        "lens_position": 140,
        "white_balance_k": 4200,
    }


def test_small_sensor_is_cropped_within_its_own_image(make_oak: MakeOak, take: Take) -> None:
    gray = np.zeros((480, 640), np.uint8)
    gray[:, 80:560] = 200  # the central square
    camera = make_oak(gray)
    camera.start()
    assert take(camera, 1)[0].gray.min() >= 190
    camera.close()
    with pytest.raises(ConfigError, match=r"camera\.region .*640x480"):
        make_oak(gray, region=(0, 0, 1280, 800)).start()


def test_pipeline_that_cannot_be_built_or_run_is_a_device_error(make_oak: MakeOak) -> None:
    def with_device_node(node: Any) -> OakCamera:
        camera = make_oak()
        source = camera._source

        def source_with_node(config: CameraConfig, stack: ExitStack) -> SensorOutput:
            sensor = source(config, stack)
            sensor[0].create(node)
            return sensor

        camera._source = source_with_node
        return camera

    with pytest.raises(DeviceError, match=r"cannot be used: .*host only"):
        with_device_node(dai.node.Script).start()
    with pytest.raises(DeviceLostError, match=r"pipeline failed: .*[Nn]o devices"):
        with_device_node(dai.node.Sync).start()


def test_ended_pipeline_is_a_loss_and_is_rebuilt(make_oak: MakeOak, take: Take) -> None:
    camera, pipelines = make_oak(), []
    source = camera._source

    def watched(config: CameraConfig, stack: ExitStack) -> SensorOutput:
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


@pytest.mark.parametrize(("set_to", "dumps"), [(None, "0"), ("/tmp", "/tmp")])
def test_a_lost_device_is_not_started_for_a_crash_dump(set_to: str | None, dumps: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "DEPTHAI_CRASHDUMP"}
    done = subprocess.run(
        [sys.executable, "-c", "import os, gripper_hw.cameras; print(os.environ['DEPTHAI_CRASHDUMP'])"],
        env=environment | ({"DEPTHAI_CRASHDUMP": set_to} if set_to else {}),
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert done.stdout.strip() == dumps


def test_depthai_does_not_report_its_use() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "DEPTHAI_TELEMETRY"}
    code = "from gripper_hw.cameras.oak import dai; dai.Device.getAllAvailableDevices()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment | {"DEPTHAI_LEVEL": "debug"},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert "Telemetry disabled" in done.stdout
