"""Driver for OAK cameras by DepthAI v3. The device crops and downscales: 16 kB per frame cross USB, not 1 MB.

Manual: https://docs.luxonis.com/software-v3/depthai/
"""

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from typing import Any

import depthai as dai
import numpy as np

from gripper_force.config import CameraConfig
from gripper_force.errors import DeviceError, DeviceLostError, DeviceNotFoundError
from gripper_force.interfaces import Clock
from gripper_force.types import Gray
from gripper_hw import UDEV_RULES
from gripper_hw.cameras.reader import BackgroundCamera, RawFrame, ReadFrame, Settings, crop_square

_MAX_DEFAULT_PX = 1280 * 800
"""Largest image that is chosen where ``camera.resolution_px`` is null: all of an OV9282."""

_DEFAULT_ISO = 100
"""Sensitivity where ``camera.gain`` is null: DepthAI sets exposure and sensitivity together."""

_DEFAULT_WHITE_BALANCE_K = 5000
"""Colour temperature where ``camera.white_balance_k`` is null."""

_QUEUE_TIMEOUT = timedelta(milliseconds=50)
"""Longest wait for one frame; between two waits the camera can be closed."""

_US = timedelta(microseconds=1)

SensorOutput = tuple[Any, Any, tuple[int, int], str]
"""A ``depthai.Pipeline``, its output of images, their width and height, and the sensor's name."""

PipelineSource = Callable[[CameraConfig, ExitStack], SensorOutput]
"""Makes a pipeline with a sensor; the stack closes both."""


def device_pipeline(config: CameraConfig, stack: ExitStack) -> SensorOutput:
    """Makes a pipeline with the configured device and sensor.

    Raises:
        DeviceError: There is no such device or sensor, or the sensor cannot do what is configured.
    """
    device = dai.Device(_find(config.device, dai.Device.getAllAvailableDevices()))
    stack.callback(device.close)
    device.setMaxReconnectionAttempts(0)  # the library would reconnect to any device, with 10 s per attempt
    sensor = choose_sensor(device.getConnectedCameraFeatures(), config.sensor)
    size_px = choose_size(sensor, config)
    pipeline = stack.enter_context(dai.Pipeline(device))
    camera = pipeline.create(dai.node.Camera).build(sensor.socket, sensorResolution=size_px)
    set_controls(camera.initialControl, sensor, config)
    frame_type = dai.ImgFrame.Type.GRAY8 if _is_mono(sensor) else dai.ImgFrame.Type.NV12
    output = camera.requestOutput(size_px, frame_type, fps=config.rate_hz)
    return pipeline, output, size_px, _name(sensor)


def choose_sensor(features: Sequence[Any], name: str | None) -> Any:
    """Returns the sensor with this socket or name (None: any). Raises `DeviceNotFoundError`.

    Of several it is the mono sensor on the lowest socket, else the colour sensor there.
    """
    if not features:
        raise DeviceNotFoundError("the OAK device has no sensor connected; check its cameras' cables")
    matches = [f for f in features if name is None or name.upper() in (f.socket.name, f.sensorName)]
    if not matches:
        raise DeviceNotFoundError(
            f"the OAK device has no sensor camera.sensor={name}; set it to a name or a socket of: "
            f"{', '.join(map(_name, features))}"
        )
    return min(matches, key=lambda f: (not _is_mono(f), f.socket.value))


def choose_size(sensor: Any, config: CameraConfig) -> tuple[int, int]:
    """Returns width and height of the configured mode of a sensor, which must reach ``camera.rate_hz``.

    Raises:
        DeviceError: The sensor has no such mode.
    """
    rates_hz = {(m.width, m.height): m.maxFps for m in sensor.configs if not (m.hdr or m.hfr)}
    rates_hz = rates_hz or {(sensor.width, sensor.height): config.rate_hz}
    # A rate of 59.94 is good enough for 60.
    fast = [size_px for size_px, rate_hz in rates_hz.items() if config.rate_hz <= math.ceil(rate_hz)]
    resolution_px = config.resolution_px
    if resolution_px in fast:
        return resolution_px
    if resolution_px or not fast:
        modes = ", ".join(f"{w}x{h} at up to {rate_hz:.0f}" for (w, h), rate_hz in rates_hz.items())
        raise DeviceError(
            f"the sensor {_name(sensor)} has no mode for camera.rate_hz={config.rate_hz:g} with camera.resolution_px="
            f"{list(resolution_px) if resolution_px else 'null'}; set them to one of its modes: {modes}"
        )
    excess_px = {(w, h): w * h - _MAX_DEFAULT_PX for w, h in fast}
    return min(fast, key=lambda size_px: (excess_px[size_px] > 0, abs(excess_px[size_px])))


