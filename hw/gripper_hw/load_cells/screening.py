"""Readings to samples: newtons, and a mark on what no live cell under a grip says. The reading is kept."""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gripper_force.config import LoadCellConfig
from gripper_force.interfaces import Clock
from gripper_force.spikes import HAMPEL_HALF_WINDOW, find_spikes
from gripper_force.types import NS_PER_S, LoadCellSample

STUCK_NS: Final = NS_PER_S // 20
STUCK_SAMPLES: Final = 10
"""A reading that stays the same to the bit for longer, and for so many samples, is no live converter's, as
that always has noise."""

DOUBT_SAMPLES: Final = 20
DOUBT_SHARE: Final = 0.4
"""Where more of the last samples than this were rejected, none of the others is to be believed either."""

PATIENCE_NS: Final = NS_PER_S
"""How long a sample waits for those after it. At 10 samples/s, the slowest HX711, they take 0.3 s."""


@dataclass(slots=True)
class LoadCellStats:
    """Counters of one load cell since it was made: rejected samples by cause, and what went wrong on the way.

    Attributes:
        saturated: The sensor was beyond its range.
        stuck: The reading stayed the same for too long.
        not_finite: The force is no finite number; that of every sample where the cell is not calibrated.
        spikes: See `find_spikes`.
        doubtful: Too many of the samples around it were rejected.
        unreadable: Lines that are none of the configured format; they give no sample.
        losses: How often the device went away.
    """

    saturated: int = 0
    stuck: int = 0
    not_finite: int = 0
    spikes: int = 0
    doubtful: int = 0
    unreadable: int = 0
    losses: int = 0


class Screen:
    """Turns readings into samples, some time later: whether it is a spike shows in the samples that follow.

    One thread may `add` while another `take`s.

    Args:
        tare_raw: The reading without load.
        n_per_raw: Newtons for one unit of the reading; NaN where that is not known.
        noisy: The readings are a converter's own. A weighing indicator rounds, and may rest on one value.
    """

    def __init__(self, tare_raw: float, n_per_raw: float, *, noisy: bool) -> None:
        self.stats = LoadCellStats()
        self._tare_raw, self._n_per_raw, self._noisy = tare_raw, n_per_raw, noisy
        self._added: deque[LoadCellSample] = deque(maxlen=100_000)
        self._waiting: list[LoadCellSample] = []
        self._before_n: deque[float] = deque(maxlen=HAMPEL_HALF_WINDOW)
        self._last_raw = math.nan
        self._last_ns = self._same_since_ns = self._same = 0
        self._rejected: deque[bool] = deque(maxlen=DOUBT_SAMPLES)

    def add(self, t_ns: int, raw: float, *, saturated: bool = False) -> None:
        """Takes a reading that came at ``t_ns``."""
        if raw != self._last_raw or t_ns - self._last_ns > PATIENCE_NS:
            self._same_since_ns, self._same = t_ns, 0
        self._same += 1
        self._last_raw, self._last_ns = raw, t_ns
        force_n = (raw - self._tare_raw) * self._n_per_raw
        valid = False
        if saturated:
            self.stats.saturated += 1
        elif self._noisy and self._same > STUCK_SAMPLES and t_ns - self._same_since_ns > STUCK_NS:
            self.stats.stuck += 1
        elif not math.isfinite(force_n):
            self.stats.not_finite += 1
        else:
            valid = True
        self._added.append(LoadCellSample(t_ns, force_n, raw, valid))

    def take(self, now_ns: int) -> list[LoadCellSample]:
        """The samples that can be judged at ``now_ns`` and were not taken yet, oldest first."""
        while self._added:
            self._waiting.append(self._added.popleft())
        ready = self._ready(now_ns)
        if not ready:
            return []
        candidates_n = [sample.force_n for sample in self._waiting if sample.valid]
        spikes = iter(find_spikes(np.array([*self._before_n, *candidates_n]))[len(self._before_n) :])
        taken, self._waiting = self._waiting[:ready], self._waiting[ready:]
        for i, sample in enumerate(taken):
            if sample.valid:
                self._before_n.append(sample.force_n)
                if next(spikes):
                    self.stats.spikes += 1
                    taken[i] = replace(sample, valid=False)
            self._rejected.append(not taken[i].valid)
            if taken[i].valid and sum(self._rejected) > DOUBT_SHARE * DOUBT_SAMPLES:
                self.stats.doubtful += 1
                taken[i] = replace(sample, valid=False)
        return taken

    def counts(self) -> dict[str, int]:
        """The counters by name."""
        return {name: getattr(self.stats, name) for name in LoadCellStats.__slots__}

    def _ready(self, now_ns: int) -> int:
        """How many of the waiting samples have the followers they need, or waited for them long enough."""
        ready, followers = len(self._waiting), 0
        for i in reversed(range(ready)):
            if self._waiting[i].valid:
                if followers < HAMPEL_HALF_WINDOW and now_ns - self._waiting[i].t_ns <= PATIENCE_NS:
                    ready = i
                followers += 1
        return ready


class LiveLoadCell:
    """What real load cells have in common: the run's clock, the screen, and the samples handed out.

    Args:
        config: Their section of the configuration.
        clock: The run's clock, which must be the host's.
        unit_n: Newtons for one unit of the reading where the configuration says nothing; NaN if unknown.
        noisy: See `Screen`.
    """

    def __init__(self, config: LoadCellConfig, clock: Clock, *, unit_n: float, noisy: bool) -> None:
        self._config, self._clock = config, clock
        n_per_raw = unit_n if config.n_per_raw is None else config.n_per_raw
        self._screen = Screen(config.tare_raw, n_per_raw, noisy=noisy)

    @property
    def stats(self) -> LoadCellStats:
        """Counters of rejected samples and losses."""
        return self._screen.stats

    def drain(self) -> list[LoadCellSample]:
        """The samples since the last call that can be judged by now, oldest first. Never blocks or raises."""
        return self._screen.take(self._clock.now_ns())

    def counts(self) -> dict[str, int]:
        """What went wrong since it was made: cause to how often (see `LoadCellStats`)."""
        return self._screen.counts()

    def _add(self, raw: float, *, saturated: bool = False) -> None:
        self._screen.add(self._clock.now_ns(), raw, saturated=saturated)
