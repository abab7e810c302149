"""Driver for a load cell on a Phidget bridge (1046, four inputs), by the vendor's package Phidget22.

Bridge: https://www.phidgets.com/?tier=3&catid=98&pcid=78&prodid=35
"""

import math
from importlib import import_module
from typing import Any, Final

from gripper_force.config import LoadCellConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceNotFoundError
from gripper_force.interfaces import Clock
from gripper_hw import UDEV_RULES
from gripper_hw.load_cells.screening import LiveLoadCell

MIN_RATE_HZ: Final = 1
MAX_RATE_HZ: Final = 122
"""Limits of the bridge's sample rate."""

ATTACH_TIMEOUT_MS: Final = 2000
"""Longest wait for the bridge when it is opened."""

_TIMED_OUT: Final = 3
"""``ErrorCode.EPHIDGET_TIMEOUT``"""
_OUT_OF_RANGE: Final = frozenset({4103, 4105, 4114, 4115})
"""``ErrorEventCode.EEPHIDGET_OUTOFRANGE``, ``_SATURATION``, ``_OUTOFRANGEHIGH`` and ``_OUTOFRANGELOW``."""

_MAX_RATIO: Final = 0.995 / 128
"""Largest ratio at the gain of 128. A 1046_1 sends a ratio beyond its range after the error, a 1046_0 sends none."""


class PhidgetLoadCell(LiveLoadCell):
    """A load cell on one input of the bridge, in V/V. The vendor's library reconnects to an unplugged bridge.

    Args:
        config: The load cell section of the configuration: channel, rate, tare and scale.
        clock: The run's clock.

    Raises:
        ConfigError: The bridge cannot sample at this rate.
    """

    def __init__(self, config: LoadCellConfig, clock: Clock) -> None:
        super().__init__(config, clock, unit_n=math.nan)
        if not MIN_RATE_HZ <= config.rate_hz <= MAX_RATE_HZ:
            raise ConfigError(
                f"load_cell.rate_hz={config.rate_hz:g} is out of a Phidget bridge's range; "
                f"set it to {MIN_RATE_HZ} to {MAX_RATE_HZ} samples/s"
            )
        self._channel: Any = None
        self._was_reported = False  # an error has reported that the next ratio is beyond the range

    def start(self) -> None:
        """Opens the bridge's input and starts sampling.

        Raises:
            DeviceNotFoundError: No bridge is connected.
            DeviceError: Phidget22 or a system library is not installed, or the bridge refuses a setting.
        """
        if self._channel is not None:
            return
        phidget = _load_phidget22()
        channel = phidget.VoltageRatioInput()

        def configure(channel: Any) -> None:
            channel.setBridgeGain(phidget.BridgeGain.BRIDGE_GAIN_128)
            channel.setDataInterval(round(1000 / self._config.rate_hz))
            channel.setVoltageRatioChangeTrigger(0.0)  # else an unchanged reading gives no sample
            channel.setBridgeEnabled(True)

        try:
            channel.setChannel(self._config.channel)
            channel.setOnVoltageRatioChangeHandler(self._sampled)
            channel.setOnErrorHandler(self._failed)
            channel.setOnDetachHandler(self._detached)
            channel.setOnAttachHandler(configure)  # it loses its settings when unplugged
            channel.openWaitForAttachment(ATTACH_TIMEOUT_MS)
            configure(channel)  # an error in the handler would not reach the caller
        except phidget.PhidgetException as error:
            channel.close()
            if error.code == _TIMED_OUT:
                raise DeviceNotFoundError(
                    f"no Phidget bridge answers for load_cell.channel={self._config.channel}; check its "
                    f"cable, and that the rules {UDEV_RULES} are installed"
                ) from error
            raise DeviceError(
                f"could not configure the Phidget bridge ({error.description}); unplug and reconnect it"
            ) from error
        self._channel = channel

    def close(self) -> None:
        """Stops sampling. May be called twice."""
        if self._channel is not None:
            self._channel.close()
            self._channel = None

    def _sampled(self, _channel: Any, ratio: float) -> None:
        saturated = not abs(ratio) <= _MAX_RATIO
        if not (saturated and self._was_reported):
            self._add(ratio, saturated)
        self._was_reported = False

    def _failed(self, _channel: Any, code: int, _text: str) -> None:
        if code in _OUT_OF_RANGE:
            self._add(math.nan, saturated=True)
            self._was_reported = True

    def _detached(self, _channel: Any) -> None:
        self.stats.losses += 1


def _load_phidget22() -> Any:
    try:
        phidget: Any = import_module("Phidget22.Devices.VoltageRatioInput")
        phidget.Phidget.getLibraryVersion()  # loads the native library: a channel's error for that is unclear
    except ImportError as error:
        raise DeviceError(
            "load_cell.backend=phidget needs the package Phidget22; run pip install 'gripper-force[phidget]'"
        ) from error
    except OSError as error:
        raise DeviceError(
            f"Phidget22 cannot load a system library ({error}); install it, on Debian libusb-1.0-0"
        ) from error
    return phidget
