"""Cost of a servo bus cycle: the driver alone and beside an arm, a plain loop of the SDK, and bare bytes."""

import multiprocessing
import os
import pty
import select
import signal
import struct
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator, MutableSequence, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Final

import numpy as np
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

from gripper_force.config import ServoConfig
from gripper_force.interfaces import SharedPort
from gripper_force.runtime.process import SWITCH_INTERVAL_S
from gripper_force.types import NS_PER_MS, NS_PER_S, ServoCommand
from gripper_hw.dynamixel.control_table import REGISTERS, load_model
from gripper_hw.dynamixel.firmware import VirtualServo
from gripper_hw.dynamixel.packets import BROADCAST_ID, Instruction, frame
from gripper_hw.dynamixel.servo import DynamixelBus
from gripper_hw.dynamixel.virtual import VirtualBus

BUS_SETTINGS: Final = tuple(
    (baud_rate, latency_ms) for latency_ms in (0.0, 1.0) for baud_rate in (1_000_000, 2_000_000, 4_000_000)
)
"""Baud rate in bits per second, and latency of the adapter in ms after an answer was on the wire."""

_MODEL: Final = "XM430-W350"
_IDS: Final = (1, 2)
_ARM_IDS: Final = (11, 12, 13, 14, 15, 16)
_WITH_ARM: Final = "driver, arm"
_RATE_HZ: Final = 200
_TURN: Final = 50
"""Cycles of one client before the next client's turn."""

_FIRMWARE: Final = 52
_READ_SIZE, _WRITE_OFFSET, _WRITE_SIZE = 16, 13, 6
"""Sizes as of the driver, which reads 13 to 20 bytes, varying from cycle to cycle."""

_BITS_PER_BYTE: Final = 10
"""Start bit, 8 data bits and stop bit."""

_OVERSLEPT_NS: Final = 150_000
"""Time before a deadline from which the line process polls, as a sleep ends late."""

_REPLY_MARGIN_MS: Final = 1000.0
"""Longer than in a session: on a busy machine the line process itself may be late."""

Cycle = Callable[[], object]


@dataclass(frozen=True, slots=True)
class BusCost:
    """Cost of a cycle, a read of two servos and a write of their goals, for one client at one setting.

    Attributes:
        client: ``driver``; ``driver, arm``, the driver on a port that it shares with another thread, which reads
            and writes the six servos of an arm once per cycle, until both are done; ``plain SDK``,
            GroupSyncRead and GroupSyncWrite over the SDK's own port, as in its examples; or ``bare bytes``,
            precomputed packets, which shows the cost of this machine's I/O.
        baud_rate: Bits per second.
        latency_ms: Latency of the adapter, see `BUS_SETTINGS`.
        line_ms: Time of the line alone: transmission of the bytes, and the latency.
        p50_ms: Median time of a cycle, back to back with the next.
        p99_ms: 99th percentile of that time.
        cpu_share: Share of one CPU that the client's thread uses at 200 cycles per second, without that of the arm.
    """

    client: str
    baud_rate: int
    latency_ms: float
    line_ms: float
    p50_ms: float
    p99_ms: float
    cpu_share: float


def bus(cycles: int) -> Iterator[tuple[BusCost, ...]]:
    """Measures the clients of `BusCost` at each setting of `BUS_SETTINGS`.

    Args:
        cycles: Cycles of each client at each setting.

    Yields:
        The costs at a setting, one per client.

    Raises:
        DeviceError: The driver gave up, because the machine is far too busy.
    """
    for baud_rate, latency_ms in BUS_SETTINGS:
        yield bus_cost(baud_rate, latency_ms, cycles)


