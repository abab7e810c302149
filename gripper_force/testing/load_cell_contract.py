"""Tests that every `gripper_force.interfaces.LoadCell` must pass.

Subclass `LoadCellContract` in a test module and override the fixture ``load_cell``::

    class TestMyLoadCell(LoadCellContract):
        @pytest.fixture
        def load_cell(self):
            return MyLoadCell(LoadCellConfig(backend="mine"), MonotonicClock())

The load cell must deliver samples while the tests wait. If it needs help to do so (a simulated clock, a stub
of the vendor's library), override ``wait`` too.
"""

import math
import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest

from gripper_force.errors import DeviceError
from gripper_force.interfaces import LoadCell
from gripper_force.types import LoadCellSample

_TIMEOUT_S = 60.0
"""Longest time on the host's clock until the wanted samples must be there."""

_POLL_S = 0.01


class LoadCellContract:
    """Contract tests of a load cell.

    Override the fixture `load_cell`; override `now_ns` and `wait` if the load cell is not on the host's
    clock, and `second_load_cell` to test a second user of the same device.
    """

    @pytest.fixture
    def load_cell(self) -> LoadCell:
        """A load cell that was constructed and not started yet."""
        raise NotImplementedError("override the fixture load_cell")

    @pytest.fixture
    def second_load_cell(self) -> LoadCell | None:
        """Another object for the same device, not started; None skips its test."""
        return None

    @pytest.fixture
    def now_ns(self) -> Callable[[], int]:
        """The clock of the samples' times."""
        return time.monotonic_ns

    @pytest.fixture
    def wait(self) -> Callable[[float], None]:
        """Lets this many seconds pass for the load cell. Override it to make the device produce samples."""
        return time.sleep

    @pytest.fixture(autouse=True)
    def _close(self, load_cell: LoadCell, second_load_cell: LoadCell | None) -> Iterator[None]:
        yield
        load_cell.close()
        if second_load_cell is not None:
            second_load_cell.close()

    # Samples.

    def test_no_sample_before_start(self, load_cell: LoadCell, wait: Callable[[float], None]) -> None:
        """``drain`` returns an empty list before ``start``."""
        wait(0.1)
        assert load_cell.drain() == []

    def test_samples_are_in_order_and_returned_once(
        self, load_cell: LoadCell, now_ns: Callable[[], int], wait: Callable[[float], None]
    ) -> None:
        """Times increase within and across calls of ``drain``, and lie between ``start`` and now."""
        start_ns = now_ns()
        load_cell.start()
        times_ns: list[int] = []
        deadline_s = time.monotonic() + _TIMEOUT_S
        while len(times_ns) < 50:
            assert time.monotonic() < deadline_s, f"{len(times_ns)} of 50 samples within {_TIMEOUT_S:g} s"
            wait(_POLL_S)
            times_ns += [sample.t_ns for sample in load_cell.drain()]
            times_ns += [sample.t_ns for sample in load_cell.drain()]
            assert max(times_ns, default=start_ns) <= now_ns()
        assert times_ns[0] >= start_ns
        assert times_ns == sorted(set(times_ns))

    def test_values_have_their_types(self, load_cell: LoadCell, wait: Callable[[float], None]) -> None:
        """Force and reading are floats; the force of a valid sample is finite."""
        load_cell.start()
        for sample in _collect(load_cell, 20, wait):
            assert type(sample.t_ns) is int
            assert isinstance(sample.force_n, float)
            assert isinstance(sample.raw, float)
            assert isinstance(sample.valid, bool)
            assert math.isfinite(sample.force_n) or not sample.valid

    def test_drain_is_empty_between_samples(self, load_cell: LoadCell, wait: Callable[[float], None]) -> None:
        """``drain`` does not wait for the next sample: called in a fast loop, it returns an empty list."""
        load_cell.start()
        _collect(load_cell, 1, wait)
        assert not all(load_cell.drain() for _ in range(50))

    def test_counts_are_not_negative_and_never_decrease(
        self, load_cell: LoadCell, wait: Callable[[float], None]
    ) -> None:
        """``counts`` maps causes to numbers, before ``start``, while sampling and after ``close``."""
        counts = [load_cell.counts()]
        load_cell.start()
        _collect(load_cell, 5, wait)
        counts.append(load_cell.counts())
        load_cell.close()
        counts.append(load_cell.counts())
        for count in counts:
            assert all(type(cause) is str and type(number) is int for cause, number in count.items())
            assert all(number >= 0 for number in count.values())
        for older, newer in pairwise(counts):
            assert all(newer.get(cause, 0) >= number for cause, number in older.items())

    # Start and close.

    def test_second_start_has_no_effect(self, load_cell: LoadCell, wait: Callable[[float], None]) -> None:
        """``start`` may be called twice; each sample is still returned once."""
        load_cell.start()
        load_cell.start()
        times_ns = [sample.t_ns for sample in _collect(load_cell, 10, wait)]
        assert times_ns == sorted(set(times_ns))

    def test_no_new_sample_after_close(
        self, load_cell: LoadCell, now_ns: Callable[[], int], wait: Callable[[float], None]
    ) -> None:
        """``close`` may be called twice; after it ``drain`` returns at most samples from before it."""
        load_cell.start()
        _collect(load_cell, 20, wait)
        load_cell.close()
        closed_ns = now_ns()
        load_cell.close()
        wait(0.1)
        assert all(sample.t_ns <= closed_ns for sample in load_cell.drain())

    def test_close_before_start(self, load_cell: LoadCell) -> None:
        """A load cell that was never started can be closed, twice."""
        load_cell.close()
        load_cell.close()
        assert load_cell.drain() == []

    def test_second_load_cell_does_not_disturb_the_first(
        self, load_cell: LoadCell, second_load_cell: LoadCell | None, wait: Callable[[float], None]
    ) -> None:
        """A second object for the same device works too, or its ``start`` raises `DeviceError`."""
        if second_load_cell is None:
            pytest.skip("the fixture second_load_cell is not overridden")
        load_cell.start()
        _collect(load_cell, 1, wait)
        try:
            second_load_cell.start()
        except DeviceError:
            pass
        else:
            _collect(second_load_cell, 2, wait)
        _collect(load_cell, 2, wait)


def _collect(load_cell: LoadCell, count: int, wait: Callable[[float], None]) -> list[LoadCellSample]:
    """Waits for at least ``count`` samples and returns them."""
    samples: list[LoadCellSample] = []
    deadline_s = time.monotonic() + _TIMEOUT_S
    while len(samples) < count:
        assert time.monotonic() < deadline_s, f"{len(samples)} of {count} samples within {_TIMEOUT_S:g} s"
        samples += load_cell.drain()
        wait(_POLL_S)
    return samples
