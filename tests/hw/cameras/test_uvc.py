import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest

from gripper_force.config import CameraConfig, load_config
from gripper_force.errors import ConfigError, DeviceError, DeviceNotFoundError
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.session import open_run
from gripper_force.types import NS_PER_MS, Frame
from gripper_hw.cameras import reader, uvc
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


def started(camera: UvcCamera) -> Any:
    """Starts and closes a camera, and returns its last ``cv2.VideoCapture``."""
    captures: list[Any] = []
    open_capture = camera._open_capture

    def kept(path: str) -> Any:
        captures.append(open_capture(path))
        return captures[-1]

    camera._open_capture = kept
    camera.start()
    camera.close()
    return captures[-1]


def test_controls_are_set_in_driver_units_and_nothing_is_automatic(make_uvc: MakeUvc) -> None:
    camera = make_uvc(exposure_us=8000, gain=20, lens_position=60, white_balance_k=5200)
    assert started(camera).controls == {
        cv2.CAP_PROP_AUTO_EXPOSURE: 1,
        cv2.CAP_PROP_EXPOSURE: 80,
        cv2.CAP_PROP_GAIN: 20,
        cv2.CAP_PROP_AUTOFOCUS: 0,
        cv2.CAP_PROP_FOCUS: 60,
        cv2.CAP_PROP_AUTO_WB: 0,
        cv2.CAP_PROP_WB_TEMPERATURE: 5200,
    }
    assert camera.settings() == {
        "fourcc": "YUYV",
        "resolution_px": "320x240",
        "exposure_us": 8000,
        "gain": 20,
        "lens_position": 60,
        "white_balance_k": 5200,
    }


def test_null_stops_automatic_focus_and_white_balance_where_they_are(make_uvc: MakeUvc) -> None:
    controls = started(make_uvc()).controls
    assert (controls[cv2.CAP_PROP_AUTOFOCUS], controls[cv2.CAP_PROP_FOCUS]) == (0, 35)
    assert (controls[cv2.CAP_PROP_AUTO_WB], controls[cv2.CAP_PROP_WB_TEMPERATURE]) == (0, 4300)
    assert controls[cv2.CAP_PROP_GAIN] == 8


@pytest.mark.parametrize(
    ("control", "what"),
    [
        (cv2.CAP_PROP_AUTO_EXPOSURE, "to stop automatic camera.exposure_us: 1 was set, 3 is read"),
        (cv2.CAP_PROP_AUTOFOCUS, "to stop automatic camera.lens_position: 0 was set, 1 is read"),
        (cv2.CAP_PROP_AUTO_WB, "to stop automatic camera.white_balance_k: 0 was set, 1 is read"),
        (cv2.CAP_PROP_EXPOSURE, "camera.exposure_us: 4000 was set, 15700 is read"),
        (cv2.CAP_PROP_GAIN, "camera.gain: 30 was set, 8 is read"),
        (cv2.CAP_PROP_FOCUS, "camera.lens_position: 0 was set, 35 is read"),
        (cv2.CAP_PROP_WB_TEMPERATURE, "camera.white_balance_k: 6500 was set, 4300 is read"),
    ],
)
def test_refused_control_is_an_error(make_uvc: MakeUvc, control: int, what: str) -> None:
    camera = make_uvc(frozenset({control}), gain=30, lens_position=0, white_balance_k=6500)
    with pytest.raises(DeviceError, match=rf"refuses {what}; set another value, or null .v4l2-ctl -d \S+ -L"):
        camera.start()
    camera.close()


@pytest.mark.parametrize(
    ("control", "key"),
    [
        (cv2.CAP_PROP_EXPOSURE, "exposure_us"),
        (cv2.CAP_PROP_GAIN, "gain"),
        (cv2.CAP_PROP_FOCUS, "lens_position"),
        (cv2.CAP_PROP_WB_TEMPERATURE, "white_balance_k"),
    ],
)
def test_control_that_the_camera_lacks_is_named(make_uvc: MakeUvc, control: int, key: str) -> None:
    camera = make_uvc(missing=frozenset({control}), **{key: 4000})
    with pytest.raises(DeviceError, match=rf"refuses camera\.{key}: no such control; set .* null"):
        camera.start()
    camera.close()


def test_exposure_between_the_steps_of_the_control_is_refused(make_uvc: MakeUvc) -> None:
    camera = make_uvc(exposure_us=140)
    with pytest.raises(DeviceError, match=r"refuses camera\.exposure_us: 140 was set, 100 is read"):
        camera.start()
    camera.close()


def test_camera_without_controls_works_if_none_is_configured(make_uvc: MakeUvc, take: Take) -> None:
    camera = make_uvc(missing=frozenset(range(64)), exposure_us=None)
    camera.start()
    take(camera, 2)
    camera.close()
    assert camera.settings().keys() == {"fourcc", "resolution_px", "exposure_us"}


def test_exposure_can_be_automatic(make_uvc: MakeUvc) -> None:
    camera = make_uvc(frozenset({cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_EXPOSURE}), exposure_us=None)
    assert started(camera).controls[cv2.CAP_PROP_AUTO_EXPOSURE] == 3
    assert camera.settings()["exposure_us"] == "automatic"


