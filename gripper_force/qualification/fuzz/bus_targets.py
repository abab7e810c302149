"""Fuzz targets of the servo bus: packet parser, virtual servo and driver."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from gripper_force.config import ServoConfig
from gripper_force.qualification.fuzz.target import Target
from gripper_force.types import NS_PER_MS, ServoCommand
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.packets import HEADER, STATUS, Instruction, Parser, crc16, frame, status
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.virtual import VirtualBus, VirtualServo, register_bus, unregister_bus

_CYCLES: Final = 4
"""Control cycles of the driver."""

_PIECE: Final = 13
"""Bytes that arrive at once."""


def _instructions() -> list[bytes]:
    read, sync = bytes((126, 0, 10, 0)), bytes((132, 0, 4, 0, 1))
    singles = [
        frame(1, Instruction.PING),
        frame(254, Instruction.PING),
        frame(1, Instruction.READ, read),
        frame(1, Instruction.WRITE, bytes((64, 0, 1))),
        frame(1, Instruction.WRITE, bytes((11, 0, 0))),
        frame(1, Instruction.WRITE, bytes((102, 0, 100, 0))),
        frame(1, Instruction.REG_WRITE, bytes((116, 0, 0, 8, 0, 0))),
        frame(1, Instruction.ACTION),
        frame(1, Instruction.REBOOT),
        frame(1, Instruction.FACTORY_RESET, b"\x01"),
        frame(1, Instruction.CLEAR, b"\x01\x44\x58\x4c\x22"),
        frame(254, Instruction.SYNC_READ, sync),
        frame(254, Instruction.FAST_SYNC_READ, sync),
        frame(254, Instruction.SYNC_WRITE, bytes((116, 0, 4, 0, 1, 0, 8, 0, 0))),
        frame(254, Instruction.BULK_READ, bytes((1, 132, 0, 4, 0))),
        frame(254, Instruction.BULK_WRITE, bytes((1, 65, 0, 1, 0, 1))),
        frame(1, Instruction.WRITE, bytes((168, 0, *(126, 0) * 14))),
    ]
    return [*singles, singles[3] + singles[5] + singles[6] + singles[7] + singles[2]]


def _answers() -> list[bytes]:
    return [*_instructions(), status(1, 0, b"\xff\xff\xfd\x01"), status(1, 0x80), status(1, 0, bytes(30)) * 3]


def _repair_checksums(data: bytes) -> bytes:
    """Replaces the checksum of each complete packet by that of its present contents."""
    fixed = bytearray(data)
    start = fixed.find(HEADER)
    while start >= 0 and len(fixed) >= start + 7:
        end = start + 7 + int.from_bytes(fixed[start + 5 : start + 7], "little")
        if start + 10 <= end <= len(fixed):
            fixed[end - 2 : end] = crc16(bytes(fixed[start : end - 2])).to_bytes(2, "little")
        start = fixed.find(HEADER, start + 4)
    return bytes(fixed)


def _parse(data: bytes, _path: Path) -> None:
    parser = Parser()
    pieces = [data[at : at + _PIECE] for at in range(0, len(data), _PIECE)]
    for packet in (packet for piece in pieces for packet in parser.feed(piece)):
        if packet.intact and packet.instruction != STATUS:
            frame(packet.id, packet.instruction, packet.params)


def _serve(data: bytes, _path: Path) -> None:
    now_ns = 0
    servo = VirtualServo(1, load_model("XM430-W350"))
    bus = VirtualBus([servo], lambda: now_ns)
    for at in range(0, len(data), _PIECE):
        bus.transact(data[at : at + _PIECE])
        now_ns += NS_PER_MS
        servo.control(now_ns, 0.3, 0.1)
    now_ns += 1000 * NS_PER_MS  # an incomplete packet has timed out, and a reboot is over
    assert not servo.get("status_return_level") or bus.transact(frame(servo.id, Instruction.PING))


def _drive(data: bytes, _path: Path) -> None:
    """Runs the driver over a bus whose answers are changed by a script, the input."""
    now_ns = 0
    bus = VirtualBus([VirtualServo(1, load_model("XM430-W350"))], lambda: now_ns)
    script = iter(data)
    bus.tamper = lambda answer: _tampered(answer, script)
    register_bus("fuzz", bus)
    servo = DynamixelServo(ServoConfig(port="virtual:fuzz"), lambda: now_ns)
    try:
        state = servo.start()
        for _ in range(_CYCLES):
            now_ns += 5 * NS_PER_MS
            servo.write(ServoCommand(state.t_ns, state.position_rad + 0.1, 0.2))
            state = servo.read()
        servo.stop(hold=bool(next(script, 0) & 1))
    finally:
        servo.close()
        unregister_bus("fuzz")


def _tampered(answer: bytes, script: Iterator[int]) -> bytes | None:
    """Answer as it arrives: the script's next byte selects the change, further bytes are its parameters."""
    change = _CHANGES.get(next(script, 0))
    return answer if change is None else change(answer, lambda: next(script, 0))


def _flipped(answer: bytes, take: Callable[[], int]) -> bytes:
    data = bytearray(answer)
    data[take() % len(data)] ^= take() or 1
    return bytes(data)


def _changed_with_checksum(answer: bytes, take: Callable[[], int]) -> bytes:
    """Changes a byte after the header; the checksum is correct."""
    data = bytearray(answer)
    data[4 + take() % (len(data) - 4)] = take()
    return _repair_checksums(bytes(data))


def _random_status(_answer: bytes, take: Callable[[], int]) -> bytes:
    return status(take(), take(), bytes(take() for _ in range(take() % 64)))


_CHANGES: Final[dict[int, Callable[[bytes, Callable[[], int]], bytes | None]]] = {
    1: lambda _answer, _take: None,
    2: _flipped,
    3: _changed_with_checksum,
    4: _random_status,
    5: lambda answer, take: answer[: take() % (len(answer) + 1)],
    6: lambda answer, _take: answer + answer,
    7: lambda answer, take: bytes(take() for _ in range(take() % 32)) + answer,
    8: lambda _answer, take: bytes(take() for _ in range(take())),
}


def _scripts() -> list[bytes]:
    """Scripts with a change early, in the middle and late; an undisturbed run has about 80 answers."""
    unchanged = bytes(90)
    return [
        unchanged,
        *(
            unchanged[:at] + bytes((change, 6, 3)) * 2 + unchanged
            for at in (0, 20, 62)
            for change in _CHANGES
        ),
    ]


TARGETS: Final = [
    Target("packets", _answers, _parse, 40, (HEADER, b"\xff\xff\xfd"), _repair_checksums),
    Target("virtual servo", _instructions, _serve, 10, (HEADER,), _repair_checksums),
    Target("servo driver", _scripts, _drive, 2, tuple(bytes((change,)) for change in _CHANGES)),
]
