"""Fuzz targets of the core: configurations, profiles, logs, checkpoints and tables."""

import json
import struct
from collections.abc import Iterable, Iterator
from datetime import UTC, date, datetime
from functools import cache
from hashlib import sha256
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
import torch
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.writer import CompressionType, Writer
from safetensors.torch import save

from gripper_force.config import (
    Config,
    GripperConfig,
    config_from_text,
    dump_config,
    load_config,
)
from gripper_force.errors import GripperError
from gripper_force.jobs.dataset import load_clip
from gripper_force.jobs.grasp import summarise_grasp
from gripper_force.jobs.imports.force_table import estimate_tare, read_forces
from gripper_force.jobs.profile_files import pack
from gripper_force.jobs.replay import replay
from gripper_force.jobs.report.reading import read_run
from gripper_force.profiles.correction import Correction, KnownFrames, ProfileArrays, load_correction
from gripper_force.profiles.object_profile import (
    Interval,
    ObjectProfile,
    OodLimit,
    OutputCurve,
    read_object,
    weights_path,
)
from gripper_force.profiles.rig_profile import (
    CalibratedValue,
    LoadCellCalibration,
    RigProfile,
    ServoCalibration,
)
from gripper_force.qualification.fuzz.target import Target
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.runtime.resolve import make_controller
from gripper_force.schema import dump
from gripper_force.types import (
    NS_PER_MS,
    Frame,
    LoadCellSample,
    Request,
    RequestKind,
    ServoState,
    VisualForce,
)
from gripper_force.vision.engines.pytorch import TorchEngine
from gripper_force.vision.estimator import ForceEstimator
from gripper_force.vision.header import FORMAT, Header, NetworkConfig, Residual
from gripper_force.vision.model_files import read_model
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.ood import orthonormal, residual_share
from gripper_force.vision.preprocess import Preprocess

_SIDE: Final = 16
"""Side of the images in pixels."""

_ATTENTIONS: Final = ("ssam", "scam", "none")
_HEADER_END: Final = b"]}}"
"""End of the JSON header of a safetensors file."""

_BODY: Final = struct.Struct("<BHQ")
"""Topic number, length and time of a message."""

_METADATA: Final = {"object": "sponge", "scene": json.dumps({"stiffness": 1.02}), "exposure_ms": "4.0"}
_CONFIG: Final = Config(gripper=GripperConfig(nm_per_a=1.8, current_step_a=0.003))


# Configurations and profiles.


_LIMITS: Final = tuple(OodLimit(force_n=force_n, typical=1e-3, limit=4.0) for force_n in (0.0, 5.0))


def _object(weights: str = "") -> ObjectProfile:
    return ObjectProfile(
        object="mug",
        date=date(2026, 1, 2),
        checkpoint="",
        camera={"camera.rate_hz": 60.0},
        touches=3,
        frames=300,
        force_n=8.0,
        output=OutputCurve(kind="monotone", estimate_n=(0.0, 4.0, 9.0), force_n=(0.1, 3.5, 8.0)),
        interval=Interval(coverage=0.9, base_n=0.1, share=0.03),
        ood_limits=_LIMITS,
        before_n=0.4,
        weights=weights,
    )


_FEATURES: Final = np.linspace(-1, 1, 8, dtype=np.float32)[None]
_ARRAYS: Final = ProfileArrays(
    head=np.ones(8, np.float32),
    offset=np.ones(1, np.float32),
    known=KnownFrames(np.ones(8, np.float32), np.eye(8, 2, dtype=np.float32), 1.0, _LIMITS),
)


def _objects() -> list[bytes]:
    return [dump(_object()).encode()]


