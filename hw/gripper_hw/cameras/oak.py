"""An OAK camera by DepthAI v3. The device crops and shrinks: 16 kB instead of 1 MB a frame cross USB.

Manual: https://docs.luxonis.com/software-v3/depthai/
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from typing import Any

import numpy as np

from gripper_force.config import CameraConfig
from gripper_force.errors import DeviceError, DeviceLostError, DeviceNotFoundError
from gripper_force.interfaces import Clock
from gripper_force.types import Gray
from gripper_hw.cameras.reader import BackgroundCamera, Read, Shot, square

PICTURE = (1280, 800)
"""Width and height in pixels of what the sensor is asked for: all of an OV9282."""

_DEFAULT_ISO = 100
_WAIT = timedelta(milliseconds=50)
_US = timedelta(microseconds=1)

FrameSource = Callable[[CameraConfig, ExitStack], tuple[Any, Any]]
"""Makes a ``depthai.Pipeline`` with an output that gives pictures of size `PICTURE`; the stack closes it."""


def device_source(config: CameraConfig, stack: ExitStack) -> tuple[Any, Any]:
    """A pipeline on the device, with its sensor's output. Raises `DeviceNotFoundError`."""
    import depthai as dai

    device = dai.Device(_find(config.device, dai.Device.getAllAvailableDevices()))
    stack.callback(device.close)
    device.setMaxReconnectionAttempts(0)  # the library's own way back takes any device, and 10 s a try
    sensor = choose_sensor(device.getConnectedCameraFeatures())
    pipeline = stack.enter_context(dai.Pipeline(device))
    camera = pipeline.create(dai.node.Camera).build(sensor.socket)
    if config.exposure_us is not None:
        iso = _DEFAULT_ISO if config.gain is None else config.gain
        camera.initialControl.setManualExposure(config.exposure_us, iso)
    mono = dai.CameraSensorType.MONO in sensor.supportedTypes
    kind = dai.ImgFrame.Type.GRAY8 if mono else dai.ImgFrame.Type.NV12
    return pipeline, camera.requestOutput(PICTURE, kind, fps=config.rate_hz)


def choose_sensor(features: Sequence[Any]) -> Any:
    """The mono sensor on the lowest socket, else the colour sensor there. Raises `DeviceNotFoundError`."""
    import depthai as dai

    if not features:
        raise DeviceNotFoundError("the OAK device has no sensor connected; check its cameras' cables")
    return min(features, key=lambda f: (dai.CameraSensorType.MONO not in f.supportedTypes, f.socket.value))


def build_queue(config: CameraConfig, pipeline: Any, output: Any) -> Any:
    """Completes the pipeline from the source's output to the queue that holds the newest gray frame.

    Where the pipeline has no device, the host does the device's work.
    """
    import depthai as dai

    left, top, side = square(config, *PICTURE)
    manip = pipeline.create(dai.node.ImageManip)
    manip.setRunOnHost(pipeline.getDefaultDevice() is None)
    manip.initialConfig.addCrop(left, top, side, side)
    manip.initialConfig.setOutputSize(config.side_px, config.side_px)
    manip.initialConfig.setFrameType(dai.ImgFrame.Type.GRAY8)
    manip.inputImage.setMaxSize(1)
    manip.inputImage.setBlocking(False)
    output.link(manip.inputImage)
    return manip.out.createOutputQueue(maxSize=1, blocking=False)


class OakCamera(BackgroundCamera):
    """The mono sensor of an OAK camera, or its colour sensor in gray.

    Frame times are the device's, synchronised to the host's clock by the library.

    Args:
        config: Its section of the configuration.
        clock: The run's clock.
        source: What gives the pictures; a test puts a host's node here.
    """

    def __init__(self, config: CameraConfig, clock: Clock, source: FrameSource = device_source) -> None:
        super().__init__(config, clock)
        self._source = source

    @contextmanager
    def _opened(self) -> Iterator[Read]:
        import depthai as dai

        broken: list[Exception] = []

        def run() -> None:
            try:
                pipeline.run()
            except Exception as error:  # `read` tells
                broken.append(error)

        def read() -> Shot | None:
            if broken:
                raise DeviceLostError(f"the OAK camera's pipeline broke: {broken[0]}")
            try:
                frame = queue.get(_WAIT)
            except dai.MessageQueue.QueueException as error:
                raise DeviceLostError("the OAK camera is gone; check its cable and power") from error
            if frame is None:
                return None
            t_ns = frame.getTimestamp(dai.CameraExposureOffset.MIDDLE) // _US * 1000
            gray: Gray = np.array(frame.getFrame())
            return Shot(t_ns, frame.getSequenceNum(), gray)

        try:
            with ExitStack() as stack:
                pipeline, output = self._source(self._config, stack)
                queue = build_queue(self._config, pipeline, output)
                # `pipeline.start` would hold Python's lock, and so the control thread, until the device runs.
                runner = threading.Thread(target=run, name="oak", daemon=True)
                runner.start()
                stack.callback(runner.join)
                stack.callback(pipeline.stop)
                while runner.is_alive() and not pipeline.isRunning():
                    runner.join(0.01)  # to stop what does not run yet would do nothing
                yield read
        except RuntimeError as error:  # the library's, on the way in or out
            raise DeviceError(f"the OAK camera can't be used: {error}") from error


def _find(wanted: str | int | None, available: Sequence[Any]) -> Any:
    fits = [info for info in available if wanted is None or str(wanted) in (info.deviceId, info.name)]
    if len(fits) == 1:
        return fits[0]
    known = ", ".join(f"{info.deviceId} at {info.name}" for info in available) or "none"
    asked = "null" if wanted is None else wanted
    raise DeviceNotFoundError(
        f"{len(fits)} free OAK cameras fit camera.device={asked} (free: {known}); check cable, power and "
        "hw/udev, that no other program has it, and name one of several by its id"
    )
