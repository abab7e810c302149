import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest

from gripper_force.config import CameraConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceNotFoundError
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.types import NS_PER_MS, Frame
from gripper_hw.cameras.uvc import UvcCamera, find_device

Take = Callable[..., list[Frame]]
MakeUvc = Callable[..., UvcCamera]


def test_device_must_be_configured() -> None:
    with pytest.raises(ConfigError, match=r"camera\.backend=uvc needs camera\.device; set it to an index"):
        UvcCamera(CameraConfig(backend="uvc"), MonotonicClock())


def test_image_is_cropped_downscaled_and_gray(make_uvc: MakeUvc, take: Take) -> None:
    camera = make_uvc(region=(10, 20, 200, 100), side_px=50)
    camera.start()
    frames = take(camera, 3)
    camera.close()
    assert {frame.gray.shape for frame in frames} == {(50, 50)}
    assert all(abs(frame.gray.mean() - 8 * (frame.seq % 30)) <= 3 for frame in frames)


def test_region_beyond_image_is_refused(make_uvc: MakeUvc) -> None:
    camera = make_uvc(region=(0, 0, 321, 100))
    with pytest.raises(ConfigError, match=r"camera\.region .*320x240"):
        camera.start()


def test_exposure_and_gain_are_set_in_driver_units(make_uvc: MakeUvc) -> None:
    camera = make_uvc(exposure_us=8000, gain=20)
    captures: list[Any] = []
    open_capture = camera._open_capture

    def kept(path: str) -> Any:
        captures.append(open_capture(path))
        return captures[-1]

    camera._open_capture = kept
    camera.start()
    camera.close()
    assert captures[0].controls == {
        cv2.CAP_PROP_AUTO_EXPOSURE: 1,
        cv2.CAP_PROP_EXPOSURE: 80,
        cv2.CAP_PROP_GAIN: 20,
    }


@pytest.mark.parametrize(
    ("control", "what"),
    [
        (cv2.CAP_PROP_AUTO_EXPOSURE, "automatic exposure off: it was set to 1 and reads 3"),
        (cv2.CAP_PROP_EXPOSURE, "an exposure of 4000 us: it was set to 40 and reads 157"),
        (cv2.CAP_PROP_GAIN, "a gain of 30: it was set to 30 and reads 8"),
    ],
)
def test_refused_control_is_an_error(make_uvc: MakeUvc, control: int, what: str) -> None:
    camera = make_uvc(frozenset({control}), gain=30)
    with pytest.raises(DeviceError, match=f"refuses {what}; "):
        camera.start()
    camera.close()


def test_exposure_can_be_automatic(make_uvc: MakeUvc, take: Take) -> None:
    camera = make_uvc(frozenset({cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_EXPOSURE}), exposure_us=None)
    camera.start()
    take(camera, 2)
    camera.close()


def test_frame_time_is_middle_of_exposure(make_uvc: MakeUvc, take: Take) -> None:
    camera = make_uvc(exposure_us=400_000)
    camera.start()
    for frame in take(camera, 3):
        assert frame.received_ns - frame.t_ns >= 200 * NS_PER_MS
    camera.close()


def test_timestamps_of_another_clock_are_refused(video: Path) -> None:
    config = CameraConfig(backend="uvc", device=str(video), exposure_us=None)
    camera = UvcCamera(config, MonotonicClock(), cv2.VideoCapture)  # the file's own times begin at 0
    with pytest.raises(DeviceError, match="timestamps its frames with another clock"):
        camera.start()


def test_path_that_is_no_free_camera_is_refused(
    make_uvc: MakeUvc, plugged: threading.Event, tmp_path: Path
) -> None:
    plugged.clear()
    with pytest.raises(DeviceError, match=r"cannot open .* as a camera; "):
        make_uvc().start()
    text = tmp_path / "no_camera"
    text.write_text("nothing to see")
    with pytest.raises(DeviceError, match=r"cannot open .* as a camera; "):
        UvcCamera(CameraConfig(backend="uvc", device=str(text)), MonotonicClock()).start()


def test_device_is_found_by_number_path_and_name(tmp_path: Path, video: Path) -> None:
    for node, index, name in [(0, 0, "Webcam"), (1, 1, "Webcam"), (2, 0, "Eye"), (4, 0, "Eye")]:
        folder = tmp_path / f"video{node}"
        folder.mkdir()
        (folder / "index").write_text(f"{index}\n")
        (folder / "name").write_text(f"{name}\n")
    assert find_device("Webcam", tmp_path) == Path("/dev/video0")
    assert find_device(str(video), tmp_path) == video
    with pytest.raises(DeviceNotFoundError, match=r"2 cameras have the name 'Eye'; .*'Eye' at /dev/video4"):
        find_device("Eye", tmp_path)
    with pytest.raises(
        DeviceNotFoundError, match=r"0 cameras have the name 'Nose'; .*'Webcam' at /dev/video0"
    ):
        find_device("Nose", tmp_path)
    with pytest.raises(DeviceNotFoundError, match="to one of: none"):
        find_device("Eye", tmp_path / "video0")
    with pytest.raises(DeviceNotFoundError, match="camera /dev/video777 does not exist; "):
        find_device(777)
