"""Camera drivers without devices: the source of the images is replaced and can be unplugged."""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import depthai as dai
import numpy as np
import pytest

from gripper_force.config import CameraConfig
from gripper_force.interfaces import Camera
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.types import Frame, Gray
from gripper_hw.cameras.oak import OakCamera, SensorOutput
from gripper_hw.cameras.uvc import UvcCamera

TIMEOUT_S = 30.0

Take = Callable[..., list[Frame]]


@pytest.fixture
def take() -> Take:
    """Waits for the next frames of a camera; ``wait`` lets time pass."""

    def take(camera: Camera, count: int, wait: Callable[[], None] = lambda: time.sleep(0.002)) -> list[Frame]:
        frames: list[Frame] = []
        deadline = time.monotonic() + TIMEOUT_S
        while len(frames) < count:
            assert time.monotonic() < deadline, f"{len(frames)} of {count} frames received"
            if (frame := camera.newest()) is None:
                wait()
            else:
                frames.append(frame)
        return frames

    return take


class HostSensor(dai.node.ThreadedHostNode):
    """Gives 100 images per second while plugged in."""

    def __init__(self, plugged: threading.Event, gray: Gray, colour: bool, config: CameraConfig) -> None:
        dai.node.ThreadedHostNode.__init__(self)
        kind = dai.Node.DatatypeHierarchy(dai.DatatypeEnum.ImgFrame, False)
        self.output = self.createOutput(possibleDatatypes=[kind])
        self.plugged, self.config = plugged, config
        self.image = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR) if colour else gray
        self.kind = dai.ImgFrame.Type.NV12 if colour else dai.ImgFrame.Type.GRAY8

    def run(self) -> None:
        seq = 0
        try:
            while self.isRunning():
                if self.plugged.is_set():
                    frame = dai.ImgFrame()
                    frame.setCvFrame(self.image, self.kind)
                    frame.setSequenceNum(seq)
                    frame.setTimestamp(timedelta(seconds=time.monotonic()))
                    frame.cam.exposureTimeUs = self.config.exposure_us or 0
                    frame.cam.sensitivityIso = self.config.gain or 0
                    frame.cam.lensPosition = self.config.lens_position or 0
                    frame.cam.wbColorTemp = self.config.white_balance_k or 0
                    self.output.send(frame)
                    seq += 1
                time.sleep(0.01)
        except Exception:
            return  # the pipeline is being stopped, and an exception here would abort the process


Formats = dict[str, dict[tuple[int, int], float]]
"""Highest frame rate by pixel format and size."""

AUTOMATIC = {
    cv2.CAP_PROP_EXPOSURE: (cv2.CAP_PROP_AUTO_EXPOSURE, 1),
    cv2.CAP_PROP_FOCUS: (cv2.CAP_PROP_AUTOFOCUS, 0),
    cv2.CAP_PROP_WB_TEMPERATURE: (cv2.CAP_PROP_AUTO_WB, 0),
}
"""Control that makes another one automatic, and its value for manual."""


