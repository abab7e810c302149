import os
import termios
import time
from collections import Counter
from pathlib import Path

import pytest
from dynamixel_sdk import protocol2_packet_handler

from gripper_force.config import Config
from gripper_force.errors import ConfigError, DeviceError, DeviceNotFoundError
from gripper_force.jobs.checks import RegisterChange, SetupResult
from gripper_hw import UDEV_RULES
from gripper_hw.dynamixel import servo_probe
from gripper_hw.dynamixel.control_table import REGISTERS, load_model
from gripper_hw.dynamixel.firmware import OVERLOAD_ERROR
from gripper_hw.dynamixel.packets import Instruction
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.servo_probe import probe, setup
from gripper_hw.dynamixel.virtual import VirtualServo

pytestmark = pytest.mark.parametrize("make_endpoint", ["pty"], indirect=True)

READS = {Instruction.PING, Instruction.READ, Instruction.FAST_SYNC_READ}
MODEL = load_model("XM430-W350")


@pytest.fixture(autouse=True)
def shorter_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets a scan wait for the answers of 60 servos: the SDK waits 0.8 s for all that a bus may have."""
    monkeypatch.setattr(protocol2_packet_handler, "MAX_ID", 60)


def config_of(endpoint, **servo) -> Config:
    # A cycle of one second, so that a busy machine passes.
    return Config.model_validate(
        {"clock": "realtime", "servo": endpoint.config(**servo), "control": {"rate_hz": 1.0}}
    )


def rows(endpoint, **servo):
    return {(check.unit, check.name): check for check in probe(config_of(endpoint, **servo))}


def written(endpoint) -> dict[str, int]:
    """Every register that was written."""
    names = {register.address: name for name, register in REGISTERS.items()}
    values = {}
    for packet in endpoint.packets():
        if packet.instruction == Instruction.WRITE:
            name = names[int.from_bytes(packet.params[:2], "little")]
            values[name] = REGISTERS[name].decode(packet.params[2:])
    return values


def test_factory_settings_pass_and_nothing_is_written(endpoint):
    found = rows(endpoint)
    assert not [check for check in found.values() if check.ok is False]
    texts = {name: check.found for (unit, name), check in found.items() if unit == "servo 1"}
    assert "of 200 reads" in texts.pop("bus cycle")
    assert texts == {
        "model": "XM430-W350, firmware 52",
        "hardware error": "none",
        "torque": "off",
        "homing offset": "0 ticks",
        "return delay time": "500 us",
        "current limit": "3.209 A",
        "operating mode": "3 (position)",
        "bus watchdog": "off",
    }
    assert found["servo 1", "return delay time"].advice == "a run sets 0 us; so does doctor --setup"
    assert {packet.instruction for packet in endpoint.packets()} == READS


def test_another_homing_offset_is_a_problem(endpoint):
    endpoint.bus.servos[0].set("homing_offset", 1024)
    check = rows(endpoint)["servo 1", "homing offset"]
    assert check.ok is False
    assert "set servo.homing_offset=1024" in check.advice


def test_configured_homing_offset_is_a_warning(endpoint):
    endpoint.bus.servos[0].set("homing_offset", 1024)
    check = rows(endpoint, homing_offset=1024)["servo 1", "watchdog"]
    assert "issue 584" in check.advice
    assert check.ok


def test_running_servo_is_not_changed(endpoint):
    servo = DynamixelServo(endpoint.config(), lambda: endpoint.now_ns)
    servo.start()
    servo.close()
    endpoint.received.clear()
    check = rows(endpoint)["servo 1", "torque"]
    assert (check.found, check.ok) == ("on", True)
    assert "the next run turns torque off first" in check.advice
    assert {packet.instruction for packet in endpoint.packets()} == READS


def test_hardware_error_is_a_problem(endpoint):
    endpoint.bus.servos[0].raise_hardware_error(OVERLOAD_ERROR)
    check = rows(endpoint)["servo 1", "hardware error"]
    assert (check.found, check.ok) == ("overload", False)
    assert "reboot" in check.advice


def test_old_firmware_is_a_problem_and_its_cycle_is_not_measured(make_endpoint):
    found = rows(make_endpoint(VirtualServo(1, MODEL, firmware=37)))
    assert found["servo 1", "model"].ok is False
    assert "update it to 38 or newer" in found["servo 1", "model"].advice
    assert ("servo 1", "bus cycle") not in found


def test_cycle_of_firmware_without_fast_sync_read_is_measured(make_endpoint):
    found = rows(make_endpoint(VirtualServo(1, MODEL, firmware=44)))
    assert found["servo 1", "model"].ok
    assert ("servo 1", "bus cycle") in found


def test_servo_without_replies_is_distinguished_from_a_missing_one(endpoint):
    endpoint.bus.servos[0].set("status_return_level", 0)
    check = rows(endpoint, retries=0)["servo 1", "registers"]
    assert check.ok is False
    assert "Status Return Level" in check.advice


def test_replies_too_late_for_a_run_are_still_measured(endpoint, monkeypatch):
    def late(answer):
        time.sleep(0.01)
        return answer

    monkeypatch.setattr(servo_probe, "_CYCLES", 10)
    endpoint.bus.tamper = late
    cycle = rows(endpoint, reply_margin_ms=1.0)["servo 1", "bus cycle"]
    assert cycle.found.endswith(" of 10 reads")


@pytest.mark.parametrize(("name", "apart"), [("XM430-W350", 0), ("XL330-M288", 10)])
def test_the_time_of_a_cycle_is_that_of_all_its_reads(make_endpoint, name, apart):
    """An XL330's voltage does not fit: every 20th cycle reads its 2 bytes on their own, with up to 7 of padding."""
    endpoint = make_endpoint(VirtualServo(1, load_model(name)))
    assert "of 200 reads" in rows(endpoint, model=name)["servo 1", "bus cycle"].found
    reads = [packet for packet in endpoint.packets() if packet.instruction == Instruction.FAST_SYNC_READ]
    assert Counter(packet.params[2] > 9 for packet in reads) == Counter({True: 200, False: apart})