def _read_object(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    _correct(Correction(read_object(path), _ARRAYS))


def _array_files() -> list[bytes]:
    return [pack(_ARRAYS)]


def _read_arrays(data: bytes, path: Path) -> None:
    profile = path.with_name("object.yaml")
    weights_path(profile).write_bytes(data)
    _correct(load_correction(profile, _object(sha256(data).hexdigest()), 8))


def _correct(correction: Correction) -> None:
    force_n = correction.force_n([-1.0, 0.0, 5.0, 30.0], np.repeat(_FEATURES, 4, 0))
    assert not np.isnan(force_n).any()
    assert (correction.half_width_n(force_n) > 0).all()
    assert correction.known is not None
    mean, axes, floor, _ = correction.known
    assert residual_share(_FEATURES, mean, orthonormal(axes), floor) >= 0


def _configs() -> list[bytes]:
    whole = dump_config(_CONFIG).encode()
    short = b"object: sponge\ntarget_n: 4.0\nservo: {id: 1}\nvision:\n  region: [0, 0, 64, 64]\n"
    return [short, short, b"camera: {device: 0}\ncontrol: {rate_hz: 200, feedback: fused}\n", whole]


def _read_config(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    _use_config(load_config(path))


def _rigs() -> list[bytes]:
    at, found = datetime(2026, 1, 2, tzinfo=UTC), CalibratedValue(value=1.7, low=1.69, high=1.72)
    servo = ServoCalibration(
        date=at,
        model="XM430-W350",
        nm_per_a=found,
        friction_n=found,
        damping_n_s_m=found,
        pinion_radius_m=CalibratedValue(value=0.02),
        open_position_rad=found,
        open_width_m=0.09,
        force_n=(0.3, 9.5),
        speed_m_s=(0.01, 0.05),
        residual_n=0.1,
    )
    cell = LoadCellCalibration(
        date=at,
        sensor="serial hx711",
        tare_raw=found,
        n_per_raw=found,
        force_n=(0, 9.8),
        noise_n=0.01,
        drift_n_min=found,
    )
    return [dump(RigProfile(servo=servo)).encode(), dump(RigProfile(load_cell=cell)).encode()]


def _read_rig(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    _use_config(load_config(None, [f"calibration.rig={path}"]))


def _assignments() -> list[bytes]:
    return [
        b"target_n=4",
        b"servo.port=/dev/ttyUSB0\nservo.id=3\ncamera.region=[0, 0, 64, 64]",
        b"control.rate_hz=200\ncontrol.force_limit_n=12\nvision.checkpoint=default",
        b"camera={backend: none}\nload_cell.n_per_raw=-1e-4\nlog.directory=runs",
    ]


def _assign(data: bytes, _path: Path) -> None:
    _use_config(load_config(None, data.decode("utf-8", "surrogateescape").split("\n")))


def _use_config(config: Config) -> None:
    completed = config.with_values(gripper=_completed(config.gripper))
    config_from_text(dump_config(completed), "a dumped configuration")
    make_controller(completed).step(0, _state(0), None, Request(0, RequestKind.GRASP, config.target_n))


def _completed(gripper: GripperConfig) -> GripperConfig:
    return gripper.model_copy(update={"nm_per_a": gripper.nm_per_a or 1.8})


# Logs.


@cache
def _log() -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with LogWriter(path, config=dump_config(_CONFIG), metadata=_METADATA) as log:
            _grasp_into(log)
        return path.read_bytes()


def _grasp_into(log: LogWriter) -> None:
    """Writes a short grasp with every kind of record of a run."""
    rng = np.random.default_rng(0)
    controller = make_controller(_CONFIG)
    position_rad = 0.0
    for cycle in range(14):
        t_ns = cycle * 20 * NS_PER_MS
        request = Request(t_ns, RequestKind.GRASP, 4.0) if cycle == 3 else None
        visual = None
        if cycle % 3 == 0:
            gray = rng.integers(0, 256, (_SIDE, _SIDE), np.uint8)
            log.write(Frame(t_ns - 15 * NS_PER_MS, t_ns, cycle, gray))
            visual = VisualForce(t_ns - 15 * NS_PER_MS, t_ns, cycle, 0.1 * cycle, 0.3, 2.0)
            log.write(visual)
        state = _state(t_ns, position_rad)
        decision = controller.step(t_ns, state, visual, request)
        position_rad = 0.5 * (position_rad + decision.command.goal_position_rad)
        if request is not None:
            log.write(request)
        log.write(state)
        log.write(decision.estimate)
        log.write(decision.command)
        log.write(decision.status)
        for event in decision.events:
            log.write(event)
        log.write(LoadCellSample(t_ns, 0.1 * cycle, 100.0 * cycle))


def _state(t_ns: int, position_rad: float = 0.0) -> ServoState:
    return ServoState(t_ns, position_rad, 0.1, 0.2, 30.0, 12.0, 0)


@cache
def _topics() -> dict[str, Schema]:
    summary = make_reader(BytesIO(_log())).get_summary()
    assert summary is not None
    return {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}


def _messages() -> Iterator[tuple[str, int, bytes]]:
    for _, channel, message in make_reader(BytesIO(_log())).iter_messages(log_time_order=False):
        yield channel.topic, message.log_time, message.data


def _uncompressed(messages: Iterable[tuple[str, int, bytes]]) -> bytes:
    """Log without compression and checksums."""
    out = BytesIO()
    writer = Writer(out, compression=CompressionType.NONE, enable_crcs=False)
    writer.start()
    writer.add_metadata("gripper_force", _METADATA)
    writer.add_attachment(0, 0, "config.yaml", "application/yaml", dump_config(_CONFIG).encode())
    channels = {}
    for topic, schema in _topics().items():
        known = writer.register_schema(schema.name, schema.encoding, schema.data)
        channels[topic] = writer.register_channel(topic, "protobuf", known)
    for topic, log_ns, data in messages:
        writer.add_message(channels[topic], log_ns, data, log_ns)
    writer.finish()
    return out.getvalue()


def _logs() -> list[bytes]:
    return [_log(), _uncompressed(_messages())]


def _bodies() -> list[bytes]:
    """All messages of a log, each after its topic, length and time."""
    numbers = {topic: i for i, topic in enumerate(_topics())}
    return [b"".join(_BODY.pack(numbers[t], len(data), ns) + data for t, ns, data in _messages())]


def _log_of(bodies: bytes) -> bytes:
    topics = list(_topics())
    messages, at = [], 0
    while at + _BODY.size <= len(bodies):
        number, length, log_ns = _BODY.unpack_from(bodies, at)
        at += _BODY.size + length
        messages.append((topics[number % len(topics)], log_ns, bodies[at - length : at]))
    return _uncompressed(messages)


def _read_log(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    recovered = list(LogReader(path, recover=True).records())
    assert list(map(repr, LogReader(path).records())) == list(map(repr, recovered))


def _use_records(data: bytes, path: Path) -> None:
    """Uses a valid log with damaged records."""
    log = _log_of(data)
    typed: GripperError | None = None
    for use in (_replay_log, _load_log_clip, _report_log, _summarise_log):
        try:
            use(log, path)
        except GripperError as error:
            typed = error
    if typed is not None:
        raise typed


def _replay_log(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    replay(path, "none", recover=True)


def _replay_log_with_vision(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    checkpoint = path.with_suffix(".safetensors")
    if not checkpoint.exists():
        checkpoint.write_bytes(_checkpoints()[0])
    replay(path, str(checkpoint), recover=True)


def _load_log_clip(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    load_clip(path, Preprocess(size=_SIDE), None)


def _report_log(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    read_run(LogReader(path, recover=True))


def _summarise_log(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    summarise_grasp(path)


# Checkpoints.


def _shape(attention: str) -> NetworkConfig:
    small = {"size": _SIDE, "width": 0.01, "hidden": 1, "head": 1}
    return NetworkConfig.model_validate({"attention": attention, **small})


def _header(attention: str) -> Header:
    residuals = (Residual(force_n=0.0, std_n=0.1), Residual(force_n=9.0, std_n=0.5))
    preprocess = Preprocess(size=_SIDE)
    return Header(
        members=(_shape(attention),),
        preprocess=preprocess,
        residuals=residuals,
        data_digest="",
        metrics={"a": 0.1},
    )


@cache
def _tensors(attention: str) -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    state = ForceNetwork(_shape(attention)).state_dict()
    return {f"0.{name}": tensor.contiguous() for name, tensor in state.items()}


def _headers() -> list[bytes]:
    return [_header(attention).model_dump_json().encode() for attention in _ATTENTIONS]


def _checkpoints() -> list[bytes]:
    return [
        save(_tensors(attention), {FORMAT: header.decode()})
        for attention, header in zip(_ATTENTIONS, _headers(), strict=True)
    ]


def _repair_length(data: bytes) -> bytes:
    """Replaces the header length of a safetensors file by that of its present header."""
    end = data.find(_HEADER_END, 8) + len(_HEADER_END)
    return (end - 8).to_bytes(8, "little") + data[8:] if end > len(_HEADER_END) else data


def _use_header(data: bytes, path: Path) -> None:
    """Uses a valid checkpoint file with a damaged header of this project."""
    text = data.decode(errors="replace")
    attention = next((name for name in _ATTENTIONS if name in text), "none")
    _use_checkpoint(save(_tensors(attention), {FORMAT: text}), path)


def _use_checkpoint(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    estimator = ForceEstimator(TorchEngine(read_model(path)))
    rng = np.random.default_rng(0)
    for _ in range(5):
        estimator.update(rng.integers(0, 256, (_SIDE, _SIDE), np.uint8))


# Tables.


def _tables() -> list[bytes]:
    rows = [f"{i},{0.04 * i:.4f},{max(0, i - 8) * 0.3:.3f}" for i in range(30)]
    table = "\n".join(["frame,t_s,force_n", *rows])
    return [table.encode(), b"\xef\xbb\xbf" + "\r\n".join(["force_n,frame,t_s,note", "0.1,0,0.0,a"]).encode()]


def _read_table(data: bytes, path: Path) -> None:
    path.write_bytes(data)
    table = read_forces(path)
    estimate_tare(table.t_s, table.force_n)
    assert all(a < b for a, b in pairwise(table.frame.tolist()))


_YAML_WORDS: Final = (b"&a ", b"*a", b"!!int ", b"!!timestamp ", b"? ", b"<<: ", b"=", b"control.", b"servo")
_LOG_WORDS: Final = tuple(
    b"zstd lz4 /frame /servo_state config.yaml exposure_ms scene mono8 8UC1 gripper_force.ServoState grasp "
    b"release stop held hold".split()
)
_TYPES: Final = tuple(b"F32 F16 BF16 F8_E4M3 I64 BOOL".split())

TARGETS: Final = [
    Target("config", _configs, _read_config, 6, _YAML_WORDS),
    Target("rig profile", _rigs, _read_rig, 6, _YAML_WORDS),
    Target("object profile", _objects, _read_object, 6, _YAML_WORDS),
    Target("object profile arrays", _array_files, _read_arrays, 3, _TYPES, _repair_length),
    Target("assignment", _assignments, _assign, 8, _YAML_WORDS),
    Target("log", _logs, _read_log, 3, _LOG_WORDS),
    Target("log replayed", _logs, _replay_log, 2, _LOG_WORDS),
    Target("log replayed with vision", _logs, _replay_log_with_vision, 1, _LOG_WORDS),
    Target("log records", _bodies, _use_records, 2, _LOG_WORDS),
    Target("log as clip", _logs, _load_log_clip, 1, _LOG_WORDS),
    Target("log reported", _logs, _report_log, 1, _LOG_WORDS),
    Target("log summarised", _logs, _summarise_log, 1, _LOG_WORDS),
    Target("checkpoint", _checkpoints, _use_checkpoint, 4, _TYPES, _repair_length),
    Target("checkpoint header", _headers, _use_header, 4),
    Target("force table", _tables, _read_table, 8, (b"frame", b"t_s")),
]
