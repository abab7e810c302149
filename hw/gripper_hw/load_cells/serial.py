"""Driver for load cells that send lines on a serial port."""

import math
import termios
import threading
from contextlib import suppress
from typing import Final

import serial

from gripper_force.config import LoadCellConfig
from gripper_force.errors import ConfigError, DeviceError
from gripper_force.interfaces import Clock
from gripper_force.types import STANDARD_GRAVITY_M_S2
from gripper_hw.load_cells.line_formats import PARSERS, LineSplitter
from gripper_hw.load_cells.screening import LiveLoadCell
from gripper_hw.serial_line import open_line

RECONNECT_S: Final = 0.5
"""Pause between two attempts to open a lost port."""


class SerialLoadCell(LiveLoadCell):
    """A load cell on a serial port. A background thread reads the port, and reopens it after a loss.

    A sample's time is when its line was complete.

    Args:
        config: The load cell section of the configuration: port, baud rate, format, tare and scale.
        clock: The run's clock.

    Raises:
        ConfigError: ``load_cell.port`` is not set.
    """

    def __init__(self, config: LoadCellConfig, clock: Clock) -> None:
        in_kg = config.format == "cas"
        super().__init__(config, clock, unit_n=STANDARD_GRAVITY_M_S2 if in_kg else math.nan)
        if config.port is None:
            raise ConfigError(
                "load_cell.backend=serial needs load_cell.port; set it to one of /dev/serial/by-id"
            )
        self._port_name = config.port
        self._parse = PARSERS[config.format]
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._port: serial.Serial | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Opens the port exclusively and starts reading.

        Raises:
            DeviceNotFoundError: The port does not exist.
            DeviceError: The port is in use or cannot be opened.
        """
        if self._thread is None:
            port = self._open()
            self._thread = threading.Thread(target=self._run, args=(port,), name="load-cell", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stops reading and releases the port. May be called twice."""
        self._stop.set()
        with self._lock:
            if self._port is not None:
                self._port.cancel_read()
        if self._thread is not None:
            self._thread.join()

    def _run(self, port: serial.Serial | None) -> None:
        while port is not None:
            try:
                with port:
                    self._read_lines(port)
            except (OSError, termios.error):
                self.stats.losses += 1
            port = self._reopen()

    def _read_lines(self, port: serial.Serial) -> None:
        lines = LineSplitter()
        with self._lock:
            self._port = port
        try:
            while not self._stop.is_set():
                for line in lines.feed(port.read(max(1, port.in_waiting))):
                    if (reading := self._parse(line)) is None:
                        self.stats.unreadable += 1
                    else:
                        self._add(*reading)
        finally:
            with self._lock:
                self._port = None

    def _reopen(self) -> serial.Serial | None:
        while not self._stop.wait(RECONNECT_S):
            with suppress(DeviceError):
                return self._open()
        return None

    def _open(self) -> serial.Serial:
        return open_line(self._port_name, self._config.baud_rate, unit="load_cell", timeout_s=None)
