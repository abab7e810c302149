"""Firmware of one virtual X-series servo: control table, access rules, safety and motor control.

Source: https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/ and https://emanual.robotis.com/docs/en/dxl/protocol2/.
Not implemented: profiles, the secondary id, reverse drive, feed-forward gains, PWM Slope and Startup
Configuration, which are stored without effect, and the backup of the control table.
"""

import math
from enum import IntEnum
from typing import Final, Literal

from gripper_hw.dynamixel.control_table import (
    CURRENT_BASED_POSITION_MODE,
    FULL_PWM,
    INPUT_VOLTAGE_ERROR,
    REGISTERS,
    TICKS_PER_REV,
    VELOCITY_UNIT_RAD_S,
    WATCHDOG_UNIT_MS,
    ZERO_TICK,
    IndirectWindow,
    Register,
    ServoModel,
)
from gripper_hw.dynamixel.packets import Error

CURRENT_MODE: Final = 0
VELOCITY_MODE: Final = 1
POSITION_MODE: Final = 3
EXTENDED_POSITION_MODE: Final = 4
PWM_MODE: Final = 16

OVERHEATING_ERROR: Final = 0x04
OVERLOAD_ERROR: Final = 0x20

CURRENT_LOOP_S: Final = 0.002  # time constant
REBOOT_NS: Final = 200_000_000  # no replies for this time

_RAD_S_TO_TICKS: Final = TICKS_PER_REV / (2 * math.pi)
_LAST_ADDRESS: Final = REGISTERS["present_temperature"].address


class _Address(IntEnum):
    OPERATING_MODE = REGISTERS["operating_mode"].address
    TORQUE_ENABLE = REGISTERS["torque_enable"].address
    GOAL_POSITION = REGISTERS["goal_position"].address


_LIMIT_REGISTERS: Final = {
    REGISTERS["goal_pwm"].address: "pwm_limit",
    REGISTERS["goal_current"].address: "current_limit",
    REGISTERS["goal_velocity"].address: "velocity_limit",
}
_GOALS: Final = frozenset(_LIMIT_REGISTERS) | {_Address.GOAL_POSITION}


