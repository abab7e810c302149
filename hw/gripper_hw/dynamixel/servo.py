"""Dynamixel servos in current-based position mode, over the vendor's unmodified SDK.

A cycle is one fast sync read and one sync write for all servos of a bus, both through indirect addresses. An XL330 or
XC330 with new firmware has too few of them for the voltage, which is read on its own every 20 cycles. Servos with old
firmware are read by a plain sync read.
Registers: https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/.
"""

import math
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from typing import Final

from gripper_force.config import ServoConfig
from gripper_force.errors import (
    ConfigError,
    DeviceError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    HardwareFaultError,
    NonFiniteError,
)
from gripper_force.interfaces import BusStats, ServoSpec, SharedPort
from gripper_force.types import ServoCommand, ServoState
from gripper_hw.dynamixel.control_table import (
    CURRENT_BASED_POSITION_MODE,
    REGISTERS,
    VELOCITY_UNIT_RAD_S,
    WATCHDOG_UNIT_MS,
    ZERO_TICK,
    IndirectWindow,
    check_model_number,
    load_model,
    rad_from_ticks,
    ticks_from_rad,
)
from gripper_hw.dynamixel.fingers import FingerPair
from gripper_hw.dynamixel.transport import PortLockedError, Transport

_REGISTERS: Final = (  # with all their bytes: a part of a register does not work as indirect data
    "present_current present_velocity present_position hardware_error_status present_temperature bus_watchdog "
    "present_input_voltage goal_current goal_position"
)
_READ_BLOCK: Final = struct.Struct("<hiiBBb")
_VOLTAGE: Final = struct.Struct("<H")
_WRITE_BLOCK: Final = struct.Struct("<hi")
CYCLE_BYTES: Final = _READ_BLOCK.size + _VOLTAGE.size
"""Bytes that a cycle reads from each servo. Where they do not fit, the voltage has a transaction of its own."""

VOLTAGE_CYCLES: Final = 20
"""Cycles between two readings of the voltage on its own."""

_INDIRECT_ADDRESSES: Final = tuple(
    REGISTERS[name].address + offset for name in _REGISTERS.split() for offset in range(REGISTERS[name].size)
)
_VOLTAGE_UNIT_V: Final = 0.1  # unit of Present Input Voltage

_MAX_TRAVEL_RAD: Final = 255 * 2 * math.pi  # Goal Position accepts 256 turns either way; one turn less
_TORQUE_OFF_TRIES: Final = 5
MIN_FIRMWARE: Final = 38
"""The first firmware with Drive Mode and Bus Watchdog."""
# Names of the bits of Hardware Error Status.
_ERRORS: Final = ("input voltage", "", "overheating", "motor encoder", "electrical shock", "overload")


def read_size(window: IndirectWindow) -> int:
    """Returns how many of `CYCLE_BYTES` fit into the window, with the write block of 6 bytes and up to 7 of padding."""
    return CYCLE_BYTES if window.length > CYCLE_BYTES + _WRITE_BLOCK.size else _READ_BLOCK.size


