"""Monitors that detect degraded sensors (lost frames, rejected samples, no data) and report each change once."""

from gripper_force.types import NS_PER_MS, NS_PER_S, LoadCellSample

_SILENCE_NS = 45 * NS_PER_MS
_SILENCE_PERIODS = 8
"""A load cell is silent if it gave no valid sample for this time and for this number of its periods."""


class CounterMonitor:
    """Reports increases of a device's problem counters, at most once per second."""

    def __init__(self) -> None:
        self._reported: dict[str, int] = {}
        self._next_ns = 0

    def update(self, t_ns: int, counts: dict[str, int], *, at_end: bool) -> str:
        """Takes the counters of a cycle. Returns the increases as a text, or an empty text."""
        if counts == self._reported or (t_ns < self._next_ns and not at_end):
            return ""
        increases = {cause: count - self._reported.get(cause, 0) for cause, count in counts.items()}
        self._reported = dict(counts)  # a device may return the same dictionary each time
        texts = [f"{count} {cause.replace('_', ' ')}" for cause, count in increases.items() if count]
        if texts:
            self._next_ns = t_ns + NS_PER_S
        return ", ".join(texts)


class LoadCellMonitor:
    """Reports when the load cell stops giving valid samples, and when it gives them again."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._period_ns = NS_PER_S / _SILENCE_PERIODS  # until it is known
        self._silent = False

    def update(self, t_ns: int, samples: list[LoadCellSample]) -> str:
        """Takes the samples of a cycle. Returns a change as a text, or an empty text."""
        last_ns = t_ns if self._last_ns is None else self._last_ns
        valid_ns = [sample.t_ns for sample in samples if sample.valid]
        if valid_ns:
            self._period_ns += 0.2 * ((valid_ns[-1] - last_ns) / len(valid_ns) - self._period_ns)
            last_ns = valid_ns[-1]
        self._last_ns = last_ns
        is_silent = t_ns - last_ns > max(_SILENCE_NS, _SILENCE_PERIODS * self._period_ns)
        if is_silent == self._silent:
            return ""
        self._silent = is_silent
        return "no valid samples, so nothing to compare with" if is_silent else "valid samples again"
