"""Logs in the vendors' viewers: their own readers and clients check what arrives."""

import asyncio
import json
import shutil
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from typer.testing import CliRunner

from gripper_force import cli, plugins
from gripper_force.errors import ConfigError, DataError, LogError
from gripper_force.jobs import view
from gripper_force.runtime.log_codecs import CODECS, UTC_NAME
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import (
    NS_PER_MS,
    AttentionMap,
    Event,
    Frame,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Record,
    Request,
    ServoCommand,
    ServoState,
    VisualForce,
)

UTC_OFFSET_NS = 1_790_000_000_000_000_000
START_NS = 5_000_000_000
CYCLES = 60
RUN_TIME_NS = (CYCLES - 1) * 5 * NS_PER_MS


def records() -> Iterator[Record]:
    """A short run with every record type."""
    rng = np.random.default_rng(1)
    yield Event(START_NS, "session", "begins")
    yield Request(START_NS, "grasp", 4.0)
    for i in range(CYCLES):
        t_ns = START_NS + i * 5 * NS_PER_MS
        if i % 4 == 0:
            yield Frame(t_ns, t_ns, i, rng.integers(0, 256, (12, 16), dtype=np.uint8))
            yield VisualForce(t_ns, t_ns, i, 0.01 * i, 0.2, 3.0)
            yield AttentionMap(t_ns, t_ns, i, rng.integers(0, 256, (3, 4), dtype=np.uint8))
        yield ServoState(t_ns, 0.1, 0.0, 0.2, 30.0, 12.0, 0)
        yield FusedForce(t_ns, 0.02 * i, 0.1, 0.03 * i, 0.0, 0.1, "fused" if i > 10 else "current")
        yield ServoCommand(t_ns, 0.1, 0.3)
        yield GraspStatus(t_ns, "ramp" if i < 30 else "hold", "" if i < 40 else "held", 1.0, 0.04)
        yield LoadCellSample(t_ns, 0.02 * i, 1.0)


def write(path: Path, metadata: dict[str, str] | None = None) -> Path:
    with LogWriter(
        path, config="target_n: 4.0\n", metadata=metadata or {UTC_NAME: str(UTC_OFFSET_NS)}
    ) as log:
        for record in records():
            log.write(record)
    return path


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write(tmp_path / "run.mcap")


def run(*arguments: str | Path) -> Any:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def fails(error: type[Exception], match: str, *arguments: str | Path) -> None:
    with pytest.raises(error, match=match):
        CliRunner().invoke(cli.app, [str(argument) for argument in arguments], catch_exceptions=False)


# The option, and what is missing.


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (["--view"], ["--view=rerun"]),
        (["--view", "--json"], ["--view=rerun", "--json"]),
        (["--view", "foxglove"], ["--view", "foxglove"]),
        (["--view=foxglove", "--seed", "3"], ["--view=foxglove", "--seed", "3"]),
        (["--seed", "3"], ["--seed", "3"]),
        ([], []),
    ],
)
def test_view_without_a_value_means_rerun(given: list[str], meant: list[str]) -> None:
    assert cli.viewing._with_viewer(given) == meant


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, log: Path) -> None:
    monkeypatch.setattr(plugins, "find_spec", lambda _: None)
    for viewer in view.VIEWERS:
        message = rf"the viewer {viewer} needs {viewer}, .*pip install 'gripper-force\[view\]'"
        fails(ConfigError, message, "view", log, "--viewer", viewer)
        fails(
            ConfigError, message, "grasp", "--view", viewer, "--set", f"log.directory={log.parent / 'none'}"
        )
    assert not (log.parent / "none").exists()  # nothing ran


@pytest.mark.parametrize("viewer", view.VIEWERS)
def test_a_viewer_that_is_too_old_is_refused(viewer: str, monkeypatch: pytest.MonkeyPatch, log: Path) -> None:
    monkeypatch.setattr(plugins, "find_spec", lambda _: object())
    monkeypatch.setattr("importlib.metadata.version", {f"{viewer}-sdk": "0.26.2"}.__getitem__)
    message = rf"the viewer {viewer} needs {viewer}-sdk {view.OLDEST[viewer]}, but 0.26.2 is installed"
    fails(ConfigError, message, "view", log, "--viewer", viewer)
    monkeypatch.setattr("importlib.metadata.version", {f"{viewer}-sdk": view.OLDEST[viewer]}.__getitem__)
    view.require(viewer)


def test_an_unknown_viewer_and_a_view_of_trials_are_refused(log: Path) -> None:
    fails(ConfigError, "'rviz' is not a viewer; use one of rerun, foxglove", "view", log, "--viewer", "rviz")
    fails(ConfigError, "--view shows one grasp", "grasp", "--trials", "2", "--view")