class DynamixelBus:
    """Servos of one model on one port, read and written together.

    Attributes:
        model: Model of all servos.
        ids: Servo ids, in the order of states and commands.
        firmware: Firmware versions in the order of ``ids``; empty before `start`.
    """

    def __init__(
        self,
        config: ServoConfig,
        ids: Sequence[int],
        clock_ns: Callable[[], int] = time.monotonic_ns,
        port: SharedPort | None = None,
    ) -> None:
        """Checks the configuration; `start` opens the port, unless a shared one is given.

        Raises:
            ConfigError: The model is unknown, has no current control, or allows less than
                ``servo.current_limit_a``.
        """
        self.model = load_model(config.model)
        if config.current_limit_a > self.model.max_current_a:
            raise ConfigError(
                f"servo.current_limit_a is {config.current_limit_a:g}, but {self.model.name} allows at most "
                f"{self.model.max_current_a:g}; lower it"
            )
        self.ids = tuple(ids)
        self.firmware: tuple[int, ...] = ()
        self._config, self._is_shared = config, port is not None
        self._transport = Transport(config, clock_ns, port)
        self._current_limit = math.floor(config.current_limit_a / self.model.current_unit_a)
        self._watchdog_setting = math.ceil(config.bus_watchdog_ms / WATCHDOG_UNIT_MS)
        self._expected_watchdog = 0
        self._data_address = 0  # indirect data: the block that is read, followed by the block that is written
        self._read_size = CYCLE_BYTES
        self._voltages: Sequence[bytes] = ()  # those that are read on their own

    @property
    def stats(self) -> BusStats:
        """Counters since construction."""
        return self._transport.stats

    @property
    def settings(self) -> dict[str, int]:
        """Register values that `start` sets before it turns torque on, by register name."""
        return {
            "return_delay_time": 0,
            "drive_mode": 0,
            "current_limit": self._current_limit,
            "operating_mode": CURRENT_BASED_POSITION_MODE,
            "status_return_level": 2,
            "profile_acceleration": 0,
            "profile_velocity": 0,
            # Gains left by another program could make the position loop oscillate within the current limit.
            "position_p_gain": self.model.setting("position_p_gain"),
            "position_i_gain": 0,
            "position_d_gain": 0,
            "feedforward_1st_gain": 0,
            "feedforward_2nd_gain": 0,
        }

    def start(
        self, check: Callable[[tuple[ServoState, ...]], None] = lambda states: None
    ) -> tuple[ServoState, ...]:
        """Opens the port, configures the servos, and turns torque on at the present position with no current.

        On an error, torque off is tried on every servo of the right model that was reached.

        Args:
            check: Called with the states before and after torque is turned on; raises if it must be off.

        Raises:
            DeviceNotFoundError: The port does not exist, or a servo does not answer.
            ConfigError: A servo is another model, or the SDK does not support the baud rate.
            HardwareFaultError: A servo reports a hardware error.
            DeviceError: The port is in use, a firmware is too old, or a register does not keep its value.
        """
        self._transport.open()
        self._expected_watchdog = 0
        with ExitStack() as undo:
            undo.callback(self.close)
            firmware = []
            for id_ in self.ids:
                self._check_model(id_)
                undo.callback(self._try_torque_off, id_)
                firmware.append(self._read_firmware(id_))
            self.firmware = tuple(firmware)
            window = self._common_window()
            self._read_size = read_size(window)
            for id_ in self.ids:
                self._configure(id_, window)
            self._data_address = window.data
            self._voltages = ()
            states = self.read()
            check(states)
            for id_, state in zip(self.ids, states, strict=True):
                self._enable_torque(id_, state)
            self._expected_watchdog = self._watchdog_setting
            states = self.read()
            check(states)
            undo.pop_all()
        return states

    def read(self) -> tuple[ServoState, ...]:
        """Reads every servo in one transaction, and every 20 cycles in another one the voltage, if it does not fit.

        Raises:
            HardwareFaultError: A servo's watchdog tripped, or it restarted and lost its settings. A hardware
                error does not raise: it is a field of the state.
            DeviceTimeoutError: No valid reply after every retry.
            DeviceLostError: The port is gone.
        """
        fast = min(self.firmware, default=0) >= self.model.fast_sync_read_firmware
        read = partial(self._transport.sync_read, self.ids, fast=fast)
        has_voltage_apart = self._read_size < CYCLE_BYTES
        if has_voltage_apart and (not self._voltages or self.stats.cycles % VOLTAGE_CYCLES == 0):
            self._voltages = read(_INDIRECT_ADDRESSES[_READ_BLOCK.size], _VOLTAGE.size)[1]
        t_ns, blocks = read(self._data_address, self._read_size)
        self.stats.cycles += 1
        voltages = self._voltages if has_voltage_apart else [block[_READ_BLOCK.size :] for block in blocks]
        return tuple(
            self._decode_state(t_ns, id_, block, voltage)
            for id_, block, voltage in zip(self.ids, blocks, voltages, strict=True)
        )

    def write(self, commands: Sequence[ServoCommand]) -> None:
        """Writes the goals of every servo in one transaction; the current is clamped to the configured limit.

        Raises:
            NonFiniteError: A goal is NaN or infinite. Nothing was sent.
            DeviceTimeoutError: The port did not accept the packet after every retry.
            DeviceLostError: The port is gone.
        """
        blocks = [self._encode_goals(command) for command in commands]
        self._transport.sync_write(
            self._data_address + self._read_size, dict(zip(self.ids, blocks, strict=True))
        )

    def stop(self, *, hold: bool) -> None:
        """Turns torque off and verifies it; with ``hold`` disarms the watchdogs and keeps the goals instead.

        Every servo is tried, even if another one fails.

        Raises:
            DeviceError: A servo could not be stopped. With ``hold``, also if it had already stopped by itself
                or its watchdog could not be disarmed; torque off is then tried.
        """
        action = self._hold if hold else self._torque_off
        failure: DeviceError | None = None
        for id_ in self.ids:
            try:
                action(id_)
            except DeviceError as error:
                failure = failure or error
        if failure is not None:
            raise failure
        self._expected_watchdog = 0

    def close(self) -> None:
        """Releases the port. Does not change the torque. May be called twice."""
        self._transport.close()

    # Start.

    def _label(self, id_: int) -> str:
        return f"the servo with id {id_} on {self._config.port}"

    def _check_model(self, id_: int) -> None:
        """Raises if another model answers. Nothing is written to it: its registers may differ."""
        label = self._label(id_)
        try:
            number = self._transport.ping(id_)
        except PortLockedError:
            raise
        except DeviceTimeoutError as error:
            key = "servo.second.id" if id_ == self._config.second.id else "servo.id"
            rate, rate_key = f"{self._config.baud_rate} baud", "servo.baud_rate"
            if self._is_shared:
                rate, rate_key = (
                    "the shared port's baud rate",
                    "the rate that your program sets by setBaudRate()",
                )
            raise DeviceNotFoundError(
                f"{label} does not answer at {rate}; check its power, {key} and {rate_key}"
            ) from error
        if number != self.model.number:  # a late reply can be mistaken for a ping's, not for a read's
            number = self._transport.get(id_, "model_number")
        check_model_number(self.model, number, label)

    def _read_firmware(self, id_: int) -> int:
        self._transport.enable_replies(id_)
        firmware = self._transport.get(id_, "firmware_version")
        if firmware < MIN_FIRMWARE:
            raise DeviceError(
                f"{self._label(id_)} has firmware {firmware}, which lacks the Bus Watchdog; update it to "
                f"{MIN_FIRMWARE} or newer with DYNAMIXEL Wizard"
            )
        return firmware

    def _common_window(self) -> IndirectWindow:
        """Returns the indirect window that all servos share: a transaction has one address for all."""
        windows = {self.model.indirect_windows(firmware)[0] for firmware in self.firmware}
        if len(windows) > 1:
            raise DeviceError(
                f"the servos on {self._config.port} have firmware versions {self.firmware}, whose indirect "
                "addresses differ; update all to the same version"
            )
        return windows.pop()

    def _configure(self, id_: int, window: IndirectWindow) -> None:
        # In this order: clearing a watchdog that tripped in an earlier run would restart the motor.
        self._transport.set(id_, "torque_enable", 0, tries=_TORQUE_OFF_TRIES)
        self._transport.set(id_, "bus_watchdog", 0)
        hardware_error = self._transport.get(id_, "hardware_error_status")
        if hardware_error:
            raise HardwareFaultError(
                f"servo {id_} reports {hardware_error_text(hardware_error)}; remove the cause, then "
                "power-cycle or reboot it"
            )
        homing_offset = self._transport.get(id_, "homing_offset")
        if homing_offset != self._config.homing_offset:
            raise DeviceError(
                f"servo {id_} has Homing Offset {homing_offset}, but servo.homing_offset is "
                f"{self._config.homing_offset}: every configured angle would be off by the difference; set "
                "servo.homing_offset if gripper.open_position_rad was found with it, or the register back"
            )
        for name, value in self.settings.items():
            if not REGISTERS[name].eeprom or self._transport.get(id_, name) != value:  # limits EEPROM wear
                self._transport.set(id_, name, value)
        pwm_limit = self._transport.get(id_, "pwm_limit")
        if pwm_limit == 0:
            raise DeviceError(f"servo {id_} has PWM Limit 0 and can't move; set the register to 885 (100 %)")
        self._transport.set(id_, "goal_pwm", pwm_limit)  # another program may have left 0
        addresses = _INDIRECT_ADDRESSES[: self._read_size] + _INDIRECT_ADDRESSES[CYCLE_BYTES:]
        pointers = struct.pack(f"<{len(addresses)}H", *addresses)
        self._transport.write(id_, window.address, pointers)
        if self._transport.read(id_, window.address, len(pointers)) != pointers:
            raise DeviceError(
                f"servo {id_} did not keep its indirect addresses; power-cycle it and start again"
            )

    def _enable_torque(self, id_: int, state: ServoState) -> None:
        self._transport.set(id_, "goal_current", 0)
        self._transport.set(id_, "goal_position", ticks_from_rad(state.position_rad))
        self._transport.set(id_, "bus_watchdog", self._watchdog_setting)
        self._transport.set(id_, "torque_enable", 1)

    def _try_torque_off(self, id_: int) -> None:
        with suppress(DeviceError):  # the earlier error is the one to report
            self._torque_off(id_)

    # Stop.

    def _torque_off(self, id_: int) -> None:
        self._transport.set(id_, "torque_enable", 0, tries=_TORQUE_OFF_TRIES)
        self._transport.set(id_, "bus_watchdog", 0)

    def _hold(self, id_: int) -> None:
        try:
            # Disarming a tripped watchdog would restart the motor.
            if self._transport.get(id_, "bus_watchdog") < 0 or not self._transport.get(id_, "torque_enable"):
                raise HardwareFaultError(
                    f"servo {id_} can't hold: it had stopped by itself, and its torque was turned off; "
                    "find the cause, then start again"
                )
            self._transport.set(id_, "bus_watchdog", 0)
        except DeviceError:
            self._try_torque_off(id_)  # it is unknown whether it holds
            raise

    # Cycle.

    def _decode_state(self, t_ns: int, id_: int, block: bytes, voltage: bytes) -> ServoState:
        current, velocity, ticks, hardware_error, temperature, watchdog = _READ_BLOCK.unpack_from(block)
        if watchdog != self._expected_watchdog:
            reason = "its bus watchdog tripped" if watchdog < 0 else "it restarted and lost its settings"
            raise HardwareFaultError(
                f"servo {id_} stopped by itself: {reason}; stop the run, find the cause, and start again"
            )
        return ServoState(
            t_ns=t_ns,
            position_rad=rad_from_ticks(ticks),
            velocity_rad_s=velocity * VELOCITY_UNIT_RAD_S,
            current_a=current * self.model.current_unit_a,
            temperature_c=float(temperature),
            voltage_v=_VOLTAGE.unpack(voltage)[0] * _VOLTAGE_UNIT_V,
            hardware_error=hardware_error,
        )

    def _encode_goals(self, command: ServoCommand) -> bytes:
        if not (math.isfinite(command.goal_position_rad) and math.isfinite(command.goal_current_a)):
            raise NonFiniteError(
                f"the servo's goals must be finite, got position {command.goal_position_rad} rad and "
                f"current {command.goal_current_a} A; nothing was sent"
            )
        current = max(0.0, min(self._current_limit, command.goal_current_a / self.model.current_unit_a))
        position_rad = max(-_MAX_TRAVEL_RAD, min(_MAX_TRAVEL_RAD, command.goal_position_rad))
        return _WRITE_BLOCK.pack(round(current), ticks_from_rad(position_rad))


