from gripper_force.runtime.monitors import CounterMonitor, LoadCellMonitor
from gripper_force.types import NS_PER_MS, LoadCellSample


def news(watch: LoadCellMonitor, period_ms: int, valid: range, until_ms: int) -> list[tuple[int, str]]:
    """Warnings about a load cell whose samples are valid at some times and missing at others."""
    told = []
    for t_ms in range(0, until_ms, 5):
        sound = t_ms % period_ms == 0 and t_ms not in valid
        samples = [LoadCellSample(t_ms * NS_PER_MS, 1.0, 1.0)] if sound else []
        if text := watch.update(t_ms * NS_PER_MS, samples):
            told.append((t_ms, text))
    return told


def test_a_slow_cell_is_not_silent() -> None:
    assert news(LoadCellMonitor(), 100, range(0), 5000) == []


def test_rejected_samples_do_not_break_the_silence() -> None:
    watch = LoadCellMonitor()
    assert news(watch, 5, range(0), 1000) == []
    bad = LoadCellSample(1100 * NS_PER_MS, 1.0, 1.0, valid=False)
    assert watch.update(1100 * NS_PER_MS, [bad]) == "no valid samples, so nothing to compare with"


def test_counts_in_one_dictionary_that_the_device_goes_on_changing_are_told() -> None:
    tally, counts = CounterMonitor(), {"spikes": 0}
    assert tally.update(0, counts, at_end=False) == ""
    counts["spikes"] = 2
    assert tally.update(1, counts, at_end=False) == "2 spikes"
