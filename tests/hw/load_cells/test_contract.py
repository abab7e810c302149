"""What every load cell keeps to, simulated, played or real."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from gripper_force.config import LoadCellConfig, load_config
from gripper_force.errors import DeviceError
from gripper_force.interfaces import Clock, LoadCell
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.runtime.log import LogWriter
from gripper_force.types import NS_PER_MS, LoadCellSample
from gripper_hw.load_cells.serial import SerialLoadCell
from gripper_hw.playback import PlaybackLoadCell
from gripper_hw.sim.simulated_rig import SimulatedRig

PERIOD_NS = 5 * NS_PER_MS


@dataclass
class Fitted:
    """A load cell, its clock, a way to let time pass, and the number of each sample."""

    cell: LoadCell
    clock: Clock
    pause: Callable[[], None]
    number: Callable[[LoadCellSample], int]


class SteppedClock:
    def __init__(self) -> None:
        self.t_ns = 77_000_000_000

    def now_ns(self) -> int:
        return self.t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        self.t_ns = t_ns


def step(clock: Clock) -> Callable[[], None]:
    return lambda: clock.sleep_until_ns(clock.now_ns() + 7 * NS_PER_MS)


def simulated(stack: ExitStack, quick: list[str], tmp_path: Path) -> Fitted:
    rig = SimulatedRig(load_config(None, quick))
    stack.callback(rig.close)
    return Fitted(rig.load_cell, rig.clock, step(rig.clock), lambda sample: sample.t_ns // PERIOD_NS)


def playback(stack: ExitStack, quick: list[str], tmp_path: Path) -> Fitted:
    path = tmp_path / "run.mcap"
    with LogWriter(path, config="", metadata={}) as log:
        for i in range(200):
            log.write(LoadCellSample(i * PERIOD_NS, 0.1 * i, float(i)))
    clock = SteppedClock()
    cell = PlaybackLoadCell(LoadCellConfig(backend="playback", path=path), clock)
    return Fitted(cell, clock, step(clock), lambda sample: round(sample.raw))


@pytest.fixture(params=["simulated", "playback", "hx711", "cas"])
def fitted(request: pytest.FixtureRequest, quick: list[str], tmp_path: Path) -> Iterator[Fitted]:
    with ExitStack() as stack:
        if request.param in ("hx711", "cas"):
            board = stack.enter_context(request.getfixturevalue("plug_in")(request.param))
            clock, scale = MonotonicClock(), 1 if request.param == "hx711" else 1000
            fitted = Fitted(
                SerialLoadCell(board.config(), clock),
                clock,
                lambda: time.sleep(0.01),
                lambda sample: round(sample.raw * scale),
            )
        else:
            make = simulated if request.param == "simulated" else playback
            fitted = make(stack, quick, tmp_path)
        stack.callback(fitted.cell.close)
        yield fitted


def test_nothing_comes_before_the_start_or_after_the_end(fitted: Fitted, collect) -> None:
    cell = fitted.cell
    fitted.pause()
    assert cell.drain() == []
    cell.start()
    collect(cell, 20, fitted.pause)
    cell.close()
    closed_ns = fitted.clock.now_ns()
    cell.close()
    fitted.pause()
    assert all(sample.t_ns <= closed_ns for sample in cell.drain())


def test_a_cell_may_be_closed_before_it_was_started(fitted: Fitted) -> None:
    fitted.cell.close()
    assert fitted.cell.drain() == []


def test_times_rise_and_none_lies_in_the_future(fitted: Fitted) -> None:
    begin_ns = fitted.clock.now_ns()
    fitted.cell.start()
    times_ns: list[int] = []
    while len(times_ns) < 50:
        fitted.pause()
        times_ns += [sample.t_ns for sample in fitted.cell.drain()]
        assert max(times_ns, default=begin_ns) <= fitted.clock.now_ns()
    assert times_ns[0] >= begin_ns
    assert times_ns == sorted(set(times_ns))


def test_each_sample_comes_once_and_in_order(fitted: Fitted, collect) -> None:
    fitted.cell.start()
    samples = collect(fitted.cell, 50, fitted.pause)
    numbers = [fitted.number(sample) for sample in samples]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert all(sample.valid for sample in samples)
    assert not any(fitted.cell.counts().values())


@pytest.mark.parametrize("board", ["hx711", "cas"], indirect=True)
def test_a_port_is_exclusive_until_closed(board, collect) -> None:
    first, second = (SerialLoadCell(board.config(), MonotonicClock()) for _ in range(2))
    first.start()
    with pytest.raises(DeviceError, match=r"load cell's port .*load_cell is in use") as caught:
        second.start()
    assert "\n" not in str(caught.value)
    first.close()
    second.start()
    collect(second, 1)
    second.close()


@pytest.mark.parametrize("board", ["hx711", "cas"], indirect=True)
def test_a_cell_that_goes_away_is_read_again_once_it_is_back(board, collect, wait_until) -> None:
    cell = SerialLoadCell(board.config(), MonotonicClock())
    cell.start()
    samples = collect(cell, 10)
    board.unplug()
    wait_until(lambda: cell.stats.losses == 1)
    samples += cell.drain()
    board.plug()
    samples += collect(cell, 20)
    cell.close()
    assert cell.stats.losses == 1
    assert cell.stats.unreadable == 0
    raws = [sample.raw for sample in samples]
    assert raws == sorted(set(raws))
    times_ns = [sample.t_ns for sample in samples]
    assert times_ns == sorted(set(times_ns))
