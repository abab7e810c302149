"""Reader of logs, complete or truncated."""

import contextlib
import dataclasses
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeVar, overload

import zstandard
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata, Schema, Statistics
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk

from gripper_force.errors import LogError
from gripper_force.runtime.log_codecs import (
    CODEC_OF_TOPIC,
    CODECS,
    CONFIG_NAME,
    METADATA_NAME,
    UTC_NAME,
    Codec,
    record_fields,
)
from gripper_force.schema import as_path
from gripper_force.types import NS_PER_S, Record

_MAGIC: Final = b"\x89MCAP0\r\n"
_FRAMING: Final = struct.Struct("<BQ")
_TIMES: Final = struct.Struct("<QQ")
_MAX_CHUNK: Final = 1 << 28
_DAMAGE: Final = (McapError, DecodeError, zstandard.ZstdError, struct.error, ValueError, OverflowError)
"""Exceptions of the decoders on damaged bytes."""

_REMEDY: Final = "read the rest with `gripper-force replay LOG --recover`, and leave this log out elsewhere"

A = TypeVar("A", bound=Record)
B = TypeVar("B", bound=Record)
C = TypeVar("C", bound=Record)


@dataclass(frozen=True, slots=True)
class _Chunk:
    """Position and times of a complete chunk."""

    offset: int
    length: int
    start_ns: int
    end_ns: int