class DynamixelServo:
    """The gripper's servo, or its two, one per finger, as one (see `gripper_force.interfaces.Servo`)."""

    def __init__(
        self,
        config: ServoConfig,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        port: SharedPort | None = None,
    ) -> None:
        """Creates the bus; see `DynamixelBus`."""
        self._bus = DynamixelBus(config, config.ids, clock_ns, port)
        self.model = self._bus.model
        self._pair = FingerPair(config, self.model) if len(config.ids) > 1 else None

    @staticmethod
    def spec(config: ServoConfig) -> ServoSpec:
        """Returns the data of the configured model, without opening the port.

        The torque of two servos is that of both together, by their mean angle and mean current.

        Raises:
            ConfigError: The model is unknown, or has no current control.
        """
        model = load_model(config.model)
        offset_rad = rad_from_ticks(ZERO_TICK + config.homing_offset)
        range_rad = (offset_rad - math.pi, offset_rad + math.pi)
        if len(config.ids) > 1:
            range_rad = FingerPair(config, model).range_rad(*range_rad)
        return ServoSpec(
            nm_per_a=len(config.ids) * model.nm_per_a,
            current_step_a=model.current_unit_a,
            voltage_range_v=model.voltage_range_v,
            position_loop_a_per_rad=model.position_loop_per_rad * model.stall_current_a,
            position_loop_gain_per_s=model.position_loop_per_rad * model.no_load_rad_s,
            position_range_rad=range_rad,
        )

    @property
    def stats(self) -> BusStats:
        """Counters of retries and losses."""
        return self._bus.stats

    def start(self) -> ServoState:
        """Turns torque on; raises the errors of `DynamixelBus.start`, and of `FingerPair.start`."""
        if self._pair is None:
            return self._bus.start()[0]
        return self._pair.combine(self._bus.start(self._pair.start))

    def read(self) -> ServoState:
        """Reads the state; see `DynamixelBus.read`, whose errors it raises, and those of `FingerPair.combine`."""
        states = self._bus.read()
        return states[0] if self._pair is None else self._pair.combine(states)

    def write(self, command: ServoCommand) -> None:
        """Writes the goals in one transaction; raises the errors of `DynamixelBus.write`."""
        self._bus.write((command,) if self._pair is None else self._pair.split(command))

    def stop(self, *, hold: bool) -> None:
        """Turns torque off, or holds; raises the errors of `DynamixelBus.stop`."""
        try:
            self._bus.stop(hold=hold)
        except DeviceError:
            if hold and self._pair is not None:  # one finger alone would push the object away
                with suppress(DeviceError):
                    self._bus.stop(hold=False)
            raise

    def close(self) -> None:
        """Releases the port. Does not change the torque. May be called twice."""
        self._bus.close()


def hardware_error_text(bits: int) -> str:
    """Names of the bits set in Hardware Error Status."""
    names = (name for bit, name in enumerate(_ERRORS) if bits >> bit & 1 and name)
    return " and ".join(names) or f"error {bits:#x}"
