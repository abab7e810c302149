"""Transactions with servos over the vendor's unmodified SDK: retried, counted, and never given a late answer.

Protocol 2.0: https://emanual.robotis.com/docs/en/dxl/protocol2/.
"""

import time
from collections.abc import Callable, Sequence
from typing import Final, TypeVar

from dynamixel_sdk import COMM_RX_CORRUPT, COMM_SUCCESS, PacketHandler
from dynamixel_sdk.protocol2_packet_handler import (
    PKT_ERROR,
    PKT_ID,
    PKT_INSTRUCTION,
    PKT_LENGTH_H,
    PKT_LENGTH_L,
)

from gripper_force.config import ServoConfig
from gripper_force.errors import DeviceError, DeviceTimeoutError
from gripper_force.interfaces import BusStats
from gripper_hw.dynamixel.control_table import REGISTERS
from gripper_hw.dynamixel.packets import BROADCAST_ID
from gripper_hw.dynamixel.port import Port, open_port

_LENGTHS: Final = 8
"""A read asks for 0 to 7 bytes more than it needs, each time another number: an answer to one of the seven
requests before has another length. The most fills the 20 bytes of an XL330's indirect data."""

_ANSWER_ALL: Final = 2
"""Status Return Level: an answer to every instruction."""

_ERROR_CRC: Final = 3
_ERROR_MASK: Final = 0x7F  # the bit above is the alert, which the read block tells in full
_ERRORS: Final = {
    1: "result fail",
    2: "instruction error",
    4: "data range error",
    5: "data length error",
    6: "data limit error",
    7: "access error",
}

_T = TypeVar("_T")


