"""Every fault of bus, servo and plant raises its own error or is recovered; stale data are never used."""

from collections import deque
from contextlib import contextmanager, suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_force.config import Config, ServoConfig
from gripper_force.errors import (
    DeviceError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    HardwareFaultError,
)
from gripper_force.fault_config import FAULTS, FaultConfig
from gripper_force.runtime.backends import open_devices
from gripper_force.types import NS_PER_MS, ServoCommand
from gripper_hw.dynamixel.bus_faults import WireFaults
from gripper_hw.dynamixel.control_table import load_model, rad_from_ticks
from gripper_hw.dynamixel.firmware import OVERLOAD_ERROR, REBOOT_NS
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.virtual import VirtualBus, VirtualServo, register_bus, unregister_bus
from gripper_hw.fault_injection import Faults

MODEL = load_model("XM430-W350")
CYCLE_NS = 5 * NS_PER_MS
UNREADABLE = {"garbage", "wrong", "slow", "delayed"}


class Bench:
    """A driver and a servo whose position changes in every cycle."""

    def __init__(self, servo: DynamixelServo, bus: VirtualBus) -> None:
        self.servo, self.bus, self.firmware = servo, bus, bus.servos[0]
        self.now_ns = self.cycles = 0

    def advance(self, cycles: int = 1) -> None:
        for _ in range(cycles):
            self.cycles += 1
            self.now_ns += CYCLE_NS
            self.firmware.control(self.now_ns, self.position_rad, 0.0)

    @property
    def position_rad(self) -> float:
        return rad_from_ticks(2048 + 3 * self.cycles)

    def read_and_check(self) -> None:
        """Reads, and checks that the state is the present one."""
        state = self.servo.read()
        assert state.position_rad == self.position_rad
        assert state.t_ns == self.now_ns


@contextmanager
def bench(*faults: FaultConfig, seed: int = 0, **config):
    bus = VirtualBus([VirtualServo(1, MODEL)], lambda: b.now_ns)
    WireFaults(bus, Faults(faults), seed)
    servo = DynamixelServo(ServoConfig.model_validate({"port": "virtual:faults"} | config), lambda: b.now_ns)
    b = Bench(servo, bus)
    register_bus("faults", bus)
    try:
        yield b
    finally:
        servo.close()
        unregister_bus("faults")


def fault(unit: str, kind: str, at_s: float = 0.0475, for_s: float = 0.1) -> FaultConfig:
    """By default cycles 10 to 29 are faulty, at 50 to 145 ms."""
    return FaultConfig.model_validate({"unit": unit, "kind": kind, "at_s": at_s, "for_s": for_s})


def read_until_fault(b: Bench) -> None:
    b.servo.start()
    for _ in range(9):
        b.advance()
        b.read_and_check()
    b.advance()


# The bus.


@pytest.mark.parametrize("kind", sorted(UNREADABLE))
def test_corrupt_or_late_reply_raises_and_is_never_used(kind):
    with bench(fault("bus", kind)) as b:
        read_until_fault(b)
        for _ in range(19):
            with pytest.raises(DeviceTimeoutError, match="no valid reply"):
                b.servo.read()
            b.advance()
        b.advance()
        b.read_and_check()


@pytest.mark.parametrize("kind", sorted(UNREADABLE))
def test_stop_turns_torque_off_despite_lost_replies(kind):
    """Only the replies are lost: the instruction is executed, but can't be confirmed."""
    with bench(fault("bus", kind)) as b:
        read_until_fault(b)
        with pytest.raises(DeviceTimeoutError):
            b.servo.stop(hold=False)
        assert b.firmware.get("torque_enable") == 0


@pytest.mark.parametrize("kind", sorted(UNREADABLE))
def test_start_fails_and_leaves_torque_off(kind):
    with bench(fault("bus", kind, at_s=0.0)) as b:
        with pytest.raises(DeviceError):
            b.servo.start()
        assert b.firmware.get("torque_enable") == 0


