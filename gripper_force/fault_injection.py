"""Faults on purpose: which is on when, and the two that the core itself suffers, estimator and disk.

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

_SEEN_SHARE = 2 / 3
_SLOW_WRITE_NS = 50 * NS_PER_MS


class Faults:
    """The faults of one run over time.

    Attributes:
        start_ns: The run's start on the run's clock.
    """

    def __init__(self, faults: Sequence[FaultConfig] = (), start_ns: int = 0) -> None:
        self.start_ns = start_ns
        self._faults = [
            (fault, start_ns + round(fault.at_s * NS_PER_S), start_ns + _ns(fault.at_s + fault.for_s))
            for fault in faults
        ]

    def has(self, unit: str) -> bool:
        """Whether the unit ever has a fault."""
        return any(fault.unit == unit for fault, _, _ in self._faults)

    def active(self, unit: str, t_ns: int) -> str:
        """The kind of the unit's fault at a time, ``ok`` where it has none. The one listed last counts."""
        for fault, begin_ns, end_ns in reversed(self._faults):
            if fault.unit == unit and begin_ns <= t_ns < end_ns:
                return fault.kind
        return "ok"

    def end_ns(self, unit: str, t_ns: int) -> int:
        """When the fault that the unit has at a time ends; that time where it has none."""
        ends = (end for fault, begin, end in self._faults if fault.unit == unit and begin <= t_ns < end)
        return max(ends, default=t_ns)


class FaultyEstimator:
    """An estimator that fails as configured."""

    def __init__(self, estimator: Any, faults: Faults, clock: Clock, *, lockstep: bool) -> None:
        self._estimator, self._faults, self._clock, self._lockstep = estimator, faults, clock, lockstep
        self._calls = 0

    @property
    def reference(self) -> Gray | None:
        """The no-contact picture of the estimator within."""
        reference: Gray | None = self._estimator.reference
        return reference

    def update(self, gray: Gray) -> ForceEstimate | None:
        """Takes the next frame, and gives what is left of the estimate."""
        now_ns = self._clock.now_ns()
        kind = self._faults.active("estimator", now_ns)
        self._calls += 1
        if kind == "off" or (kind == "intermittent" and self._calls % 2):
            raise RuntimeError("the estimator fails, as configured")
        if kind == "stuck":
            if not self._lockstep:  # there time would stand still with it
                self._clock.sleep_until_ns(self._faults.end_ns("estimator", now_ns))
            return None
        estimate: ForceEstimate | None = self._estimator.update(gray)
        if estimate is None or kind == "ok":
            return estimate
        force_n = _SEEN_SHARE * estimate.force_n
        if kind == "garbage":
            force_n = (math.nan, math.inf, -math.inf)[self._calls % 3]
        return ForceEstimate(force_n, estimate.std_n)


class FaultyFile:
    """A log's file on a disk that fails as configured."""

    def __init__(self, file: BinaryIO, faults: Faults, clock: Clock, *, lockstep: bool) -> None:
        self._file, self._faults, self._clock, self._lockstep = file, faults, clock, lockstep
        self._writes = 0

    def write(self, data: bytes) -> int:
        """Writes, or fails."""
        now_ns = self._clock.now_ns()
        kind = self._faults.active("disk", now_ns)
        self._writes += 1
        if kind == "off":
            self._file.write(data[: len(data) // 2])  # a full disk takes what still fits
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if kind == "intermittent" and self._writes % 2:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if kind == "slow" and not self._lockstep:  # there a write takes no time
            self._clock.sleep_until_ns(now_ns + _SLOW_WRITE_NS)
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _ns(seconds: float) -> int:
    """Nanoseconds; a time beyond all runs for infinity."""
    return round(min(seconds, 1e9) * NS_PER_S)
