"""Encoding of the records of a log: protobuf messages, with one topic per record type.

The schemas are made from the dataclasses of `gripper_force.types` when this module is imported, so records and
schemas always agree and there are no generated files. Images are ``foxglove.RawImage``. Foxglove and Rerun show
every topic without knowing this project.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final, get_args, get_type_hints

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import timestamp_pb2
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from mcap.records import Message as McapMessage

from gripper_force.types import NS_PER_S, Frame, Record

CONFIG_NAME: Final = "config.yaml"
METADATA_NAME: Final = "gripper_force"

_FIELD_TYPES: Final = {
    int: FieldDescriptorProto.TYPE_INT64,
    float: FieldDescriptorProto.TYPE_DOUBLE,
    str: FieldDescriptorProto.TYPE_STRING,
    bool: FieldDescriptorProto.TYPE_BOOL,
}


@dataclass(frozen=True, slots=True)
class Codec:
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


def _record_codec(record_type: type[Record]) -> Codec:
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
    return Codec(topic, descriptor.full_name, _schema(descriptor.file), encode, decode)


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


CODECS: Final[dict[type[Record], Codec]] = {
    record_type: _record_codec(record_type) for record_type in get_args(Record) if record_type is not Frame
}
CODECS[Frame] = Codec(
    "/frame",
    RawImage.DESCRIPTOR.full_name,
    _schema(timestamp_pb2.DESCRIPTOR, RawImage.DESCRIPTOR.file),
    _encode_frame,
    _decode_frame,
)
TYPE_OF_TOPIC: Final = {codec.topic: record_type for record_type, codec in CODECS.items()}
