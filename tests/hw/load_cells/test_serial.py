import math
import threading

import pytest

from gripper_force.config import LoadCellConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceNotFoundError
from gripper_force.runtime.backends import MonotonicClock
from gripper_hw.load_cells.screening import MAX_WAIT_NS
from gripper_hw.load_cells.serial import SerialLoadCell


@pytest.fixture
def cell(board):
    cell = SerialLoadCell(board.config(), MonotonicClock())
    yield cell
    cell.close()


def test_thread_ends_with_close(cell, collect):
    cell.start()
    cell.start()
    collect(cell, 5)
    assert [t.name for t in threading.enumerate()].count("load-cell") == 1
    cell.close()
    assert "load-cell" not in [t.name for t in threading.enumerate()]


def test_force_is_reading_minus_tare_times_scale(board, collect):
    cell = SerialLoadCell(board.config(tare_raw=-500.0, n_per_raw=0.25), MonotonicClock())
    cell.start()
    samples = collect(cell, 10)
    cell.close()
    assert all(s.force_n == (s.raw + 500.0) * 0.25 for s in samples)


@pytest.mark.parametrize("board", ["cas"], indirect=True)
def test_kilograms_of_indicator_become_newtons_without_calibration(board, collect):
    cell = SerialLoadCell(board.config(n_per_raw=None), MonotonicClock())
    cell.start()
    samples = collect(cell, 10)
    cell.close()
    assert [s.force_n for s in samples] == pytest.approx([9.80665 * s.raw for s in samples])


def test_board_without_calibration_gives_invalid_samples(board, collect):
    cell = SerialLoadCell(board.config(n_per_raw=None), MonotonicClock())
    cell.start()
    samples = collect(cell, 10)
    cell.close()
    assert all(math.isnan(s.force_n) and not s.valid and s.raw >= 0 for s in samples)


def test_unreadable_lines_and_saturation_are_counted(board, cell, collect):
    board.line = lambda i: {1: b"HX711 ready\r\n", 4: b"\xff\xfe\n", 7: b"8388607\r\n"}.get(
        i % 10, b"%d\n" % i
    )
    cell.start()
    samples = collect(cell, 50)
    stats = cell.stats
    assert stats.unreadable >= 8
    assert stats.saturated >= 4
    assert all(s.valid == (s.raw != 8388607) for s in samples)


def test_lost_load_cell_can_be_drained_and_closed(board, cell, collect, wait_until):
    cell.start()
    collect(cell, 1)
    board.unplug()
    wait_until(lambda: cell.stats.losses == 1)
    lost_ns = MonotonicClock().now_ns()
    wait_until(lambda: MonotonicClock().now_ns() > lost_ns + MAX_WAIT_NS)
    assert cell.drain()
    assert cell.drain() == []
    cell.close()
    assert cell.drain() == []


def test_missing_port_is_one_line(tmp_path):
    cell = SerialLoadCell(LoadCellConfig(backend="serial", port=str(tmp_path / "no")), MonotonicClock())
    with pytest.raises(DeviceNotFoundError, match=r"there is no port .*/no; plug it in") as caught:
        cell.start()
    assert "\n" not in str(caught.value)
    assert cell.drain() == []
    cell.close()


@pytest.mark.parametrize("baud_rate", [9600, 115_200])
def test_file_that_is_no_port_is_refused(tmp_path, baud_rate):
    (tmp_path / "file").touch()
    config = LoadCellConfig(backend="serial", port=str(tmp_path / "file"), baud_rate=baud_rate)
    with pytest.raises(DeviceError, match="can't open the load cell's port"):
        SerialLoadCell(config, MonotonicClock()).start()


def test_port_must_be_configured():
    with pytest.raises(ConfigError, match=r"needs load_cell\.port"):
        SerialLoadCell(LoadCellConfig(backend="serial"), MonotonicClock())
