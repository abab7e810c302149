"""Tests that every `gripper_force.interfaces.LoadCell` must pass.

Subclass `LoadCellContract` in a test module and override the fixture ``load_cell``::

    class TestMyLoadCell(LoadCellContract):
        @pytest.fixture
        def load_cell(self, clock):
            return MyLoadCell(gf.LoadCellConfig(backend="my_package.cells:MyLoadCell"), clock)

The load cell must deliver samples while the tests wait. If it needs help to do so (a simulated clock, a stub
of the vendor's library), override ``wait`` too.
"""

import math
from collections.abc import Callable, Iterator

import pytest

from gripper_force.interfaces import Clock, LoadCell
from gripper_force.testing.sensor_contract import SensorContract, check_counts, check_second_object, collect


class LoadCellContract(SensorContract):
    """Contract tests of a load cell.

    Override the fixture `load_cell`; override `clock` if the load cell is not on the host's clock, and
    `second_load_cell` to test a second user of the same device.
    """

    @pytest.fixture
    def load_cell(self) -> LoadCell:
        """A load cell that was constructed and not started yet."""
        raise NotImplementedError("override the fixture load_cell")

    @pytest.fixture
    def second_load_cell(self) -> LoadCell | None:
        """Another object for the same device, not started; None skips its test."""
        return None

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
        self, load_cell: LoadCell, clock: Clock, wait: Callable[[float], None]
    ) -> None:
        """Times increase within and across calls of ``drain``, and lie between ``start`` and now."""
        start_ns = clock.now_ns()
        load_cell.start()
        times_ns: list[int] = []
        for _ in range(25):
            times_ns += [sample.t_ns for sample in collect(load_cell.drain, 2, wait)]
            times_ns += [sample.t_ns for sample in load_cell.drain()]
            assert times_ns[-1] <= clock.now_ns()
        assert times_ns[0] >= start_ns
        assert times_ns == sorted(set(times_ns))

    def test_values_have_their_types(self, load_cell: LoadCell, wait: Callable[[float], None]) -> None:
        """Force and reading are floats; the force of a valid sample is finite."""
        load_cell.start()
        for sample in collect(load_cell.drain, 20, wait):
            assert type(sample.t_ns) is int
            assert isinstance(sample.force_n, float)
            assert isinstance(sample.raw, float)
            assert isinstance(sample.valid, bool)
            assert math.isfinite(sample.force_n) or not sample.valid

    def test_drain_is_empty_between_samples(self, load_cell: LoadCell, wait: Callable[[float], None]) -> None:
        """``drain`` does not wait for the next sample: called in a fast loop, it returns an empty list."""
        load_cell.start()
        collect(load_cell.drain, 1, wait)
        assert not all(load_cell.drain() for _ in range(50))

    def test_counts_are_not_negative_and_never_decrease(
        self, load_cell: LoadCell, wait: Callable[[float], None]
    ) -> None:
        """``counts`` maps causes to numbers, before ``start``, while sampling and after ``close``."""
        counts = [load_cell.counts()]
        load_cell.start()
        collect(load_cell.drain, 5, wait)
        counts.append(load_cell.counts())
        load_cell.close()
        counts.append(load_cell.counts())
        check_counts(counts)

    # Start and close.

    def test_second_start_has_no_effect(self, load_cell: LoadCell, wait: Callable[[float], None]) -> None:
        """``start`` may be called twice; each sample is still returned once."""
        load_cell.start()
        load_cell.start()
        times_ns = [sample.t_ns for sample in collect(load_cell.drain, 10, wait)]
        assert times_ns == sorted(set(times_ns))

    def test_no_new_sample_after_close(
        self, load_cell: LoadCell, clock: Clock, wait: Callable[[float], None]
    ) -> None:
        """``close`` may be called twice; after it ``drain`` returns at most samples from before it."""
        load_cell.start()
        collect(load_cell.drain, 20, wait)
        load_cell.close()
        closed_ns = clock.now_ns()
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
        check_second_object(load_cell, second_load_cell, lambda one, count: collect(one.drain, count, wait))