class FileCapture:
    """An endless video file in place of a V4L2 camera, with its pace, formats, controls and timestamps.

    As in OpenCV and uvcvideo, a format that the camera does not have is replaced without an error, a change of
    format keeps a rate that the former one allowed, and a value is ignored while its function is automatic. As in
    some drivers, what was set before the stream is lost.
    """

    def __init__(
        self,
        path: str,
        plugged: threading.Event,
        refused: frozenset[int] = frozenset(),
        missing: frozenset[int] = frozenset(),
        formats: Formats | None = None,
        controls: dict[int, float] | None = None,
        spoilt: dict[int, str] | None = None,
    ) -> None:
        self.path, self.plugged, self.refused = path, plugged, refused
        self.capture = cv2.VideoCapture(path if plugged.is_set() else "/none")
        initial = {
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
            cv2.CAP_PROP_EXPOSURE: 157.0,
            cv2.CAP_PROP_GAIN: 8.0,
            cv2.CAP_PROP_AUTOFOCUS: 1.0,
            cv2.CAP_PROP_FOCUS: 35.0,
            cv2.CAP_PROP_AUTO_WB: 1.0,
            cv2.CAP_PROP_WB_TEMPERATURE: 4300.0,
        } | (controls or {})
        self.initial = {control: value for control, value in initial.items() if control not in missing}
        self.controls = dict(self.initial)
        self.formats = formats or {"YUYV": {(320, 240): 1000.0}}
        self.fourcc = next(iter(self.formats))
        self.size = next(iter(self.formats[self.fourcc]))
        self.width = 0
        self.fps = 30.0
        self.timestamp_ms = 0.0
        self.streams = False
        self.spoilt, self.grabbed = spoilt or {}, 0

    def isOpened(self) -> bool:  # noqa: N802
        return bool(self.capture.isOpened())

    def set(self, control: int, value: float) -> bool:
        if control == cv2.CAP_PROP_FOURCC:
            fourcc = int(value).to_bytes(4, "little").decode()
            self.fourcc = fourcc if fourcc in self.formats else self.fourcc
        elif control == cv2.CAP_PROP_FRAME_WIDTH:
            self.width = int(value)
        elif control == cv2.CAP_PROP_FRAME_HEIGHT:
            self.size = (self.width, int(value))
        elif control == cv2.CAP_PROP_FPS:
            self.fps = value
        elif control in self.controls and control not in self.refused:
            automatic, manual = AUTOMATIC.get(control, (control, value))
            if self.controls.get(automatic, manual) == manual or automatic == control:
                self.controls[control] = value
            return True
        else:
            return False
        sizes = self.formats[self.fourcc]
        if self.size not in sizes:
            self.size = next(iter(sizes))
        self.fps = min(self.fps, sizes[self.size])
        return True

    def get(self, control: int) -> float:
        formats = {
            cv2.CAP_PROP_POS_MSEC: self.timestamp_ms,
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*self.fourcc)),
            cv2.CAP_PROP_FPS: self.fps,
            cv2.CAP_PROP_FRAME_WIDTH: self.size[0],
            cv2.CAP_PROP_FRAME_HEIGHT: self.size[1],
        }
        return formats.get(control, self.controls.get(control, -1.0))

    def grab(self) -> bool:
        time.sleep(0.01)
        if not self.streams:
            self.streams, self.controls = True, dict(self.initial)
        self.timestamp_ms = time.monotonic_ns() / 1e6
        self.grabbed += 1
        return self.plugged.is_set()

    def retrieve(self) -> tuple[bool, Any]:
        match self.spoilt.get(self.grabbed):
            case "truncated":
                return False, None
            case "empty":
                raise cv2.error("(-215:Assertion failed) !buf.empty() in function 'imdecode_'")
        received, image = self.capture.read()
        if not received:
            self.capture.release()
            self.capture.open(self.path)
            received, image = self.capture.read()
        return received, cv2.resize(image, self.size)

    def release(self) -> None:
        self.capture.release()


@pytest.fixture(scope="session")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Thirty frames of 320x240 pixels with rising brightness."""
    path = tmp_path_factory.mktemp("video") / "camera.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (320, 240))
    assert writer.isOpened()
    for i in range(30):
        writer.write(np.full((240, 320, 3), 8 * i, np.uint8))
    writer.release()
    return path


@pytest.fixture
def plugged() -> threading.Event:
    """Set while the camera is plugged in."""
    event = threading.Event()
    event.set()
    return event


@pytest.fixture
def make_oak(plugged: threading.Event) -> Callable[..., OakCamera]:
    """An `OakCamera` whose pipeline runs on the host."""

    def make(gray: Gray | None = None, colour: bool = False, **config: Any) -> OakCamera:
        image = np.zeros((800, 1280), np.uint8) if gray is None else gray  # all of an OV9282
        height, width = image.shape

        def source(config: CameraConfig, stack: ExitStack) -> SensorOutput:
            pipeline = stack.enter_context(dai.Pipeline(createImplicitDevice=False))
            node = pipeline.create(HostSensor, plugged, image, colour, config)
            return pipeline, node.output, (width, height), "OV9282 at CAM_B"

        section = CameraConfig(backend="oak", **{"timeout_ms": 2000} | config)
        return OakCamera(section, MonotonicClock(), source)

    return make


@pytest.fixture
def make_uvc(plugged: threading.Event, video: Path) -> Callable[..., UvcCamera]:
    """A `UvcCamera` that reads a video file."""

    def make(
        refused: frozenset[int] = frozenset(),
        missing: frozenset[int] = frozenset(),
        formats: Formats | None = None,
        controls: dict[int, float] | None = None,
        spoilt: dict[int, str] | None = None,
        **config: Any,
    ) -> UvcCamera:
        section = CameraConfig(backend="uvc", **{"device": str(video)} | config)

        def open_capture(path: str) -> FileCapture:
            return FileCapture(path, plugged, refused, missing, formats, controls, spoilt)

        return UvcCamera(section, MonotonicClock(), open_capture)

    return make