def test_a_port_for_rerun_is_refused(log: Path) -> None:
    fails(ConfigError, "--port is for Foxglove; add --viewer foxglove", "view", log, "--port", "8765")


# A log while it is written.


def test_a_growing_log_gives_every_record_once_as_soon_as_its_chunk_is_written(tmp_path: Path) -> None:
    path, expected = tmp_path / "run.mcap", list(records())
    to_write = iter(expected)
    seen: list[Record] = []
    behind: list[int] = []
    writer: list[LogWriter] = []

    def wait() -> bool:
        """Writes some more, and notes how many written records were not seen."""
        if not writer:
            writer.append(LogWriter(path, config="a: 1", metadata={}))
        behind.append(written - len(seen) - writer[0].waiting)
        more = [record for _, record in zip(range(7), to_write, strict=False)]
        for record in more:
            writer[0].write(record)
        count(len(more))
        if not more:
            writer[0].close()
        return True

    written = 0

    def count(more: int) -> None:
        nonlocal written
        written += more

    for record in view.GrowingLog(path, wait).records():
        seen.append(record)
    assert [type(record) for record in seen] == [type(record) for record in expected]
    assert [repr(r) for r in seen if not isinstance(r, Frame | AttentionMap)] == [
        repr(r) for r in expected if not isinstance(r, Frame | AttentionMap)
    ]
    assert set(behind) == {0}


def test_a_growing_log_ends_with_its_writer(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="was not written"):
        view.GrowingLog(tmp_path / "none.mcap", lambda: False)
    path = tmp_path / "cut.mcap"
    whole = write(tmp_path / "run.mcap").read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    read = list(view.GrowingLog(path, lambda: False).records())
    assert 0 < len(read) < len(list(records()))