def test_other_servos_are_listed(make_endpoint):
    endpoint = make_endpoint(VirtualServo(1, MODEL), VirtualServo(7, load_model("XL330-M288")))
    check = rows(endpoint)["servo 7", "model"]
    assert (check.found, check.ok) == ("XL330-M288, firmware 52", None)


def test_missing_servo_check_lists_the_ids_that_answer(make_endpoint):
    endpoint = make_endpoint(VirtualServo(7, MODEL))
    check = rows(endpoint, reply_margin_ms=20.0)["servo 1", "model"]
    assert (check.found, check.ok) == ("no answer at 1000000 baud (ids that answer: 7)", False)
    assert check.advice == "check power, cable and servo.id"


def test_both_servos_of_two_fingers_are_checked(make_endpoint):
    endpoint = make_endpoint(VirtualServo(1, MODEL), VirtualServo(2, MODEL))
    found = rows(endpoint, second={"id": 2})
    assert not [check for check in found.values() if check.ok is False]
    assert {unit for unit, name in found if name == "torque"} == {"servo 1", "servo 2"}
    assert found["servo 1 and 2", "fingers"].found == "0.000 rad apart"
    assert "of 200 reads" in found["servo 1 and 2", "bus cycle"].found
    reads = [packet for packet in endpoint.packets() if packet.instruction == Instruction.FAST_SYNC_READ]
    assert {packet.params[4:] for packet in reads} == {b"\x01\x02"}
    with pytest.raises(ConfigError, match=r"one servo at a time.*servo\.id=2"):
        setup(config_of(endpoint, second={"id": 2}), never)


def test_fingers_that_a_run_refuses_are_a_problem(make_endpoint):
    endpoint = make_endpoint(VirtualServo(1, MODEL), VirtualServo(2, MODEL))
    check = rows(endpoint, second={"id": 2, "offset_rad": 0.3})["servo 1 and 2", "fingers"]
    assert (check.found, check.ok) == ("0.300 rad apart", False)
    assert "set servo.second.offset_rad=0.000" in check.advice


def test_a_missing_second_servo_is_named_by_its_key(make_endpoint):
    endpoint = make_endpoint(VirtualServo(1, MODEL))
    found = rows(endpoint, reply_margin_ms=20.0, second={"id": 2})
    assert found["servo 1", "torque"].ok
    assert found["servo 2", "model"].advice == "check power, cable and servo.second.id"


