"""Diagnostics of serial ports and servos: model, registers and cycle time. Also the setup of a servo."""

from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Final

from serial.tools import list_ports

from gripper_force.config import Config, ServoConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceTimeoutError, GripperError
from gripper_force.jobs.checks import Check, Confirm, RegisterChange, SetupResult, judged, keep_only, time_ms
from gripper_force.runtime.backends import SERVOS, load_servo_class, open_devices
from gripper_hw import UDEV_RULES
from gripper_hw.dynamixel.control_table import (
    REGISTERS,
    check_model_number,
    model_name,
    rad_from_ticks,
)
from gripper_hw.dynamixel.fingers import FingerPair
from gripper_hw.dynamixel.servo import (
    CYCLE_BYTES,
    MIN_FIRMWARE,
    VOLTAGE_CYCLES,
    DynamixelBus,
    hardware_error_text,
    read_size,
)
from gripper_hw.dynamixel.servo_scan import BAUD_RATES, FAST_BAUD_RATE
from gripper_hw.dynamixel.transport import Transport

_SYSFS: Final = Path("/sys/bus/usb-serial/devices")
_CYCLES: Final = 200
_MIN_REPLY_MARGIN_MS: Final = 100.0
"""Longer than servo.reply_margin_ms, so that a bus too slow for a run is measured instead of failing."""

_MODES: Final = {
    0: "current",
    1: "velocity",
    3: "position",
    4: "extended position",
    5: "current-based position",
    16: "PWM",
}
_ALWAYS_LISTED: Final = ("return_delay_time", "current_limit", "operating_mode", "bus_watchdog")


def probe(config: Config, sysfs: Path = _SYSFS) -> Iterator[Check]:
    """Lists serial ports and servos, and checks the configured servo. Only reads.

    Args:
        config: Configuration of the run.
        sysfs: Folder in which the kernel lists USB serial adapters.

    Raises:
        GripperError: The port can't be opened, or the servo is another model.
    """
    ports = [f"{port.device}: {port.description}" for port in list_ports.comports()]
    yield from (Check("servo", "listed", port, None) for port in ports or ["no serial port"])
    servo = config.servo
    if servo.backend not in SERVOS:
        load_servo_class(config)
        yield Check("servo", "backend", f"{servo.backend}, which only a run checks", None)
        return
    if config.clock == "lockstep" and not servo.is_virtual:
        advice = "a real servo does not follow simulated time: set clock=realtime"
        yield Check("servo", "clock", "lockstep", False, advice)
    with _opened(config) as inspection:
        yield Check("servo", "port", servo.port, True)
        timer = sysfs / Path(servo.port).resolve().name / "latency_timer"
        if timer.is_file():
            latency_ms = int(timer.read_text())
            fast = latency_ms < servo.reply_margin_ms
            advice = f"copy {UDEV_RULES} to /etc/udev/rules.d: it sets the timer to 1 ms"
            yield judged("servo", "latency timer", f"{latency_ms} ms", fast, advice)
        answers = inspection.transport.scan()
        for id_, (number, firmware) in sorted(answers.items()):
            if id_ not in servo.ids:
                name = model_name(number) or f"model number {number}"
                yield Check(f"servo {id_}", "model", f"{name}, firmware {firmware}", None)
        ready = True
        for id_ in servo.ids:
            if id_ in answers:
                ready &= yield from inspection.checks(id_, *answers[id_])
        missing_ids = [id_ for id_ in servo.ids if id_ not in answers]
        if not missing_ids:
            if ready:
                yield from inspection.common_checks(config, min(answers[id_][1] for id_ in servo.ids))
            return
    answered = ", ".join(str(id_) for id_ in sorted(answers)) or "none"
    found_text = f"no answer at {servo.baud_rate} baud (ids that answer: {answered})"
    for id_ in missing_ids:
        advice = f"check power, cable and {'servo.id' if id_ == servo.id else 'servo.second.id'}"
        if rate := _other_baud_rate(servo, id_):
            advice = f"it answers at {rate} baud: set servo.baud_rate={rate}"
        yield Check(f"servo {id_}", "model", found_text, False, advice)


def setup(config: Config, confirm: Confirm, *, commission: bool = False) -> SetupResult:
    """Writes the registers that a run would write, if ``confirm`` returns True. A run then writes no EEPROM.

    Args:
        config: The configuration.
        confirm: Called with the changes.
        commission: See `gripper_force.jobs.doctor.setup`.

    Raises:
        GripperError: See `gripper_force.jobs.doctor.setup`.
    """
    if config.servo.backend not in SERVOS:
        raise ConfigError(
            f"only Dynamixel servos have these registers, not servo.backend={config.servo.backend}; set it up with its "
            "vendor's program"
        )
    if len(config.servo.ids) > 1:
        raise ConfigError(
            "doctor --setup sets up one servo at a time; pass --set servo.second.id=null, and then "
            f"--set servo.id={config.servo.second.id} as well"
        )
    with _opened(config) as inspection:
        return inspection.set_up(config.servo.id, confirm, commission)


