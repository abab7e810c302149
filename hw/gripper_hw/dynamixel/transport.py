"""Transactions with servos over the vendor's unmodified SDK: retried, counted, late replies rejected.

Protocol 2.0: https://emanual.robotis.com/docs/en/dxl/protocol2/.
"""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, TypeVar

from dynamixel_sdk import BROADCAST_ID, COMM_RX_CORRUPT, COMM_SUCCESS, PacketHandler
from dynamixel_sdk.protocol2_packet_handler import (
    ERRNUM_CRC,
    PKT_ERROR,
    PKT_ID,
    PKT_INSTRUCTION,
    PKT_LENGTH_H,
    PKT_LENGTH_L,
)

from gripper_force.config import ServoConfig
from gripper_force.errors import DeviceError, DeviceTimeoutError
from gripper_force.interfaces import BusStats, Lock, SharedPort
from gripper_hw.dynamixel.control_table import REGISTERS
from gripper_hw.dynamixel.port import BorrowedPort, Port, open_port

_READ_LENGTHS: Final = 8
"""A read requests 0 to 7 bytes more than it needs, in turn, so that a late reply to one of the seven previous
requests of as many bytes has another length. The longest request fills the 20 bytes of an XL330's indirect data."""

_REPLY_TO_ALL: Final = 2
"""Status Return Level: a reply to every instruction."""

_ERROR_MASK: Final = 0x7F  # bit 7 is the alert; the read block contains the full hardware error
_ERRORS: Final = ("result fail", "instruction", "crc", "data range", "data length", "data limit", "access")
"""Names of the error numbers, from 1 on."""

_T = TypeVar("_T")


class PortLockedError(DeviceTimeoutError):
    """The other user of a shared port did not release its lock in time; nothing was sent."""