def test_a_run_that_deletes_its_empty_log_ends_the_view(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "empty.mcap"
    path.touch()

    def deleted(self: object, path: Path, *, recover: bool) -> None:
        path.unlink()
        raise LogError(f"can't read {path}")

    monkeypatch.setattr(LogReader, "__init__", deleted)
    with pytest.raises(LogError, match="was not written"):
        view.GrowingLog(path, lambda: False)


def test_what_is_no_log_is_refused_while_it_is_followed(tmp_path: Path) -> None:
    def wait() -> bool:
        pytest.fail("it waits")

    path = tmp_path / "text.mcap"
    path.write_bytes(b"hello there")
    with pytest.raises(LogError, match="not an MCAP file"):
        view.GrowingLog(path, wait)
    with pytest.raises(LogError, match="Is a directory"):
        view.GrowingLog(tmp_path, wait)
    with path.open("wb") as file:
        foreign = Writer(file)
        foreign.start()
        foreign.finish()
    with pytest.raises(LogError, match="holds no configuration"):
        view.GrowingLog(path, wait)


def test_a_growing_log_waits_for_its_configuration(log: Path, tmp_path: Path) -> None:
    path, whole = tmp_path / "begun.mcap", log.read_bytes()
    sizes = iter([0, 3, 20, 60, len(whole)])

    def wait() -> bool:
        path.write_bytes(whole[: next(sizes)])
        return True

    assert view.GrowingLog(path, wait).complete


# Rerun.


def rerun_program() -> str:
    pytest.importorskip("rerun")
    return shutil.which("rerun", path=f"{Path(sys.executable).parent}") or pytest.fail("no rerun command")


def rerun_output(*arguments: str | Path) -> str:
    done = subprocess.run(
        [rerun_program(), *map(str, arguments)],
        capture_output=True,
        text=True,
        env={"RERUN_ANALYTICS": "0", "HOME": "/nonexistent"},
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_rerun_finds_no_fault_in_a_log(log: Path) -> None:
    output = rerun_output("mcap", "check", "--full", log)
    rows = [line.split() for line in output.splitlines() if line.startswith(("ok", "warn", "error"))]
    assert {row[3] for row in rows} == {codec.topic for codec in CODECS.values()}
    assert all(row[0] == "ok" for row in rows)


def columns(path: Path) -> dict[str, list[tuple[int, int, Any]]]:
    """Time of the run and UTC in nanoseconds, and value, by entity and component, by Rerun's own reader."""
    from rerun.chunk import RrdReader

    found: dict[str, list[tuple[int, int, Any]]] = defaultdict(list)
    for chunk in RrdReader(path).stream().to_chunks():
        if not chunk.is_static and {"run", "utc"} <= set(chunk.timeline_names):
            table = chunk.to_record_batch()
            run_ns, utc_ns = (table.column(name).cast("int64").to_pylist() for name in ("run", "utc"))
            for name in table.schema.names:
                if ":" in name:
                    rows = zip(run_ns, utc_ns, table.column(name).to_pylist(), strict=True)
                    found[f"{chunk.entity_path} {name}"] += [row for row in rows if row[2] is not None]
    return {name: sorted(rows, key=lambda row: row[0]) for name, rows in found.items()}


def test_logs_of_one_name_in_two_folders_are_two_recordings(log: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    ids = set()
    for name in ("a", "b"):
        copy = tmp_path / name / "run.mcap"
        copy.parent.mkdir()
        copy.write_bytes(log.read_bytes())
        assert run("view", copy, "--save", copy.with_suffix(".rrd"), "--json").exit_code == 0
        ids.add(RrdReader(copy.with_suffix(".rrd")).recordings()[0].recording_id)
    assert len(ids) == 2


def test_rerun_reads_what_the_log_holds(log: Path, tmp_path: Path) -> None:
    rerun_program()
    done = run("view", log, "--save", tmp_path / "run.rrd", "--json")
    assert json.loads(done.stdout) == {"log": str(log), "viewer": "rerun", "file": str(tmp_path / "run.rrd")}
    read = columns(tmp_path / "run.rrd")
    expected = list(records())

    def values(entity: str) -> list[float]:
        return [value[0] for _, _, value in read[f"/{entity} Scalars:scalars"]]

    fused = [r for r in expected if isinstance(r, FusedForce)]
    assert values("force/estimate") == [r.force_n for r in fused]
    assert values("force/interval_low") == pytest.approx([r.force_n - 1.645 * r.std_n for r in fused])
    assert values("force/interval_high") == pytest.approx([r.force_n + 1.645 * r.std_n for r in fused])
    assert values("force/load_cell") == [r.force_n for r in expected if isinstance(r, LoadCellSample)]
    assert values("force/target") == [r.reference_n for r in expected if isinstance(r, GraspStatus)]
    assert values("force/vision") == [r.force_n for r in expected if isinstance(r, VisualForce)]
    states = {
        name: [v[0] for _, _, v in read[f"/state/{name} StateChange:state"]] for name in ("phase", "source")
    }
    assert states == {"phase": ["ramp", "hold"], "source": ["current", "fused"]}
    told = [text[0] for _, _, text in read["/events TextLog:text"]]
    assert told == ["session: begins", "request: grasp at 4 N", "outcome: held"]
    assert len(read["/camera Image:buffer"]) == len(read["/attention DepthImage:buffer"]) > 5
    last_run_ns, last_utc_ns, _ = read["/force/estimate Scalars:scalars"][-1]
    assert last_run_ns == RUN_TIME_NS
    assert last_utc_ns == START_NS + RUN_TIME_NS + UTC_OFFSET_NS


def test_a_run_is_followed_into_a_file(tmp_path: Path) -> None:
    rerun_program()
    path, saved = tmp_path / "run.mcap", tmp_path / "run.rrd"
    writer = threading.Timer(0.3, write, [path])
    writer.start()
    done = run("view", path, "--follow", "--save", saved, "--json")
    writer.join()
    assert json.loads(done.stdout.splitlines()[0]) == {"ready": True}
    assert len(columns(saved)["/force/estimate Scalars:scalars"]) == CYCLES


def test_a_log_of_version_0_1_is_shown(tmp_path: Path) -> None:
    rerun_program()
    old = Path(__file__).parents[2] / "data" / "version_0_1.mcap"
    assert run("view", old, "--save", tmp_path / "old.rrd", "--json").exit_code == 0


def test_a_machine_without_a_display_is_told_what_to_do(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rerun_program()
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    fails(DataError, "no display for Rerun; write a file with `gripper-force view LOG --save", "view", log)


# Foxglove.


def test_every_path_of_the_layout_is_in_the_log() -> None:
    fields = {
        codec.topic: {f.name for file in _files(codec.schema) for m in file.message_type for f in m.field}
        for codec in CODECS.values()
    }
    paths = [p["value"] for p in _walk(json.loads(view.FOXGLOVE_LAYOUT.read_text()), "paths")]
    assert len(paths) >= 12
    for path in paths:
        topic, field = path.split(".")
        assert field in fields[topic], path
    assert [i["imageTopic"] for i in _walk(json.loads(view.FOXGLOVE_LAYOUT.read_text()), "imageMode")] == [
        "/frame",
        "/attention_map",
    ]


def _files(schema: bytes) -> Any:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    return FileDescriptorSet.FromString(schema).file


def _walk(tree: Any, key: str) -> Iterator[Any]:
    """Every element below every entry of that name."""
    children = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for name, child in children:
        if name == key:
            yield from child if isinstance(child, list) else [child]
        else:
            yield from _walk(child, key)


async def subscribed(
    url: str, topics: list[str], count: int, play: Callable[[], object] | None = None
) -> Any:
    """Acts as the Foxglove app: subscribes, and returns times and messages by topic."""
    websockets = pytest.importorskip("websockets")
    channels: dict[int, str] = {}
    got: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
    async with websockets.connect(url, subprotocols=["foxglove.sdk.v1"]) as socket:
        while len(channels) < len(CODECS):
            message = json.loads(await socket.recv())
            if message["op"] == "advertise":
                channels |= {channel["id"]: channel["topic"] for channel in message["channels"]}
        wanted = [number for number, topic in channels.items() if topic in topics]
        ids = [{"id": number, "channelId": number} for number in wanted]
        await socket.send(json.dumps({"op": "subscribe", "subscriptions": ids}))
        if play is not None:
            play()
        while sum(map(len, got.values())) < count:
            message = await asyncio.wait_for(socket.recv(), 30)
            if isinstance(message, bytes) and message[0] == 1:
                topic = channels[int.from_bytes(message[1:5], "little")]
                got[topic].append((int.from_bytes(message[5:13], "little"), message[13:]))
    return got


def test_the_foxglove_app_gets_a_run_while_it_is_written(tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    from gripper_force.jobs.view.foxglove_view import FoxgloveViewer

    path = tmp_path / "run.mcap"
    server = FoxgloveViewer("run", 0)
    topics = ["/fused_force", "/log", "/attention_map"]
    expected = [r for r in records() if isinstance(r, FusedForce | Event | AttentionMap)]

    def serve() -> None:
        server.wait_for_app()
        write(path)
        view.show(LogReader(path), server)

    thread = threading.Thread(target=serve)
    thread.start()
    got = asyncio.run(subscribed(server.url, topics, len(expected)))
    thread.join()
    sent = [t_ns for t_ns, _ in got["/fused_force"]]
    assert sent == [r.t_ns + UTC_OFFSET_NS for r in records() if isinstance(r, FusedForce)]
    assert got["/log"][0][1] == CODECS[Event].encode(next(records()), UTC_OFFSET_NS)
    assert len(got["/attention_map"]) == CYCLES // 4


def test_the_foxglove_app_plays_a_log_searches_it_and_plays_it_again(log: Path) -> None:
    pytest.importorskip("foxglove")
    from foxglove.websocket import PlaybackCommand, PlaybackStatus

    from gripper_force.jobs.view.foxglove_view import FoxgloveViewer

    reader = LogReader(log)
    server = FoxgloveViewer("run", 0, reader)
    middle_ns = START_NS + UTC_OFFSET_NS + RUN_TIME_NS // 2

    def ask(command: PlaybackCommand, seek_ns: int | None = None) -> PlaybackStatus:
        request = SimpleNamespace(
            playback_command=command, playback_speed=50.0, seek_time=seek_ns, request_id="1"
        )
        state = server.on_playback_control_request(request)
        assert (state.request_id, state.did_seek) == ("1", seek_ns is not None)
        return state.status

    assert ask(PlaybackCommand.Pause) == PlaybackStatus.Paused
    player = threading.Thread(target=server.play, args=(reader,))
    player.start()

    def play_twice() -> None:
        server.wait_for_app()
        assert ask(PlaybackCommand.Play) == PlaybackStatus.Playing
        while server._plays:  # until the end
            time.sleep(0.01)
        ask(PlaybackCommand.Play, middle_ns)

    times = [r.t_ns + UTC_OFFSET_NS for r in records() if isinstance(r, FusedForce)]
    expected = times + [t_ns for t_ns in times if t_ns >= middle_ns]
    got = asyncio.run(subscribed(server.url, ["/fused_force"], len(expected), play_twice))
    server.close()
    player.join()
    assert [t_ns for t_ns, _ in got["/fused_force"]] == expected


def test_a_port_in_use_is_named() -> None:
    pytest.importorskip("foxglove")
    from gripper_force.jobs.view.foxglove_view import FoxgloveViewer

    server = FoxgloveViewer("run", 0)
    port = int(server.url.rsplit(":", 1)[1])
    with pytest.raises(DataError, match=f"at port {port}.*--port"):
        FoxgloveViewer("run", port)
    server.close()