def bus_cost(baud_rate: int, latency_ms: float, cycles: int) -> tuple[BusCost, ...]:
    """Measures the clients of `BusCost` at one setting, in turns.

    Args:
        baud_rate: Bits per second.
        latency_ms: Latency of the adapter.
        cycles: Cycles of each client.

    Raises:
        DeviceError: The driver gave up.
    """
    with _line(baud_rate, latency_ms) as (paths, sent), ExitStack() as stack:
        clients = {
            "driver": stack.enter_context(_driver(paths[0], baud_rate)),
            _WITH_ARM: stack.enter_context(_driver_and_arm(paths[1], baud_rate)),
            "plain SDK": stack.enter_context(_plain_sdk(paths[2], baud_rate)),
            "bare bytes": stack.enter_context(_bare_bytes(paths[3])),
        }
        turns = [(name, min(_TURN, cycles - done)) for done in range(0, cycles, _TURN) for name in clients]
        times_ns: dict[str, list[int]] = {name: [] for name in clients}
        shares: dict[str, list[float]] = {name: [] for name in clients}
        begun = list(sent)
        for name, count in turns:
            times_ns[name] += [_time_ns(clients[name]) for _ in range(count)]
        bytes_ = [after - before for before, after in zip(begun, sent, strict=True)]
        for name, count in turns:
            shares[name].append(_cpu_share(clients[name], count))
    costs = []
    for name, count in zip(clients, bytes_, strict=True):
        replies = 2 if name == _WITH_ARM else 1  # each after the latency
        line_ms = _wire_ns(count, baud_rate) / cycles / NS_PER_MS + replies * latency_ms
        p50_ms, p99_ms = (float(ms) for ms in np.percentile(times_ns[name], (50, 99)) / NS_PER_MS)
        share = float(np.median(shares[name]))
        costs.append(BusCost(name, baud_rate, latency_ms, line_ms, p50_ms, p99_ms, share))
    return tuple(costs)


@contextmanager
def _driver(path: str, baud_rate: int, port: SharedPort | None = None) -> Iterator[Cycle]:
    config = ServoConfig(
        model=_MODEL, port=path, baud_rate=baud_rate, bus_watchdog_ms=2540, reply_margin_ms=_REPLY_MARGIN_MS
    )
    bus = DynamixelBus(config, _IDS, port=port)

    def cycle() -> None:
        bus.write([ServoCommand(state.t_ns, state.position_rad, 0.1) for state in bus.read()])

    bus.start()
    try:
        yield cycle
        bus.stop(hold=False)
    finally:
        bus.close()


@contextmanager
def _driver_and_arm(path: str, baud_rate: int) -> Iterator[Cycle]:
    """Client that runs a cycle of the gripper and, in another thread, one of an arm, on one port."""
    lock = threading.Lock()
    with (
        _sdk_port(path, baud_rate) as handler,
        _driver(path, baud_rate, SharedPort(handler, lock)) as gripper_cycle,
        ThreadPoolExecutor(1) as thread,
        ExitStack() as stack,
    ):
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(SWITCH_INTERVAL_S)  # as a program that calls `own_process`
        arm_cycle = _sdk_cycle(handler, _ARM_IDS, lock)

        def cycle() -> None:
            arm = thread.submit(arm_cycle)
            gripper_cycle()
            arm.result()

        yield cycle


@contextmanager
def _plain_sdk(path: str, baud_rate: int) -> Iterator[Cycle]:
    with _sdk_port(path, baud_rate) as handler:
        yield _sdk_cycle(handler, _IDS, threading.Lock())


@contextmanager
def _sdk_port(path: str, baud_rate: int) -> Iterator[PortHandler]:
    handler = PortHandler(path)
    handler.setBaudRate(baud_rate)
    try:
        yield handler
    finally:
        handler.closePort()


def _sdk_cycle(handler: PortHandler, ids: Sequence[int], lock: threading.Lock) -> Cycle:
    """Reads and writes servos as the SDK's examples do."""
    packets = PacketHandler(2.0)
    current, velocity, position, goal = (
        REGISTERS[name]
        for name in ("present_current", "present_velocity", "present_position", "goal_position")
    )
    reader = GroupSyncRead(handler, packets, current.address, current.size + velocity.size + position.size)
    writer = GroupSyncWrite(handler, packets, goal.address, goal.size)
    for id_ in ids:
        reader.addParam(id_)
        writer.addParam(id_, bytes(goal.size))

    def cycle() -> None:
        with lock:
            reader.txRxPacket()
        for id_ in ids:
            ticks = [reader.getData(id_, r.address, r.size) for r in (current, velocity, position)][-1]
            writer.changeParam(id_, goal.encode(ticks))
        with lock:
            writer.txPacket()

    return cycle