class VirtualServo:
    """One servo's firmware. A plant calls `control`.

    The methods are not thread-safe: a plant in a thread other than the bus's must hold `VirtualBus.lock`.

    Attributes:
        id: Id on the bus.
        model: Model of the servo.
        tripped: True after a Bus Watchdog trip, until 0 is written to the watchdog: the goals are read-only.
        silent_until_ns: End of a reboot; before this time the servo ignores all packets.
        on_watchdog: What a Bus Watchdog trip does in the position modes, which the vendor does not document: the
            motor goes ``limp``, holds the present position (``brake``), follows its last goals on (``continue``),
            or runs away by the Homing Offset; see docs/decisions/0021-what-a-watchdog-trip-does.md.
        reverses_voltage: True if the current loop may reverse the voltage that the operating mode wants. If not, it
            can only lower it to zero, and a motor that is turned against it draws more than its goal current. The
            vendor does not document it.
        excess_current_ratio: Fault: motor current beyond the commanded one, as a fraction of it.
    """

    def __init__(self, id: int, model: ServoModel, firmware: int = 52) -> None:
        self.model = model
        self._registers = _registers_of(model, model.indirect_windows(firmware))
        self._register_at = {
            address: register for register in self._registers for address in _addresses(register)
        }
        self._pointer_at = _pointers(model.indirect_windows(firmware))
        self._memory = bytearray(max(self._register_at) + 1)
        self._stall_a = model.stall_current_a
        self._no_load_rad_s = model.no_load_rad_s
        self._position_rad = 0.0
        self._velocity_rad_s = 0.0
        self._current_a = 0.0
        self._present_current_a = 0.0
        self._pwm = 0.0
        self._integral = 0.0
        self._turn_ticks = 0
        self._temperature_c = 30.0
        self._voltage_v = model.nominal_voltage_v
        self._t_ns: int | None = None  # of the last control step
        self._last_packet_ns = 0
        self._pending_write: tuple[int, bytes] | None = None
        self.silent_until_ns = 0
        self.reverses_voltage = True
        self.excess_current_ratio = 0.0
        self.on_watchdog: Literal["limp", "brake", "continue", "run away"] = "limp"
        self.tripped = False
        self._homing_ticks = 0
        self._reset(eeprom=True)
        self._store("firmware_version", firmware)
        self._store("id", id)
        self._reset(eeprom=False)

    # Calls from the plant.

    def control(
        self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float = 0.0
    ) -> float:
        """Runs one step of the firmware.

        In the position modes the position PID sets a voltage, so back-EMF damps the motion; mode 5 limits the
        resulting current to Goal Current.

        Args:
            t_ns: Time of the step.
            position_rad: Angle of the horn at the encoder; 0 rad is tick 2048.
            velocity_rad_s: Angular velocity of the horn.
            current_noise_a: Measurement error of the current in this step.

        Returns:
            Motor current in A.
        """
        dt_s = 0.0 if self._t_ns is None else max(0, t_ns - self._t_ns) * 1e-9
        self._t_ns = t_ns
        self._position_rad = position_rad
        self._velocity_rad_s = velocity_rad_s
        self.check_watchdog(t_ns)
        if self.tripped and self.on_watchdog == "run away":
            self._goal_position = self._ticks() - self._homing_ticks
        if self._torque_on and not (self.tripped and self.on_watchdog == "limp"):
            target_a = self._target_current_a(dt_s)
            self._current_a += (target_a - self._current_a) * -math.expm1(-dt_s / CURRENT_LOOP_S)
            motor_a = self._current_a * (1 + self.excess_current_ratio)
        else:
            motor_a = self._current_a = 0.0
            self._pwm = 0.0
            self._integral = 0.0
        self._present_current_a = motor_a + current_noise_a
        return motor_a

    def set_conditions(self, *, temperature_c: float | None = None, voltage_v: float | None = None) -> None:
        """Sets temperature and supply voltage, and raises the hardware error if one is outside its limits."""
        if temperature_c is not None:
            self._temperature_c = temperature_c
            if temperature_c > self.get("temperature_limit"):
                self.raise_hardware_error(OVERHEATING_ERROR)
        if voltage_v is not None:
            self._voltage_v = voltage_v
            if not self.get("min_voltage_limit") <= voltage_v * 10 <= self.get("max_voltage_limit"):
                self.raise_hardware_error(INPUT_VOLTAGE_ERROR)

    def raise_hardware_error(self, bits: int) -> None:
        """Sets bits of Hardware Error Status; turns torque off if Shutdown contains one of them."""
        self.set("hardware_error_status", self.get("hardware_error_status") | bits)
        if bits & self.get("shutdown"):
            self.set("torque_enable", 0)

    # Calls from the bus.

    @property
    def alert(self) -> bool:
        """True while Hardware Error Status is not 0."""
        return self._memory[REGISTERS["hardware_error_status"].address] != 0

    def check_watchdog(self, t_ns: int) -> None:
        """Trips the Bus Watchdog if no instruction packet arrived within its time."""
        if (
            self._watchdog_ns > 0
            and self._torque_on
            and not self.tripped
            and t_ns - self._last_packet_ns > self._watchdog_ns
        ):
            self.set("bus_watchdog", -1)

    def feed_watchdog(self, t_ns: int) -> None:
        """Records an instruction packet to any servo."""
        self._last_packet_ns = t_ns

    def answers_group_read(self, *, fast: bool) -> bool:
        """Returns True if the servo answers a sync or bulk read; older firmware ignores the fast ones."""
        is_known = not fast or self.get("firmware_version") >= self.model.fast_sync_read_firmware
        return is_known and self.get("status_return_level") > 0

    def read(self, address: int, size: int) -> tuple[Error, bytes]:
        """Reads bytes from a defined address on; gaps between registers read 0."""
        if size == 0 or address + size > len(self._memory) or address not in self._register_at:
            return Error.ACCESS, b""
        self._refresh()
        return Error.NONE, bytes(self._memory[self._resolve(address + offset)] for offset in range(size))

    def write(self, address: int, data: bytes) -> Error:
        """Writes whole registers; if one is refused, none is written."""
        error = self.check_write(address, data)
        if error is Error.NONE:
            mode = self._mode
            for target, byte in self._resolve_all(address, data).items():
                self._memory[target] = byte
            if self.get("operating_mode") != mode:
                self._store("goal_current", self.get("current_limit"))
            self._apply()
        return error

    def check_write(self, address: int, data: bytes) -> Error:
        """Returns the error that `write` would return."""
        if not data or address + len(data) > len(self._memory):
            return Error.ACCESS
        values = self._resolve_all(address, data)
        for target in values:
            register = self._register_at.get(target)
            if register is None or register.access != "rw" or (register.eeprom and self._torque_on):
                return Error.ACCESS
            addresses = _addresses(register)
            if any(part not in values for part in addresses):
                return Error.DATA_LENGTH
            if target == register.address:
                error = self._check_value(
                    register, register.decode(bytes(values[part] for part in addresses))
                )
                if error is not Error.NONE:
                    return error
        return Error.NONE

    def register_write(self, address: int, data: bytes) -> Error:
        """Stores a write for `action`."""
        error = self.check_write(address, data)
        if error is Error.NONE:
            self._pending_write = address, data
            self.set("registered_instruction", 1)
        return error

    def action(self) -> Error:
        """Executes the stored write."""
        if self._pending_write is None:
            return Error.INSTRUCTION
        pending, self._pending_write = self._pending_write, None
        self.set("registered_instruction", 0)
        return self.write(*pending)

    def reboot(self, t_ns: int) -> None:
        """Restarts: no replies for `REBOOT_NS`, RAM at its initial values, multi-turn count reset."""
        self._reset(eeprom=False)
        self.clear_turns()
        self.silent_until_ns = t_ns + REBOOT_NS

    def factory_reset(self, option: int, t_ns: int) -> Error:
        """Resets all (0xFF), all but the id (1), or all but id and baud rate (2), then reboots."""
        kept = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate")}.get(option)
        if kept is None:
            return Error.DATA_RANGE
        values = {name: self.get(name) for name in (*kept, "firmware_version")}
        self._reset(eeprom=True)
        for name, value in values.items():
            self._store(name, value)
        self.reboot(t_ns)
        return Error.NONE

    def clear_turns(self) -> None:
        """Resets the multi-turn count: Present Position is within one turn again."""
        ticks = self._ticks() - self._homing_ticks
        self._turn_ticks -= ticks // TICKS_PER_REV * TICKS_PER_REV

    def get(self, name: str) -> int:
        """Returns a register's value, without access rules."""
        register = REGISTERS[name]
        return register.decode(self._memory[register.address : register.address + register.size])

    def set(self, name: str, value: int) -> None:
        """Sets a register, without access rules."""
        self._store(name, value)
        self._apply()

    def _store(self, name: str, value: int) -> None:
        register = REGISTERS[name]
        self._memory[register.address : register.address + register.size] = register.encode(value)

    def _reset(self, *, eeprom: bool) -> None:
        """Sets the EEPROM or the RAM area to its initial values."""
        for register in self._registers:
            if register.eeprom is eeprom and register.initial is not None:
                self._memory[register.address : register.address + register.size] = register.encode(
                    register.initial
                )
        if not eeprom:
            self._store("goal_pwm", self.get("pwm_limit"))
            self._store("goal_current", self.get("current_limit"))
            self._pending_write = None
        self._apply()

    def _resolve(self, address: int) -> int:
        """Returns the address of a byte; for indirect data, the one in its indirect address."""
        pointer = self._pointer_at.get(address)
        return address if pointer is None else self._memory[pointer] | self._memory[pointer + 1] << 8

    def _resolve_all(self, address: int, data: bytes) -> dict[int, int]:
        return {self._resolve(address + offset): byte for offset, byte in enumerate(data)}

    def _target_current_a(self, dt_s: float) -> float:
        mode = self._mode
        back_emf = self._velocity_rad_s / self._no_load_rad_s
        limit_a = self._current_limit_a
        if mode == CURRENT_MODE:
            self._pwm = back_emf + self._goal_current_a / self._stall_a
            limit_a = min(limit_a, abs(self._goal_current_a))
        elif mode == VELOCITY_MODE:
            error = self._goal_velocity - self._velocity_rad_s / VELOCITY_UNIT_RAD_S
            self._pwm = (
                self._goal_velocity * VELOCITY_UNIT_RAD_S / self._no_load_rad_s + self._velocity_p * error
            )
        elif mode == PWM_MODE:
            self._pwm = self._goal_pwm
        else:
            self._pwm = self._position_pid(dt_s)
            if mode == CURRENT_BASED_POSITION_MODE:
                limit_a = min(limit_a, abs(self._goal_current_a))
        bound = self._pwm_limit if mode == PWM_MODE else min(self._pwm_limit, abs(self._goal_pwm))
        self._pwm = max(-bound, min(bound, self._pwm))
        target_a = max(-limit_a, min(limit_a, self._stall_a * (self._pwm - back_emf)))
        if self.reverses_voltage:
            return target_a
        at_no_voltage_a = -self._stall_a * back_emf
        return max(target_a, at_no_voltage_a) if self._pwm >= 0 else min(target_a, at_no_voltage_a)

    def _position_pid(self, dt_s: float) -> float:
        error = self._goal_position - self._ticks()
        pwm = self._position_p * error - self._position_d * self._velocity_rad_s * _RAD_S_TO_TICKS
        if self._position_i:
            bound = self._pwm_limit
            self._integral = max(-bound, min(bound, self._integral + self._position_i * error * dt_s))
            pwm += self._integral
        return pwm

    def _ticks(self) -> int:
        sensed = round(ZERO_TICK + self._position_rad * _RAD_S_TO_TICKS)
        return sensed + self._homing_ticks + self._turn_ticks

    def _check_value(self, register: Register, value: int) -> Error:
        if register.address in _GOALS and self.tripped:
            return Error.DATA_RANGE
        if register.range is not None and not register.range[0] <= value <= register.range[1]:
            return Error.DATA_RANGE
        limit = _LIMIT_REGISTERS.get(register.address)
        if limit is not None and abs(value) > self.get(limit):
            return Error.DATA_LIMIT
        match register.address:
            case _Address.OPERATING_MODE if value not in self.model.operating_modes:
                return Error.DATA_RANGE
            case _Address.GOAL_POSITION if self._mode == POSITION_MODE:
                allowed = range(self.get("min_position_limit"), self.get("max_position_limit") + 1)
                return Error.NONE if value in allowed else Error.DATA_LIMIT
            case _Address.TORQUE_ENABLE if value and self.get("hardware_error_status") & self.get("shutdown"):
                return Error.RESULT_FAIL
        return Error.NONE

    def _apply(self) -> None:
        """Caches the register values that `control` uses. Called after every change."""
        self.id = self.get("id")
        self._mode = self.get("operating_mode")
        self._torque_on = self.get("torque_enable") == 1
        watchdog = self.get("bus_watchdog")
        self._watchdog_ns = max(0, watchdog) * WATCHDOG_UNIT_MS * 1_000_000
        if watchdog < 0 and not self.tripped and self.on_watchdog == "brake":
            self._store("goal_position", self._ticks())
        self.tripped = watchdog < 0
        self._homing_ticks = self.get("homing_offset")
        self._current_limit_a = self.get("current_limit") * self.model.current_unit_a
        self._goal_current_a = self.get("goal_current") * self.model.current_unit_a
        self._goal_velocity = self.get("goal_velocity")
        self._goal_position = self.get("goal_position")
        self._goal_pwm = self.get("goal_pwm") / FULL_PWM
        self._pwm_limit = self.get("pwm_limit") / FULL_PWM
        self._velocity_p = self.get("velocity_p_gain") / 128 / FULL_PWM
        self._position_p = self.get("position_p_gain") / 128 / FULL_PWM
        self._position_i = self.get("position_i_gain") / 65536 * 1000 / FULL_PWM
        self._position_d = self.get("position_d_gain") / 16 / 1000 / FULL_PWM

    def _refresh(self) -> None:
        """Writes the last measurements into the present registers, quantised."""
        velocity = round(self._velocity_rad_s / VELOCITY_UNIT_RAD_S)
        for name, value in (
            ("present_position", self._ticks()),
            ("present_velocity", velocity),
            ("present_current", round(self._present_current_a / self.model.current_unit_a)),
            ("present_pwm", round(self._pwm * FULL_PWM)),
            ("present_input_voltage", round(self._voltage_v * 10)),
            ("present_temperature", max(0, round(self._temperature_c))),
            ("realtime_tick", (self._t_ns or 0) // 1_000_000 % 32768),
            ("moving", int(abs(velocity) > self.get("moving_threshold"))),
        ):
            self._store(name, value)


def _addresses(register: Register) -> range:
    return range(register.address, register.address + register.size)


def _pointers(windows: tuple[IndirectWindow, ...]) -> dict[int, int]:
    """Maps the address of each indirect data byte to the address of its indirect address."""
    return {
        window.data + index: window.address + 2 * index
        for window in windows
        for index in range(window.length)
    }


def _registers_of(model: ServoModel, windows: tuple[IndirectWindow, ...]) -> tuple[Register, ...]:
    """Returns the model's registers with its initial values, its indirect addresses and its indirect data."""
    pointers = _pointers(windows)
    overrides = {"model_number": model.number, **model.initial}
    registers = [
        register._replace(initial=initial)
        for name, register in REGISTERS.items()
        if (initial := overrides.get(name, register.initial)) is not None
    ]
    max_address = max([*pointers, _LAST_ADDRESS])
    for data, pointer in pointers.items():
        registers.append(Register(pointer, 2, "rw", False, "", data, (64, max_address)))
        registers.append(Register(data, 1, "rw", False, "", 0, None))
    return tuple(
        register._replace(range=(0, model.setting("current_limit")))
        if register.address == REGISTERS["current_limit"].address
        else register
        for register in registers
    )