@pytest.mark.parametrize("fixed", [1.0, 2.0])
@pytest.mark.parametrize("has", [{3}, {0}])
def test_exposure_is_automatic_again_after_a_run_with_a_fixed_one(
    make_uvc: MakeUvc, has: set[int], fixed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = make_uvc(controls={cv2.CAP_PROP_AUTO_EXPOSURE: fixed}, exposure_us=None)
    open_capture = camera._open_capture

    def limited(path: str) -> Any:
        capture = open_capture(path)
        accepts = capture.set
        capture.set = lambda control, value: (
            (control != cv2.CAP_PROP_AUTO_EXPOSURE or value in has) and accepts(control, value)
        )
        return capture

    monkeypatch.setattr(camera, "_open_capture", limited)
    assert started(camera).controls[cv2.CAP_PROP_AUTO_EXPOSURE] in has
    assert camera.settings()["exposure_us"] == "automatic"


def test_exposure_that_stays_fixed_is_an_error(make_uvc: MakeUvc) -> None:
    control = cv2.CAP_PROP_AUTO_EXPOSURE
    camera = make_uvc(frozenset({control}), controls={control: 1.0}, exposure_us=None)
    with pytest.raises(DeviceError, match=r"refuses automatic exposure; set camera\.exposure_us"):
        camera.start()
    camera.close()


def test_images_that_cannot_be_decoded_are_skipped(make_uvc: MakeUvc, take: Take) -> None:
    spoilt = {1: "truncated", 2: "empty", 3: "truncated", 8: "truncated", 10: "empty"}
    camera = make_uvc(spoilt=spoilt)
    camera.start()
    take(camera, 8)
    camera.close()
    assert camera.counts() == {"losses": 0}


def test_camera_whose_images_cannot_be_decoded_is_an_error(
    make_uvc: MakeUvc, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "_FIRST_FRAME_TIMEOUT_NS", 100 * NS_PER_MS)
    camera = make_uvc(spoilt=dict.fromkeys(range(1, 9999), "truncated"))
    with pytest.raises(DeviceError, match="gave no frame for 100 ms; check its cable"):
        camera.start()
    camera.close()


def test_gain_without_exposure_is_refused(make_uvc: MakeUvc) -> None:
    with pytest.raises(ConfigError, match=r"camera\.gain is set, but camera\.exposure_us=null"):
        make_uvc(exposure_us=None, gain=20)


WEBCAM = {
    "YUYV": {(320, 240): 30.0, (640, 480): 30.0},
    "MJPG": {(320, 240): 120.0, (640, 480): 60.0, (1280, 720): 60.0},
}


def test_fast_format_is_set_before_size_and_rate(make_uvc: MakeUvc) -> None:
    capture = started(make_uvc(formats=WEBCAM, fourcc="MJPG", resolution_px=(1280, 720), rate_hz=60))
    assert (capture.fourcc, capture.size, capture.fps) == ("MJPG", (1280, 720), 60)


@pytest.mark.parametrize(
    ("keys", "why"),
    [
        ({"fourcc": "GREY"}, "fourcc=GREY and gives 30 frames per second of 320x240 pixels in YUYV"),
        (
            {"fourcc": "MJPG", "resolution_px": (800, 600)},
            r"resolution_px=\(800, 600\) and gives 30 frames per second of 320x240 pixels in MJPG",
        ),
        (
            {"resolution_px": (640, 480), "rate_hz": 60},
            r"rate_hz=60\.0 and gives 30 frames per second of 640x480 pixels in YUYV",
        ),
    ],
)
def test_refused_format_is_an_error(make_uvc: MakeUvc, keys: dict[str, Any], why: str) -> None:
    camera = make_uvc(formats=WEBCAM, **{"rate_hz": 30} | keys)
    with pytest.raises(
        DeviceError, match=rf"refuses camera\.{why}; v4l2-ctl -d \S+ --list-formats-ext .*MJPG"
    ):
        camera.start()
    camera.close()


def test_log_holds_the_settings_in_force(
    make_uvc: MakeUvc, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, quick: list[str]
) -> None:
    monkeypatch.setattr(uvc, "UvcCamera", lambda section, clock: make_uvc(lens_position=60))
    keys = ["clock=realtime", "camera.backend=uvc", "camera.device=0", "vision.checkpoint=none"]
    with open_run(load_config(None, [*quick, *keys]), tmp_path / "run.mcap") as session:
        session.wait_for_reference()
    assert json.loads(LogReader(tmp_path / "run.mcap").attachments["camera.json"]) == {
        "fourcc": "YUYV",
        "resolution_px": "320x240",
        "exposure_us": 4000,
        "gain": 8,
        "lens_position": 60,
        "white_balance_k": 4300,
    }


def test_frame_time_is_middle_of_exposure(make_uvc: MakeUvc, take: Take) -> None:
    camera = make_uvc(exposure_us=400_000)
    camera.start()
    for frame in take(camera, 3):
        assert frame.received_ns - frame.t_ns >= 200 * NS_PER_MS
    camera.close()


def test_timestamps_of_another_clock_are_refused(video: Path) -> None:
    config = CameraConfig(backend="uvc", device=str(video), exposure_us=None, rate_hz=30)
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
    (tmp_path / "video5").mkdir()  # being unplugged: its files are gone
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
