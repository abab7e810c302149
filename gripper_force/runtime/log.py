"""Logs: a run is an MCAP file of protobuf messages, with one topic per record type.

The protobuf schemas are made from the dataclasses of `gripper_force.types` when this module is imported, so
records and schemas always agree and there are no generated files. Images are ``foxglove.RawImage``. Foxglove and
Rerun show every topic without knowing this project.

A chunk is closed and passed to the operating system at least every 0.1 s of log time, so a killed run loses no
more than that. Format: https://mcap.dev/spec
"""

import contextlib
import dataclasses
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Self, TypeVar, get_args, get_type_hints, overload

import numpy as np
import zstandard
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import timestamp_pb2
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer

from gripper_force.errors import LogError
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, Record, VisualForce

CHUNK_NS: Final = 100 * NS_PER_MS
CONFIG_NAME: Final = "config.yaml"
METADATA_NAME: Final = "gripper_force"

_MAGIC: Final = b"\x89MCAP0\r\n"
_FRAMING: Final = struct.Struct("<BQ")
_TIMES: Final = struct.Struct("<QQ")
_MAX_CHUNK: Final = 1 << 28
_DAMAGE: Final = (
    McapError,
    DecodeError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    OverflowError,
)
"""Exceptions of the decoders on damaged bytes."""

_FIELD_TYPES: Final = {
    int: FieldDescriptorProto.TYPE_INT64,
    float: FieldDescriptorProto.TYPE_DOUBLE,
    str: FieldDescriptorProto.TYPE_STRING,
    bool: FieldDescriptorProto.TYPE_BOOL,
}

A = TypeVar("A", bound=Record)
B = TypeVar("B", bound=Record)
C = TypeVar("C", bound=Record)


@dataclass(frozen=True, slots=True)
class _Codec:
    """Encoding of one record type."""

    topic: str
    schema_name: str
    schema: bytes
    encode: Callable[[Any], bytes]
    decode: Callable[[Any], Record]


def _message_class(record_type: type[Record]) -> type[Message]:
    name = record_type.__name__
    file = FileDescriptorProto(name=f"gripper_force/{name}.proto", package="gripper_force", syntax="proto3")
    message = file.message_type.add(name=name)
    for number, (field, kind) in enumerate(get_type_hints(record_type).items(), start=1):
        message.field.add(
            name=field, number=number, type=_FIELD_TYPES[kind], label=FieldDescriptorProto.LABEL_OPTIONAL
        )
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return GetMessageClass(pool.FindMessageTypeByName(f"gripper_force.{name}"))


def _schema(*files: FileDescriptor) -> bytes:
    result = FileDescriptorSet()
    for file in files:
        file.CopyToProto(result.file.add())
    return result.SerializeToString()


def _record_codec(record_type: type[Record]) -> _Codec:
    message_class: Any = _message_class(record_type)
    names = tuple(get_type_hints(record_type))
    values = attrgetter(*names)

    def encode(record: Record) -> bytes:
        data: bytes = message_class(**dict(zip(names, values(record), strict=True))).SerializeToString()
        return data

    def decode(message: McapMessage) -> Record:
        return record_type(*values(message_class.FromString(message.data)))

    topic = "/" + re.sub(r"(?<!^)(?=[A-Z])", "_", record_type.__name__).lower()
    descriptor = message_class.DESCRIPTOR
    return _Codec(topic, descriptor.full_name, _schema(descriptor.file), encode, decode)


def _encode_frame(frame: Frame) -> bytes:
    if frame.gray.ndim != 2 or frame.gray.dtype != np.uint8:
        raise ValueError(f"a frame is (H, W) uint8, not {frame.gray.shape} {frame.gray.dtype}")
    height, width = frame.gray.shape
    seconds, nanos = divmod(frame.t_ns, NS_PER_S)
    message = RawImage(
        timestamp=timestamp_pb2.Timestamp(seconds=seconds, nanos=nanos),
        frame_id="camera",
        width=width,
        height=height,
        encoding="mono8",
        step=width,
        data=frame.gray.tobytes(),
    )
    data: bytes = message.SerializeToString()
    return data


def _decode_frame(message: McapMessage) -> Frame:
    image = RawImage.FromString(message.data)
    if image.encoding not in {"mono8", "8UC1"}:
        raise ValueError(f"an image is {image.encoding!r}, not mono8")
    if not (image.height and 0 < image.width <= image.step):
        raise ValueError(f"an image has {image.width}x{image.height} pixels in rows of {image.step}")
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    gray = rows[:, : image.width].copy()  # a writable array of its own, as torch wants it  # (H, W)
    t_ns = image.timestamp.seconds * NS_PER_S + image.timestamp.nanos
    if not max(abs(t_ns), message.log_time) < 2**63:
        raise ValueError(f"an image was taken at {t_ns} ns and came at {message.log_time} ns")
    return Frame(t_ns, message.log_time, message.sequence, gray)


