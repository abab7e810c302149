"""Protocol 2.0 packets of the virtual bus: framing, CRC and byte stuffing. The driver uses the vendor's SDK instead.

See https://emanual.robotis.com/docs/en/dxl/protocol2/.
"""

from collections.abc import Iterator
from enum import IntEnum
from typing import Final, NamedTuple

HEADER: Final = b"\xff\xff\xfd\x00"
BROADCAST_ID: Final = 0xFE
ALERT: Final = 0x80
STATUS: Final = 0x55

_MAX_LENGTH: Final = 1024  # a longer length field is noise that looks like a header


class Instruction(IntEnum):
    """Instruction byte of a packet from a client."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Error(IntEnum):
    """Error number of a status packet."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


class Packet(NamedTuple):
    """A received packet; ``intact`` is False if its CRC is wrong."""

    id: int
    instruction: int
    params: bytes
    intact: bool = True


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC_TABLE: Final = _crc_table()


def crc16(data: bytes) -> int:
    """CRC-16 with polynomial 0x8005, most significant bit first."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def stuff(body: bytes) -> bytes:
    """Inserts stuffing bytes, so that no header pattern occurs in the body."""
    return body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")


def unstuff(body: bytes) -> bytes:
    """Removes the bytes that `stuff` inserted."""
    return body.replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")


def frame(id_: int, instruction: int, params: bytes = b"") -> bytes:
    """Returns a complete packet."""
    body = stuff(bytes((instruction,)) + params)
    head = HEADER + bytes((id_,)) + (len(body) + 2).to_bytes(2, "little") + body
    return head + crc16(head).to_bytes(2, "little")


def status(id_: int, error: int, params: bytes = b"") -> bytes:
    """Returns a complete status packet."""
    return frame(id_, STATUS, bytes((error,)) + params)


class Parser:
    """Extracts packets from a byte stream that may contain garbage and may be split anywhere."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Adds received bytes and yields every packet that is now complete."""
        self._buffer += data
        while (packet := self._next()) is not None:
            yield packet

    def _next(self) -> Packet | None:
        buffer = self._buffer
        while True:
            start = buffer.find(HEADER)
            if start < 0:
                del buffer[: max(0, len(buffer) - len(HEADER) + 1)]
                return None
            del buffer[:start]
            if len(buffer) < 7:
                return None
            length = int.from_bytes(buffer[5:7], "little")
            if 3 <= length <= _MAX_LENGTH:
                break
            del buffer[: len(HEADER)]
        if len(buffer) < 7 + length:
            return None
        raw = bytes(buffer[: 7 + length])
        intact = crc16(raw[:-2]) == int.from_bytes(raw[-2:], "little")
        # A corrupt length field may cover the next packet's header: search again right after this header.
        del buffer[: len(raw) if intact else len(HEADER)]
        body = unstuff(raw[7:-2])
        return Packet(raw[4], body[0], body[1:], intact)
