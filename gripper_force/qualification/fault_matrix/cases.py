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
class Row:
    """A line of the matrix.

    Attributes:
        name: What breaks.
        unit: Of `gripper_force.config.FAULTS`; ``process`` for a signal.
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
    Row("process killed", "process", "SIGKILL", Expected.WATCHDOG, 60.0),
    Row("process stopped", "process", "SIGSTOP", Expected.WATCHDOG, 60.0),
    Row("control loop wedged", "clock", "stuck", Expected.STOP, None, 0.5),
    Row("bus: adapter unplugged", "bus", "off", Expected.STOP, 20.0),
    Row("bus: answers corrupted", "bus", "garbage", Expected.STOP, 20.0),
    Row("bus: answers with another id", "bus", "wrong", Expected.STOP, 20.0),
    Row("bus: answers too late", "bus", "slow", Expected.STOP, 20.0),
    Row("bus: answers one request behind", "bus", "delayed", Expected.STOP, 20.0),
    Row("bus: half of the answers lost", "bus", "intermittent", Expected.STOP_OR_CARRY_ON, None),
    Row("servo: hardware error", "servo", "wrong", Expected.STOP, _CYCLE_MS),
    Row("servo: watchdog at -1", "servo", "stuck", Expected.STOP, _CYCLE_MS),
    Row("servo: power lost", "servo", "off", Expected.STOP, 20.0),
    Row("servo: brownout, RAM reset", "servo", "intermittent", Expected.STOP, 20.0),
    Row("camera: no frames", "camera", "off", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: picture stands still", "camera", "stuck", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: 5 frames a second", "camera", "slow", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: frames 0.3 s late", "camera", "delayed", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: most frames lost", "camera", "intermittent", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: noise", "camera", "garbage", Expected.CURRENT_ALONE, _THREE_FRAMES_MS),
    Row("camera: wrong exposure", "camera", "wrong", Expected.CURRENT_ALONE, _THREE_FRAMES_MS),
    Row("estimator: not finite", "estimator", "garbage", Expected.CURRENT_ALONE, _CYCLE_MS),
    Row("estimator: exception", "estimator", "off", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("estimator: hangs", "estimator", "stuck", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("estimator: a third too low", "estimator", "wrong", Expected.CAP, None),
    Row("load cell: no samples", "load_cell", "off", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: stuck", "load_cell", "stuck", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: garbage", "load_cell", "garbage", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: saturated", "load_cell", "wrong", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: 2 samples a second", "load_cell", "slow", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: 0.5 s late", "load_cell", "delayed", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: comes and goes", "load_cell", "intermittent", Expected.COMPARISON_INVALID, 400.0),
    Row("over-force: motor gives too much", "plant", "wrong", Expected.EASED, 10.0, 2.0),
    Row("wall clock jumps", "clock", "wrong", Expected.NO_EFFECT, None),
    Row("disk full", "disk", "off", Expected.CARRY_ON, None),
    Row("disk: I/O errors", "disk", "intermittent", Expected.CARRY_ON, None),
    Row("disk slow", "disk", "slow", Expected.CARRY_ON, None),
)