def test_unplugged_bus_is_lost_until_plugged_in_and_restarted():
    with bench(fault("bus", "off")) as b:
        read_until_fault(b)
        for call in (b.servo.read, lambda: b.servo.stop(hold=False)):
            with pytest.raises(DeviceLostError, match="gone"):
                call()
        b.servo.close()
        with pytest.raises(DeviceNotFoundError):
            b.servo.start()
        b.advance(20)
        b.servo.start()
        b.advance()
        b.read_and_check()


def test_unplugged_port_stays_lost_until_reopened():
    with bench(fault("bus", "off", for_s=0.01)) as b:
        read_until_fault(b)
        with pytest.raises(DeviceLostError):
            b.servo.read()
        b.advance(5)
        with pytest.raises(DeviceLostError):
            b.servo.read()


def test_retries_recover_lost_replies():
    with bench(fault("bus", "intermittent", for_s=1.0), retries=10) as b:
        read_until_fault(b)
        for _ in range(50):
            b.read_and_check()
            b.advance()
        stats = b.servo.stats
        assert stats.retries == stats.timeouts > 20


def test_same_seed_loses_the_same_replies():
    def retries(seed):
        with bench(fault("bus", "intermittent"), retries=10, seed=seed) as b:
            read_until_fault(b)
            for _ in range(5):
                b.servo.read()
            return b.servo.stats.retries

    assert retries(1) == retries(1)
    assert len({retries(seed) for seed in range(8)}) > 1


@settings(deadline=None, max_examples=60)
@given(
    st.lists(
        st.tuples(st.sampled_from(sorted(FAULTS["bus"])), st.integers(0, 40), st.integers(1, 40)), max_size=4
    ),
    st.integers(0, 5),
    st.integers(0, 2**32),
)
def test_read_returns_a_current_state_or_raises_for_any_bus_faults(spans, retries, seed):
    faults = [fault("bus", kind, at * 0.005, length * 0.005) for kind, at, length in spans]
    with bench(*faults, retries=retries, seed=seed, bus_watchdog_ms=2540) as b:
        for _ in range(50):
            b.advance()
            with suppress(DeviceError):
                b.servo.start() if b.servo._bus._transport._port is None else b.read_and_check()
            if b.bus.is_unplugged():
                b.servo.close()
        b.advance(40)
        if b.servo._bus._transport._port is None:
            b.servo.start()
        b.servo.stop(hold=False)
        assert b.firmware.get("torque_enable") == 0


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 7), st.integers(0, 6), st.integers(0, 2**32))
def test_reply_up_to_seven_requests_late_is_rejected(late, retries, seed):
    with bench(retries=retries) as b:
        b.servo.start()
        for _ in range(seed % 8):
            b.servo.read()
        held: deque[bytes] = deque()

        def delay(answer):
            held.append(answer)
            return held.popleft() if len(held) > late else None

        b.bus.tamper = delay
        for _ in range(12):
            b.advance()
            with pytest.raises(DeviceTimeoutError):
                b.servo.read()
        with pytest.raises(DeviceTimeoutError):
            b.servo._bus._transport.get(1, "present_position")


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 100), st.integers(1, 255))
def test_reply_with_any_corrupt_byte_is_rejected(at, bits):
    with bench(retries=0) as b:
        b.servo.start()
        b.advance()

        def damage(answer):
            where = at % len(answer)
            return answer[:where] + bytes((answer[where] ^ bits,)) + answer[where + 1 :]

        b.bus.tamper = damage
        with pytest.raises(DeviceTimeoutError):
            b.servo.read()


# The servo and the motor.


