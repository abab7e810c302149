"""Exceptions. Every message states the problem, the key or device, and the remedy.

::

    GripperError
    ├── ConfigError             a configuration key, value, object or backend is unknown or not allowed
    ├── DeviceError             a device is missing, in use, lost, or refuses a request
    │   ├── DeviceNotFoundError
    │   ├── DeviceLostError
    │   ├── DeviceTimeoutError
    │   └── HardwareFaultError  the device reports a fault
    ├── SimulationError         a simulated scene can't be built or rendered, or failed while running
    ├── LogError                a log can't be read or written
    ├── DataError               a recording, data set or camera frame is incomplete or unusable
    │   └── UnfamiliarFrameError  a frame is unlike all known ones, or the object is gone, or the view is covered
    ├── CheckpointError         a checkpoint is missing, damaged, or of another network
    ├── RequestError            a request was refused: a target out of range, or nothing to hold
    └── NonFiniteError          NaN or infinity where a finite number is required
"""

import math


class GripperError(Exception):
    """Base class of all errors that this project raises; the command line exits with code 2."""


class ConfigError(GripperError):
    """A configuration key, value, object or backend is unknown or not allowed."""


class DeviceError(GripperError):
    """A device is missing, in use, lost, or refuses a request."""


class DeviceNotFoundError(DeviceError):
    """The device does not exist."""


class DeviceLostError(DeviceError, ConnectionError):
    """The device was connected and no longer is (unplugged, powered off)."""


class DeviceTimeoutError(DeviceError, TimeoutError):
    """The device did not answer in time, after bounded retries."""


class HardwareFaultError(DeviceError):
    """The device reports a fault (overload, overheating, supply voltage)."""


class SimulationError(GripperError):
    """A simulated scene can't be built or rendered, or failed while running."""


class LogError(GripperError):
    """A log can't be read or written."""


class DataError(GripperError):
    """A recording, data set or camera frame is incomplete or unusable."""


class UnfamiliarFrameError(DataError):
    """A frame is unlike all known ones, the view is covered or blurred, or the object is gone.

    Attributes:
        force_n: The network's output for this frame: not the contact force, but it rises when a grip gets firmer. NaN
            if the network has not run, because the view is covered or blurred, or the object is gone.
    """

    def __init__(self, message: str, force_n: float = math.nan) -> None:
        super().__init__(message)  # a worker's error is made again from its message, then gets its attributes
        self.force_n = force_n


class CheckpointError(GripperError):
    """A checkpoint is missing, damaged, or belongs to another network."""


class RequestError(GripperError, ValueError):
    """A request was refused: a target out of range, or nothing to hold."""


class NonFiniteError(GripperError, ValueError):
    """NaN or infinity where a finite number is required."""