class Transport:
    """A port, and whole transactions with the servos on it.

    Where nothing else is said, each method tries as often as the configuration says and raises
    `DeviceTimeoutError` where no sound answer came, `DeviceLostError` where the port is gone, and
    `DeviceError` where a servo refused, or the line is not open.

    Attributes:
        stats: Counters since construction.
    """

    def __init__(self, config: ServoConfig, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Takes note of the port; `open` opens it."""
        self.stats = BusStats()
        self._config = config
        self._clock_ns = clock_ns
        self._packets = PacketHandler(2.0)
        self._port: Port | None = None
        self._requests = 0

    def open(self, reply_margin_ms: float | None = None) -> None:
        """Opens the port.

        Args:
            reply_margin_ms: How long to wait for an answer beyond its bytes' time; None: as configured.

        Raises:
            DeviceNotFoundError: The port is not there.
            DeviceError: It is in use.
        """
        margin_ms = self._config.reply_margin_ms if reply_margin_ms is None else reply_margin_ms
        self._port = open_port(self._config.port, self._config.baud_rate, margin_ms)

    def close(self) -> None:
        """Releases the port. May be called twice."""
        if self._port is not None:
            self._port.closePort()
            self._port = None

    # One servo.

    def ping(self, id_: int) -> int:
        """The model number. An answer that comes late can pass for a ping's, and for no other's."""
        what = f"a ping of servo {id_}"

        def once() -> tuple[int, int]:
            number, result, error = self._packets.ping(self._port, id_)
            return _checked(what, result, error), number

        return self._transact(what, once)

    def get(self, id_: int, name: str) -> int:
        """Reads a register."""
        register = REGISTERS[name]
        return register.decode(self.read(id_, register.address, register.size))

    def set(self, id_: int, name: str, value: int, tries: int = 1) -> None:
        """Writes a register and reads it back, up to so many times; raises `DeviceError` if it differs."""
        register = REGISTERS[name]
        for left in reversed(range(tries)):
            try:
                self.write(id_, register.address, register.encode(value))
                if self.get(id_, name) == value:
                    return
            except DeviceTimeoutError:
                if not left:
                    raise
        raise DeviceError(f"servo {id_} did not keep {name} = {value}; power-cycle it and start again")

    def read(self, id_: int, address: int, size: int) -> bytes:
        """Reads ``size`` bytes at an address."""
        what = f"a read of {size} bytes at {address} of servo {id_}"

        def once() -> tuple[int, bytes]:
            asked = self._length(size)
            sent = self._packets.readTx(self._port, id_, address, asked)
            result, answer = self._answer(sent, id_, 1 + asked)
            return _checked(what, result, answer[0] if answer else 0), answer[1 : 1 + size]

        return self._transact(what, once)

    def write(self, id_: int, address: int, data: bytes) -> None:
        """Writes bytes at an address, and waits for the servo to say that it took them."""
        what = f"a write of {len(data)} bytes at {address} of servo {id_}"

        def once() -> tuple[int, None]:
            result, error = self._packets.writeTxRx(self._port, id_, address, len(data), data)
            return _checked(what, result, error), None

        self._transact(what, once)

    def ask_for_answers(self, id_: int) -> None:
        """Another program may have left the servo mute; a sync write is a write that awaits no answer."""
        self.sync_write(REGISTERS["status_return_level"].address, {id_: bytes((_ANSWER_ALL,))})

    # All servos at once.

    def scan(self) -> dict[int, tuple[int, int]]:
        """Id to model number and firmware of all that answer; tried once."""
        found, _ = self._packets.broadcastPing(self._port)
        return {id_: (number, firmware) for id_, (number, firmware) in found.items()}

    def sync_read(self, ids: Sequence[int], address: int, size: int) -> tuple[int, list[bytes]]:
        """Reads ``size`` bytes of each servo by one fast sync read.

        Returns:
            When the answer was asked for, and the bytes in the order of ``ids``.
        """

        def once() -> tuple[int, tuple[int, list[bytes]]]:
            t_ns = self._clock_ns()
            asked = self._length(size)
            sent = self._packets.syncReadTx(self._port, address, asked, ids, len(ids), True)
            step = asked + 4  # error number and id come before a servo's data, a CRC after
            result, answer = self._answer(sent, BROADCAST_ID, step * len(ids) - 2)
            if result == COMM_SUCCESS and answer[1::step] != bytes(ids):
                result = COMM_RX_CORRUPT
            starts = range(2, len(answer), step)
            return result, (t_ns, [answer[start : start + size] for start in starts])

        return self._transact("a fast sync read", once)

    def sync_write(self, address: int, blocks: dict[int, bytes]) -> None:
        """Writes a block of the same size to each servo, by id; none answers."""
        (size,) = {len(block) for block in blocks.values()}
        params = b"".join(bytes((id_,)) + block for id_, block in blocks.items())

        def once() -> tuple[int, None]:
            result: int = self._packets.syncWriteTxOnly(self._port, address, size, params, len(params))
            return result, None

        self._transact("a sync write", once)

    # How a transaction goes.

    def _transact(self, what: str, once: Callable[[], tuple[int, _T]]) -> _T:
        """Tries a transaction until it succeeds; ``once`` returns the SDK's result code and a value."""
        if self._port is None:
            raise DeviceError(
                f"the servo's port {self._config.port} is not open, so {what} was not sent; start first"
            )
        for attempt in range(self._config.retries + 1):
            self.stats.retries += attempt > 0
            self._port.is_using = False  # an interrupted transaction would leave it set for ever
            try:
                result, value = once()
            except IndexError:  # the SDK indexes into answers that are too short
                result = COMM_RX_CORRUPT
            if result == COMM_SUCCESS:
                return value
            if result == COMM_RX_CORRUPT:
                self.stats.corrupt += 1
            else:
                self.stats.timeouts += 1
            self._port.drain()  # or the rest of a damaged answer would meet the next request on the line
        raise DeviceTimeoutError(
            f"no sound answer to {what} on {self._config.port} after {self._config.retries + 1} tries; check "
            "cable, power, and that the adapter's latency timer is below servo.reply_margin_ms"
        )

    def _length(self, size: int) -> int:
        """How many bytes a read asks for to get ``size``: see `_LENGTHS`."""
        self._requests += 1
        return size + self._requests % _LENGTHS

    def _answer(self, sent: int, id_: int, size: int) -> tuple[int, bytes]:
        """Listens for the answer to what was ``sent``, and passes over those to requests before.

        The SDK's own reads compare the id alone, and cut an answer to the length that they look for.

        Returns:
            The SDK's result code, and ``size`` bytes from the error number on; or 1, where that is no 0.
        """
        result = sent
        while result == COMM_SUCCESS:
            packet, result = self._packets.rxPacket(self._port, id_ == BROADCAST_ID)
            if result != COMM_SUCCESS:
                break
            length = packet[PKT_LENGTH_L] | packet[PKT_LENGTH_H] << 8
            answer = bytes(packet[PKT_ERROR : PKT_INSTRUCTION + length - 2])
            whole = len(answer) == size or (len(answer) == 1 and answer[0] & _ERROR_MASK)
            if whole and packet[PKT_ID] == id_:
                return result, answer
        return result, b""


def _checked(what: str, result: int, error: int) -> int:
    """The SDK's result code, where the servo's own error number is no reason to raise `DeviceError`."""
    number = error & _ERROR_MASK
    if result != COMM_SUCCESS or number == 0:
        return result
    if number == _ERROR_CRC:
        return int(COMM_RX_CORRUPT)  # our packet was damaged on its way: worth another try
    raise DeviceError(f"{what} was refused: {_ERRORS.get(number, f'error {number}')}")