def test_power_loss_times_out_and_then_reports_the_restart():
    with bench(fault("servo", "off")) as b:
        read_until_fault(b)
        with pytest.raises(DeviceTimeoutError):
            b.servo.read()
        assert b.firmware.get("torque_enable") == 0
        b.advance(19)
        with pytest.raises(DeviceTimeoutError):
            b.servo.read()
        b.advance(REBOOT_NS // CYCLE_NS + 1)
        with pytest.raises(HardwareFaultError, match="restarted and lost"):
            b.servo.read()
        assert (b.firmware.get("torque_enable"), b.firmware.get("bus_watchdog")) == (0, 0)
        assert b.firmware.get("goal_current") == b.firmware.get("current_limit")
        b.servo.close()
        b.servo.start()
        b.advance()
        b.servo.read()


def test_intermittent_power_reports_each_restart():
    with bench(fault("servo", "intermittent", for_s=10.0)) as b:
        read_until_fault(b)
        with pytest.raises(DeviceTimeoutError):
            b.servo.read()
        assert b.firmware.get("torque_enable") == 0
        b.advance(50)
        with pytest.raises(HardwareFaultError, match="restarted and lost"):
            b.servo.read()
        b.advance(10)  # 0.3 s after the first time
        with pytest.raises(DeviceTimeoutError):
            b.servo.read()


def test_stuck_watchdog_trip_raises_and_prevents_start():
    with bench(fault("servo", "stuck")) as b:
        read_until_fault(b)
        with pytest.raises(HardwareFaultError, match="watchdog tripped"):
            b.servo.read()
        assert b.firmware.control(b.now_ns, 0.0, 0.0) == 0.0
        b.servo.close()
        with pytest.raises(DeviceError, match="did not keep bus_watchdog"):
            b.servo.start()
        assert b.firmware.get("torque_enable") == 0


def test_overload_is_in_the_state_and_turns_torque_off():
    with bench(fault("servo", "wrong")) as b:
        read_until_fault(b)
        assert b.servo.read().hardware_error == OVERLOAD_ERROR
        assert b.firmware.get("torque_enable") == 0
        b.advance(30)
        assert b.servo.read().hardware_error == OVERLOAD_ERROR  # until it is rebooted
        b.servo.close()
        with pytest.raises(HardwareFaultError, match="overload"):
            b.servo.start()


def test_excess_motor_current_is_measured_and_ends_with_torque_off():
    with bench(fault("plant", "wrong", for_s=1.0)) as b:
        b.servo.start()
        b.servo.write(ServoCommand(0, 1.0, 0.2))
        given_a = []
        for _ in range(160):
            b.advance()
            b.servo.read()  # the fault acts on packets
            given_a.append(b.firmware.control(b.now_ns, b.position_rad, 0.0))
            assert b.servo.read().current_a == pytest.approx(given_a[-1], abs=MODEL.current_unit_a)
        before, half, full = given_a[8], given_a[83], given_a[158]
        assert before == pytest.approx(0.2, abs=0.01)
        assert full - before == pytest.approx(2 * (half - before), rel=0.1)
        assert full > 0.26
        b.servo.stop(hold=False)
        assert b.firmware.control(b.now_ns, b.position_rad, 0.0) == 0.0


# The simulated rig.


@contextmanager
def rig(unit: str, kind: str, **span: float):
    config = Config.model_validate(
        {
            "camera": {"backend": "none"},
            "load_cell": {"backend": "none"},
            "sim": {"detail": "coarse"},
            "servo": {"retries": 0},
            "faults": [{"unit": unit, "kind": kind, "at_s": 0.012} | span],
        }
    )
    with open_devices(config) as devices:
        state = devices.servo.start()
        devices.servo.write(ServoCommand(0, state.position_rad + 2.0, 0.2))
        devices.clock.sleep_until_ns(10 * NS_PER_MS)
        devices.servo.read()
        yield devices


def read_on(devices) -> None:
    for cycle in range(3, 100):
        devices.clock.sleep_until_ns(cycle * CYCLE_NS)
        state = devices.servo.read()
        if state.hardware_error or state.current_a > 0.21:
            raise HardwareFaultError(str(state))


def test_power_cut_between_two_cycles_is_detected():
    with rig("servo", "off", for_s=0.001) as devices:
        with pytest.raises(DeviceTimeoutError):
            read_on(devices)
        devices.clock.sleep_until_ns(REBOOT_NS + 20 * NS_PER_MS)
        with pytest.raises(HardwareFaultError, match="restarted and lost"):
            devices.servo.read()
