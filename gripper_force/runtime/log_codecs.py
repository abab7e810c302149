"""Encoding of the records of a log: protobuf messages, with one topic per record type.

The schemas are made from the dataclasses of `gripper_force.types` when this module is imported, so records and
schemas always agree and there are no generated files. Images are ``foxglove.RawImage`` and events ``foxglove.Log``.
A message's publish time is on the clock of the records; its log time is the same time in UTC (see `UTC_NAME`).
Foxglove and Rerun show every topic without knowing this project.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any, Final, get_args, get_type_hints

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import timestamp_pb2
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from mcap.records import Message as McapMessage

from gripper_force.types import NS_PER_S, AttentionMap, Event, Frame, Record

CONFIG_NAME: Final = "config.yaml"
METADATA_NAME: Final = "gripper_force"
UTC_NAME: Final = "utc_offset_ns"
"""Key of the metadata: UTC less the clock of the records, in nanoseconds; missing if that clock is simulated."""

INTERVAL_STD: Final = 1.645
"""Half-width of the 90 % interval of a normal distribution, in standard deviations."""

_LOW, _HIGH = 101, 102
"""Numbers of the fields with the ends of the claimed interval, which a viewer can't compute."""

_FIELD_TYPES: Final = {
    int: FieldDescriptorProto.TYPE_INT64,
    float: FieldDescriptorProto.TYPE_DOUBLE,
    str: FieldDescriptorProto.TYPE_STRING,
    bool: FieldDescriptorProto.TYPE_BOOL,
}


@dataclass(frozen=True, slots=True)
class Codec:
    """Encoding of one record type; ``encode`` takes a record and UTC less its clock."""

    record_type: type[Record]
    topic: str
    schema_name: str
    schema: bytes
    encode: Callable[[Any, int], bytes]
    decode: Callable[[McapMessage], Record]


def _message_class(record_type: type[Record]) -> type[Message]:
    name = record_type.__name__
    file = FileDescriptorProto(name=f"gripper_force/{name}.proto", package="gripper_force", syntax="proto3")
    message = file.message_type.add(name=name)
    hints = get_type_hints(record_type)
    fields = [(number, *hint) for number, hint in enumerate(hints.items(), start=1)]
    if "std_n" in hints:
        fields += [(_LOW, "low_n", float), (_HIGH, "high_n", float)]
    for number, field, kind in fields:
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


def _record_codec(record_type: type[Record]) -> Codec:
    message_class: Any = _message_class(record_type)
    names = tuple(get_type_hints(record_type))
    values = attrgetter(*names)

    def encode(record: Any, utc_offset_ns: int) -> bytes:
        message = message_class(**dict(zip(names, values(record), strict=True)))
        if "std_n" in names:
            half_n = INTERVAL_STD * record.std_n
            message.low_n, message.high_n = record.force_n - half_n, record.force_n + half_n
        return bytes(message.SerializeToString())

    def decode(message: McapMessage) -> Record:
        return record_type(*values(message_class.FromString(message.data)))

    topic = "/" + re.sub(r"(?<!^)(?=[A-Z])", "_", record_type.__name__).lower()
    descriptor = message_class.DESCRIPTOR
    return Codec(record_type, topic, descriptor.full_name, _schema(descriptor.file), encode, decode)


def _timestamp(t_ns: int) -> timestamp_pb2.Timestamp:
    seconds, nanos = divmod(t_ns, NS_PER_S)
    return timestamp_pb2.Timestamp(seconds=seconds, nanos=nanos)


def _encode_event(event: Event, utc_offset_ns: int) -> bytes:
    timestamp = _timestamp(event.t_ns + utc_offset_ns)
    message = Log(timestamp=timestamp, level=Log.INFO, name=event.unit, message=event.text)
    return bytes(message.SerializeToString())


def _decode_event(message: McapMessage) -> Event:
    if message.publish_time >= 2**63:
        raise ValueError(f"an event came at {message.publish_time} ns")
    log = Log.FromString(message.data)
    return Event(message.publish_time, log.name, log.message)


def _encode_image(frame: Frame | AttentionMap, utc_offset_ns: int) -> bytes:
    if frame.gray.ndim != 2 or frame.gray.dtype != np.uint8:
        raise ValueError(f"a frame is (H, W) uint8, not {frame.gray.shape} {frame.gray.dtype}")
    height, width = frame.gray.shape
    message = RawImage(
        timestamp=_timestamp(frame.t_ns + utc_offset_ns),
        frame_id="camera",
        width=width,
        height=height,
        encoding="mono8",
        step=width,
        data=frame.gray.tobytes(),
    )
    return bytes(message.SerializeToString())


def _decode_image(record_type: type[Frame | AttentionMap], message: McapMessage) -> Record:
    image = RawImage.FromString(message.data)
    if image.encoding not in {"mono8", "8UC1"}:
        raise ValueError(f"an image is {image.encoding!r}, not mono8")
    if not (image.height and 0 < image.width <= image.step):
        raise ValueError(f"an image has {image.width}x{image.height} pixels in rows of {image.step}")
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    gray = rows[:, : image.width].copy()  # a writable array of its own, as torch wants it  # (H, W)
    utc_offset_ns = message.log_time - message.publish_time
    t_ns = image.timestamp.seconds * NS_PER_S + image.timestamp.nanos - utc_offset_ns
    if not max(abs(t_ns), message.publish_time) < 2**63:
        raise ValueError(f"an image was taken at {t_ns} ns and came at {message.publish_time} ns")
    return record_type(t_ns, message.publish_time, message.sequence, gray)


def _image_codec(record_type: type[Frame | AttentionMap], topic: str) -> Codec:
    schema = _schema(timestamp_pb2.DESCRIPTOR, RawImage.DESCRIPTOR.file)
    decode = partial(_decode_image, record_type)
    return Codec(record_type, topic, RawImage.DESCRIPTOR.full_name, schema, _encode_image, decode)


_LOG_SCHEMA: Final = _schema(timestamp_pb2.DESCRIPTOR, Log.DESCRIPTOR.file)
_OWN: Final = {kind: _record_codec(kind) for kind in get_args(Record) if kind not in (Frame, AttentionMap)}
CODECS: Final[dict[type[Record], Codec]] = {
    **_OWN,
    Frame: _image_codec(Frame, "/frame"),
    AttentionMap: _image_codec(AttentionMap, "/attention_map"),
    Event: Codec(Event, "/log", Log.DESCRIPTOR.full_name, _LOG_SCHEMA, _encode_event, _decode_event),
}
CODEC_OF_TOPIC: Final = {codec.topic: codec for codec in (*_OWN.values(), *CODECS.values())}
"""Codecs of logs of this version and of older ones, whose events have a schema of their own."""


def record_fields(schema: bytes) -> list[tuple[str, int, int]]:
    """Returns name, number and type of the fields that hold a record, without those for viewers."""
    files = FileDescriptorSet.FromString(schema).file
    fields = (field for file in files for message in file.message_type for field in message.field)
    return [(field.name, field.number, field.type) for field in fields if field.number < _LOW]
