import errno
import io
import re
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO, get_args

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from gripper_force.errors import ConfigError, LogError
from gripper_force.fault_config import FaultConfig
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.runtime.log_codecs import CODECS, INTERVAL_STD, UTC_NAME
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import CHUNK_NS, LogWriter
from gripper_force.types import (
    NS_PER_MS,
    AttentionMap,
    Event,
    ForceEstimate,
    Frame,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Record,
    ServoState,
    VisualForce,
)
from gripper_hw.fault_injection import Faults, FaultyFile

TIMES = st.integers(0, 2**63 - 1)
BY_TYPE: dict[Any, st.SearchStrategy[Any]] = {
    int: TIMES,
    float: st.floats(),
    str: st.text(),
    bool: st.booleans(),
}
IMAGE_TYPES = (Frame, AttentionMap)
SCALAR_TYPES = [kind for kind in get_args(Record) if kind not in IMAGE_TYPES]


@st.composite
def images(draw: st.DrawFn) -> Frame | AttentionMap:
    height, width = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    pixels = draw(st.binary(min_size=height * width, max_size=height * width))
    gray = np.frombuffer(pixels, np.uint8).reshape(height, width)
    t_ns = draw(st.integers(-(2**40), 2**60))
    kind = Frame if draw(st.booleans()) else AttentionMap
    return kind(t_ns, draw(TIMES), draw(st.integers(0, 2**32 - 1)), gray)


def scalars(kind: type[Any]) -> st.SearchStrategy[Any]:
    return st.builds(kind, *(BY_TYPE[field.type] for field in fields(kind)))


RECORDS = st.one_of(images(), *(scalars(kind) for kind in SCALAR_TYPES))


def image(record: Record) -> object:
    """A value that is equal only for records that are equal to the bit, NaN included."""
    if isinstance(record, IMAGE_TYPES):
        times = record.t_ns, record.received_ns
        return type(record), *times, record.seq, record.gray.shape, record.gray.tobytes()
    return repr(record)


def run(path: Path, count: int = 40) -> list[Record]:
    """Writes a log of several chunks."""
    rng = np.random.default_rng(0)
    records: list[Record] = []
    with LogWriter(path, config="target_n: 4.0\n", metadata={"version": "1.2"}) as log:
        for i in range(count):
            t_ns = i * 10 * NS_PER_MS
            records.append(ServoState(t_ns, 0.1 * i, 0.0, 0.2, 30.0, 12.0, 0))
            if i % 3 == 0:
                gray = rng.integers(0, 256, (4, 5), dtype=np.uint8)
                records.append(Frame(t_ns - 5, t_ns, i, gray))
        for record in records:
            log.write(record)
        log.attach("profile.yaml", b"a: 1", "application/yaml")
    return records


@settings(max_examples=60)
@given(st.lists(RECORDS, max_size=12), st.sampled_from([{}, {UTC_NAME: "1790000000123456789"}]))
def test_every_record_returns_to_the_bit_and_in_the_order_written(
    tmp_path_factory: pytest.TempPathFactory, records: list[Record], metadata: dict[str, str]
) -> None:
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    with LogWriter(path, config="", metadata=metadata) as log:
        for record in records:
            log.write(record)
    assert [image(r) for r in LogReader(path).records()] == [image(r) for r in records]


def test_reader_gives_config_metadata_attachments_and_duration(tmp_path: Path) -> None:
    path = tmp_path / "new" / "run.mcap"
    run(path)
    log = LogReader(path)
    assert log.complete
    assert log.config == "target_n: 4.0\n"
    assert log.metadata == {"version": "1.2"}
    assert log.attachments["profile.yaml"] == b"a: 1"
    assert log.duration_ns == 390 * NS_PER_MS


