"""The error tree. Every error says what is wrong, where, and what to do.

::

    GripperError
    ├── ConfigError             a key, a value, an object's or a backend's name
    ├── DeviceError             a device is missing, in use, lost or refuses
    │   ├── DeviceNotFoundError
    │   ├── DeviceLostError
    │   ├── DeviceTimeoutError
    │   └── HardwareFaultError  the device itself reports a fault
    ├── SimulationError         a simulated scene can't be built, drawn or trusted
    ├── LogError                a log can't be read or written
    ├── DataError               a recording or a data set is unusable
    ├── CheckpointError         a network's file is of another network, or damaged
    ├── RequestError            a request was refused: a target out of range, or nothing to hold
    └── NonFiniteError          NaN or infinity where a number is needed
"""


class GripperError(Exception):
    """Base of every error this project raises on purpose; the command line turns it into exit code 2."""


class ConfigError(GripperError):
    """A configuration key, value, object or backend is not known or not allowed."""


class DeviceError(GripperError):
    """A device is missing, in use, lost, or refuses a request."""


class DeviceNotFoundError(DeviceError):
    """No such device."""


class DeviceLostError(DeviceError, ConnectionError):
    """The device was there and is gone (unplugged, powered off)."""


class DeviceTimeoutError(DeviceError, TimeoutError):
    """The device did not answer in time, after bounded retries."""


class HardwareFaultError(DeviceError):
    """The device reports a fault of its own (overload, overheating, supply voltage)."""


class SimulationError(GripperError):
    """A simulated scene can't be built, can't be drawn, or broke while running."""


class LogError(GripperError):
    """A log can't be read or written."""


class DataError(GripperError):
    """A recording or data set is missing a part or can't be used."""


class CheckpointError(GripperError):
    """A checkpoint is missing, damaged, or belongs to another network."""


class RequestError(GripperError, ValueError):
    """A request was refused: a target out of range, or nothing to hold."""


class NonFiniteError(GripperError, ValueError):
    """NaN or infinity reached a place that must only see finite numbers."""
