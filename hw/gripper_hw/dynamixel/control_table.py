"""Control table of X-series servos and data of each model, from ``servos/*.yaml`` or a file of one's own."""

import math
import re
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple, Self

from pydantic import Field, model_validator

from gripper_force.errors import ConfigError
from gripper_force.schema import Positive, Section, Tree, merged, read_tree, validated

TICKS_PER_REV: Final = 4096
ZERO_TICK: Final = 2048  # the middle of the turn is 0 rad
VELOCITY_UNIT_RAD_S: Final = 0.229 * 2 * math.pi / 60  # 0.229 rpm
WATCHDOG_UNIT_MS: Final = 20
FULL_PWM: Final = 885  # 100 % duty
CURRENT_BASED_POSITION_MODE: Final = 5
INPUT_VOLTAGE_ERROR: Final = 0x01
"""The only hardware error that leaves torque on, except on an XL330: see `ServoModel.stopping_errors`."""
CYCLE_WINDOW_BYTES: Final = 20  # of indirect data that a cycle reads and writes

_TICKS_PER_RAD: Final = TICKS_PER_REV / (2 * math.pi)
_FOLDER: Final = Path(__file__).with_name("servos")
_SHARED: Final = "x_series.yaml"


class Register(NamedTuple):
    """One entry of the control table.

    Attributes:
        address: Address of the first byte.
        size: Number of bytes: 1, 2 or 4.
        access: ``r`` or ``rw``.
        signed: True for two's complement.
        unit: Unit of one step; empty for a pure number.
        initial: Factory setting; None if it depends on the model, or a model lacks the register.
        range: Lowest and highest value that may be written; None if only the size limits it.
    """

    address: int
    size: int
    access: str
    signed: bool
    unit: str
    initial: int | None
    range: tuple[int, int] | None

    @property
    def eeprom(self) -> bool:
        """True if the value survives power-off and can't be written while torque is on."""
        return self.address < 64

    def encode(self, value: int) -> bytes:
        """Returns ``value`` as ``size`` bytes, little-endian."""
        return value.to_bytes(self.size, "little", signed=self.signed)

    def decode(self, data: bytes | bytearray) -> int:
        """Returns the value of ``size`` little-endian bytes."""
        return int.from_bytes(data, "little", signed=self.signed)


class IndirectWindow(NamedTuple):
    """Indirect addresses and the indirect data bytes that they map.

    Attributes:
        address: Address of the first indirect address; each has two bytes.
        data: Address of the first indirect data byte.
        length: Number of data bytes.
    """

    address: int
    data: int
    length: int


class ServoModel(Section):
    """Data of one model, from its manual.

    Attributes:
        name: The vendor's name, without the connector's ``-T`` or ``-R``, or the stem of one's own file.
        number: Model Number, register 0.
        current_unit_a: Unit of all current registers.
        stall_torque_nm: Stall torque at the horn, at the nominal voltage.
        stall_current_a: Stall current, at the nominal voltage.
        no_load_rpm: Speed without load, at the nominal voltage.
        nominal_voltage_v: Supply voltage of the three values above.
        voltage_range_v: Lowest and highest supply voltage.
        operating_modes: Values that Operating Mode accepts.
        fast_sync_read_firmware: First firmware that supports Fast Sync Read.
        indirect: First firmware to the indirect windows from that version on, in order of firmware.
        initial: Factory settings that depend on the model, by register name; null for a register it lacks.
    """

    name: str
    number: int = Field(ge=0, le=0xFFFF)
    current_unit_a: Positive
    stall_torque_nm: Positive
    stall_current_a: Positive
    no_load_rpm: Positive
    nominal_voltage_v: Positive
    voltage_range_v: tuple[Positive, Positive]
    operating_modes: tuple[int, ...]
    fast_sync_read_firmware: int = Field(ge=0)
    indirect: dict[int, tuple[IndirectWindow, ...]]
    initial: dict[str, int | None]

    @model_validator(mode="after")
    def _is_usable(self) -> Self:
        low_v, high_v = self.voltage_range_v
        if not low_v < high_v:
            raise ValueError("voltage_range_v must be the lowest and the highest supply voltage")
        if CURRENT_BASED_POSITION_MODE not in self.operating_modes:
            raise ValueError(
                "operating_modes lacks 5, the current-based position mode, so it can't hold a force"
            )
        if 0 not in self.indirect or not all(self.indirect.values()):
            raise ValueError("indirect needs at least one window, and an entry for firmware 0")
        if any(windows[0].length < CYCLE_WINDOW_BYTES for windows in self.indirect.values()):
            raise ValueError(
                f"the first indirect window must have {CYCLE_WINDOW_BYTES} bytes, which a cycle needs"
            )
        for name, value in self.initial.items():
            if name not in REGISTERS:
                raise ValueError(f"initial names an unknown register {name!r}")
            if value is not None and not 0 <= value < 1 << 8 * REGISTERS[name].size:
                raise ValueError(f"initial.{name} = {value} does not fit the register")
        for name in ("current_limit", "position_p_gain"):
            if not self.initial.get(name):
                raise ValueError(f"initial.{name} is missing or 0")
        return self

    @property
    def nm_per_a(self) -> float:
        """Torque constant at the horn, stall torque over stall current: a prior, to be calibrated."""
        return self.stall_torque_nm / self.stall_current_a

    @property
    def no_load_rad_s(self) -> float:
        """Speed without load at the nominal voltage."""
        return self.no_load_rpm * 2 * math.pi / 60

    @property
    def position_loop_per_rad(self) -> float:
        """Duty per radian between goal and present position, with the factory's position gain."""
        return self.setting("position_p_gain") / 128 / FULL_PWM * _TICKS_PER_RAD

    @property
    def stopping_errors(self) -> int:
        """Bits of Hardware Error Status that may turn torque off, with the factory's Shutdown.

        See https://emanual.robotis.com/docs/en/dxl/x/xl330-m288/#shutdown. An error of the motor's encoder is not in
        Shutdown, but counts: without its encoder a motor cannot be controlled.
        """
        return ~INPUT_VOLTAGE_ERROR & 0xFF | self.setting("shutdown")

    @property
    def max_current_a(self) -> float:
        """Highest Current Limit."""
        return self.setting("current_limit") * self.current_unit_a

    def setting(self, name: str) -> int:
        """Returns the factory setting of a register, 0 if the model lacks it."""
        return self.initial.get(name, REGISTERS[name].initial) or 0

    def indirect_windows(self, firmware: int) -> tuple[IndirectWindow, ...]:
        """Returns the indirect windows of this model with ``firmware``."""
        return self.indirect[max(first for first in self.indirect if first <= firmware)]