def test_records_are_filtered_by_type(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written = run(path)
    log = LogReader(path)
    assert [r.seq for r in log.records(Frame)] == [r.seq for r in written if isinstance(r, Frame)]
    assert list(log.records(Event)) == []
    assert [image(r) for r in log.records(Frame, ServoState)] == [image(r) for r in written]


def test_a_read_image_may_be_written_to(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run(path)
    assert all(frame.gray.flags.writeable for frame in LogReader(path).records(Frame))


def test_an_image_that_is_not_contiguous_is_written_as_seen(tmp_path: Path) -> None:
    gray = np.arange(48, dtype=np.uint8).reshape(6, 8)[::2, ::-1]
    with LogWriter(tmp_path / "run.mcap", config="", metadata={}) as log:
        log.write(Frame(0, 0, 0, gray))
    (frame,) = LogReader(tmp_path / "run.mcap").records(Frame)
    np.testing.assert_array_equal(frame.gray, gray)


def decoded(path: Path) -> list[tuple[str, Message, Any]]:
    """Topic, message and value of every message, decoded with the schemas in the log alone."""
    result = []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            pool = DescriptorPool()
            for proto in FileDescriptorSet.FromString(schema.data).file:
                pool.Add(proto)
            value: Any = GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(message.data)
            result.append((channel.topic, message, value))
    return result


def test_a_log_carries_utc_beside_the_clock_of_the_records(tmp_path: Path) -> None:
    path, utc_offset_ns = tmp_path / "run.mcap", 1_790_000_000_123_456_789
    records: list[Record] = [
        Event(7_000_000_001, "servo", "a retry"),
        Frame(7_000_000_002, 7_000_000_005, 7, np.zeros((2, 3), np.uint8)),
        AttentionMap(7_000_000_002, 7_000_000_009, 7, np.zeros((2, 2), np.uint8)),
        LoadCellSample(7_000_000_010, 1.5, 2.5),
    ]
    with LogWriter(path, config="", metadata={UTC_NAME: str(utc_offset_ns)}) as log:
        for record in records:
            log.write(record)
    messages = decoded(path)
    assert [topic for topic, _, _ in messages] == ["/log", "/frame", "/attention_map", "/load_cell_sample"]
    assert {message.log_time - message.publish_time for _, message, _ in messages} == {utc_offset_ns}
    event, frame, attention, sample = (value for _, _, value in messages)
    assert (event.name, event.message, event.level) == ("servo", "a retry", event.INFO)
    assert event.timestamp.ToNanoseconds() == 7_000_000_001 + utc_offset_ns
    assert (
        frame.timestamp.ToNanoseconds()
        == attention.timestamp.ToNanoseconds()
        == 7_000_000_002 + utc_offset_ns
    )
    assert sample.t_ns == messages[-1][1].publish_time == 7_000_000_010
    reader = LogReader(path)
    assert (reader.utc_offset_ns, reader.start_ns, reader.duration_ns) == (utc_offset_ns, 7_000_000_001, 9)


@given(force_n=st.floats(-100, 100), std_n=st.floats(0, 100))
def test_an_estimate_is_written_with_its_claimed_interval(
    tmp_path_factory: pytest.TempPathFactory, force_n: float, std_n: float
) -> None:
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    records: list[Record] = [
        FusedForce(1, force_n, std_n, 0, 0, 0, ""),
        VisualForce(1, 2, 3, force_n, std_n, 0),
    ]
    with LogWriter(path, config="", metadata={}) as log:
        for record in records:
            log.write(record)
    for _, _, value in decoded(path):
        assert value.high_n - value.low_n == pytest.approx(2 * INTERVAL_STD * std_n, abs=1e-9)
        assert value.high_n + value.low_n == pytest.approx(2 * force_n, abs=1e-9)
    assert list(LogReader(path).records()) == records


def test_an_offset_that_is_no_number_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("gripper_force", {UTC_NAME: "soon"})
        writer.add_attachment(0, 0, "config.yaml", "application/yaml", b"")
        writer.finish()
    with pytest.raises(LogError, match="is empty, or damaged at its start"):
        LogReader(path)


def test_what_is_no_path_is_refused() -> None:
    with pytest.raises(ConfigError, match="the log must be a path, not 3"):
        LogReader(3)  # type: ignore[arg-type]


def test_another_program_decodes_every_topic_from_the_log_alone(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    records: list[Record] = [
        VisualForce(1, 2, 3, 4.5, 0.5, 6.0),
        GraspStatus(2, "hold", "held", 4.0, 0.03, "steady"),
        LoadCellSample(3, 1.5, 2.5, False),
        Frame(2_000_000_005, 4, 7, np.zeros((2, 3), np.uint8)),
    ]
    with LogWriter(path, config="", metadata={}) as log:
        for record in records:
            log.write(record)
    messages = decoded(path)
    assert [topic for topic, _, _ in messages] == [
        "/visual_force",
        "/grasp_status",
        "/load_cell_sample",
        "/frame",
    ]
    vision, status, sample, frame = (value for _, _, value in messages)
    assert (vision.force_n, status.outcome, sample.valid) == (4.5, "held", False)
    assert (frame.timestamp.seconds, frame.timestamp.nanos, frame.encoding) == (2, 5, "mono8")
    assert [message.log_time for _, message, _ in messages] == [2, 2, 3, 4]
    assert messages[-1][1].sequence == 7


@pytest.mark.parametrize("gap_ms", [1, 10, 99, 100, 250])
def test_a_killed_run_loses_less_than_a_chunk(tmp_path: Path, gap_ms: int) -> None:
    path = tmp_path / "run.mcap"
    log = LogWriter(path, config="", metadata={})
    for i in range(400 // gap_ms + 2):
        log.write(Event(i * gap_ms * NS_PER_MS, "session", "tick"))
        snapshot = LogReader(_copy(path), recover=True)
        last_ns = max((event.t_ns for event in snapshot.records(Event)), default=-gap_ms * NS_PER_MS)
        assert i * gap_ms * NS_PER_MS - last_ns <= CHUNK_NS + (gap_ms - 1) * NS_PER_MS
    log.close()


def _copy(path: Path) -> Path:
    copy = path.with_suffix(".copy")
    copy.write_bytes(path.read_bytes())
    return copy


def test_a_log_cut_at_any_byte_is_refused_in_one_sentence_and_every_whole_chunk_recovered(
    tmp_path: Path,
) -> None:
    whole = tmp_path / "run.mcap"
    written = [image(r) for r in run(whole)]
    chunks = chunk_sizes(whole)
    assert len(chunks) >= 4
    data = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    whole_chunks = -1
    ends = [0, *(end for end, _ in chunks), len(data)]
    near = {size for end in ends for size in range(max(end - 40, 0), min(end + 40, len(data)))}
    for size in sorted(near | set(range(0, len(data), 29))):
        cut.write_bytes(data[:size])
        with pytest.raises(LogError) as refused:
            LogReader(cut)
        if "is empty, or damaged at its start" in str(refused.value):
            assert whole_chunks == -1
            with pytest.raises(LogError, match=r"damaged at its start, .*; leave it out"):
                LogReader(cut, recover=True)
            continue
        refused.match(
            r"cut\.mcap is cut short, damaged or not finished yet: \d+ records .* are left; .*--recover"
        )
        log = LogReader(cut, recover=True)
        assert not log.complete
        counts = [count for end, count in chunks if end <= size]
        whole_chunks = len(counts)
        assert [image(r) for r in log.records()] == written[: sum(counts)]
    assert whole_chunks == len(chunks)


def chunk_sizes(path: Path) -> list[tuple[int, int]]:
    """Where each chunk ends, and how many messages it holds, as the MCAP library reads it."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        ends = [index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes]
        file.seek(0)
        chunks = [item for item in StreamReader(file, emit_chunks=True).records if isinstance(item, Chunk)]
    counts = [sum(isinstance(item, Message) for item in breakup_chunk(chunk)) for chunk in chunks]
    return list(zip(ends, counts, strict=True))


def test_the_sentence_about_a_cut_log_says_how_much_is_left(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    count = len(run(path))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(LogError, match=rf": {count} records \(0\.39 s\) are left"):
        LogReader(path)


@pytest.fixture(scope="module")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("short") / "run.mcap"
    run(path, count=15)
    return path.read_bytes()


@settings(max_examples=300)
@given(st.data())
def test_flipped_bytes_are_told_or_harmless_never_an_untyped_error(
    tmp_path_factory: pytest.TempPathFactory, short_log: bytes, data: st.DataObject
) -> None:
    path = tmp_path_factory.getbasetemp() / "flipped.mcap"
    content = bytearray(short_log)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    for recover in (False, True):
        try:
            list(LogReader(path, recover=recover).records())
        except LogError as error:
            assert str(path) in str(error)  # noqa: PT017


def test_what_is_no_type_of_record_is_refused_at_the_call(tmp_path: Path) -> None:
    run(tmp_path / "run.mcap", count=1)
    log: Any = LogReader(tmp_path / "run.mcap")
    types: tuple[Any, ...] = ("FusedForce", "/fused_force", dict, {}, ForceEstimate)
    for wrong in types:
        with pytest.raises(
            TypeError, match=r"is no type of the records in a log; pass some of .*, FusedForce, "
        ):
            log.records(Frame, wrong)


def test_recovery_leaves_out_a_damaged_chunk_alone(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written = run(path)
    log = LogReader(path)
    content = bytearray(path.read_bytes())
    chunk = log._chunks[1]
    content[chunk.offset + chunk.length - 3] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(LogError, match="is damaged"):
        list(LogReader(path).records())
    reader = LogReader(path, recover=True)
    rest = [image(r) for r in reader.records()]
    assert reader.damaged == {chunk.offset}
    whole = [image(r) for r in written]
    first = next(i for i, (a, b) in enumerate(zip(rest, whole, strict=False)) if a != b)
    assert 0 < first < len(rest) < len(whole), "there are records before and after it"
    assert rest[first:] == whole[first - len(rest) :]


def test_damage_outside_of_the_chunks_is_found(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run(path)
    whole = path.read_bytes()
    chunk = LogReader(path)._chunks[1]
    for position in (whole.index(b"target_n: 4"), chunk.offset - 9):  # in the configuration; kind of a record
        content = bytearray(whole)
        content[position] ^= 1
        path.write_bytes(content)
        with pytest.raises(LogError, match=r"not finished yet|damaged at its start"):
            LogReader(path)


@pytest.mark.parametrize("recover", [False, True])
def test_what_is_no_log_is_refused(tmp_path: Path, recover: bool) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("hello, this is text")
    with pytest.raises(LogError, match=r"notes\.txt is not an MCAP file"):
        LogReader(text, recover=recover)
    with pytest.raises(LogError, match=r"can't read the log .*missing\.mcap: No such file"):
        LogReader(tmp_path / "missing.mcap", recover=recover)
    with pytest.raises(LogError, match="Is a directory"):
        LogReader(tmp_path, recover=recover)


def _foreign(path: Path, topic: str, schema: str, data: bytes) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("gripper_force", {"version gripper-force": "0.0.9"})
        writer.add_attachment(0, 0, "config.yaml", "application/yaml", b"")
        channel = writer.register_channel(topic, "protobuf", writer.register_schema(schema, "protobuf", data))
        writer.add_message(channel, 1, b"", 1)
        writer.finish()
    return path


def test_a_log_of_another_program_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(LogError, match="holds no configuration"):
        LogReader(path)
    path = _foreign(tmp_path / "topic.mcap", "/imu", "a.Imu", b"")
    with pytest.raises(LogError, match="the topic /imu, which"):
        list(LogReader(path).records())


@pytest.mark.parametrize(
    ("kind", "old", "new", "why"),
    [
        (CompressionType.LZ4, rb"", rb"", "compressed as 'lz4'"),
        (
            CompressionType.ZSTD,
            rb".{8}(.{4}\x04\0\0\0zstd)",
            b"\0\0\0\0\1\0\0\0\\1",
            "says that it holds 4294967296",
        ),
        (CompressionType.NONE, rb"\x15\x03", b"\x15\0", "0x2 pixels in rows of 3"),
        (CompressionType.NONE, rb"-\x03", b"-\x02", "3x2 pixels in rows of 2"),
        (
            CompressionType.NONE,
            rb"\x01\0{7}(\n\x02\x10\x01)",
            b"\1\0\0\0\0\0\0\x80\\1",
            "came at 9223372036854775809 ns",
        ),
        (CompressionType.NONE, rb"mono8", rb"mono9", "'mono9', not mono8"),
    ],
)
def test_a_chunk_that_lies_is_refused(
    tmp_path: Path, kind: CompressionType, old: bytes, new: bytes, why: str
) -> None:
    path, codec = tmp_path / "run.mcap", CODECS[Frame]
    with path.open("wb") as file:
        writer = Writer(file, compression=kind, enable_crcs=False)
        writer.start()
        writer.add_attachment(0, 0, "config.yaml", "application/yaml", b"")
        schema = writer.register_schema(codec.schema_name, "protobuf", codec.schema)
        channel = writer.register_channel(codec.topic, "protobuf", schema)
        writer.add_message(channel, 1, codec.encode(Frame(1, 1, 1, np.zeros((2, 3), np.uint8)), 0), 1)
        writer.finish()
    content, count = re.subn(old, new, path.read_bytes(), count=1, flags=re.DOTALL)
    assert count
    path.write_bytes(content)
    with pytest.raises(LogError, match=why):
        list(LogReader(path).records())


def test_a_record_of_another_version_is_refused_with_that_version(tmp_path: Path) -> None:
    schema = FileDescriptorSet()
    message = schema.file.add(name="x.proto", package="gripper_force").message_type.add(name="Event")
    message.field.add(name="t_s", number=1, type=1)
    path = _foreign(tmp_path / "old.mcap", "/event", "gripper_force.Event", schema.SerializeToString())
    with pytest.raises(LogError, match=r"/event as another version .*\(0\.0\.9\)"):
        list(LogReader(path).records())
    path = _foreign(tmp_path / "image.mcap", "/frame", "foxglove.Log", b"")
    with pytest.raises(LogError, match="/frame as another version"):
        list(LogReader(path).records())


def test_a_log_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run(path)
    before = path.read_bytes()
    with pytest.raises(LogError, match="it exists already"):
        LogWriter(path, config="", metadata={})
    assert path.read_bytes() == before


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(
        LogError, match=r"can't write the log .*: File exists \(.*/file\); name another folder$"
    ):
        LogWriter(tmp_path / "file" / "run.mcap", config="", metadata={})


@pytest.mark.parametrize(
    "record",
    [
        Event(-1, "session", "before time began"),
        Event(0, "session", "\ud800"),
        ServoState(0, 0.0, 0.0, 0.0, 0.0, 0.0, 2**63),
        Frame(0, 0, 0, np.zeros((2, 2, 3), np.uint8)),
        Frame(0, 0, 0, np.zeros((2, 2))),  # type: ignore[arg-type]
    ],
)
def test_a_value_that_does_not_fit_is_refused_and_the_log_goes_on(tmp_path: Path, record: Record) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path, config="", metadata={}) as log:
        with pytest.raises(LogError, match="doesn't fit the log"):
            log.write(record)
        log.write(Event(5, "session", "on"))
    assert list(LogReader(path).records()) == [Event(5, "session", "on")]


class FullDisk(io.RawIOBase):
    """Takes ``room`` bytes, then reports a full disk."""

    def __init__(self, room: int) -> None:
        self.data = b""
        self._room = room

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        taken = bytes(data)[: self._room - len(self.data)]
        if not taken:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.data += taken
        return len(taken)

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return len(self.data)


def fill(path: Path) -> None:
    """Writes until the disk is full."""
    with LogWriter(path, config="x" * 100, metadata={}) as log:
        try:
            for i in range(100_000):
                log.write(FusedForce(i * NS_PER_MS, 0.5, 0.1 * i, 1.0 / (1 + i), 0.0, 0.9, "fused"))
        except LogError:
            with pytest.raises(LogError, match="failed before"):
                log.write(Event(0, "session", "more"))
            raise


@pytest.mark.parametrize("room", [0, 60, 400, 1500, 6000, 30_000])
def test_a_full_disk_is_one_typed_error_that_stays_and_leaves_a_prefix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    disk = FullDisk(room)
    path = tmp_path / "run.mcap"
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", lambda *_: io.BufferedWriter(disk))
        with pytest.raises(LogError, match=r"run\.mcap: No space left on device"):
            fill(path)
    path.write_bytes(disk.data)
    assert len(disk.data) == room
    if room >= 400:
        times = [r.t_ns for r in LogReader(path, recover=True).records(FusedForce)]
        assert times == [i * NS_PER_MS for i in range(len(times))]
        assert bool(times) == (room >= 6000)


def test_a_log_that_can_not_be_begun_leaves_no_file(tmp_path: Path) -> None:
    path, full = tmp_path / "run.mcap", Faults([FaultConfig(unit="disk", kind="off")])

    def broken(file: BinaryIO) -> Any:
        return FaultyFile(file, full, MonotonicClock(), lockstep=False)

    with pytest.raises(LogError, match=r"run\.mcap: No space left on device"):
        LogWriter(path, config="", metadata={}, wrap_file=broken)
    LogWriter(path, config="", metadata={}).close()


def test_a_closed_log_takes_no_more_and_may_be_closed_again(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "run.mcap", config="", metadata={})
    log.close()
    log.close()
    with pytest.raises(LogError, match="is closed"):
        log.write(Event(0, "session", "late"))


def stumble(path: Path) -> None:
    with LogWriter(path, config="", metadata={}) as log:
        log.write(Event(0, "session", "on"))
        raise ZeroDivisionError


def test_a_log_is_whole_after_an_error_in_its_block(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with pytest.raises(ZeroDivisionError):
        stumble(path)
    assert LogReader(path).complete
