"""Boards behind pseudo-terminals: real bytes on a port that can be pulled out and plugged in again."""

import os
import pty
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Literal

import pytest

from gripper_force.config import LoadCellConfig
from gripper_force.interfaces import LoadCell
from gripper_force.types import LoadCellSample

Format = Literal["hx711", "cas"]

PATIENCE_S = 60.0
"""How long to wait on a busy machine before a test fails."""

LINES: dict[Format, Callable[[int], bytes]] = {
    "hx711": lambda i: b"%d,%d\r\n" % (1000 * i, i),
    "cas": lambda i: b"ST,GS,1\xc4,%8.3f kg\r\n" % (i / 1000),
}


class Board:
    """Prints 0, 1, 2... counts or grams, and goes on counting when it is plugged in again."""

    def __init__(self, link: Path, form: Format) -> None:
        self.path = str(link)
        self.form = form
        self.line = LINES[form]
        self._count = 0
        self._plugged = threading.Event()
        self.plug()

    def plug(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        Path(self.path).symlink_to(os.ttyname(self._slave))
        self._plugged.set()
        self._sender = threading.Thread(target=self._send)
        self._sender.start()

    def unplug(self) -> None:
        if self._plugged.is_set():
            self._plugged.clear()
            self._sender.join()
            Path(self.path).unlink()
            os.close(self._slave)
            os.close(self._master)

    def config(self, **values: object) -> LoadCellConfig:
        section = {"backend": "serial", "port": self.path, "format": self.form, "n_per_raw": 0.01}
        return LoadCellConfig.model_validate(section | values)

    def _send(self) -> None:
        while self._plugged.is_set():
            left = self.line(self._count)
            self._count += 1
            while left and self._plugged.is_set():
                try:
                    left = left[os.write(self._master, left) :]
                except BlockingIOError:
                    time.sleep(0.01)
            time.sleep(0.002)


@pytest.fixture
def plug_in(tmp_path: Path) -> Callable[[Format], AbstractContextManager[Board]]:
    @contextmanager
    def plug_in(form: Format) -> Iterator[Board]:
        board = Board(tmp_path / "load_cell", form)
        yield board
        board.unplug()

    return plug_in


@pytest.fixture
def board(
    request: pytest.FixtureRequest, plug_in: Callable[[Format], AbstractContextManager[Board]]
) -> Iterator[Board]:
    """An HX711 board, or what the test's parameter names."""
    with plug_in(getattr(request, "param", "hx711")) as board:
        yield board


@pytest.fixture
def wait_until() -> Callable[[Callable[[], bool]], None]:
    def wait(is_so: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        while not is_so():
            assert time.monotonic() < deadline_s, "it never came"
            time.sleep(0.01)

    return wait


@pytest.fixture
def collect() -> Callable[..., list[LoadCellSample]]:
    """Drains a cell until there are so many samples; `pause` lets time pass for the cell."""

    def collect(
        cell: LoadCell, count: int, pause: Callable[[], None] = lambda: time.sleep(0.01)
    ) -> list[LoadCellSample]:
        samples: list[LoadCellSample] = []
        deadline_s = time.monotonic() + PATIENCE_S
        while len(samples) < count:
            assert time.monotonic() < deadline_s, f"{len(samples)} of {count} samples came"
            samples += cell.drain()
            pause()
        return samples

    return collect
