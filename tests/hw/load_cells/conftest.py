"""Boards behind pseudo-terminals, which can be unplugged, and a stub of the Phidget library."""

import os
import pty
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest

from gripper_force.config import LoadCellConfig
from gripper_force.interfaces import LoadCell
from gripper_force.types import LoadCellSample

Format = Literal["hx711", "cas"]

TIMEOUT_S = 60.0
"""Longest wait on a busy machine before a test fails."""

LINES: dict[Format, Callable[[int], bytes]] = {
    "hx711": lambda i: b"%d,%d\r\n" % (1000 * i, i),
    "cas": lambda i: b"ST,GS,1\xc4,%8.3f kg\r\n" % (i / 1000),
}


class Board:
    """Sends 0, 1, 2... counts or grams, and continues the count when it is plugged in again."""

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
    """An HX711 board, or the format of the test's parameter."""
    with plug_in(getattr(request, "param", "hx711")) as board:
        yield board


@pytest.fixture
def wait_until() -> Callable[[Callable[[], bool]], None]:
    def wait(condition: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + TIMEOUT_S
        while not condition():
            assert time.monotonic() < deadline_s, "condition not met"
            time.sleep(0.01)

    return wait


@pytest.fixture
def collect() -> Callable[..., list[LoadCellSample]]:
    """Drains a load cell until it gave this many samples; `pause` lets time pass for it."""

    def collect(
        cell: LoadCell, count: int, pause: Callable[[], None] = lambda: time.sleep(0.01)
    ) -> list[LoadCellSample]:
        samples: list[LoadCellSample] = []
        deadline_s = time.monotonic() + TIMEOUT_S
        while len(samples) < count:
            assert time.monotonic() < deadline_s, f"{len(samples)} of {count} samples received"
            samples += cell.drain()
            pause()
        return samples

    return collect


class PhidgetError(Exception):
    """Stub of the vendor's PhidgetException."""

    def __init__(self, code: int) -> None:
        self.code, self.description = code, "Timed Out" if code == 3 else "Invalid Argument"


class Channel:
    """Stub of the vendor's VoltageRatioInput: records the values it is given."""

    attach_error: PhidgetError | None = None
    made: list["Channel"]

    def __init__(self) -> None:
        self.told: dict[str, Any] = {}
        self.closed = 0
        self.made.append(self)

    def __getattr__(self, name: str) -> Any:
        return lambda value: self.told.update({name.removeprefix("set"): value})

    def openWaitForAttachment(self, timeout_ms: int) -> None:  # noqa: N802
        if self.attach_error is not None:
            raise self.attach_error

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def phidget_library(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A stub of the vendor's library without a bridge."""

    class Fresh(Channel):
        made: list[Channel] = []  # noqa: RUF012

    library = SimpleNamespace(
        VoltageRatioInput=Fresh,
        PhidgetException=PhidgetError,
        BridgeGain=SimpleNamespace(BRIDGE_GAIN_128=8),
        Phidget=SimpleNamespace(getLibraryVersion=lambda: "1.26"),
    )
    monkeypatch.setitem(sys.modules, "Phidget22.Devices.VoltageRatioInput", library)
    return library
