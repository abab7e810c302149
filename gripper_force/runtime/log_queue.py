"""Queue in front of the log, so that a run neither waits for the disk nor ends because of it."""

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from gripper_force.errors import LogError
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import Record

CAPACITY: Final = 4096
"""Records that may wait for the disk: about three seconds of a run."""

_TIMEOUT_S: Final = 10.0


class LogQueue:
    """Passes records to a log and counts lost ones.

    In real time a thread writes; if the disk is so slow that the queue is full, records are dropped. In lockstep
    the caller writes, while the clock stands still.

    Args:
        log: The log; the queue closes it.
        lockstep: True if the clock is simulated.

    Attributes:
        lost: Number of records missing from the log.
    """

    def __init__(self, log: LogWriter, *, lockstep: bool) -> None:
        self.lost = 0
        self._log = log
        self._error, self._remedy = "", "free some space, or name another folder (log.directory or --out)"
        self._queue: queue.Queue[Callable[[], None] | None] = queue.Queue(CAPACITY)
        self._thread: threading.Thread | None = None
        if not lockstep:
            self._thread = threading.Thread(target=self._run, name="log_queue", daemon=True)
            self._thread.start()

    def write(self, record: Record) -> None:
        """Writes a record, now or soon."""
        self._submit(lambda: self._log.write(record))

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        """Adds a file to the log, now or soon."""
        self._submit(lambda: self._log.attach(name, data, media_type))

    def close(self) -> None:
        """Writes the waiting records and completes the log. May be called twice."""
        if self._thread is not None:
            with suppress(queue.Full):  # the thread is blocked
                self._queue.put(None, timeout=_TIMEOUT_S)
                self._thread.join(_TIMEOUT_S)
            if self._thread.is_alive():
                self.lost += self._queue.qsize()
                self._error = f"the disk did not take the last records within {_TIMEOUT_S:g} s"
                return  # the log is still the thread's
            self._thread = None
        self._run_write(self._log.close)

    def raise_losses(self) -> None:
        """Reports lost records after the run, because they must not end it.

        Raises:
            LogError: Records are missing from the log.
        """
        if self._error:
            raise LogError(
                f"{self._error}; the run went on, and its log lacks {self.lost} records: {self._remedy}"
            )

    def _submit(self, write: Callable[[], None]) -> None:
        if self._thread is None:
            self._run_write(write)
            return
        try:
            self._queue.put_nowait(write)
        except queue.Full:
            self.lost += 1
            self._error = self._error or "the disk is too slow for the log"

    def _run(self) -> None:
        while (write := self._queue.get()) is not None:
            self._run_write(write)

    def _run_write(self, write: Callable[[], None]) -> None:
        try:
            write()
        # If the thread ended here, all later records would be lost without a message.
        except Exception as error:
            self._lose(str(error) if isinstance(error, LogError) else f"{type(error).__name__}: {error}")

    def _lose(self, reason: str) -> None:
        self.lost += 1
        if self._log.failed:
            self.lost += self._log.waiting
            self._log.waiting = 0
        elif not self._error:
            self._remedy = "correct the class of the device that gave them"
        self._error = self._error or reason
