"""A load cell on a Phidget bridge (1046, four inputs), through the vendor's Phidget22.

See https://www.phidgets.com/?tier=3&catid=98&pcid=78&prodid=35 for the bridge.
"""

import math
from importlib import import_module
from typing import Any, Final

from gripper_force.config import LoadCellConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceNotFoundError
from gripper_force.interfaces import Clock
from gripper_hw.load_cells.screening import LiveLoadCell

MIN_RATE_HZ: Final = 1
MAX_RATE_HZ: Final = 122
ATTACH_TIMEOUT_MS: Final = 2000

_TIMED_OUT: Final = 3
"""``ErrorCode.EPHIDGET_TIMEOUT``"""
_OUT_OF_RANGE: Final = 4103
"""``ErrorEventCode.EEPHIDGET_OUTOFRANGE``"""


class PhidgetLoadCell(LiveLoadCell):
    """Samples one input of the bridge in V/V. The vendor's library finds it again after it was unplugged.

    Args:
        config: Its section of the configuration: channel, rate, tare and scale.
        clock: The run's clock.

    Raises:
        ConfigError: The bridge does not sample at this rate.
    """

    def __init__(self, config: LoadCellConfig, clock: Clock) -> None:
        super().__init__(config, clock, unit_n=math.nan, noisy=True)
        if not MIN_RATE_HZ <= config.rate_hz <= MAX_RATE_HZ:
            raise ConfigError(
                f"load_cell.rate_hz is {config.rate_hz:g}, and a Phidget bridge gives {MIN_RATE_HZ} to "
                f"{MAX_RATE_HZ} samples a second; set one of these"
            )
        self._channel: Any = None

    def start(self) -> None:
        """Opens the bridge's input and begins to sample.

        Raises:
            DeviceNotFoundError: There is no bridge.
            DeviceError: Phidget22 or a library that it needs is not installed, or the bridge refuses.
        """
        if self._channel is not None:
            return
        phidget = _load_phidget22()
        channel = phidget.VoltageRatioInput()

        def configure(channel: Any) -> None:
            channel.setBridgeGain(phidget.BridgeGain.BRIDGE_GAIN_128)
            channel.setDataInterval(round(1000 / self._config.rate_hz))
            channel.setVoltageRatioChangeTrigger(0.0)  # else a reading that stays the same gives no sample
            channel.setBridgeEnabled(True)

        try:
            channel.setChannel(self._config.channel)
            channel.setOnVoltageRatioChangeHandler(self._sampled)
            channel.setOnErrorHandler(self._failed)
            channel.setOnDetachHandler(self._detached)
            channel.setOnAttachHandler(configure)  # it forgets its settings while it is away
            channel.openWaitForAttachment(ATTACH_TIMEOUT_MS)
            configure(channel)  # here an error reaches the caller, and in the handler it does not
        except phidget.PhidgetException as error:
            channel.close()
            if error.code == _TIMED_OUT:
                raise DeviceNotFoundError(
                    f"no Phidget bridge answers for input {self._config.channel}; check its cable, and that "
                    "hw/udev's rules are installed"
                ) from error
            raise DeviceError(f"the Phidget bridge refuses: {error.description}; plug it in again") from error
        self._channel = channel

    def close(self) -> None:
        """Stops sampling. May be called twice."""
        if self._channel is not None:
            self._channel.close()
            self._channel = None

    def _sampled(self, _channel: Any, ratio: float) -> None:
        self._add(ratio)

    def _failed(self, _channel: Any, code: int, _text: str) -> None:
        if code == _OUT_OF_RANGE:
            self._add(math.nan, saturated=True)

    def _detached(self, _channel: Any) -> None:
        self.stats.losses += 1


def _load_phidget22() -> Any:
    try:
        phidget: Any = import_module("Phidget22.Devices.VoltageRatioInput")
        phidget.Phidget.getLibraryVersion()  # loads the native library, and a channel's own error is untidy
    except ImportError as error:
        raise DeviceError(
            "load_cell.backend=phidget needs the package Phidget22; pip install 'gripper-force[phidget]'"
        ) from error
    except OSError as error:
        raise DeviceError(
            f"Phidget22 can't load a library of the system ({error}); install that, on Debian libusb-1.0-0"
        ) from error
    return phidget
