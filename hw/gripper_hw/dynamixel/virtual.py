"""Virtual X-series bus that speaks Protocol 2.0, and the registry of ``virtual:<name>`` ports.

Source: https://emanual.robotis.com/docs/en/dxl/protocol2/.
"""

import threading
import time
from collections.abc import Callable, Iterable
from typing import Final

from gripper_force.errors import ConfigError
from gripper_hw.dynamixel.firmware import VirtualServo
from gripper_hw.dynamixel.packets import (
    ALERT,
    BROADCAST_ID,
    HEADER,
    STATUS,
    Error,
    Instruction,
    Packet,
    Parser,
    crc16,
    status,
)

__all__ = ["VirtualBus", "VirtualServo", "find_bus", "register_bus", "unregister_bus"]

_STALE_NS: Final = 20_000_000  # pause after which an incomplete packet is discarded
_CLEAR_TURNS: Final = b"\x01\x44\x58\x4c\x22"  # parameters of Clear for the multi-turn count


class VirtualBus:
    """Virtual servos on one bus.

    Attributes:
        servos: Servos on the bus.
        lock: Held while a packet is executed.
        clock_ns: Clock of the watchdogs and reboots.
        before_packet: Called with the lock held before a packet is executed; advances the plant to now.
        tamper: Fault hook: takes each reply and returns the bytes that arrive, None for no reply.
        is_unplugged: Fault hook: returns True while the bus is unplugged.
    """

    def __init__(
        self,
        servos: Iterable[VirtualServo],
        clock_ns: Callable[[], int] = time.monotonic_ns,
        before_packet: Callable[[], None] | None = None,
    ) -> None:
        """Creates a bus; see the class for the arguments."""
        self.servos = tuple(servos)
        self.lock = threading.RLock()
        self.clock_ns = clock_ns
        self.tamper: Callable[[bytes], bytes | None] | None = None
        self.is_unplugged: Callable[[], bool] = lambda: False
        self.before_packet = before_packet
        self._parser = Parser()
        self._last_data_ns = 0

    def transact(self, data: bytes) -> bytes:
        """Executes received bytes and returns the replies; ``data`` may be any piece of any byte stream."""
        with self.lock:
            now_ns = self.clock_ns()
            if now_ns - self._last_data_ns > _STALE_NS:
                self._parser = Parser()  # a real servo discards an incomplete packet too
            self._last_data_ns = now_ns
            replies = [self._execute(packet) for packet in self._parser.feed(data)]
        if self.tamper is not None:
            replies = [self.tamper(reply) or b"" for reply in replies if reply]
        return b"".join(replies)

    def _execute(self, packet: Packet) -> bytes:
        if packet.instruction == STATUS:
            return b""
        if self.before_packet is not None:
            self.before_packet()
        now_ns = self.clock_ns()
        online = {servo.id: servo for servo in self.servos if now_ns >= servo.silent_until_ns}
        for servo in online.values():
            servo.check_watchdog(now_ns)
            if packet.intact:
                servo.feed_watchdog(now_ns)
        if packet.intact and packet.instruction in _GROUP_READS:
            return self._group_read(packet, online)
        if packet.intact and packet.instruction in _GROUP_WRITES:
            for id_, address, data in _GROUP_WRITES[packet.instruction](packet.params):
                if id_ in online:
                    online[id_].write(address, data)
            return b""
        if packet.id != BROADCAST_ID:
            return _reply(online[packet.id], packet, now_ns) if packet.id in online else b""
        replies = [_reply(servo, packet, now_ns) for _, servo in sorted(online.items())]
        return b"".join(replies) if packet.instruction == Instruction.PING else b""

    def _group_read(self, packet: Packet, online: dict[int, VirtualServo]) -> bytes:
        """Each servo replies after the one before it, so a missing servo silences all that follow."""
        reads = _GROUP_READS[packet.instruction](packet.params)
        fast = packet.instruction in (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)
        blocks = []
        for id_, address, size in reads:
            if id_ not in online or not online[id_].answers_group_read(fast=fast):
                break
            error, data = online[id_].read(address, size)
            blocks.append((id_, error | _alert(online[id_]), data))
        if fast:
            return _fast_status(blocks, 1 + sum(size + 4 for _, _, size in reads))
        return b"".join(status(*block) for block in blocks)


def _fast_status(blocks: list[tuple[int, int, bytes]], length: int) -> bytes:
    """One packet to which every servo adds a block; the CRC is cumulative, and nothing is stuffed."""
    if not blocks:
        return b""
    reply = HEADER + bytes((BROADCAST_ID,)) + (length & 0xFFFF).to_bytes(2, "little") + bytes((STATUS,))
    for id_, error, data in blocks:
        reply += bytes((error, id_)) + data
        reply += crc16(reply).to_bytes(2, "little")
    return reply


