"""The load cell contract on every built-in load cell, and tests of what some of them add to it."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest

from gripper_force.config import Config, LoadCellConfig, load_config
from gripper_force.interfaces import Clock, LoadCell
from gripper_force.runtime.backends import LOAD_CELLS, MonotonicClock
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.testing.load_cell_contract import LoadCellContract
from gripper_force.types import NS_PER_MS, LoadCellSample
from gripper_hw.load_cells.phidget import PhidgetLoadCell
from gripper_hw.load_cells.serial import SerialLoadCell
from gripper_hw.playback import PlaybackLoadCell
from gripper_hw.sim.simulated_rig import SimulatedRig

PERIOD_NS = 5 * NS_PER_MS


class NumberedContract(LoadCellContract):
    """The contract, on a device whose samples can be numbered, so that a lost one shows."""

    def number(self, sample: LoadCellSample) -> int:
        raise NotImplementedError

    def test_no_sample_is_lost_or_rejected(
        self, load_cell: LoadCell, wait: Callable[[float], None], collect
    ) -> None:
        load_cell.start()
        samples = collect(load_cell, 50, lambda: wait(0.01))
        numbers = [self.number(sample) for sample in samples]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert all(sample.valid for sample in samples)
        assert not any(load_cell.counts().values())


class TestSimulatedLoadCell(NumberedContract):
    @pytest.fixture
    def config(self, quick: list[str]) -> Config:
        return load_config(None, quick)

    @pytest.fixture
    def rig(self, config: Config) -> Iterator[SimulatedRig]:
        with closing(SimulatedRig(config)) as rig:
            yield rig

    @pytest.fixture
    def load_cell(self, rig: SimulatedRig) -> LoadCell:
        return rig.load_cell

    @pytest.fixture
    def clock(self, rig: SimulatedRig) -> Clock:
        return rig.clock

    def number(self, sample: LoadCellSample) -> int:
        return sample.t_ns // PERIOD_NS


class TestSimulatedLoadCellWithFaults(TestSimulatedLoadCell):
    @pytest.fixture
    def config(self, quick: list[str]) -> Config:
        return load_config(None, [*quick, "faults=[{unit: load_cell, kind: stuck, at_s: 1000}]"])


class TestPlaybackLoadCell(NumberedContract):
    @pytest.fixture
    def section(self, tmp_path: Path) -> LoadCellConfig:
        path = tmp_path / "run.mcap"
        with LogWriter(path, config="", metadata={}) as log:
            for i in range(1000):
                log.write(LoadCellSample(i * PERIOD_NS, 0.1 * i, float(i)))
        return LoadCellConfig(backend="playback", path=path)

    @pytest.fixture
    def load_cell(self, section: LoadCellConfig) -> LoadCell:
        return PlaybackLoadCell(section, MonotonicClock())

    @pytest.fixture
    def second_load_cell(self, section: LoadCellConfig) -> LoadCell:
        return PlaybackLoadCell(section, MonotonicClock())

    def number(self, sample: LoadCellSample) -> int:
        return round(sample.raw)


class TestHx711LoadCell(NumberedContract):
    form = "hx711"
    numbers_per_raw = 1

    @pytest.fixture
    def board(self, plug_in):
        with plug_in(self.form) as board:
            yield board

    @pytest.fixture
    def load_cell(self, board) -> LoadCell:
        return SerialLoadCell(board.config(), MonotonicClock())

    @pytest.fixture
    def second_load_cell(self, board) -> LoadCell:
        return SerialLoadCell(board.config(), MonotonicClock())

    def number(self, sample: LoadCellSample) -> int:
        return round(sample.raw * self.numbers_per_raw)

    def test_unplugged_load_cell_is_read_again_when_it_is_back(
        self, board, load_cell: SerialLoadCell, collect, wait_until
    ) -> None:
        load_cell.start()
        samples = collect(load_cell, 10)
        board.unplug()
        wait_until(lambda: load_cell.stats.losses == 1)
        samples += load_cell.drain()
        board.plug()
        samples += collect(load_cell, 20)
        load_cell.close()
        assert load_cell.stats.losses == 1
        assert load_cell.stats.unreadable == 0
        raws = [sample.raw for sample in samples]
        assert raws == sorted(set(raws))
        times_ns = [sample.t_ns for sample in samples]
        assert times_ns == sorted(set(times_ns))


class TestCasLoadCell(TestHx711LoadCell):
    form = "cas"
    numbers_per_raw = 1000


class TestPhidgetLoadCell(NumberedContract):
    """A stub of the vendor's library gives 1, 2, 3... microvolts per volt while the test waits."""

    @pytest.fixture
    def load_cell(self, phidget_library: SimpleNamespace) -> LoadCell:
        config = LoadCellConfig(backend="phidget", rate_hz=100, n_per_raw=1000.0)
        return PhidgetLoadCell(config, MonotonicClock())

    @pytest.fixture
    def wait(self, phidget_library: SimpleNamespace) -> Callable[[float], None]:
        number = 0

        def wait(seconds: float) -> None:
            nonlocal number
            for _ in range(math.ceil(seconds / 0.01)):
                time.sleep(0.01)
                for channel in phidget_library.VoltageRatioInput.made:
                    if not channel.closed:
                        number += 1
                        channel.told["OnVoltageRatioChangeHandler"](channel, number * 1e-6)

        return wait

    def number(self, sample: LoadCellSample) -> int:
        return round(sample.raw * 1e6)


def test_contract_runs_on_every_built_in_load_cell() -> None:
    assert set(LOAD_CELLS) == {"none", "simulated", "playback", "serial", "phidget"}
