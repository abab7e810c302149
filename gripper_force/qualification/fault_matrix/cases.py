"""Rows of the fault matrix: each fault, and the expected reaction."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class Expected(StrEnum):
    """Expected reaction to a fault."""

    STOP = "stop, latched"
    STOP_OR_CARRY_ON = "retries succeed, or stop"
    CURRENT_ALONE = "current alone"
    CURRENT_LIMIT = "current limit holds"
    CURRENT_LOWERED = "current lowered"
    COMPARISON_INVALID = "control unchanged, comparison marked invalid"
    NO_EFFECT = "no effect"
    CARRY_ON = "control continues, losses counted"
    WATCHDOG = "servo watchdog trips"


@dataclass(frozen=True, slots=True)
class FaultCase:
    """A row of the matrix.

    Attributes:
        name: Name of the fault.
        unit: Failing unit, a key of `gripper_force.fault_config.FAULTS`; ``process`` for a signal.
        kind: Kind of failure in `FAULTS`; for ``process`` the signal's name.
        expected: Expected reaction.
        within_ms: Time limit of the reaction; None if only the reaction counts.
        for_s: Duration of the fault.
    """

    name: str
    unit: str
    kind: str
    expected: Expected
    within_ms: float | None
    for_s: float = 1.0


_CYCLE_MS: Final = 5.0
"""Control cycle at 200 Hz."""

_SILENCE_MS: Final = 60.0
"""Time of servo.bus_watchdog_ms, 40 ms, after which a servo that does not answer ends the run, with the tries and
a cycle."""

_TWO_FRAMES_MS: Final = 2e3 / 60 + _CYCLE_MS
"""Two frame periods at 60 Hz, and a cycle."""

_THREE_FRAMES_MS: Final = 3e3 / 60 + _CYCLE_MS

ROWS: Final = (
    FaultCase("process killed", "process", "SIGKILL", Expected.WATCHDOG, 60.0),
    FaultCase("process stopped", "process", "SIGSTOP", Expected.WATCHDOG, 60.0),
    FaultCase("control loop blocked", "clock", "stuck", Expected.STOP, None, 0.5),
    FaultCase("bus: adapter unplugged", "bus", "off", Expected.STOP, 20.0),
    FaultCase("bus: answers corrupted", "bus", "garbage", Expected.STOP, _SILENCE_MS),
    FaultCase("bus: answers with another id", "bus", "wrong", Expected.STOP, _SILENCE_MS),
    FaultCase("bus: answers too late", "bus", "slow", Expected.STOP, _SILENCE_MS),
    FaultCase("bus: answers one request behind", "bus", "delayed", Expected.STOP, _SILENCE_MS),
    FaultCase("bus: half of the answers lost", "bus", "intermittent", Expected.STOP_OR_CARRY_ON, None),
    FaultCase("servo: hardware error", "servo", "wrong", Expected.STOP, _CYCLE_MS),
    FaultCase("servo: watchdog at -1", "servo", "stuck", Expected.STOP, _CYCLE_MS),
    FaultCase("servo: power lost", "servo", "off", Expected.STOP, _SILENCE_MS),
    FaultCase("servo: brownout, RAM reset", "servo", "intermittent", Expected.STOP, _SILENCE_MS),
    FaultCase("camera: no frames", "camera", "off", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: frozen image", "camera", "stuck", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: 5 frames a second", "camera", "slow", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: frames 0.3 s late", "camera", "delayed", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: most frames lost", "camera", "intermittent", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: noise", "camera", "garbage", Expected.CURRENT_ALONE, _THREE_FRAMES_MS),
    FaultCase("camera: wrong exposure", "camera", "wrong", Expected.CURRENT_ALONE, _THREE_FRAMES_MS),
    FaultCase("estimator: not finite", "estimator", "garbage", Expected.CURRENT_ALONE, _CYCLE_MS),
    FaultCase("estimator: exception", "estimator", "off", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("estimator: hangs", "estimator", "stuck", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("estimator: a third too low", "estimator", "wrong", Expected.CURRENT_LIMIT, None),
    FaultCase("load cell: no samples", "load_cell", "off", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: stuck", "load_cell", "stuck", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: garbage", "load_cell", "garbage", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: saturated", "load_cell", "wrong", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: 2 samples a second", "load_cell", "slow", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: 0.5 s late", "load_cell", "delayed", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: intermittent", "load_cell", "intermittent", Expected.COMPARISON_INVALID, 400.0),
    FaultCase("over-force: motor too strong", "plant", "wrong", Expected.CURRENT_LOWERED, 10.0, 2.0),
    FaultCase("wall clock jumps", "clock", "wrong", Expected.NO_EFFECT, None),
    FaultCase("disk full", "disk", "off", Expected.CARRY_ON, None),
    FaultCase("disk: I/O errors", "disk", "intermittent", Expected.CARRY_ON, None),
    FaultCase("disk slow", "disk", "slow", Expected.CARRY_ON, None),
)
"""Rows of the matrix, in the order of docs/reliability.md."""
