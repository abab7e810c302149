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
from gripper_hw.cameras.oak import SENSOR_SIZE_PX, OakCamera
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

    def __init__(self, plugged: threading.Event, gray: Gray, colour: bool, exposure_us: int) -> None:
        dai.node.ThreadedHostNode.__init__(self)
        kind = dai.Node.DatatypeHierarchy(dai.DatatypeEnum.ImgFrame, False)
        self.output = self.createOutput(possibleDatatypes=[kind])
        self.plugged, self.exposure_us = plugged, exposure_us
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
                    frame.cam.exposureTimeUs = self.exposure_us
                    self.output.send(frame)
                    seq += 1
                time.sleep(0.01)
        except Exception:
            return  # the pipeline is being stopped, and an exception here would abort the process


class FileCapture:
    """An endless video file in place of a V4L2 camera, with its pace, controls and timestamps."""

    def __init__(self, path: str, plugged: threading.Event, refused: frozenset[int] = frozenset()) -> None:
        self.path, self.plugged, self.refused = path, plugged, refused
        self.capture = cv2.VideoCapture(path if plugged.is_set() else "/none")
        self.controls: dict[int, float] = {
            cv2.CAP_PROP_AUTO_EXPOSURE: 3,
            cv2.CAP_PROP_EXPOSURE: 157,
            cv2.CAP_PROP_GAIN: 8,
        }
        self.timestamp_ms = 0.0

    def isOpened(self) -> bool:  # noqa: N802
        return bool(self.capture.isOpened())

    def set(self, control: int, value: float) -> bool:
        if control in self.controls and control not in self.refused:
            self.controls[control] = value
        return control not in self.refused

    def get(self, control: int) -> float:
        return self.timestamp_ms if control == cv2.CAP_PROP_POS_MSEC else self.controls[control]

    def read(self) -> tuple[bool, Any]:
        time.sleep(0.01)
        self.timestamp_ms = time.monotonic_ns() / 1e6
        if not self.plugged.is_set():
            return False, None
        received, image = self.capture.read()
        if not received:
            self.capture.release()
            self.capture.open(self.path)
            received, image = self.capture.read()
        return received, image

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
        width, height = SENSOR_SIZE_PX
        image = np.zeros((height, width), np.uint8) if gray is None else gray

        def source(config: CameraConfig, stack: ExitStack) -> tuple[Any, Any]:
            pipeline = stack.enter_context(dai.Pipeline(createImplicitDevice=False))
            sensor = pipeline.create(HostSensor, plugged, image, colour, config.exposure_us or 0)
            return pipeline, sensor.output

        section = CameraConfig(backend="oak", **{"timeout_ms": 2000} | config)
        return OakCamera(section, MonotonicClock(), source)

    return make


@pytest.fixture
def make_uvc(plugged: threading.Event, video: Path) -> Callable[..., UvcCamera]:
    """A `UvcCamera` that reads a video file."""

    def make(refused: frozenset[int] = frozenset(), **config: Any) -> UvcCamera:
        section = CameraConfig(backend="uvc", **{"device": str(video)} | config)
        return UvcCamera(section, MonotonicClock(), lambda path: FileCapture(path, plugged, refused))

    return make
