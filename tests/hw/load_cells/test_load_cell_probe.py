from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gripper_force.config import Config
from gripper_force.jobs import checks
from gripper_force.jobs.checks import Check
from gripper_force.jobs.dataset import Clip
from gripper_force.types import NS_PER_S
from gripper_hw.load_cells.load_cell_probe import probe

REAL = {"clock": "realtime", "servo": {"port": "/dev/nowhere"}}


def rows(config: dict[str, Any]) -> dict[str, Check]:
    return {check.name: check for check in probe(Config.model_validate(config))}


def test_simulated_load_cell_is_measured_in_simulated_time() -> None:
    found = rows({"object": "stapler", "sim": {"detail": "coarse"}, "load_cell": {"rate_hz": 100.0}})
    assert all(check.ok for check in found.values())
    assert found["rate"].found == "100.0 Hz of simulated, in simulated time"
    assert float(found["noise"].found.split()[0]) == pytest.approx(0.01, abs=0.003)
    assert found["rejected"].found.startswith("0 of ")


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measures for a fifth of a second only."""
    monkeypatch.setattr(checks, "_MEASURE_NS", NS_PER_S // 5)


@pytest.mark.usefixtures("short")
def test_board_on_serial_port_is_measured(board) -> None:
    section = board.config().model_dump(mode="json")
    found = rows(REAL | {"load_cell": section})
    assert found["rate"].ok is True
    assert "Hz of serial, in real time" in found["rate"].found
    assert "noise" in found


@pytest.mark.usefixtures("short")
def test_load_cell_without_scale_is_a_problem(board) -> None:
    section = board.config(n_per_raw=None).model_dump(mode="json")
    found = rows(REAL | {"load_cell": section})
    assert "noise" not in found
    assert found["rejected"].ok is False
    assert "not finite" in found["rejected"].found
    assert "set load_cell.n_per_raw" in found["rejected"].advice


def test_load_cell_without_samples_is_a_problem(board, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "_FIRST_NS", 0)
    section = board.config().model_dump(mode="json")
    check = rows(REAL | {"load_cell": section})["rate"]
    assert check.ok is False
    assert check.found.startswith("0 samples")
    assert "load_cell.baud_rate" in check.advice


def test_no_load_cell_is_no_problem() -> None:
    assert rows({"load_cell": {"backend": "none"}}) == {
        "backend": Check("load cell", "backend", "none", None)
    }


@pytest.mark.usefixtures("short")
def test_playback_is_measured(
    write_log: Callable[[Clip, Path], Path], press: Callable[[int], Clip], tmp_path: Path
) -> None:
    section = {"backend": "playback", "path": str(write_log(press(0), tmp_path))}
    assert rows(REAL | {"camera": {"backend": "none"}, "load_cell": section})["rejected"].ok is True
