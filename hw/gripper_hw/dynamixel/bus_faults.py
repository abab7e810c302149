"""Faults of servo, bus and plant on a virtual bus (see `gripper_force.fault_config.FAULTS`)."""

import random
from collections import deque
from typing import Final

from gripper_force.fault_injection import Faults
from gripper_force.types import NS_PER_MS, NS_PER_S
from gripper_hw.dynamixel.firmware import OVERLOAD_ERROR, REBOOT_NS, VirtualServo
from gripper_hw.dynamixel.packets import BROADCAST_ID, crc16
from gripper_hw.dynamixel.virtual import VirtualBus

_REQUESTS_LATE: Final = {"delayed": 1, "slow": 3}
_LOST_SHARE: Final = 0.5
_CUT_NS: Final = 5 * NS_PER_MS
_CUT_PERIOD_NS: Final = 300 * NS_PER_MS
_EXCESS_PER_S: Final = 0.5


class WireFaults:
    """Tampers with what a bus answers, and lets its servos fail."""

    def __init__(self, bus: VirtualBus, faults: Faults, seed: int) -> None:
        """Takes hold of a bus's hooks.

        Args:
            bus: Its time is the run's, counted from ``faults.start_ns``.
            faults: What fails when.
            seed: Tells which answers are lost, and how they are damaged.
        """
        self._bus = bus
        self._line, self._servo, self._plant = (_Fault(faults, unit) for unit in ("bus", "servo", "plant"))
        self._random = random.Random(seed)
        self._late: deque[bytes] = deque()
        bus.before_packet = lambda: self.update(bus.clock_ns())
        bus.tamper = self._tamper
        bus.is_unplugged = lambda: self._line.at(bus.clock_ns()) == "off"

    def update(self, t_ns: int) -> None:
        """Makes of the servos what their faults leave of them. Call it with the bus's lock held."""
        kind, plant = self._servo.at(t_ns), self._plant.at(t_ns)
        excess = _EXCESS_PER_S * (t_ns - self._plant.since_ns) / NS_PER_S if plant == "wrong" else 0.0
        is_cut = kind == "off" or (
            kind == "intermittent" and (t_ns - self._servo.since_ns) % _CUT_PERIOD_NS < _CUT_NS
        )
        for servo in self._bus.servos:
            servo.excess = excess
            if is_cut:
                _cut_power(servo, t_ns)
            elif kind == "stuck":
                servo.set("bus_watchdog", -1)
            elif kind == "wrong":
                servo.raise_hardware_error(OVERLOAD_ERROR)

    def _tamper(self, answer: bytes) -> bytes | None:
        kind = self._line.at(self._bus.clock_ns())
        if kind in _REQUESTS_LATE:
            self._late.append(answer)
            return self._late.popleft() if len(self._late) > _REQUESTS_LATE[kind] else None
        self._late.clear()
        match kind:
            case "garbage":
                return self._damaged(answer)
            case "wrong":
                return _from_another(answer)
            case "intermittent" if self._random.random() < _LOST_SHARE:
                return None
        return answer

    def _damaged(self, answer: bytes) -> bytes:
        """One byte; of damage to more the checksum lets one in 65,536 pass."""
        at = self._random.randrange(len(answer))
        return answer[:at] + bytes((answer[at] ^ self._random.randrange(1, 256),)) + answer[at + 1 :]


class _Fault:
    """What one unit suffers.

    Attributes:
        since_ns: Since when.
    """

    def __init__(self, faults: Faults, unit: str) -> None:
        self.since_ns = 0
        self._faults, self._unit, self._kind = faults, unit, "ok"

    def at(self, t_ns: int) -> str:
        """Its kind, which is ``ok`` where there is none."""
        kind = self._faults.active(self._unit, self._faults.start_ns + t_ns)
        if kind != self._kind:
            self._kind, self.since_ns = kind, t_ns
        return kind


def _cut_power(servo: VirtualServo, t_ns: int) -> None:
    if t_ns >= servo.silent_until_ns:
        servo.reboot(t_ns)
    servo.silent_until_ns = t_ns + REBOOT_NS  # it starts once its power is back


def _from_another(answer: bytes) -> bytes:
    """The answer, sound, with the next id: in a fast one's first block, which names no servo in its head."""
    data = bytearray(answer[:-2])
    at = 9 if data[4] == BROADCAST_ID else 4
    data[at] = (data[at] + 1) % BROADCAST_ID
    return bytes(data) + crc16(bytes(data)).to_bytes(2, "little")
