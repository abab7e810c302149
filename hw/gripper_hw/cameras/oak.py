"""Driver for OAK cameras by DepthAI v3. The device crops and downscales: 16 kB per frame cross USB, not 1 MB.

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
from gripper_hw.cameras.reader import BackgroundCamera, RawFrame, ReadFrame, crop_square

SENSOR_SIZE_PX = (1280, 800)
"""Width and height requested from the sensor: all of an OV9282."""

_DEFAULT_ISO = 100
"""Sensitivity where ``camera.gain`` is null: DepthAI sets exposure and sensitivity together."""

_QUEUE_TIMEOUT = timedelta(milliseconds=50)
"""Longest wait for one frame; between two waits the camera can be closed."""

_US = timedelta(microseconds=1)

PipelineSource = Callable[[CameraConfig, ExitStack], tuple[Any, Any]]
"""Makes a ``depthai.Pipeline`` and an output of frames of `SENSOR_SIZE_PX`; the stack closes both."""


def device_pipeline(config: CameraConfig, stack: ExitStack) -> tuple[Any, Any]:
    """Makes a pipeline on the configured device and its sensor's output. Raises `DeviceNotFoundError`."""
    import depthai as dai

    device = dai.Device(_find(config.device, dai.Device.getAllAvailableDevices()))
    stack.callback(device.close)
    device.setMaxReconnectionAttempts(0)  # the library would reconnect to any device, with 10 s per attempt
    sensor = choose_sensor(device.getConnectedCameraFeatures())
    pipeline = stack.enter_context(dai.Pipeline(device))
    camera = pipeline.create(dai.node.Camera).build(sensor.socket)
    if config.exposure_us is not None:
        iso = _DEFAULT_ISO if config.gain is None else config.gain
        camera.initialControl.setManualExposure(config.exposure_us, iso)
    mono = dai.CameraSensorType.MONO in sensor.supportedTypes
    frame_type = dai.ImgFrame.Type.GRAY8 if mono else dai.ImgFrame.Type.NV12
    return pipeline, camera.requestOutput(SENSOR_SIZE_PX, frame_type, fps=config.rate_hz)


def choose_sensor(features: Sequence[Any]) -> Any:
    """Returns the mono sensor on the lowest socket, else the colour sensor there.

    Raises:
        DeviceNotFoundError: The device has no sensor.
    """
    import depthai as dai

    if not features:
        raise DeviceNotFoundError("the OAK device has no sensor connected; check its cameras' cables")
    return min(features, key=lambda f: (dai.CameraSensorType.MONO not in f.supportedTypes, f.socket.value))


def build_queue(config: CameraConfig, pipeline: Any, output: Any) -> Any:
    """Completes a pipeline: crops, downscales and converts, and returns the queue of the newest gray frame.

    If the pipeline has no device, this runs on the host.
    """
    import depthai as dai

    left, top, side = crop_square(config, *SENSOR_SIZE_PX)
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
    """The mono sensor of an OAK camera, or its colour sensor converted to gray.

    The library converts the device's frame times to the host's clock.

    Args:
        config: The camera section of the configuration.
        clock: The run's clock.
        source: Makes the pipeline; tests pass a pipeline that runs on the host.
    """

    def __init__(self, config: CameraConfig, clock: Clock, source: PipelineSource = device_pipeline) -> None:
        super().__init__(config, clock)
        self._source = source

    @contextmanager
    def _open(self) -> Iterator[ReadFrame]:
        import depthai as dai

        pipeline_errors: list[Exception] = []

        def run() -> None:
            try:
                pipeline.run()
            except Exception as error:  # `read` raises it
                pipeline_errors.append(error)

        def read() -> RawFrame | None:
            if pipeline_errors:
                raise DeviceLostError(
                    f"the OAK camera's pipeline failed: {pipeline_errors[0]}; check its cable and power"
                )
            try:
                frame = queue.get(_QUEUE_TIMEOUT)
            except dai.MessageQueue.QueueException as error:
                raise DeviceLostError("the OAK camera is gone; check its cable and power") from error
            if frame is None:
                return None
            t_ns = frame.getTimestamp(dai.CameraExposureOffset.MIDDLE) // _US * 1000
            gray: Gray = np.array(frame.getFrame())
            return RawFrame(t_ns, frame.getSequenceNum(), gray)

        try:
            with ExitStack() as stack:
                pipeline, output = self._source(self._config, stack)
                queue = build_queue(self._config, pipeline, output)
                # `pipeline.start` would hold the GIL, and block the control thread, until the device runs.
                runner = threading.Thread(target=run, name="oak", daemon=True)
                runner.start()
                stack.callback(runner.join)
                stack.callback(pipeline.stop)
                while runner.is_alive() and not pipeline.isRunning():
                    runner.join(0.01)  # `pipeline.stop` has no effect before the pipeline runs
                yield read
        except RuntimeError as error:  # DepthAI raises it while opening and closing
            raise DeviceError(f"the OAK camera cannot be used: {error}; check its cable and power") from error


def _find(wanted: str | int | None, available: Sequence[Any]) -> Any:
    """Returns the only device with this id or address (None: any). Raises `DeviceNotFoundError`."""
    matches = [info for info in available if wanted is None or str(wanted) in (info.deviceId, info.name)]
    if len(matches) == 1:
        return matches[0]
    known = ", ".join(f"{info.deviceId} at {info.name}" for info in available) or "none"
    shown = "null" if wanted is None else wanted
    raise DeviceNotFoundError(
        f"{len(matches)} free OAK cameras match camera.device={shown} (free: {known}); check cable, power, "
        "the rules of hw/udev, and that no other program uses it; of several, name one by its id"
    )