def test_servo_at_another_baud_rate_is_found(endpoint):
    fd = os.open(endpoint.port, os.O_RDWR | os.O_NOCTTY)
    endpoint.bus.tamper = lambda answer: answer if termios.tcgetattr(fd)[4] == termios.B57600 else None
    check = rows(endpoint)["servo 1", "model"]
    os.close(fd)
    assert (check.found, check.ok) == ("no answer at 1000000 baud (ids that answer: none)", False)
    assert check.advice == "it answers at 57600 baud: set servo.baud_rate=57600"


@pytest.mark.parametrize(("latency_ms", "ok"), [(16, False), (1, True)])
def test_adapter_latency_is_checked(endpoint, tmp_path, latency_ms, ok):
    adapter = tmp_path / Path(endpoint.port).name
    adapter.mkdir()
    (adapter / "latency_timer").write_text(f"{latency_ms}\n")
    checks = probe(config_of(endpoint, reply_margin_ms=10.0), tmp_path)
    check = next(check for check in checks if check.name == "latency timer")
    assert (check.found, check.ok) == (f"{latency_ms} ms", ok)
    assert (str(UDEV_RULES) in check.advice) is not ok


def test_wrong_model_and_missing_port_raise(endpoint):
    with pytest.raises(ConfigError, match=r"XM430-W350 .*, not the configured XL330-M288"):
        rows(endpoint, model="XL330-M288")
    with pytest.raises(DeviceNotFoundError, match="there is no port /dev/nowhere"):
        rows(endpoint, port="/dev/nowhere")


def test_lockstep_clock_with_a_real_servo_is_a_problem(endpoint):
    config = config_of(endpoint).model_copy(update={"clock": "lockstep"})
    check = next(check for check in probe(config) if check.name == "clock")
    assert (check.ok, check.advice) == (
        False,
        "a real servo does not follow simulated time: set clock=realtime",
    )


# Setup.


def never(servo: str, changes: list[RegisterChange]) -> bool:
    pytest.fail(f"asked to change {changes} of {servo}")


def test_setup_writes_nothing_if_declined(endpoint):
    asked: list[tuple[str, list[RegisterChange]]] = []

    def declined(servo: str, changes: list[RegisterChange]) -> bool:
        asked.append((servo, changes))
        return False

    result = setup(config_of(endpoint), declined)
    ((servo, changes),) = asked
    assert servo == "servo 1"
    assert [(c.register, c.old, c.new) for c in changes] == [
        ("return_delay_time", "500 us", "0 us"),
        ("current_limit", "3.209 A", "1.200 A"),
        ("operating_mode", "3 (position)", "5 (current-based position)"),
    ]
    assert result == SetupResult(1, changes, applied=False)
    assert {packet.instruction for packet in endpoint.packets()} <= READS


def test_setup_writes_the_listed_changes_so_that_start_does_not(endpoint):
    assert setup(config_of(endpoint), lambda *_: True).applied
    assert written(endpoint) == {
        "return_delay_time": 0,
        "current_limit": int(1.2 / MODEL.current_unit_a),
        "operating_mode": 5,
    }
    endpoint.received.clear()
    servo = DynamixelServo(endpoint.config(), lambda: endpoint.now_ns)
    servo.start()
    servo.stop(hold=False)
    servo.close()
    writes = [packet for packet in endpoint.packets() if packet.instruction == Instruction.WRITE]
    assert writes
    assert all(int.from_bytes(packet.params[:2], "little") >= 64 for packet in writes)
    assert setup(config_of(endpoint), never) == SetupResult(1, [], applied=False)


def test_setup_overwrites_registers_of_another_program(endpoint):
    firmware = endpoint.bus.servos[0]
    odd = {"drive_mode": 4, "status_return_level": 1, "profile_velocity": 50, "profile_acceleration": 5}
    for name, value in odd.items():
        firmware.set(name, value)
    setup(config_of(endpoint), lambda *_: True)
    assert [firmware.get(name) for name in odd] == [0, 2, 0, 0]


def test_setup_refuses_while_torque_is_on(endpoint):
    endpoint.bus.servos[0].set("torque_enable", 1)
    with pytest.raises(DeviceError, match="servo 1 has torque on, so nothing was changed"):
        setup(config_of(endpoint), never)
    assert not written(endpoint)


def test_setup_refuses_another_model(endpoint):
    with pytest.raises(ConfigError, match="not the configured XL330-M288"):
        setup(config_of(endpoint, model="XL330-M288"), never)
    assert not written(endpoint)
