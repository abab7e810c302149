"""What may break in a grasp, and what is to follow."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class Expected(StrEnum):
    """What is to follow from a fault."""

    STOP = "stop, latched"
    STOP_OR_CARRY_ON = "retries carry it, or stop"
    CURRENT_ALONE = "current alone"
    CAP = "the current's cap holds"
    EASED = "eased"
    COMPARISON_INVALID = "control unchanged, comparison marked invalid"
    NO_EFFECT = "no effect"
    CARRY_ON = "control goes on, losses counted"
    WATCHDOG = "the servo's watchdog trips"


@dataclass(frozen=True, slots=True)
class FaultCase:
    """A line of the matrix.

    Attributes:
        name: What breaks.
        unit: Of `gripper_force.fault_config.FAULTS`; ``process`` for a signal.
        kind: Likewise; or the signal's name.
        expected: What is to follow.
        within_ms: In which time; None where only what follows counts.
        for_s: How long the fault lasts.
    """

    name: str
    unit: str
    kind: str
    expected: Expected
    within_ms: float | None
    for_s: float = 1.0


_CYCLE_MS = 5.0
_TWO_FRAMES_MS = 2e3 / 60 + _CYCLE_MS
_THREE_FRAMES_MS = 3e3 / 60 + _CYCLE_MS

ROWS: Final = (
    FaultCase("process killed", "process", "SIGKILL", Expected.WATCHDOG, 60.0),
    FaultCase("process stopped", "process", "SIGSTOP", Expected.WATCHDOG, 60.0),
    FaultCase("control loop wedged", "clock", "stuck", Expected.STOP, None, 0.5),
    FaultCase("bus: adapter unplugged", "bus", "off", Expected.STOP, 20.0),
    FaultCase("bus: answers corrupted", "bus", "garbage", Expected.STOP, 20.0),
    FaultCase("bus: answers with another id", "bus", "wrong", Expected.STOP, 20.0),
    FaultCase("bus: answers too late", "bus", "slow", Expected.STOP, 20.0),
    FaultCase("bus: answers one request behind", "bus", "delayed", Expected.STOP, 20.0),
    FaultCase("bus: half of the answers lost", "bus", "intermittent", Expected.STOP_OR_CARRY_ON, None),
    FaultCase("servo: hardware error", "servo", "wrong", Expected.STOP, _CYCLE_MS),
    FaultCase("servo: watchdog at -1", "servo", "stuck", Expected.STOP, _CYCLE_MS),
    FaultCase("servo: power lost", "servo", "off", Expected.STOP, 20.0),
    FaultCase("servo: brownout, RAM reset", "servo", "intermittent", Expected.STOP, 20.0),
    FaultCase("camera: no frames", "camera", "off", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: picture stands still", "camera", "stuck", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: 5 frames a second", "camera", "slow", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: frames 0.3 s late", "camera", "delayed", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: most frames lost", "camera", "intermittent", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("camera: noise", "camera", "garbage", Expected.CURRENT_ALONE, _THREE_FRAMES_MS),
    FaultCase("camera: wrong exposure", "camera", "wrong", Expected.CURRENT_ALONE, _THREE_FRAMES_MS),
    FaultCase("estimator: not finite", "estimator", "garbage", Expected.CURRENT_ALONE, _CYCLE_MS),
    FaultCase("estimator: exception", "estimator", "off", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("estimator: hangs", "estimator", "stuck", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    FaultCase("estimator: a third too low", "estimator", "wrong", Expected.CAP, None),
    FaultCase("load cell: no samples", "load_cell", "off", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: stuck", "load_cell", "stuck", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: garbage", "load_cell", "garbage", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: saturated", "load_cell", "wrong", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: 2 samples a second", "load_cell", "slow", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: 0.5 s late", "load_cell", "delayed", Expected.COMPARISON_INVALID, 100.0),
    FaultCase("load cell: comes and goes", "load_cell", "intermittent", Expected.COMPARISON_INVALID, 400.0),
    FaultCase("over-force: motor gives too much", "plant", "wrong", Expected.EASED, 10.0, 2.0),
    FaultCase("wall clock jumps", "clock", "wrong", Expected.NO_EFFECT, None),
    FaultCase("disk full", "disk", "off", Expected.CARRY_ON, None),
    FaultCase("disk: I/O errors", "disk", "intermittent", Expected.CARRY_ON, None),
    FaultCase("disk slow", "disk", "slow", Expected.CARRY_ON, None),
)
