import fcntl
import os
import termios
import threading
import time
from contextlib import suppress
from pathlib import Path

import dynamixel_sdk as sdk
import pytest

from gripper_force.errors import DeviceError
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.firmware import VirtualServo
from gripper_hw.dynamixel.packets import Instruction, frame
from gripper_hw.dynamixel.pty_server import BenchMotor, PtyServer, serve_virtual_servo
from gripper_hw.dynamixel.virtual import VirtualBus
from gripper_hw.serial_line import open_line

PACKETS = sdk.PacketHandler(2.0)
MODEL = load_model("XM430-W350")
MS = 1_000_000


def test_vendors_port_finds_the_servos_of_consecutive_clients():
    with serve_virtual_servo("XL330-M288", ids=(1, 2)) as server:
        for id_ in (1, 2):
            port = sdk.PortHandler(server.device_path)
            port.openPort()
            assert PACKETS.ping(port, id_) == (1200, sdk.COMM_SUCCESS, 0)
            port.closePort()


def test_exclusive_mode_ends_some_time_after_its_program_was_killed():
    with serve_virtual_servo("XL330-M288") as server:
        killed = os.open(server.device_path, os.O_RDWR | os.O_NOCTTY)
        fcntl.ioctl(killed, termios.TIOCEXCL)
        os.close(killed)
        deadline = time.monotonic() + 30  # a mode that stays would block the test for ever
        while True:
            assert time.monotonic() < deadline
            with suppress(DeviceError):
                open_line(server.device_path, 57_600, unit="servo", timeout_s=0).close()
                break
            time.sleep(0.01)


def test_served_motor_moves():
    with serve_virtual_servo("XM430-W350") as server:
        port = sdk.PortHandler(server.device_path)
        port.openPort()
        PACKETS.write4ByteTxRx(port, 1, 116, 2100)
        PACKETS.write1ByteTxRx(port, 1, 64, 1)
        ticks = 0
        for _ in range(100_000):
            with suppress(IndexError):  # what the library makes of a late answer on a busy machine
                ticks = PACKETS.read4ByteTxRx(port, 1, 132)[0]
            if ticks > 2090:
                break
        port.closePort()
    assert ticks > 2090


def test_close_releases_handles_and_threads():
    handles = len(list(Path("/proc/self/fd").iterdir()))
    threads = threading.active_count()
    server = PtyServer(VirtualBus([VirtualServo(1, MODEL)]))
    server.close()
    server.close()
    assert len(list(Path("/proc/self/fd").iterdir())) == handles
    assert threading.active_count() == threads


def test_client_that_never_reads_does_not_block_the_bus():
    answered = threading.Semaphore(0)

    def flood(answer: bytes) -> bytes:
        answered.release()
        return bytes(100_000)

    bus = VirtualBus([VirtualServo(1, MODEL)])
    bus.tamper = flood
    with PtyServer(bus) as server:
        handle = os.open(server.device_path, os.O_RDWR | os.O_NOCTTY)
        for _ in range(4):
            os.write(handle, frame(1, Instruction.PING))
            assert answered.acquire(timeout=10)
        os.close(handle)


def run(motor: BenchMotor, duration_ms: int) -> None:
    for t_ns in range(0, duration_ms * MS, MS):
        motor.advance(t_ns)


def motor_in_mode_5(goal_ticks: int, goal_current: int, **plant: float) -> BenchMotor:
    servo = VirtualServo(1, MODEL)
    for name, value in (
        ("operating_mode", 5),
        ("goal_position", goal_ticks),
        ("goal_current", goal_current),
        ("torque_enable", 1),
    ):
        servo.set(name, value)
    return BenchMotor(servo, **plant)


def test_free_motor_reaches_its_goal_and_stops():
    motor = motor_in_mode_5(2048 + 500, 400)
    run(motor, 1500)
    assert motor.position_rad == pytest.approx(500 * 2 * 3.14159265 / 4096, abs=0.01)
    assert motor.velocity_rad_s == 0.0


def test_contact_torque_matches_the_goal_current():
    motor = motor_in_mode_5(4000, 100, contact_rad=0.5, stiffness_nm_per_rad=20.0)
    run(motor, 2000)
    pressed_nm = 20.0 * (motor.position_rad - 0.5)
    assert pressed_nm == pytest.approx(100 * MODEL.current_unit_a * MODEL.nm_per_a, abs=0.051)  # friction


def test_motor_without_torque_does_not_move():
    motor = BenchMotor(VirtualServo(1, MODEL))
    run(motor, 100)
    assert (motor.position_rad, motor.velocity_rad_s) == (0.0, 0.0)


def test_long_pause_is_simulated_only_in_part():
    motor = motor_in_mode_5(4000, 400)
    motor.advance(0)
    motor.advance(10**15)
    assert 0.0 < motor.position_rad < 2.0
