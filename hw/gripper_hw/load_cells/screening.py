"""Conversion of readings to samples in newtons, with implausible samples marked as invalid."""

import math
from collections import deque
from dataclasses import asdict, dataclass, replace
from typing import Final

import numpy as np

from gripper_force.config import LoadCellConfig
from gripper_force.interfaces import Clock
from gripper_force.spikes import HAMPEL_HALF_WINDOW, find_spikes
from gripper_force.types import NS_PER_S, LoadCellSample

STUCK_NS: Final = NS_PER_S // 20
STUCK_SAMPLES: Final = 10
"""A converter always has noise, so a reading that stays identical for longer than this time and for more
samples than this is stuck."""

REJECTION_WINDOW_SAMPLES: Final = 20
MAX_REJECTED_SHARE: Final = 0.4
"""Share of rejected samples among the last ones above which all samples are rejected."""

MAX_WAIT_NS: Final = NS_PER_S
"""Longest wait of a sample for those after it. At 10 samples/s, the slowest HX711, they take 0.3 s."""

_MAX_UNTAKEN: Final = 100_000
"""Samples kept if they are never taken; the oldest are dropped."""


@dataclass(slots=True)
class LoadCellStats:
    """Counters of one load cell since its construction: rejected samples by cause, and connection faults.

    Attributes:
        saturated: Samples beyond the sensor's range.
        stuck: Samples whose reading stayed the same for too long.
        not_finite: Samples whose force is NaN or infinite; all samples if the load cell is not calibrated.
        spikes: Samples that `find_spikes` rejects.
        doubtful: Samples rejected because too many of the samples before them were rejected.
        unreadable: Lines that are not of the configured format; they give no sample.
        losses: Losses of the device.
    """

    saturated: int = 0
    stuck: int = 0
    not_finite: int = 0
    spikes: int = 0
    doubtful: int = 0
    unreadable: int = 0
    losses: int = 0


class SampleValidator:
    """Converts readings to samples and marks implausible ones as invalid. The reading itself is kept.

    A sample is delayed by the few samples after it, because a spike can only be detected with them. One
    thread may call `add` while another calls `take`.

    Args:
        tare_raw: Reading without load.
        n_per_raw: Newtons per unit of the reading; NaN if unknown.
    """

    def __init__(self, tare_raw: float, n_per_raw: float) -> None:
        self.stats = LoadCellStats()
        self._tare_raw, self._n_per_raw = tare_raw, n_per_raw
        self._added: deque[LoadCellSample] = deque(maxlen=_MAX_UNTAKEN)
        self._waiting: list[LoadCellSample] = []
        self._previous_n: deque[float] = deque(maxlen=HAMPEL_HALF_WINDOW)
        self._last_raw = math.nan
        self._last_ns = self._same_since_ns = self._same_count = 0
        self._rejected: deque[bool] = deque(maxlen=REJECTION_WINDOW_SAMPLES)

    def add(self, t_ns: int, raw: float, saturated: bool = False, rounded: bool = False) -> None:
        """Adds a reading received at ``t_ns``.

        Args:
            t_ns: Time of the reading.
            raw: The reading.
            saturated: True if the sensor reports that it is beyond its range.
            rounded: True if the reading may stay the same, as a weighing indicator's does. A converter's
                always varies.
        """
        if raw != self._last_raw or t_ns - self._last_ns > MAX_WAIT_NS:
            self._same_since_ns, self._same_count = t_ns, 0
        self._same_count += 1
        self._last_raw, self._last_ns = raw, t_ns
        force_n = (raw - self._tare_raw) * self._n_per_raw
        valid = False
        if saturated:
            self.stats.saturated += 1
        elif not rounded and self._same_count > STUCK_SAMPLES and t_ns - self._same_since_ns > STUCK_NS:
            self.stats.stuck += 1
        elif not math.isfinite(force_n):
            self.stats.not_finite += 1
        else:
            valid = True
        self._added.append(LoadCellSample(t_ns, force_n, raw, valid))

    def take(self, now_ns: int) -> list[LoadCellSample]:
        """Returns the samples that were not taken yet and can be checked at ``now_ns``, oldest first."""
        while self._added:
            self._waiting.append(self._added.popleft())
        count = self._ready_count(now_ns)
        if not count:
            return []
        candidates_n = [sample.force_n for sample in self._waiting if sample.valid]
        spikes = iter(find_spikes(np.array([*self._previous_n, *candidates_n]))[len(self._previous_n) :])
        samples, self._waiting = self._waiting[:count], self._waiting[count:]
        for i, sample in enumerate(samples):
            if sample.valid:
                self._previous_n.append(sample.force_n)
                if next(spikes):
                    self.stats.spikes += 1
                    samples[i] = replace(sample, valid=False)
            self._rejected.append(not samples[i].valid)
            if samples[i].valid and sum(self._rejected) > MAX_REJECTED_SHARE * REJECTION_WINDOW_SAMPLES:
                self.stats.doubtful += 1
                samples[i] = replace(sample, valid=False)
        return samples

    def counts(self) -> dict[str, int]:
        """Counters by name (see `LoadCellStats`)."""
        return asdict(self.stats)

    def _ready_count(self, now_ns: int) -> int:
        """Number of waiting samples that have enough followers, or waited `MAX_WAIT_NS` for them."""
        count, followers = len(self._waiting), 0
        for i in reversed(range(count)):
            if self._waiting[i].valid:
                if followers < HAMPEL_HALF_WINDOW and now_ns - self._waiting[i].t_ns <= MAX_WAIT_NS:
                    count = i
                followers += 1
        return count


class LiveLoadCell:
    """Base class of real load cells: adds readings at the run's time and returns checked samples.

    Args:
        config: The load cell section of the configuration.
        clock: The run's clock, which must be the host's.
        unit_n: Newtons per unit of the reading if ``load_cell.n_per_raw`` is not set; NaN if unknown.

    Attributes:
        stats: Counters of rejected samples and losses.
    """

    def __init__(self, config: LoadCellConfig, clock: Clock, *, unit_n: float) -> None:
        self._config, self._clock = config, clock
        n_per_raw = unit_n if config.n_per_raw is None else config.n_per_raw
        self._validator = SampleValidator(config.tare_raw, n_per_raw)
        self.stats = self._validator.stats

    def drain(self) -> list[LoadCellSample]:
        """Returns the samples since the last call that can be checked by now, oldest first.

        Never blocks or raises.
        """
        return self._validator.take(self._clock.now_ns())

    def counts(self) -> dict[str, int]:
        """Number of rejected samples and faults since construction, by cause (see `LoadCellStats`)."""
        return self._validator.counts()

    def _add(self, raw: float, saturated: bool = False, rounded: bool = False) -> None:
        self._validator.add(self._clock.now_ns(), raw, saturated, rounded)