@contextmanager
def _bare_bytes(path: str) -> Iterator[Cycle]:
    """Client that sends precomputed packets of the driver: the cost of the machine's I/O alone."""
    data = load_model(_MODEL).indirect_windows(_FIRMWARE)[0].data
    read = frame(BROADCAST_ID, Instruction.FAST_SYNC_READ, struct.pack("<HH", data, _READ_SIZE) + bytes(_IDS))
    goals = b"".join(bytes((id_,)) + bytes(_WRITE_SIZE) for id_ in _IDS)
    params = struct.pack("<HH", data + _WRITE_OFFSET, _WRITE_SIZE) + goals
    write = frame(BROADCAST_ID, Instruction.SYNC_WRITE, params)
    line = os.open(path, os.O_RDWR | os.O_NOCTTY)

    def cycle() -> None:
        os.write(line, read)
        left = 8 + (_READ_SIZE + 4) * len(_IDS)
        while left > 0:
            left -= len(os.read(line, left))
        os.write(line, write)

    try:
        yield cycle
    finally:
        os.close(line)


def _time_ns(cycle: Cycle) -> int:
    start_ns = time.perf_counter_ns()
    cycle()
    return time.perf_counter_ns() - start_ns


def _cpu_share(cycle: Cycle, cycles: int) -> float:
    """Share of a CPU that this thread uses for ``cycles`` cycles at 200 Hz."""
    start_ns, cpu_ns = time.monotonic_ns(), time.thread_time_ns()
    for i in range(1, cycles + 1):
        cycle()
        time.sleep(max(0.0, (start_ns + i * NS_PER_S / _RATE_HZ - time.monotonic_ns()) / NS_PER_S))
    return (time.thread_time_ns() - cpu_ns) / (time.monotonic_ns() - start_ns)


def _wire_ns(count: int, baud_rate: int) -> float:
    return count * _BITS_PER_BYTE * NS_PER_S / baud_rate


# The line runs in a separate process, as it must neither share Python's lock with a client nor be late.


@contextmanager
def _line(baud_rate: int, latency_ms: float) -> Iterator[tuple[list[str], Sequence[int]]]:
    """Serves a virtual bus to four clients. Yields their paths, and the bytes on the wire for each."""
    context = multiprocessing.get_context("spawn")
    sent: MutableSequence[int] = context.RawArray("q", 4)
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there, sent, baud_rate, latency_ms), daemon=True)
    process.start()
    there.close()
    try:
        yield here.recv(), sent
    finally:
        here.close()
        process.join()


def _serve(parent: Connection, sent: MutableSequence[int], baud_rate: int, latency_ms: float) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C, and then closes the pipe
    bus = VirtualBus(VirtualServo(id_, load_model(_MODEL)) for id_ in (*_IDS, *_ARM_IDS))
    clients = {}
    paths = []
    for i in range(len(sent)):
        master, slave = pty.openpty()
        tty.setraw(slave)
        clients[master] = i
        paths.append(os.ttyname(slave))
    parent.send(paths)
    free_ns = 0.0  # time from which the wire is free
    while parent.fileno() not in (ready := select.select([parent.fileno(), *clients], [], [])[0]):
        for master in ready:
            request = os.read(master, 4096)
            free_ns = max(free_ns, time.monotonic_ns()) + _wire_ns(len(request), baud_rate)
            answer = bus.transact(request)
            sent[clients[master]] += len(request) + len(answer)
            if answer:
                free_ns += _wire_ns(len(answer), baud_rate)
                _wait_until(free_ns + latency_ms * NS_PER_MS)
                os.write(master, answer)


def _wait_until(t_ns: float) -> None:
    """Sleeps until shortly before a time and then polls, as a sleep ends late."""
    if (left_ns := t_ns - _OVERSLEPT_NS - time.monotonic_ns()) > 0:
        time.sleep(left_ns / NS_PER_S)
    while time.monotonic_ns() < t_ns:
        pass