class Transport:
    """Complete transactions with the servos on one port.

    Unless stated otherwise, every method makes up to ``1 + servo.retries`` attempts and raises
    `DeviceTimeoutError` without a valid reply, `DeviceLostError` if the port is gone, and `DeviceError` if a
    servo refused the request or the port is not open.

    Attributes:
        stats: Counters since construction.
    """

    def __init__(
        self,
        config: ServoConfig,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        shared: SharedPort | None = None,
    ) -> None:
        """Stores the configuration; `open` opens the port, or takes the shared one."""
        self.stats = BusStats()
        self._shared = shared
        self._lock: Lock = threading.Lock() if shared is None else shared.lock
        self._lock_timeout_s = config.bus_watchdog_ms / 1e3 / (config.retries + 1)
        self._config = config
        self._clock_ns = clock_ns
        self._packets = PacketHandler(2.0)
        self._port: Port | None = None
        self._request_count = 0

    def open(self, reply_margin_ms: float | None = None) -> None:
        """Opens the port.

        Args:
            reply_margin_ms: Reply timeout beyond the transmission time; None: as configured.

        Raises:
            ConfigError: The SDK does not support the baud rate.
            DeviceNotFoundError: The port does not exist.
            DeviceError: The port is in use, or a shared port is not open.
        """
        margin_ms = self._config.reply_margin_ms if reply_margin_ms is None else reply_margin_ms
        if self._shared is not None:
            self._port = BorrowedPort(self._config.port, self._shared.handler, margin_ms)
            return
        self._port = open_port(self._config.port, self._config.baud_rate, margin_ms)

    def close(self) -> None:
        """Releases the port. May be called twice."""
        if self._port is not None:
            self._port.closePort()
            self._port = None

    # Transactions with one servo.

    def ping(self, id_: int) -> int:
        """Returns the model number. Unlike other replies, a late one can be mistaken for a ping's reply."""
        description = f"a ping of servo {id_}"

        def attempt() -> tuple[int, int]:
            number, result, error = self._packets.ping(self._port, id_)
            return _check_result(description, result, error), number

        return self._transact(description, attempt)

    def get(self, id_: int, name: str) -> int:
        """Reads a register."""
        register = REGISTERS[name]
        return register.decode(self.read(id_, register.address, register.size))

    def set(self, id_: int, name: str, value: int, tries: int = 1) -> None:
        """Writes a register and reads it back, up to ``tries`` times; raises `DeviceError` if it differs."""
        register = REGISTERS[name]
        for tries_left in reversed(range(tries)):
            try:
                self.write(id_, register.address, register.encode(value))
                if self.get(id_, name) == value:
                    return
            except DeviceTimeoutError:
                if not tries_left:
                    raise
        raise DeviceError(f"servo {id_} did not keep {name} = {value}; power-cycle it and start again")

    def read(self, id_: int, address: int, size: int) -> bytes:
        """Reads ``size`` bytes at an address."""
        description = f"a read of {size} bytes at {address} of servo {id_}"

        def attempt() -> tuple[int, bytes]:
            requested = self._padded_size(size)
            sent = self._packets.readTx(self._port, id_, address, requested)
            result, reply = self._receive(sent, id_, 1 + requested)
            return _check_result(description, result, reply[0] if reply else 0), reply[1 : 1 + size]

        return self._transact(description, attempt)

    def write(self, id_: int, address: int, data: bytes) -> None:
        """Writes bytes at an address and waits for the servo's reply."""
        description = f"a write of {len(data)} bytes at {address} of servo {id_}"

        def attempt() -> tuple[int, None]:
            result, error = self._packets.writeTxRx(self._port, id_, address, len(data), data)
            return _check_result(description, result, error), None

        self._transact(description, attempt)

    def enable_replies(self, id_: int) -> None:
        """Sets Status Return Level to 2 by a sync write, which needs no reply: the level may be 0 before."""
        self.sync_write(REGISTERS["status_return_level"].address, {id_: bytes((_REPLY_TO_ALL,))})

    # Transactions with several servos.

    def scan(self) -> dict[int, tuple[int, int]]:
        """Returns id to model number and firmware of every servo that replies; a single attempt."""
        answers, _ = self._packets.broadcastPing(self._port)
        return {id_: (number, firmware) for id_, (number, firmware) in answers.items()}

    def sync_read(
        self, ids: Sequence[int], address: int, size: int, *, fast: bool = True
    ) -> tuple[int, list[bytes]]:
        """Reads ``size`` bytes of each servo in one transaction.

        Args:
            ids: Servos to read.
            address: Address of the first byte.
            size: Number of bytes.
            fast: True: a fast sync read, to which all servos reply in one packet. False: a sync read, to
                which each servo replies with its own packet, for older firmware.

        Returns:
            Time of the request in ns, and the bytes in the order of ``ids``.
        """
        description = "a fast sync read" if fast else "a sync read"

        def attempt() -> tuple[int, tuple[int, list[bytes]]]:
            t_ns = self._clock_ns()
            requested = self._padded_size(size)
            result = self._packets.syncReadTx(self._port, address, requested, ids, len(ids), fast)
            blocks = []
            if not fast:
                for id_ in ids:
                    result, reply = self._receive(result, id_, 1 + requested)
                    result = _check_result(description, result, reply[0] if reply else 0)
                    blocks.append(reply[1 : 1 + size])
                return result, (t_ns, blocks)
            step = requested + 4  # error number and id before a servo's data, CRC after it
            result, reply = self._receive(result, BROADCAST_ID, step * len(ids) - 2)
            if result == COMM_SUCCESS and reply[1::step] != bytes(ids):
                result = COMM_RX_CORRUPT
            starts = range(2, len(reply), step)
            return result, (t_ns, [reply[start : start + size] for start in starts])

        return self._transact(description, attempt)

    def sync_write(self, address: int, blocks: dict[int, bytes]) -> None:
        """Writes one block per servo, by id. All blocks have the same size; no servo replies."""
        (size,) = {len(block) for block in blocks.values()}
        params = b"".join(bytes((id_,)) + block for id_, block in blocks.items())

        def attempt() -> tuple[int, None]:
            result: int = self._packets.syncWriteTxOnly(self._port, address, size, params, len(params))
            return result, None

        self._transact("a sync write", attempt)

    # Attempts and replies.

    def _transact(self, description: str, attempt: Callable[[], tuple[int, _T]]) -> _T:
        """Repeats a transaction until it succeeds; ``attempt`` returns the SDK's result code and a value."""
        if self._port is None:
            raise DeviceError(
                f"the servo's port {self._config.port} is not open, so {description} was not sent; "
                "call start() first"
            )
        sent = False
        for number in range(self._config.retries + 1):
            self.stats.retries += number > 0
            if not self._lock.acquire(timeout=self._lock_timeout_s):
                self.stats.timeouts += 1
                continue
            sent = True
            try:
                self._port.is_using = False  # an interrupted transaction leaves it set
                try:
                    result, value = attempt()
                except IndexError:  # raised by the SDK for replies that are too short
                    result = COMM_RX_CORRUPT
                if result == COMM_SUCCESS:
                    return value
                if result == COMM_RX_CORRUPT:
                    self.stats.corrupt += 1
                else:
                    self.stats.timeouts += 1
                self._port.drain()  # the rest of a corrupt reply would collide with the next request
            finally:
                self._lock.release()
        if not sent:
            raise PortLockedError(
                f"{description} was not sent on {self._config.port}: its lock was not free for "
                f"{self._config.bus_watchdog_ms} ms; let its other user hold it for one transaction only"
            )
        raise DeviceTimeoutError(
            f"no valid reply to {description} on {self._config.port} after {self._config.retries + 1} tries; "
            "check cable, power, and that the adapter's latency timer is below servo.reply_margin_ms"
        )

    def _padded_size(self, size: int) -> int:
        """Number of bytes to request in order to read ``size``: see `_READ_LENGTHS`."""
        self._request_count += 1
        return size + self._request_count % _READ_LENGTHS

    def _receive(self, result: int, id_: int, size: int) -> tuple[int, bytes]:
        """Receives the reply to a request and skips late replies to earlier ones.

        The SDK's own reads compare only the id, and cut a reply to the expected length.

        Args:
            result: The SDK's result code of sending the request.
            id_: Id in the reply.
            size: Bytes of the reply from the error number on.

        Returns:
            The SDK's result code, and ``size`` bytes from the error number on, or only the error number if it
            is not 0.
        """
        while result == COMM_SUCCESS:
            packet, result = self._packets.rxPacket(self._port, id_ == BROADCAST_ID)
            if result != COMM_SUCCESS:
                break
            length = packet[PKT_LENGTH_L] | packet[PKT_LENGTH_H] << 8
            reply = bytes(packet[PKT_ERROR : PKT_INSTRUCTION + length - 2])
            complete = len(reply) == size or (len(reply) == 1 and reply[0] & _ERROR_MASK)
            if complete and packet[PKT_ID] == id_:
                return result, reply
        return result, b""


def _check_result(description: str, result: int, error: int) -> int:
    """Returns the SDK's result code; raises `DeviceError` if the servo reports an error other than CRC."""
    number = error & _ERROR_MASK
    if result != COMM_SUCCESS or number == 0:
        return result
    if number == ERRNUM_CRC:
        return int(COMM_RX_CORRUPT)  # the request was corrupted on the bus: retry
    name = _ERRORS[number - 1] if number <= len(_ERRORS) else "unknown"
    raise DeviceError(f"{description} was refused: error {number} ({name}); power-cycle the servo")