class LogReader:
    """Reads a log, complete or truncated.

    Args:
        path: The file.
        recover: Read what is whole of a file that is cut short or damaged.

    Attributes:
        config: The run's configuration as YAML.
        metadata: Versions, digests and other facts.
        attachments: Files by name, the configuration among them.
        complete: False where the file ends before its footer.
        damaged: Positions of the chunks of about a tenth of a second that were read and left out as damaged.
        utc_offset_ns: UTC less the clock of the records, in nanoseconds; 0 if that clock is simulated.

    Raises:
        ConfigError: ``path`` is no path.
        LogError: The file is missing, no MCAP, not of this project, or (without ``recover``) cut short.
    """

    def __init__(self, path: str | Path, *, recover: bool = False) -> None:
        self.path = path = as_path(path, "the log")
        self.complete = False
        self.utc_offset_ns = 0
        self.metadata: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self.damaged: set[int] = set()
        self._recover = recover
        self._chunks: list[_Chunk] = []
        self._scan_end = 0
        try:
            with path.open("rb") as file:
                self._scan(file)
        except OSError as error:
            raise LogError(f"can't read the log {path}: {error.strerror}; check the path") from error
        if CONFIG_NAME not in self.attachments:
            problem = "holds no configuration" if self.complete else "is empty, or damaged at its start"
            raise LogError(f"{path} {problem}, so it can't be used; leave it out")
        if not (self.complete or recover):
            raise LogError(self._describe_loss())
        self.config = self.attachments[CONFIG_NAME].decode(errors="replace")

    @property
    def start_ns(self) -> int:
        """Time of the first record in nanoseconds; 0 for an empty log."""
        return min((chunk.start_ns - self.utc_offset_ns for chunk in self._chunks), default=0)

    @property
    def duration_ns(self) -> int:
        """Time from the first record to the last in nanoseconds."""
        return max((c.end_ns - self.utc_offset_ns for c in self._chunks), default=0) - self.start_ns

    @overload
    def records(self, a: type[A], /) -> Iterator[A]: ...
    @overload
    def records(self, a: type[A], b: type[B], /) -> Iterator[A | B]: ...
    @overload
    def records(self, a: type[A], b: type[B], c: type[C], /) -> Iterator[A | B | C]: ...
    @overload
    def records(self, *types: type[Record]) -> Iterator[Record]: ...

    def records(self, *types: type[Any]) -> Iterator[Any]:
        """Yields the records of the given types, or all of them, in the order in which they were written.

        Raises:
            TypeError: One of the types is not among those that a log holds.
            LogError: A chunk is damaged (without ``recover``; with it the chunk is left out), or a topic is not as this
                version writes it.
        """
        if unknown := [kind for kind in types if kind not in [*CODECS]]:  # at the call, not in the generator
            names = ", ".join(sorted(kind.__name__ for kind in CODECS))
            raise TypeError(f"{unknown[0]!r} is no type of the records in a log; pass some of {names}")
        return self._decoded(frozenset(types or CODECS))

    def _decoded(self, types: frozenset[type[Record]]) -> Iterator[Record]:
        try:
            for channel, message in self._messages(types):
                yield channel.decode(message)
        except OSError as error:
            raise LogError(f"can't read the log {self.path}: {error.strerror}") from error
        except _DAMAGE as error:
            if not self._recover:
                raise LogError(f"{self.path} is damaged ({error}); {_REMEDY}") from error

    def _messages(self, record_types: frozenset[type[Record]]) -> Iterator[tuple[Codec, McapMessage]]:
        schemas: dict[int, Schema] = {}
        codecs: dict[int, Codec | None] = {}
        for item in self._chunk_contents():
            if isinstance(item, McapMessage):
                if item.channel_id not in codecs:
                    raise ValueError("a message before its channel")
                if (codec := codecs[item.channel_id]) is not None:
                    yield codec, item
            elif isinstance(item, Schema):
                schemas[item.id] = item
            elif isinstance(item, Channel):
                codec = self._codec(item, schemas.get(item.schema_id))
                codecs[item.id] = codec if codec.record_type in record_types else None

    def _chunk_contents(self) -> Iterator[McapRecord]:
        """Yields schemas, channels and messages of each chunk; with ``recover`` a damaged chunk is left out."""
        with self.path.open("rb") as file:
            for chunk in self._chunks_to_read():
                file.seek(chunk.offset)
                try:
                    contents = _checked(Chunk.read(_stream(file.read(chunk.length))))
                    yield from breakup_chunk(contents, validate_crc=True)
                except _DAMAGE:
                    if not self._recover:
                        raise
                    self.damaged.add(chunk.offset)

    def _chunks_to_read(self) -> Iterator[_Chunk]:
        """Yields the chunks to read; a log that is being written has more later (`GrowingLog`)."""
        yield from self._chunks

    def _codec(self, channel: Channel, schema: Schema | None) -> Codec:
        codec = CODEC_OF_TOPIC.get(channel.topic)
        if codec is None or schema is None or schema.encoding != "protobuf":
            raise LogError(f"{self.path} holds the topic {channel.topic}, which gripper-force doesn't know")
        # Foxglove and protobuf keep Foxglove's schemas compatible; our own records must agree field by field.
        is_own = codec.schema_name.startswith("gripper_force.")
        if schema.name != codec.schema_name or (is_own and not _is_readable(schema.data, codec)):
            raise LogError(
                f"{self.path} holds {channel.topic} as another version of gripper-force wrote it; "
                f"read it with that version{_version(self.metadata)}"
            )
        return codec

    def _scan(self, file: BinaryIO) -> None:
        """Reads the framing of the records that were not read yet, and keeps the positions of complete ones."""
        if not self._scan_end:
            if not _MAGIC.startswith(file.read(len(_MAGIC))):
                raise LogError(f"{self.path} is not an MCAP file; pass a log that gripper-force wrote")
            self._scan_end = len(_MAGIC)
        file.seek(self._scan_end)
        size = self.path.stat().st_size
        with contextlib.suppress(*_DAMAGE):
            while file.tell() + _FRAMING.size <= size:
                opcode, length = _FRAMING.unpack(file.read(_FRAMING.size))
                offset = file.tell()
                if offset + length > size:
                    return
                self._read_framed(file, opcode, offset, length)
                self._scan_end = file.seek(offset + length)
                if opcode == Opcode.FOOTER:
                    self.complete = file.read() == _MAGIC
                    return

    def _read_framed(self, file: BinaryIO, opcode: int, offset: int, length: int) -> None:
        """Keeps what a reader needs before the messages: chunk positions, attachments and metadata."""
        if opcode == Opcode.CHUNK:
            start_ns, end_ns = _TIMES.unpack(file.read(_TIMES.size))
            self._chunks.append(_Chunk(offset, length, start_ns, end_ns))
        elif opcode == Opcode.ATTACHMENT:
            data = file.read(length)
            stored_crc = int.from_bytes(data[-4:], "little")  # 0: the tool that wrote the file computes none
            if stored_crc and zlib.crc32(data[:-4]) != stored_crc:
                raise ValueError("an attachment is damaged")
            attachment = Attachment.read(_stream(data))
            self.attachments[attachment.name] = attachment.data
        elif opcode == Opcode.STATISTICS:
            if Statistics.read(_stream(file.read(length))).chunk_count != len(self._chunks):
                raise ValueError("a chunk is missing")
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(_stream(file.read(length)))
            if metadata.name == METADATA_NAME:
                self.metadata = metadata.metadata
                self.utc_offset_ns = int(self.metadata.get(UTC_NAME, 0))

    def _describe_loss(self) -> str:
        self._recover = True
        readable = f"{sum(1 for _ in self.records())} records ({self.duration_ns / NS_PER_S:.2f} s)"
        return f"{self.path} is cut short, damaged or not finished yet: {readable} are left; {_REMEDY}"


def _checked(chunk: Chunk) -> Chunk:
    """Returns the chunk after a check that unpacking it takes the stated and a limited amount of memory."""
    if chunk.compression not in ("zstd", ""):
        raise ValueError(f"a chunk is compressed as {chunk.compression!r}")
    size = zstandard.frame_content_size(chunk.data) if chunk.compression else len(chunk.data)
    if size != chunk.uncompressed_size or size > _MAX_CHUNK:
        raise ValueError(f"a chunk says that it holds {chunk.uncompressed_size} bytes, and holds {size}")
    return chunk


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(data))


def _is_readable(schema: bytes, codec: Codec) -> bool:
    """Returns True if the fields are those of the record, or lack only later ones whose default is zero."""
    fields, expected = record_fields(schema), record_fields(codec.schema)
    missing = expected[len(fields) :]
    defaults = {field.name: field.default for field in dataclasses.fields(codec.record_type)}
    return fields == expected[: len(fields)] and all(
        defaults[name] in (0.0, "", False) for name, _, _ in missing
    )


def _version(metadata: Mapping[str, str]) -> str:
    version = metadata.get("version gripper-force")
    return f" ({version})" if version else ""
