from gripper_force.runtime.monitors import CounterMonitor, LoadCellMonitor
from gripper_force.types import NS_PER_MS, NS_PER_S, LoadCellSample


def news(watch: LoadCellMonitor, period_ms: int, valid: range, until_ms: int) -> list[tuple[int, str]]:
    """Warnings about a load cell whose samples are valid at some times and missing at others."""
    told = []
    for t_ms in range(0, until_ms, 5):
        sound = t_ms % period_ms == 0 and t_ms not in valid
        samples = [LoadCellSample(t_ms * NS_PER_MS, 1.0, 1.0)] if sound else []
        if text := watch.update(t_ms * NS_PER_MS, samples):
            told.append((t_ms, text))
    return told


def test_silence_is_told_once_and_its_end() -> None:
    told = news(LoadCellMonitor(), 5, range(1000, 1500), 2000)
    assert told == [(1045, "no valid samples, so nothing to compare with"), (1500, "valid samples again")]


def test_a_slow_cell_is_not_silent() -> None:
    assert news(LoadCellMonitor(), 100, range(0), 5000) == []


def test_rejected_samples_do_not_break_the_silence() -> None:
    watch = LoadCellMonitor()
    assert news(watch, 5, range(0), 1000) == []
    bad = LoadCellSample(1100 * NS_PER_MS, 1.0, 1.0, valid=False)
    assert watch.update(1100 * NS_PER_MS, [bad]) == "no valid samples, so nothing to compare with"


def test_counts_that_rise_are_told_once_a_second_and_at_the_end() -> None:
    tally = CounterMonitor()
    assert tally.update(0, {"spikes": 0, "losses": 0}, at_end=False) == ""
    assert tally.update(1, {"spikes": 2, "losses": 0}, at_end=False) == "2 spikes"
    assert tally.update(2, {"spikes": 5, "losses": 1}, at_end=False) == ""
    assert tally.update(NS_PER_S + 1, {"spikes": 6, "losses": 1}, at_end=False) == "4 spikes, 1 losses"
    assert tally.update(NS_PER_S + 2, {"spikes": 7, "losses": 1}, at_end=True) == "1 spikes"


def test_counts_in_one_dictionary_that_the_device_goes_on_changing_are_told() -> None:
    tally, counts = CounterMonitor(), {"spikes": 0}
    assert tally.update(0, counts, at_end=False) == ""
    counts["spikes"] = 2
    assert tally.update(1, counts, at_end=False) == "2 spikes"
