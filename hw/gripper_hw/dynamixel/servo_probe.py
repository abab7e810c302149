"""Which ports and servos are there, how are they set, and how long is a cycle? Also what sets a servo up."""

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from serial.tools import list_ports

from gripper_force.config import Config, ServoConfig
from gripper_force.errors import DeviceError, DeviceTimeoutError, GripperError
from gripper_force.jobs.doctor import Agree, Check, RegisterChange, judged, only, time_ms
from gripper_force.runtime.backends import open_devices
from gripper_hw.dynamixel.control_table import (
    REGISTERS,
    check_model_number,
    load_model,
    model_names,
)
from gripper_hw.dynamixel.port import VIRTUAL_PREFIX
from gripper_hw.dynamixel.servo import CYCLE_BYTES, DynamixelBus, hardware_error_text
from gripper_hw.dynamixel.transport import Transport

_SYSFS: Final = Path("/sys/bus/usb-serial/devices")
_CYCLES: Final = 200
_PATIENCE_MS: Final = 100.0
"""More than servo.reply_margin_ms: a line that is too slow for a run is to be measured, not to fail."""

_BAUD_RATES: Final = (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
_MODES: Final = {
    0: "current",
    1: "velocity",
    3: "position",
    4: "extended position",
    5: "current-based position",
    16: "PWM",
}
_SHOWN: Final = ("return_delay_time", "current_limit", "operating_mode", "bus_watchdog")


def probe(config: Config, sysfs: Path = _SYSFS) -> Iterator[Check]:
    """Lists serial ports and servos, and looks at the configured servo. Only reads.

    Args:
        config: The run.
        sysfs: Where the kernel lists USB serial adapters.

    Raises:
        GripperError: The port can't be opened, or the servo is another model.
    """
    ports = [f"{port.device}: {port.description}" for port in list_ports.comports()]
    yield from (Check("servo", "listed", port, None) for port in ports or ["no serial port"])
    servo = config.servo
    if config.clock == "lockstep" and not servo.port.startswith(VIRTUAL_PREFIX):
        advice = "a real servo can't keep simulated time: set clock=realtime"
        yield Check("servo", "clock", "lockstep", False, advice)
    with _opened(config) as looked:
        yield Check("servo", "port", servo.port, True)
        timer = sysfs / Path(servo.port).resolve().name / "latency_timer"
        if timer.is_file():
            latency_ms = int(timer.read_text())
            fast, advice = latency_ms < servo.reply_margin_ms, "install hw/udev's rules, which make it 1 ms"
            yield judged("servo", "latency timer", f"{latency_ms} ms", fast, advice)
        found = looked.line.scan()
        for id_, (number, firmware) in sorted(found.items()):
            if id_ != servo.id:
                yield Check(f"servo {id_}", "model", f"{_model(number)}, firmware {firmware}", None)
        if servo.id in found:
            yield from looked.checks(config, *found[servo.id])
            return
    answered = ", ".join(str(id_) for id_ in sorted(found)) or "none"
    what = f"no answer at {servo.baud_rate} baud (ids that answer: {answered})"
    advice = "check power, cable and servo.id"
    if rate := _other_baud_rate(servo):
        advice = f"it answers at {rate} baud: set servo.baud_rate={rate}"
    yield Check(f"servo {servo.id}", "model", what, False, advice)


def setup(config: Config, agree: Agree) -> dict[str, Any]:
    """Sets the configured servo up as a run would, so that EEPROM is written now and not then.

    Raises:
        GripperError: See `gripper_force.jobs.doctor.setup`.
    """
    with _opened(config) as looked:
        return looked.set_up(config.servo.id, agree)


class _Looked:
    """The configured servo, looked at without a start: it stays as it is."""

    def __init__(self, config: ServoConfig) -> None:
        bus = DynamixelBus(config, (config.id,))  # never opened: it knows what a run sets
        self.model = bus.model
        self.line = Transport(config)
        self._config = config
        self._wanted = bus.settings | {"bus_watchdog": 0}  # what a start writes once torque is off

    def checks(self, config: Config, number: int, firmware: int) -> Iterator[Check]:
        """Looks at the configured servo."""
        id_ = config.servo.id
        unit = f"servo {id_}"
        check_model_number(self.model, number, f"the servo with id {id_} on {config.servo.port}")
        able = firmware >= self.model.min_firmware
        advice = f"update it to {self.model.min_firmware} or newer with DYNAMIXEL Wizard"
        yield judged(unit, "model", f"{self.model.name}, firmware {firmware}", able, advice)
        try:
            values = self._values(id_)
            error, torque = self.line.get(id_, "hardware_error_status"), self.line.get(id_, "torque_enable")
        except DeviceTimeoutError:
            advice = "its Status Return Level may be 0, which a run sets right; else check the cable"
            yield Check(unit, "registers", "it answers a ping, and no read", False, advice)
            return
        text, advice = hardware_error_text(error), "remove the cause, then power-cycle or reboot it"
        yield judged(unit, "hardware error", text if error else "none", not error, advice)
        advice = "it holds as it was told to, and the next run lets go first"
        yield judged(unit, "torque", "on" if torque else "off", not torque, advice, harmless=True)
        for name, new in self._wanted.items():
            if name in _SHOWN or values[name] != new:
                same, text = values[name] == new, self._text(name, values[name])
                advice = f"a run sets {self._text(name, new)}, and so does doctor --setup"
                yield judged(unit, name.replace("_", " "), text, same, advice, harmless=True)
        if not able:
            return
        start = REGISTERS["present_current"].address  # as many bytes as a cycle's, wherever they lie
        median_ms, p99_ms = time_ms(lambda: self.line.sync_read((id_,), start, CYCLE_BYTES), _CYCLES)
        found = f"median {median_ms:.2f} ms, p99 {p99_ms:.2f} ms of {_CYCLES} reads"
        rate_hz, lockstep = config.control.rate_hz, config.clock == "lockstep"
        advice = f"longer than a cycle at control.rate_hz={rate_hz:g}: close what computes, or lower it"
        yield judged(unit, "bus cycle", found, p99_ms <= 1e3 / rate_hz, advice, harmless=lockstep)

    def set_up(self, id_: int, agree: Agree) -> dict[str, Any]:
        """See `setup`."""
        check_model_number(self.model, self.line.ping(id_), f"the servo with id {id_} on {self._config.port}")
        if self.line.get(id_, "torque_enable"):
            raise DeviceError(
                f"servo {id_} has torque on, so nothing was changed; take the object out, then power-cycle it"
            )
        values = self._values(id_)
        wanted = {name: new for name, new in self._wanted.items() if values[name] != new}
        text = self._text
        changes = [
            RegisterChange(name, text(name, values[name]), text(name, new)) for name, new in wanted.items()
        ]
        applied = bool(changes) and agree(f"servo {id_}", changes)
        if applied:
            self.line.ask_for_answers(id_)
            for name, new in wanted.items():
                self.line.set(id_, name, new)
        return {"servo": id_, "changes": changes, "applied": applied}

    def _values(self, id_: int) -> dict[str, int]:
        return {name: self.line.get(id_, name) for name in self._wanted}

    def _text(self, name: str, value: int) -> str:
        match name:
            case "return_delay_time":
                return f"{2 * value} us"
            case "current_limit":
                return f"{value * self.model.current_unit_a:.3f} A"
            case "operating_mode":
                return f"{value} ({_MODES.get(value, 'unknown')})"
            case "bus_watchdog" if value <= 0:
                return "tripped" if value else "off"
        return str(value)


@contextmanager
def _opened(config: Config) -> Iterator[_Looked]:
    with ExitStack() as stack:
        if config.servo.port.startswith(VIRTUAL_PREFIX):
            stack.enter_context(open_devices(only(config, "servo")))
        looked = _Looked(config.servo)
        stack.callback(looked.line.close)
        _open(looked.line, config.servo)
        yield looked


def _open(line: Transport, servo: ServoConfig) -> None:
    line.open(max(_PATIENCE_MS, servo.reply_margin_ms))


def _other_baud_rate(servo: ServoConfig) -> int | None:
    if servo.port.startswith(VIRTUAL_PREFIX):
        return None
    for rate in _BAUD_RATES:
        if rate == servo.baud_rate:
            continue
        other = servo.model_copy(update={"baud_rate": rate, "retries": 0})
        with suppress(GripperError), closing(Transport(other)) as line:
            _open(line, other)
            line.ping(servo.id)
            return rate
    return None


def _model(number: int) -> str:
    known = {load_model(name).number: name for name in model_names()}
    return known.get(number, f"model number {number}")