def ticks_from_rad(position_rad: float) -> int:
    """Converts radians to ticks; 0 rad is tick 2048."""
    return round(ZERO_TICK + position_rad * _TICKS_PER_RAD)


def rad_from_ticks(ticks: int) -> float:
    """Converts ticks to radians; tick 2048 is 0 rad."""
    return (ticks - ZERO_TICK) / _TICKS_PER_RAD


def model_names() -> tuple[str, ...]:
    """Names of the models that `load_model` accepts, sorted."""
    files = (entry.name for entry in _FOLDER.iterdir())
    return tuple(sorted(name.removesuffix(".yaml") for name in files if name != _SHARED))


def model_name(number: int) -> str | None:
    """Returns the vendor's name of the model with a Model Number, with or without current control."""
    names = {load_model(name).number: name for name in model_names()}
    names |= {without: name for name, without in _shared()["without_current_control"].items()}
    return names.get(number)


def load_model(name: str) -> ServoModel:
    """Loads a model.

    Args:
        name: The vendor's name, with or without the connector's ``-T`` or ``-R``, or the path of a YAML file
            with the keys of `ServoModel` (without ``name``). With ``like: MODEL`` it states only what differs
            from that model.

    Raises:
        ConfigError: The model is unknown or has no current control, or the file is wrong.
    """
    if Path(name).suffix in (".yaml", ".yml"):
        return _model(Path(name).stem, read_tree(Path(name), "servo model"), name)
    return _shipped_model(re.sub("-[TR]$", "", name))


@cache
def _shipped_model(name: str) -> ServoModel:
    if name in _shared()["without_current_control"]:
        raise ConfigError(_no_current_control(name))
    if name not in model_names():
        raise ConfigError(
            f"unknown servo.model {name!r}; use one of {', '.join(model_names())}, or the path of a YAML file"
        )
    return _model(name, read_tree(_FOLDER / f"{name}.yaml"), name)


def _model(name: str, tree: Tree, where: str) -> ServoModel:
    if "like" in tree:
        base = _shipped_model(re.sub("-[TR]$", "", str(tree.pop("like"))))
        tree = merged(base.model_dump(), tree)
    return validated(ServoModel, tree | {"name": name}, where, "servo model")


def check_model_number(model: ServoModel, number: int, label: str) -> None:
    """Compares a servo's Model Number with the configured model.

    Args:
        model: The configured model.
        number: The servo's Model Number.
        label: Name of the servo for the error message.

    Raises:
        ConfigError: The servo is another model. The message names it and says if it has no current control.
    """
    if number == model.number:
        return
    name = model_name(number) or "an unknown model"
    if name in _shared()["without_current_control"]:
        raise ConfigError(f"{label} is an {name}: {_no_current_control(name)}")
    raise ConfigError(
        f"{label} is {name} (model number {number}), not the configured {model.name} ({model.number}); "
        "set servo.model to the model that is connected"
    )


def _no_current_control(name: str) -> str:
    return (
        f"{name} has no current control (its register 126 is Present Load, not a current), so it can't "
        f"control force; use one of {', '.join(model_names())}"
    )


@cache
def _shared() -> Tree:
    """Returns the registers' rows by name, and numbers by name of models without current control."""
    return read_tree(_FOLDER / _SHARED)


REGISTERS: Final = {
    name: Register._make((*row[:6], row[6] and tuple(row[6]))) for name, row in _shared()["registers"].items()
}
"""Registers by name, in order of address. Indirect addresses depend on the model: see `ServoModel`."""
