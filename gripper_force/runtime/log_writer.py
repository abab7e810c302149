"""Writer of logs: MCAP files (https://mcap.dev/spec).

A chunk is closed and passed to the operating system at least every 0.1 s of log time, so a killed run loses no
more than that.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Self

from mcap.writer import Writer

from gripper_force.errors import LogError
from gripper_force.runtime.log_codecs import CODECS, CONFIG_NAME, METADATA_NAME, UTC_NAME
from gripper_force.types import NS_PER_MS, AttentionMap, Frame, Record, VisualForce

CHUNK_NS: Final = 100 * NS_PER_MS


def available_ns(record: Record) -> int:
    """Returns the time at which a record was first available."""
    match record:
        case Frame() | AttentionMap():
            return record.received_ns
        case VisualForce():
            return record.ready_ns
        case _:
            return record.t_ns


class LogWriter:
    """Writes a log. One thread alone may use it.

    Args:
        path: A new file; its folder is made if it does not exist.
        config: The run's configuration as YAML.
        metadata: Versions, digests and other facts; and `UTC_NAME`, unless the clock is simulated.
        wrap_file: Wraps the opened file; None: it is written as it is.

    Attributes:
        failed: True once the disk has failed; nothing more is written then.
        waiting: Number of records in the open chunk, which are lost if the disk fails.

    Raises:
        LogError: The file exists already, or can't be written (every method).
    """

    def __init__(
        self,
        path: Path,
        *,
        config: str,
        metadata: Mapping[str, str],
        wrap_file: Callable[[BinaryIO], BinaryIO] | None = None,
    ) -> None:
        self.waiting = 0
        self._path = path
        self._utc_offset_ns = int(metadata.get(UTC_NAME, 0))
        self.failed = False
        self._closed = False
        self._channels: dict[type[Record], int] = {}
        self._chunk_start_ns: int | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file: BinaryIO = path.open("xb")
            self._file = file if wrap_file is None else wrap_file(file)
        except OSError as error:
            remedy = "it exists already, and a log is never overwritten; move it away, or name another file"
            exists = isinstance(error, FileExistsError) and error.filename == str(path)
            reason = remedy if exists else f"{error.strerror} ({error.filename}); name another folder"
            raise LogError(f"can't write the log {path}: {reason}") from error
        self._writer = Writer(self._file)
        try:
            with self._guard():
                self._writer.start(profile="", library="gripper-force")
                self._writer.add_metadata(METADATA_NAME, dict(metadata))
            self.attach(CONFIG_NAME, config.encode(), "application/yaml")
        except LogError:
            self.close()
            with contextlib.suppress(OSError):
                path.unlink()  # the next run with this name would be refused because of an empty file
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, record: Record) -> None:
        """Appends a record.

        Raises:
            LogError: The disk is full or failed (every later call raises too), the log is closed, or a
                field's value doesn't fit its type (the log goes on without the record).
        """
        record_type = type(record)
        t_ns = available_ns(record)
        with self._guard():
            data = CODECS[record_type].encode(record, self._utc_offset_ns)
            utc_ns = t_ns + self._utc_offset_ns
            if not (0 <= t_ns < 2**64 and 0 <= utc_ns < 2**64):
                raise ValueError(f"its time is {t_ns} ns")
            sequence = record.seq if isinstance(record, Frame | AttentionMap) else 0
            if not 0 <= sequence < 2**32:  # detected later, it would damage the chunk
                raise ValueError(f"its sequence number is {sequence}")
            channel = self._channels.get(record_type) or self._register(record_type)
            self._writer.add_message(channel, utc_ns, data, publish_time=t_ns, sequence=sequence)
            self.waiting += 1
            if self._chunk_start_ns is None:
                self._chunk_start_ns = t_ns
            if t_ns - self._chunk_start_ns >= CHUNK_NS:
                self._writer.flush()
                self._chunk_start_ns, self.waiting = None, 0

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        """Adds a file, such as a YAML profile."""
        with self._guard():
            self._writer.add_attachment(0, 0, name, media_type, data)
            self._file.flush()

    def close(self) -> None:
        """Completes the file. May be called twice."""
        if self._closed:
            return
        try:
            if not self.failed:
                with self._guard():
                    self._writer.finish()
                    self._file.flush()
                    self.waiting = 0
        finally:
            self._closed = True
            # After a failure, which was reported, closing may fail once more on the bytes still held.
            with contextlib.suppress(OSError):
                self._file.close()

    def _register(self, record_type: type[Record]) -> int:
        codec = CODECS[record_type]
        schema = self._writer.register_schema(codec.schema_name, "protobuf", codec.schema)
        channel: int = self._writer.register_channel(codec.topic, "protobuf", schema)
        self._channels[record_type] = channel
        return channel

    @contextlib.contextmanager
    def _guard(self) -> Iterator[None]:
        if self._closed or self.failed:
            raise LogError(f"the log {self._path} {'is closed' if self._closed else 'failed before'}")
        try:
            yield
        except OSError as error:
            self.failed = True
            raise LogError(f"can't write the log {self._path}: {error.strerror}") from error
        except (ValueError, TypeError) as error:
            raise LogError(f"a record doesn't fit the log {self._path}: {error}") from error