def set_controls(control: Any, sensor: Any, config: CameraConfig) -> None:
    """Sets a sensor's ``depthai.CameraControl``, so that nothing but a null exposure is automatic.

    Raises:
        DeviceError: The sensor does not have what is configured, or needs what is not.
    """
    name, position, colour_k = f"the sensor {_name(sensor)}", config.lens_position, config.white_balance_k
    if sensor.hasAutofocus:
        if position is None:
            raise DeviceError(
                f"{name} has a lens with autofocus, which is off in a run, and camera.lens_position is null; "
                "set it to 0 (far) to 255 (near)"
            )
        control.setAutoFocusMode(dai.CameraControl.AutoFocusMode.OFF)
        control.setManualFocus(position)
    elif position is not None:
        raise DeviceError(f"{name} has a lens with fixed focus; set camera.lens_position=null")
    if dai.CameraSensorType.COLOR in sensor.supportedTypes:
        # With a lock on top it would have no effect: https://github.com/luxonis/depthai-core/issues/501
        control.setManualWhiteBalance(colour_k or _DEFAULT_WHITE_BALANCE_K)
    elif colour_k is not None:
        raise DeviceError(f"{name} is mono and has no white balance; set camera.white_balance_k=null")
    if config.exposure_us is not None:
        control.setManualExposure(config.exposure_us, _DEFAULT_ISO if config.gain is None else config.gain)


def _is_mono(sensor: Any) -> bool:
    return dai.CameraSensorType.MONO in sensor.supportedTypes


def _name(sensor: Any) -> str:
    return f"{sensor.sensorName} at {sensor.socket.name}"


def build_queue(config: CameraConfig, pipeline: Any, output: Any, size_px: tuple[int, int]) -> Any:
    """Completes a pipeline: crops, downscales and converts, and returns the queue of the newest gray frame.

    If the pipeline has no device, this runs on the host.
    """
    left, top, side = crop_square(config, *size_px)
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
            self._settings = {"sensor": name, "resolution_px": size, **_reported(frame, self._config)}
            return RawFrame(t_ns, frame.getSequenceNum(), gray)

        try:
            with ExitStack() as stack:
                pipeline, output, size_px, name = self._source(self._config, stack)
                queue, size = build_queue(self._config, pipeline, output, size_px), "{}x{}".format(*size_px)
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


def _reported(frame: Any, config: CameraConfig) -> Settings:
    """Returns the settings that the device reports with a frame; 0 means that it has no such setting."""
    exposure_us = "automatic" if config.exposure_us is None else frame.getExposureTime() // _US
    settings = {"exposure_us": exposure_us, "gain": frame.getSensitivity()}
    settings |= {"lens_position": frame.getLensPosition(), "white_balance_k": frame.getColorTemperature()}
    return {key: value for key, value in settings.items() if value}


def _find(device: str | int | None, available: Sequence[Any]) -> Any:
    """Returns the only device with this id or address (None: any). Raises `DeviceNotFoundError`."""
    matches = [info for info in available if device is None or str(device) in (info.deviceId, info.name)]
    if len(matches) == 1:
        return matches[0]
    devices = ", ".join(f"{info.deviceId} at {info.name}" for info in available) or "none"
    device_text = "null" if device is None else device
    raise DeviceNotFoundError(
        f"{len(matches)} free OAK cameras match camera.device={device_text} (free: {devices}); check cable, power, "
        f"that the rules {UDEV_RULES} are installed, and that no other program uses it; of several, name one by its id"
    )
