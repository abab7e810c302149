"""Fault injection: schedule of the faults, and faults of estimator and disk.

`gripper_force.fault_config.FAULTS` lists the kinds of each unit; the simulated devices carry out the others.
"""

import errno
import math
import os
from collections.abc import Sequence
from typing import Any, BinaryIO

from gripper_force.fault_config import FaultConfig
from gripper_force.interfaces import Clock
from gripper_force.types import NS_PER_MS, NS_PER_S, ForceEstimate, Gray

_WRONG_GAIN = 2 / 3
"""Gain of a wrong estimator."""

_SLOW_WRITE_NS = 50 * NS_PER_MS
"""Time of each write to a slow disk."""


class Faults:
    """Schedule of the faults of one run.

    Attributes:
        start_ns: Start of the run on its clock.
    """

    def __init__(self, faults: Sequence[FaultConfig] = (), start_ns: int = 0) -> None:
        self.start_ns = start_ns
        self._faults = [
            (fault, start_ns + round(fault.at_s * NS_PER_S), start_ns + _ns(fault.at_s + fault.for_s))
            for fault in faults
        ]

    def has(self, unit: str) -> bool:
        """Returns True if the unit has a fault at any time."""
        return any(fault.unit == unit for fault, _, _ in self._faults)

    def active(self, unit: str, t_ns: int, servo_id: int | None = None) -> str:
        """Returns the kind of the fault of a unit, or of one servo, or ``ok``. The last one listed has priority."""
        for fault, begin_ns, end_ns in reversed(self._faults):
            if fault.unit == unit and begin_ns <= t_ns < end_ns and fault.id in (None, servo_id):
                return fault.kind
        return "ok"

    def end_ns(self, unit: str, t_ns: int) -> int:
        """Returns the end of the fault that the unit has at a time, or that time if it has none."""
        ends = (end for fault, begin, end in self._faults if fault.unit == unit and begin <= t_ns < end)
        return max(ends, default=t_ns)


class FaultyEstimator:
    """Wrapper that makes an estimator fail as configured."""

    def __init__(self, estimator: Any, faults: Faults, clock: Clock, *, lockstep: bool) -> None:
        self._estimator, self._faults, self._clock, self._lockstep = estimator, faults, clock, lockstep
        self._calls = 0

    def renew_reference(self) -> None:
        """Renews the reference of the wrapped estimator."""
        self._estimator.renew_reference()

    def attention_map(self) -> Any:
        """Returns the attention map of the wrapped estimator."""
        return self._estimator.attention_map()

    def update(self, gray: Gray) -> ForceEstimate | None:
        """Passes the next frame to the estimator and returns its estimate with the active fault applied."""
        now_ns = self._clock.now_ns()
        kind = self._faults.active("estimator", now_ns)
        self._calls += 1
        if kind == "off" or (kind == "intermittent" and self._calls % 2):
            raise RuntimeError("injected fault: the estimator fails")
        if kind == "stuck":
            if not self._lockstep:  # lockstep time would not advance
                self._clock.sleep_until_ns(self._faults.end_ns("estimator", now_ns))
            return None
        estimate: ForceEstimate | None = self._estimator.update(gray)
        if estimate is None or kind not in ("garbage", "wrong"):
            return estimate
        force_n = _WRONG_GAIN * estimate.force_n
        if kind == "garbage":
            force_n = (math.nan, math.inf, -math.inf)[self._calls % 3]
        return ForceEstimate(force_n, estimate.std_n)


class FaultyFile:
    """Wrapper of a log file that fails as configured."""

    def __init__(self, file: BinaryIO, faults: Faults, clock: Clock, *, lockstep: bool) -> None:
        self._file, self._faults, self._clock, self._lockstep = file, faults, clock, lockstep
        self._writes = 0

    def write(self, data: bytes) -> int:
        """Writes the data or fails."""
        now_ns = self._clock.now_ns()
        kind = self._faults.active("disk", now_ns)
        self._writes += 1
        if kind == "off":
            self._file.write(data[: len(data) // 2])  # a full disk writes what still fits
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if kind == "intermittent" and self._writes % 2:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if kind == "slow" and not self._lockstep:  # in lockstep a write takes no time
            self._clock.sleep_until_ns(now_ns + _SLOW_WRITE_NS)
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _ns(seconds: float) -> int:
    """Returns nanoseconds; infinity becomes a time beyond the end of any run."""
    return round(min(seconds, 1e9) * NS_PER_S)
