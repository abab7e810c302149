"""Port of a virtual bus in this process. A separate module, so that a real servo does not import it."""

from collections.abc import Iterable
from typing import Final

from dynamixel_sdk import PortHandler

from gripper_force.errors import DeviceError, DeviceLostError, DeviceNotFoundError
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus


class MemoryPort(PortHandler):  # type: ignore[misc]
    """In-process port of a `VirtualBus`. Never sleeps: a reply is available at once, or never."""

    def __init__(self, name: str, bus_name: str) -> None:
        super().__init__(name)
        self._bus_name = bus_name
        self._received = bytearray()
        bus = find_bus(self._bus_name)
        if bus is None:
            raise DeviceNotFoundError(
                f"no virtual bus named {self._bus_name!r} is registered in this process; "
                "simulate one first, or set servo.port to a device path"
            )
        if bus in _in_use:
            raise DeviceError(f"the servo's port {name} is in use; close its other user first")
        self._bus: VirtualBus | None = bus
        _in_use.add(bus)

    def closePort(self) -> None:  # noqa: N802
        """Releases the bus. May be called twice."""
        self.is_using = False
        if self._bus is not None:
            _in_use.discard(self._bus)
            self._bus = None

    def clearPort(self) -> None:  # noqa: N802
        """Discards received bytes."""
        self._received.clear()

    def writePort(self, packet: Iterable[int]) -> int:  # noqa: N802
        """Sends a packet; the reply has arrived when this returns."""
        if self._bus is None or find_bus(self._bus_name) is not self._bus:
            self.closePort()  # like a device file: after it is plugged in again it must be reopened
            raise DeviceLostError(f"the virtual bus {self._bus_name!r} is gone; start again")
        data = bytes(packet)
        self._received += self._bus.transact(data)
        return len(data)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Returns up to ``length`` bytes."""
        data = bytes(self._received[: max(0, length)])
        del self._received[: len(data)]
        return data

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Returns True once all received bytes were read: no more will arrive."""
        return not self._received

    def drain(self) -> None:
        """Discards received bytes."""
        self._received.clear()


_in_use: Final[set[VirtualBus]] = set()
