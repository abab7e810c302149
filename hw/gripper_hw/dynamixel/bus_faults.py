"""Injects the faults of servo, bus and plant into a virtual bus (see `gripper_force.fault_config.FAULTS`)."""

import random
from collections import deque
from typing import Final

from gripper_force.types import NS_PER_MS, NS_PER_S
from gripper_hw.dynamixel.firmware import OVERLOAD_ERROR, REBOOT_NS, VirtualServo
from gripper_hw.dynamixel.packets import BROADCAST_ID, crc16
from gripper_hw.dynamixel.virtual import VirtualBus
from gripper_hw.fault_injection import Faults

# As `gripper_force.fault_config.FAULTS` describes them.
_DELAY_REQUESTS: Final = {"delayed": 1, "slow": 3}
_LOST_SHARE: Final = 0.5
_CUT_NS: Final = 5 * NS_PER_MS
_CUT_PERIOD_NS: Final = 300 * NS_PER_MS
_EXCESS_PER_S: Final = 0.5


class WireFaults:
    """Faults of one bus: changes its replies and makes its servos fail."""

    def __init__(self, bus: VirtualBus, faults: Faults, seed: int) -> None:
        """Installs the fault hooks of a bus.

        Args:
            bus: The bus; its clock is the run's, counted from ``faults.start_ns``.
            faults: Faults over time.
            seed: Seed for which replies are lost and how they are corrupted.
        """
        self._bus = bus
        self._wire = _ActiveFault(faults, "bus")
        self._of_servos = [
            (servo, _ActiveFault(faults, "servo", servo.id), _ActiveFault(faults, "plant", servo.id))
            for servo in bus.servos
        ]
        self._random = random.Random(seed)
        self._delayed: deque[bytes] = deque()
        bus.before_packet = lambda: self.update(bus.clock_ns())
        bus.tamper = self._tamper
        bus.is_unplugged = lambda: self._wire.at(bus.clock_ns()) == "off"

    def update(self, t_ns: int) -> None:
        """Applies the active faults to the servos. Call it with the bus's lock held."""
        for servo, fault, plant in self._of_servos:
            kind, is_excess = fault.at(t_ns), plant.at(t_ns) == "wrong"
            since_s = (t_ns - plant.since_ns) / NS_PER_S
            servo.excess_current_ratio = _EXCESS_PER_S * since_s if is_excess else 0.0
            if kind == "off" or (
                kind == "intermittent" and (t_ns - fault.since_ns) % _CUT_PERIOD_NS < _CUT_NS
            ):
                _cut_power(servo, t_ns)
            elif kind == "stuck":
                servo.set("bus_watchdog", -1)
            elif kind == "wrong":
                servo.raise_hardware_error(OVERLOAD_ERROR)

    def _tamper(self, reply: bytes) -> bytes | None:
        kind = self._wire.at(self._bus.clock_ns())
        if kind in _DELAY_REQUESTS:
            self._delayed.append(reply)
            return self._delayed.popleft() if len(self._delayed) > _DELAY_REQUESTS[kind] else None
        self._delayed.clear()
        match kind:
            case "garbage":
                return self._corrupted(reply)
            case "wrong":
                return _with_next_id(reply)
            case "intermittent" if self._random.random() < _LOST_SHARE:
                return None
        return reply

    def _corrupted(self, reply: bytes) -> bytes:
        """Changes one byte. With more, the CRC would miss one corruption in 65,536."""
        index = self._random.randrange(len(reply))
        return reply[:index] + bytes((reply[index] ^ self._random.randrange(1, 256),)) + reply[index + 1 :]


class _ActiveFault:
    """Active fault of one unit, or of one servo.

    Attributes:
        since_ns: Time at which it became active.
    """

    def __init__(self, faults: Faults, unit: str, servo_id: int | None = None) -> None:
        self.since_ns = 0
        self._faults, self._unit, self._servo_id, self._kind = faults, unit, servo_id, "ok"

    def at(self, t_ns: int) -> str:
        """Returns its kind, ``ok`` without a fault."""
        kind = self._faults.active(self._unit, self._faults.start_ns + t_ns, self._servo_id)
        if kind != self._kind:
            self._kind, self.since_ns = kind, t_ns
        return kind


def _cut_power(servo: VirtualServo, t_ns: int) -> None:
    if t_ns >= servo.silent_until_ns:
        servo.reboot(t_ns)
    servo.silent_until_ns = t_ns + REBOOT_NS  # it boots once its power is back


def _with_next_id(reply: bytes) -> bytes:
    """Returns the reply with the next id and a valid CRC; a fast reply has its id in the first block."""
    data = bytearray(reply[:-2])
    index = 9 if data[4] == BROADCAST_ID else 4
    data[index] = (data[index] + 1) % BROADCAST_ID
    return bytes(data) + crc16(bytes(data)).to_bytes(2, "little")
