"""What a servo bus cycle costs, by the driver and by what others use."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from gripper_force.backends import BUS_COST, load

BUS_SETTINGS: Final = tuple(
    (baud_rate, latency_ms) for latency_ms in (0.0, 1.0) for baud_rate in (1_000_000, 2_000_000, 4_000_000)
)
"""Bits a second, and how much later than on the wire an answer comes out of the adapter."""


@dataclass(frozen=True, slots=True)
class BusCost:
    """What a cycle takes, a read of two servos and a write of their goals, by one client at one setting.

    Attributes:
        client: ``driver``; ``plain SDK``, GroupSyncRead and GroupSyncWrite over the SDK's own port, as in its
            examples; or ``bare bytes``, packets made beforehand: what this machine takes to carry them.
        baud_rate: Bits a second.
        latency_ms: See `BUS_SETTINGS`.
        line_ms: What the line alone takes: the bytes' own time, and the latency.
        p50_ms: Median of a cycle, back to back with the next.
        p99_ms: 99th percentile of it.
        cpu_share: Share of one CPU that the client takes at 200 cycles a second.
    """

    client: str
    baud_rate: int
    latency_ms: float
    line_ms: float
    p50_ms: float
    p99_ms: float
    cpu_share: float


def bus(cycles: int) -> Iterator[tuple[BusCost, ...]]:
    """Measures the servo's driver, beside what `BusCost` names, setting by setting.

    Args:
        cycles: How many of each client at each setting.

    Raises:
        DeviceError: The driver gave the line up, on a machine that is far too busy.
    """
    for baud_rate, latency_ms in BUS_SETTINGS:
        yield load(BUS_COST)(baud_rate, latency_ms, cycles)