def _reply(servo: VirtualServo, packet: Packet, now_ns: int) -> bytes:
    """Executes one servo's instruction and returns its status packet."""
    level = servo.get("status_return_level")
    id_ = servo.id
    if not packet.intact:
        error, data = Error.CRC, b""
    else:
        error, data = _run_instruction(servo, packet, now_ns)
    return (
        status(id_, error | _alert(servo), data) if level >= _REPLY_LEVELS.get(packet.instruction, 2) else b""
    )


def _run_instruction(servo: VirtualServo, packet: Packet, now_ns: int) -> tuple[Error, bytes]:
    params = packet.params
    head = int.from_bytes(params[:2], "little")
    match packet.instruction:
        case Instruction.PING:
            return Error.NONE, servo.read(0, 2)[1] + servo.read(6, 1)[1]
        case Instruction.READ if len(params) == 4:
            return servo.read(head, int.from_bytes(params[2:4], "little"))
        case Instruction.WRITE if len(params) > 2:
            return servo.write(head, params[2:]), b""
        case Instruction.REG_WRITE if len(params) > 2:
            return servo.register_write(head, params[2:]), b""
        case Instruction.ACTION:
            return servo.action(), b""
        case Instruction.REBOOT:
            servo.reboot(now_ns)
            return Error.NONE, b""
        case Instruction.FACTORY_RESET if len(params) == 1:
            return servo.factory_reset(params[0], now_ns), b""
        case Instruction.CLEAR if params == _CLEAR_TURNS:
            servo.clear_turns()
            return Error.NONE, b""
    return Error.INSTRUCTION, b""


def _alert(servo: VirtualServo) -> int:
    return ALERT if servo.alert else 0


def _sync_read(params: bytes) -> list[tuple[int, int, int]]:
    if len(params) < 5:
        return []
    address, size = _word(params, 0), _word(params, 2)
    return [(id_, address, size) for id_ in params[4:]]


def _bulk_read(params: bytes) -> list[tuple[int, int, int]]:
    return [(params[i], _word(params, i + 1), _word(params, i + 3)) for i in range(0, len(params) - 4, 5)]


def _sync_write(params: bytes) -> list[tuple[int, int, bytes]]:
    if len(params) < 5:
        return []
    address, step = _word(params, 0), _word(params, 2) + 1
    starts = range(4, len(params) - step + 1, step)
    return [(params[start], address, params[start + 1 : start + step]) for start in starts]


def _bulk_write(params: bytes) -> list[tuple[int, int, bytes]]:
    writes = []
    while len(params) >= 5 and len(params) >= 5 + (size := _word(params, 3)):
        writes.append((params[0], _word(params, 1), params[5 : 5 + size]))
        params = params[5 + size :]
    return writes


def _word(data: bytes, index: int) -> int:
    return data[index] | data[index + 1] << 8


_REPLY_LEVELS: Final[dict[int, int]] = {Instruction.PING: 0, Instruction.READ: 1}
_GROUP_READS: Final[dict[int, Callable[[bytes], list[tuple[int, int, int]]]]] = {
    Instruction.SYNC_READ: _sync_read,
    Instruction.FAST_SYNC_READ: _sync_read,
    Instruction.BULK_READ: _bulk_read,
    Instruction.FAST_BULK_READ: _bulk_read,
}
_GROUP_WRITES: Final[dict[int, Callable[[bytes], list[tuple[int, int, bytes]]]]] = {
    Instruction.SYNC_WRITE: _sync_write,
    Instruction.BULK_WRITE: _bulk_write,
}

_buses: Final[dict[str, VirtualBus]] = {}


def register_bus(name: str, bus: VirtualBus) -> None:
    """Makes a bus available as port ``virtual:<name>`` in this process.

    Raises:
        ConfigError: The name is taken.
    """
    if _buses.setdefault(name, bus) is not bus:
        raise ConfigError(
            f"servo.port=virtual:{name} is in use in this process; close the gripper that has it, or name another "
            "port, such as virtual:second"
        )


def unregister_bus(name: str) -> None:
    """Removes a bus; an open port then reports it as unplugged. An unknown name is not an error."""
    _buses.pop(name, None)


def find_bus(name: str) -> VirtualBus | None:
    """Returns the bus registered as ``name``, or None if it is missing or unplugged."""
    bus = _buses.get(name)
    return None if bus is None or bus.is_unplugged() else bus
