"""What is worth a line about devices that go on working: losses, rejected samples, silence."""

from gripper_force.types import NS_PER_MS, NS_PER_S, LoadCellSample

_CELL_PATIENCE_NS = 45 * NS_PER_MS
_CELL_PERIODS = 8
"""A load cell without a sound sample for so long, and for so many of its periods, says nothing any more."""


class CounterMonitor:
    """Says by how much a device's counts of what went wrong have risen, once a second at most."""

    def __init__(self) -> None:
        self._told: dict[str, int] = {}
        self._next_ns = 0

    def update(self, t_ns: int, counts: dict[str, int], *, at_end: bool) -> str:
        """Takes the counts of a cycle. Returns the news, or an empty text."""
        if counts == self._told or (t_ns < self._next_ns and not at_end):
            return ""
        risen = {cause: count - self._told.get(cause, 0) for cause, count in counts.items()}
        self._told = counts
        news = [f"{count} {cause.replace('_', ' ')}" for cause, count in risen.items() if count]
        if news:
            self._next_ns = t_ns + NS_PER_S
        return ", ".join(news)


class LoadCellMonitor:
    """Says when the load cell stops giving sound samples to compare with, and when it gives them again."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._period_ns = NS_PER_S / _CELL_PERIODS  # until it shows
        self._silent = False

    def update(self, t_ns: int, samples: list[LoadCellSample]) -> str:
        """Takes what came in a cycle. Returns the news, or an empty text."""
        last_ns = t_ns if self._last_ns is None else self._last_ns
        sound_ns = [sample.t_ns for sample in samples if sample.valid]
        if sound_ns:
            self._period_ns += 0.2 * ((sound_ns[-1] - last_ns) / len(sound_ns) - self._period_ns)
            last_ns = sound_ns[-1]
        self._last_ns = last_ns
        silent = t_ns - last_ns > max(_CELL_PATIENCE_NS, _CELL_PERIODS * self._period_ns)
        if silent == self._silent:
            return ""
        self._silent = silent
        return "no sound sample; nothing to compare with" if silent else "sound samples again"
