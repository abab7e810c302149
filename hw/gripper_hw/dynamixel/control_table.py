"""The control table of X-series servos, and what sets one model apart, as data (``servos/*.yaml``)."""

import math
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple

import yaml

from gripper_force.errors import ConfigError

TICKS_PER_REV: Final = 4096
ZERO_TICK: Final = 2048
VELOCITY_UNIT_RAD_S: Final = 0.229 * 2 * math.pi / 60
WATCHDOG_UNIT_MS: Final = 20
CURRENT_BASED_POSITION_MODE: Final = 5

_TICKS_PER_RAD: Final = TICKS_PER_REV / (2 * math.pi)
_SHARED: Final = "x_series.yaml"


class Register(NamedTuple):
    """One entry of the control table.

    Attributes:
        address: First byte.
        size: Bytes, 1, 2 or 4.
        access: ``r`` or ``rw``.
        signed: Two's complement.
        unit: Unit of one step; empty for a pure number.
        initial: Factory setting; None where a model has its own, or lacks the register.
        range: Least and greatest value that may be written; None where nothing but the size bounds it.
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
        """True where the value survives power-off and can't be written while torque is on."""
        return self.address < 64

    def encode(self, value: int) -> bytes:
        """Bytes of ``value``, little-endian."""
        return value.to_bytes(self.size, "little", signed=self.signed)

    def decode(self, data: bytes | bytearray) -> int:
        """The value of ``size`` little-endian bytes."""
        return int.from_bytes(data, "little", signed=self.signed)


class IndirectWindow(NamedTuple):
    """A row of two-byte addresses, and the row of bytes that stand for them."""

    address: int
    data: int
    length: int


@dataclass(frozen=True)
class ServoModel:
    """One model, as its manual gives it.

    Attributes:
        name: The vendor's name, without the ``-T`` or ``-R`` of its connector.
        number: Model Number, register 0.
        current_unit_a: One step of every current.
        stall_torque_nm: Torque at the horn at stall, at the nominal voltage.
        stall_current_a: Current at stall.
        no_load_rpm: Speed without load.
        nominal_voltage_v: Supply the three values above hold for.
        voltage_range_v: Least and greatest supply.
        operating_modes: Values that Operating Mode accepts.
        min_firmware: The first firmware that answers Fast Sync Read.
        indirect: First firmware to the indirect windows it has, in order of firmware.
        initial: Factory settings that differ from model to model, by register name.
    """

    name: str
    number: int
    current_unit_a: float
    stall_torque_nm: float
    stall_current_a: float
    no_load_rpm: float
    nominal_voltage_v: float
    voltage_range_v: tuple[float, float]
    operating_modes: tuple[int, ...]
    min_firmware: int
    indirect: dict[int, tuple[IndirectWindow, ...]]
    initial: dict[str, int]

    @property
    def nm_per_a(self) -> float:
        """Torque constant at the horn, stall torque by stall current: a prior, to be calibrated."""
        return self.stall_torque_nm / self.stall_current_a

    @property
    def max_current_a(self) -> float:
        """The greatest Current Limit."""
        return self.initial["current_limit"] * self.current_unit_a

    def indirect_windows(self, firmware: int) -> tuple[IndirectWindow, ...]:
        """The indirect addresses that servos of this model have with ``firmware``."""
        return self.indirect[max(first for first in self.indirect if first <= firmware)]


def ticks_from_rad(position_rad: float) -> int:
    """Position in ticks; 0 rad is tick 2048."""
    return round(ZERO_TICK + position_rad * _TICKS_PER_RAD)


def rad_from_ticks(ticks: int) -> float:
    """Position in radians; tick 2048 is 0 rad."""
    return (ticks - ZERO_TICK) / _TICKS_PER_RAD


def model_names() -> tuple[str, ...]:
    """Names `load_model` knows."""
    files = (entry.name for entry in _servos().iterdir())
    return tuple(sorted(name.removesuffix(".yaml") for name in files if name != _SHARED))


@cache
def load_model(name: str) -> ServoModel:
    """Loads a model by its name.

    Raises:
        ConfigError: The model is not known, or controls no current.
    """
    if name in _without_current_control():
        raise ConfigError(_no_current_control(name))
    if name not in model_names():
        raise ConfigError(f"unknown servo model {name!r}; known: {', '.join(model_names())}")
    tree = _load(f"{name}.yaml")
    for row in ("operating_modes", "voltage_range_v"):
        tree[row] = tuple(tree[row])
    tree["indirect"] = {
        first: tuple(IndirectWindow(*window) for window in windows)
        for first, windows in sorted(tree["indirect"].items())
    }
    return ServoModel(name=name, **tree)


def check_model_number(model: ServoModel, number: int, where: str) -> None:
    """Compares a servo's Model Number with the model it should be.

    Raises:
        ConfigError: It is another model. The sentence names it, and says so where it controls no current.
    """
    if number == model.number:
        return
    for name, known in _without_current_control().items():
        if number == known:
            raise ConfigError(f"{where} is an {name}: {_no_current_control(name)}")
    name = next((known for known in model_names() if load_model(known).number == number), "an unknown model")
    raise ConfigError(
        f"{where} is {name} (model number {number}), not the configured {model.name} ({model.number}); "
        "set servo.model to what is fitted"
    )


def _no_current_control(name: str) -> str:
    return (
        f"{name} has no current control (its register 126 is Present Load, not a current), so it can't set a "
        f"force; use one of {', '.join(model_names())}"
    )


@cache
def _without_current_control() -> dict[str, int]:
    return dict(_load(_SHARED)["without_current_control"])


def _servos() -> Any:
    return resources.files("gripper_hw.dynamixel") / "servos"


def _load(name: str) -> dict[str, Any]:
    tree: dict[str, Any] = yaml.safe_load((_servos() / name).read_text(encoding="utf-8"))
    return tree


def _registers() -> dict[str, Register]:
    rows = _load(_SHARED)["registers"].items()
    return {name: Register._make((*row[:6], row[6] and tuple(row[6]))) for name, row in rows}


REGISTERS: Final = _registers()
"""Register name to its entry, in order of address. Indirect addresses differ by model: see `ServoModel`."""