class _Inspection:
    """Reads the configured servo without `DynamixelBus.start`, which would change it."""

    def __init__(self, config: ServoConfig) -> None:
        bus = DynamixelBus(config, (config.id,))  # never opened: only for the settings of a run
        self.model = bus.model
        self.transport = Transport(config)
        self._config = config
        self._pair = FingerPair(config, self.model) if len(config.ids) > 1 else None
        self._expected = bus.settings | {"bus_watchdog": 0}  # a start writes them while torque is off

    def checks(self, id_: int, number: int, firmware: int) -> Generator[Check, None, bool]:
        """Checks a servo of the gripper. Returns True if `common_checks` can follow."""
        unit = f"servo {id_}"
        check_model_number(self.model, number, f"the servo with id {id_} on {self._config.port}")
        supported = firmware >= MIN_FIRMWARE
        advice = f"update it to {MIN_FIRMWARE} or newer with DYNAMIXEL Wizard"
        yield judged(unit, "model", f"{self.model.name}, firmware {firmware}", supported, advice)
        try:
            values = self._values(id_)
            error = self.transport.get(id_, "hardware_error_status")
            torque = self.transport.get(id_, "torque_enable")
        except DeviceTimeoutError:
            advice = "its Status Return Level may be 0, which a run corrects; otherwise check the cable"
            yield Check(unit, "registers", "it answers a ping, but no read", False, advice)
            return False
        text, advice = hardware_error_text(error), "remove the cause, then power-cycle or reboot it"
        yield judged(unit, "hardware error", text if error else "none", not error, advice)
        advice = "it still holds; the next run turns torque off first"
        yield judged(unit, "torque", "on" if torque else "off", not torque, advice, harmless=True)
        offset, expected = self.transport.get(id_, "homing_offset"), self._config.homing_offset
        advice = (
            f"a run refuses it: set servo.homing_offset={offset} if gripper.open_position_rad was found with "
            "it, or set the register back with DYNAMIXEL Wizard"
        )
        yield judged(unit, "homing offset", f"{offset} ticks", offset == expected, advice)
        if offset == expected != 0:
            advice = (
                "some firmware moves the motor after a watchdog trip with a Homing Offset (DynamixelSDK issue 584): "
                "set it to 0 with DYNAMIXEL Wizard, and measure gripper.open_position_rad again"
            )
            yield judged(unit, "watchdog", "may move the jaws", False, advice, harmless=True)
        if "330" in self.model.name:
            advice = (
                "firmware 51 of 330-size servos was seen to keep turning after a trip in current control: update "
                "it, and try it once: stop a grasp with kill -9"
            )
            yield judged(unit, "watchdog", "unproven on this model", False, advice, harmless=True)
        for name, target in self._expected.items():
            if name in _ALWAYS_LISTED or values[name] != target:
                is_same, text = values[name] == target, self._text(name, values[name])
                advice = f"a run sets {self._text(name, target)}; so does doctor --setup"
                yield judged(unit, name.replace("_", " "), text, is_same, advice, harmless=True)
        return supported

    def common_checks(self, config: Config, firmware: int) -> Iterator[Check]:
        """Checks the servos of the gripper together; ``firmware`` is the oldest."""
        ids = config.servo.ids
        unit = f"servo {' and '.join(map(str, ids))}"
        if self._pair is not None:
            positions_rad = [rad_from_ticks(self.transport.get(id_, "present_position")) for id_ in ids]
            difference_rad = abs(self._pair.difference_rad(*positions_rad))
            advice = self._pair.start_problem(*positions_rad).rpartition("; ")[2]
            yield judged(unit, "fingers", f"{difference_rad:.3f} rad apart", not advice, advice)
        start = REGISTERS["present_pwm"].address  # any address, but as many bytes as a cycle reads
        fast = firmware >= self.model.fast_sync_read_firmware
        size, numbers = read_size(self.model.indirect_windows(firmware)[0]), count()

        def cycle() -> None:
            if size < CYCLE_BYTES and next(numbers) % VOLTAGE_CYCLES == 0:
                self.transport.sync_read(ids, start, CYCLE_BYTES - size, fast=fast)
            self.transport.sync_read(ids, start, size, fast=fast)

        median_ms, p99_ms = time_ms(cycle, _CYCLES)
        result = f"median {median_ms:.2f} ms, p99 {p99_ms:.2f} ms of {_CYCLES} reads"
        rate_hz, lockstep = config.control.rate_hz, config.clock == "lockstep"
        advice = f"longer than a cycle at control.rate_hz={rate_hz:g}: close other programs, or lower it"
        yield judged(unit, "bus cycle", result, p99_ms <= 1e3 / rate_hz, advice, harmless=lockstep)

    def set_up(self, id_: int, confirm: Confirm, commission: bool) -> SetupResult:
        """Implements `setup`."""
        number = self.transport.ping(id_)
        check_model_number(self.model, number, f"the servo with id {id_} on {self._config.port}")
        if self.transport.get(id_, "torque_enable"):
            raise DeviceError(
                f"servo {id_} has torque on, so nothing was changed; remove the object, then power-cycle it"
            )
        targets = self._commissioned(id_) if commission else self._expected
        values = {name: self.transport.get(id_, name) for name in targets}
        differing = [name for name, target in targets.items() if values[name] != target]
        changes = {
            name: RegisterChange(name, self._text(name, values[name]), self._text(name, targets[name]))
            for name in differing
        }
        steps = [[name] for name in differing] if commission else [differing]
        accepted = [
            name
            for names in steps
            if names and confirm(f"servo {id_}", [changes[name] for name in names])
            for name in names
        ]
        if accepted:
            self.transport.enable_replies(id_)
        for name in accepted:
            if name == "baud_rate":
                self._change_baud_rate(id_, targets[name])
            else:
                self.transport.set(id_, name, targets[name])
        return SetupResult(id_, list(changes.values()), bool(accepted) and len(accepted) == len(differing))

    def _commissioned(self, id_: int) -> dict[str, int]:
        """Returns the EEPROM registers that a servo needs, the baud rate last."""
        targets = {name: target for name, target in self._expected.items() if REGISTERS[name].eeprom}
        targets["homing_offset"] = self._config.homing_offset
        present = self.transport.get(id_, "baud_rate")
        rate = next((rate for rate, code in BAUD_RATES.items() if code == present), 0)
        # A servo with another baud rate than the others on its bus would be lost to their program.
        if rate < FAST_BAUD_RATE and set(self.transport.scan()) == {id_}:
            targets["baud_rate"] = BAUD_RATES[FAST_BAUD_RATE]
        return targets

    def _change_baud_rate(self, id_: int, code: int) -> None:
        with suppress(DeviceTimeoutError):  # the reply may come at either rate
            register = REGISTERS["baud_rate"]
            self.transport.write(id_, register.address, register.encode(code))
        self.transport.close()
        self._config = self._config.model_copy(update={"baud_rate": FAST_BAUD_RATE})
        self.transport = Transport(self._config)
        _open(self.transport, self._config)
        if self.transport.get(id_, "baud_rate") != code:
            raise DeviceError(f"servo {id_} did not keep its new baud rate; power-cycle it and start again")

    def _values(self, id_: int) -> dict[str, int]:
        return {name: self.transport.get(id_, name) for name in self._expected}

    def _text(self, name: str, value: int) -> str:
        match name:
            case "return_delay_time":
                return f"{2 * value} us"
            case "baud_rate":
                return next(
                    (f"{rate} baud" for rate, code in BAUD_RATES.items() if code == value), str(value)
                )
            case "homing_offset":
                return f"{value} ticks"
            case "current_limit":
                return f"{value * self.model.current_unit_a:.3f} A"
            case "operating_mode":
                return f"{value} ({_MODES.get(value, 'unknown')})"
            case "bus_watchdog" if value <= 0:
                return "tripped" if value else "off"
        return str(value)


@contextmanager
def _opened(config: Config) -> Iterator[_Inspection]:
    with ExitStack() as stack:
        if config.servo.is_virtual:
            stack.enter_context(open_devices(keep_only(config, "servo")))
        inspection = _Inspection(config.servo)
        stack.callback(lambda: inspection.transport.close())
        _open(inspection.transport, config.servo)
        yield inspection


def _open(transport: Transport, servo: ServoConfig) -> None:
    transport.open(max(_MIN_REPLY_MARGIN_MS, servo.reply_margin_ms))


def _other_baud_rate(servo: ServoConfig, id_: int) -> int | None:
    if servo.is_virtual:
        return None
    for rate in BAUD_RATES:
        if rate == servo.baud_rate:
            continue
        other = servo.model_copy(update={"baud_rate": rate, "retries": 0})
        with suppress(GripperError), closing(Transport(other)) as transport:
            _open(transport, other)
            transport.ping(id_)
            return rate
    return None