_CODECS: Final[dict[type[Record], _Codec]] = {
    record_type: _record_codec(record_type) for record_type in get_args(Record) if record_type is not Frame
}
_CODECS[Frame] = _Codec(
    "/frame",
    RawImage.DESCRIPTOR.full_name,
    _schema(timestamp_pb2.DESCRIPTOR, RawImage.DESCRIPTOR.file),
    _encode_frame,
    _decode_frame,
)
_TYPE_OF_TOPIC: Final = {codec.topic: record_type for record_type, codec in _CODECS.items()}


def _log_ns(record: Record) -> int:
    """Time at which the record was first available."""
    match record:
        case Frame():
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
        metadata: Versions, digests and other facts.
        wrap_file: Wraps the opened file.

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
        wrap_file: Callable[[BinaryIO], BinaryIO] = lambda file: file,
    ) -> None:
        self.waiting = 0
        self._path = path
        self.failed = False
        self._closed = False
        self._channels: dict[type[Record], int] = {}
        self._chunk_start_ns: int | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = wrap_file(path.open("xb"))
        except OSError as error:
            there = "it exists already, and a log is never overwritten; move it away, or set log.directory"
            reason = there if path.exists() else error.strerror
            raise LogError(f"can't write the log {path}: {reason}") from error
        self._writer = Writer(self._file)
        try:
            with self._guard():
                self._writer.start(profile="", library="gripper-force")
                self._writer.add_metadata(METADATA_NAME, dict(metadata))
            self.attach(CONFIG_NAME, config.encode(), "application/yaml")
        except LogError:
            self.close()
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
        log_ns = _log_ns(record)
        with self._guard():
            data = _CODECS[record_type].encode(record)
            if not 0 <= log_ns < 2**64:
                raise ValueError(f"its time is {log_ns} ns")
            sequence = record.seq if isinstance(record, Frame) else 0
            if not 0 <= sequence < 2**32:  # detected later, it would damage the chunk
                raise ValueError(f"its sequence number is {sequence}")
            channel = self._channels.get(record_type) or self._register(record_type)
            self._writer.add_message(channel, log_ns, data, publish_time=log_ns, sequence=sequence)
            self.waiting += 1
            if self._chunk_start_ns is None:
                self._chunk_start_ns = log_ns
            if log_ns - self._chunk_start_ns >= CHUNK_NS:
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
        codec = _CODECS[record_type]
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

    Raises:
        LogError: The file is missing, no MCAP, not of this project, or (without ``recover``) cut short.
    """

    def __init__(self, path: str | Path, *, recover: bool = False) -> None:
        self.path = path = Path(path)
        self.complete = False
        self.metadata: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self._recover = recover
        self._chunks: list[_Chunk] = []
        try:
            with path.open("rb") as file:
                self._scan(file)
        except OSError as error:
            raise LogError(f"can't read the log {path}: {error.strerror}; check the path") from error
        if not (self.complete or recover):
            raise LogError(self._loss())
        if CONFIG_NAME not in self.attachments:
            why = "it holds no configuration" if self.complete else "it is cut before its configuration"
            raise LogError(f"{path} can't be used: {why}, so gripper-force did not write it whole")
        self.config = self.attachments[CONFIG_NAME].decode(errors="replace")

    @property
    def start_ns(self) -> int:
        """Log time of the first record in nanoseconds; 0 for an empty log."""
        return min((chunk.start_ns for chunk in self._chunks), default=0)

    @property
    def duration_ns(self) -> int:
        """Log time from the first record to the last in nanoseconds."""
        return max((chunk.end_ns for chunk in self._chunks), default=0) - self.start_ns

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
            LogError: A chunk is damaged (without ``recover``; with it the records end there), or a topic is
                not as this version writes it.
        """
        try:
            for channel, message in self._messages(frozenset(types or _CODECS)):
                yield channel.decode(message)
        except OSError as error:
            raise LogError(f"can't read the log {self.path}: {error.strerror}") from error
        except _DAMAGE as error:
            if not self._recover:
                raise LogError(f"{self.path} is damaged ({error}); --recover reads it up to there") from error

    def _messages(self, wanted: frozenset[type[Record]]) -> Iterator[tuple[_Codec, McapMessage]]:
        schemas: dict[int, Schema] = {}
        codecs: dict[int, _Codec | None] = {}
        with self.path.open("rb") as file:
            for chunk in self._chunks:
                file.seek(chunk.offset)
                chunk_data = _checked(Chunk.read(_stream(file.read(chunk.length))))
                for item in breakup_chunk(chunk_data, validate_crc=True):
                    if isinstance(item, McapMessage):
                        if item.channel_id not in codecs:
                            raise ValueError("a message before its channel")
                        codec = codecs[item.channel_id]
                        if codec is not None:
                            yield codec, item
                    elif isinstance(item, Schema):
                        schemas[item.id] = item
                    elif isinstance(item, Channel):
                        record_type = self._record_type(item, schemas.get(item.schema_id))
                        codecs[item.id] = _CODECS[record_type] if record_type in wanted else None

    def _record_type(self, channel: Channel, schema: Schema | None) -> type[Record]:
        record_type = _TYPE_OF_TOPIC.get(channel.topic)
        if record_type is None or schema is None or schema.encoding != "protobuf":
            raise LogError(f"{self.path} holds the topic {channel.topic}, which gripper-force doesn't know")
        codec = _CODECS[record_type]
        # Foxglove and protobuf keep foxglove.RawImage compatible; our own records must agree field by field.
        if schema.name != codec.schema_name or (
            record_type is not Frame and not _is_readable(_fields(schema.data), record_type)
        ):
            raise LogError(
                f"{self.path} holds {channel.topic} as another version of gripper-force wrote it; "
                f"read it with that version{_version(self.metadata)}"
            )
        return record_type

    def _scan(self, file: BinaryIO) -> None:
        """Reads the framing of the records, and keeps the positions of complete ones."""
        magic = file.read(len(_MAGIC))
        if not _MAGIC.startswith(magic):
            raise LogError(f"{self.path} is not an MCAP file; pass a log that gripper-force wrote")
        size = self.path.stat().st_size
        with contextlib.suppress(*_DAMAGE):
            while file.tell() + _FRAMING.size <= size:
                opcode, length = _FRAMING.unpack(file.read(_FRAMING.size))
                start = file.tell()
                if start + length > size:
                    return
                self._note(file, opcode, start, length)
                file.seek(start + length)
                if opcode == Opcode.FOOTER:
                    self.complete = file.read() == _MAGIC
                    return

    def _note(self, file: BinaryIO, opcode: int, start: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            start_ns, end_ns = _TIMES.unpack(file.read(_TIMES.size))
            self._chunks.append(_Chunk(start, length, start_ns, end_ns))
        elif opcode == Opcode.ATTACHMENT:
            attachment = Attachment.read(_stream(file.read(length)))
            self.attachments[attachment.name] = attachment.data
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(_stream(file.read(length)))
            if metadata.name == METADATA_NAME:
                self.metadata = metadata.metadata

    def _loss(self) -> str:
        self._recover = True
        count = sum(1 for _ in self.records())
        return (
            f"{self.path} is cut short or damaged: {count} records ({self.duration_ns / NS_PER_S:.2f} s) "
            "can be recovered, --recover reads them"
        )


def _checked(chunk: Chunk) -> Chunk:
    """Returns the chunk after a check that unpacking it takes the stated and a limited amount of memory."""
    match chunk.compression:
        case "zstd":
            size = zstandard.frame_content_size(chunk.data)
        case "":
            size = len(chunk.data)
        case other:
            raise ValueError(f"a chunk is compressed as {other!r}")
    if size != chunk.uncompressed_size or size > _MAX_CHUNK:
        raise ValueError(f"a chunk says that it holds {chunk.uncompressed_size} bytes, and holds {size}")
    return chunk


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(data))


def _fields(schema: bytes) -> list[tuple[str, int, int]]:
    files = FileDescriptorSet.FromString(schema).file
    return [(f.name, f.number, f.type) for file in files for m in file.message_type for f in m.field]


def _is_readable(fields: list[tuple[str, int, int]], record_type: type[Record]) -> bool:
    """Returns True if the fields are those of the record, or lack only later ones whose default is zero."""
    known = _fields(_CODECS[record_type].schema)
    missing = known[len(fields) :]
    defaults = {field.name: field.default for field in dataclasses.fields(record_type)}
    return fields == known[: len(fields)] and all(
        defaults[name] in (0.0, "", False) for name, _, _ in missing
    )


def _version(metadata: Mapping[str, str]) -> str:
    return f" ({metadata['version']})" if "version" in metadata else ""
