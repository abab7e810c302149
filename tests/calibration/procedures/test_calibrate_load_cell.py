"""Load-cell calibration with a simulated board behind a pseudo-terminal."""

import math
import os
import pty
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_calibration.procedures import calibrate_load_cell as procedure
from gripper_calibration.procedures.calibrate_load_cell import calibrate_load_cell, weigh
from gripper_force.cli import app
from gripper_force.config import Config, config_from, load_config
from gripper_force.errors import ConfigError, DataError, DeviceTimeoutError
from gripper_force.profiles.rig_profile import read_rig
from gripper_force.types import NS_PER_S, LoadCellSample

TARE, N_PER_RAW, WEIGHT_N = -4_000, 1e-4, 5.0


class Board:
    """An HX711 that prints counts under a load."""

    def __init__(self) -> None:
        self.force_n = 0.0
        self._rng = np.random.default_rng(0)
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(slave)
        self._on = True
        self._sender = threading.Thread(target=self._send)
        self._sender.start()

    def do(self, what: str) -> None:
        self.force_n = WEIGHT_N if what.startswith("Put") else 0.0

    def close(self) -> None:
        self._on = False
        self._sender.join()

    def _send(self) -> None:
        while self._on:
            raw = round(TARE + (self.force_n + self._rng.normal(0, 0.01)) / N_PER_RAW)
            try:
                os.write(self._master, b"%d\r\n" % raw)
            except BlockingIOError:
                time.sleep(0.01)
            time.sleep(0.003)


@pytest.fixture
def board() -> Iterator[Board]:
    board = Board()
    yield board
    board.close()


def config_of(board: Board) -> Config:
    cell = {"backend": "serial", "port": board.port, "tare_raw": 77, "n_per_raw": 3}
    return config_from({"load_cell": cell}, "the test")


def test_board_is_calibrated_through_its_driver(
    board: Board, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(procedure, "_SETTLE_NS", NS_PER_S // 5)  # this load needs no time to settle
    rig = tmp_path / "rig.yaml"
    asked: list[str] = []

    def ask(text: str) -> None:
        asked.append(text)
        board.do(text)

    result = calibrate_load_cell(config_of(board), WEIGHT_N, rig, prompt=ask, seconds=1.0)
    assert [what.split()[0] for what in asked] == ["Take", "Put", "Take"]
    found = read_rig(rig).load_cell
    assert found is not None
    assert found.sensor == "serial hx711"
    assert found.force_n == (0, WEIGHT_N)
    assert found.tare_raw.value == pytest.approx(TARE, abs=30)
    assert found.n_per_raw.value == pytest.approx(N_PER_RAW, rel=0.01)
    assert found.noise_n == pytest.approx(0.01, rel=0.3)
    assert Path(result.report).stat().st_size > 10_000
    settings = load_config(None, [f"calibration.rig={rig}"]).load_cell
    assert (settings.tare_raw, settings.n_per_raw) == (found.tare_raw.value, found.n_per_raw.value)


class Cell:
    """A load cell with its own clock. A function of the prompts and the time gives its reading."""

    def __init__(self, reading: Callable[[int, float], float | None], noise: float = 20) -> None:
        self._noise = noise
        self._reading, self._now_ns, self._sampled_ns = reading, 0, 0
        self._asked, self._asked_ns = 0, 0
        self._rng = np.random.default_rng(0)

    def ask(self, text: str) -> None:
        self._asked, self._asked_ns = self._asked + 1, self._now_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        self._now_ns = t_ns

    def start(self) -> None: ...

    def drain(self) -> list[LoadCellSample]:
        samples = []
        while self._sampled_ns < self._now_ns:
            self._sampled_ns += NS_PER_S // 80
            raw = self._reading(self._asked, (self._sampled_ns - self._asked_ns) / NS_PER_S)
            if raw is not None:
                samples.append(LoadCellSample(self._sampled_ns, 0.0, raw + self._rng.normal(0, self._noise)))
        return samples

    def counts(self) -> dict[str, int]:
        return {"unreadable": 3}

    def close(self) -> None: ...


def weighed(reading: Callable[[int, float], float | None]) -> tuple[float, float]:
    cell = Cell(reading)
    fit = weigh(cell, cell, WEIGHT_N, prompt=cell.ask, seconds=3.0, timeout_s=30.0)
    return fit.tare_raw.value, fit.n_per_raw.value


def test_waits_until_a_late_swinging_load_is_at_rest() -> None:
    def reading(asked: int, t_s: float) -> float:
        loaded = (asked == 2 and t_s > 8) or (asked == 3 and t_s < 6)
        swing = 2000 * np.exp(-(t_s - 8) / 2) * np.cos(9 * t_s) if asked == 2 and t_s > 8 else 0.0
        return 500 + 50_000 * loaded + float(swing)

    tare, scale = weighed(reading)
    assert tare == pytest.approx(500, abs=20)
    assert scale == pytest.approx(1e-4, rel=0.003)


def test_display_shows_its_resolution_while_the_load_changes() -> None:
    def shown_kg(asked: int, t_s: float) -> float:
        return round((1 - math.exp(-9 * t_s) if asked == 2 else math.exp(-9 * t_s) * (asked == 3)) * 0.5, 3)

    cell = Cell(shown_kg, noise=0)
    fit = weigh(cell, cell, WEIGHT_N, prompt=cell.ask, seconds=3.0, timeout_s=30.0)
    assert (fit.tare_raw.low, fit.tare_raw.high) == pytest.approx((-0.0005, 0.0005))
    assert fit.n_per_raw.value == pytest.approx(10)


@pytest.mark.parametrize(
    ("reading", "sentence"),
    [
        (lambda asked, t_s: 500, "the load changes the reading by"),
        (
            lambda asked, t_s: 500 + 50_000 * (asked >= 2),
            r"the empty reading after the load differs from the one before it by 200\.0 % of the load",
        ),
        (
            lambda asked, t_s: 500 + 50_000 * (asked == 2) + 2e3 * t_s,
            r"the reading does not settle without load: it varies by 6\.7 % of the load",
        ),
    ],
)
def test_timeout_names_the_problem(reading: Callable[[int, float], float], sentence: str) -> None:
    with pytest.raises(DataError, match=sentence):
        weighed(reading)


def test_silent_load_cell_is_an_error() -> None:
    with pytest.raises(DeviceTimeoutError, match=r"gives no readings \(counted: 3 unreadable\)"):
        weighed(lambda asked, t_s: None)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "--mass-kg or --force-n"),
        (["--mass-kg", "1", "--force-n", "9"], "--mass-kg or --force-n"),
        (["--mass-kg", "1"], "load_cell.backend=simulated has no raw readings"),
        (["--force-n", "nan", "--set", "load_cell.backend=serial"], "a mass of nan N can't be weighed"),
    ],
)
def test_invalid_arguments_are_refused(arguments: list[str], sentence: str) -> None:
    end = CliRunner().invoke(app, ["calibrate", "load-cell", *arguments])
    assert isinstance(end.exception, ConfigError)
    assert sentence in str(end.exception)


def test_without_a_terminal_the_command_is_refused(board: Board, tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    options = [f"load_cell.{key}" for key in ("backend=serial", f"port={board.port}")]
    flags = [part for option in options for part in ("--set", option)]
    end = CliRunner().invoke(app, ["calibrate", "load-cell", "--force-n", "5", "--rig", str(rig), *flags])
    assert isinstance(end.exception, ConfigError)
    assert "this needs a person at a terminal: Take everything off" in str(end.exception)
    assert not rig.exists()
