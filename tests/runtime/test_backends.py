import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gripper_force.config import Config, LoadCellConfig, load_config
from gripper_force.errors import ConfigError, DeviceError, LogError
from gripper_force.interfaces import Clock
from gripper_force.runtime import backends
from gripper_force.runtime.backends import MonotonicClock, open_devices
from gripper_force.types import LoadCellSample
from gripper_hw.dynamixel.virtual import find_bus


@pytest.fixture
def config(quick: list[str]) -> Config:
    return load_config(None, quick)


@pytest.mark.parametrize(
    ("unit", "known"),
    [
        ("camera", "none, simulated, playback, oak, uvc"),
        ("load_cell", "none, simulated, playback, serial, phidget"),
    ],
)
def test_an_unknown_backend_is_named_with_the_known_ones(config: Config, unit: str, known: str) -> None:
    with (
        pytest.raises(
            ConfigError, match=rf"unknown {unit}\.backend 'oak9'.*; use {known} or package\.module:Class"
        ),
        open_devices(config.with_values(**{unit: {"backend": "oak9"}})),
    ):
        pass
    assert find_bus("rig") is None


def test_only_what_is_named_is_built(config: Config) -> None:
    with open_devices(config.with_values(load_cell={"backend": "none"})) as devices:
        assert devices.camera is None
        assert devices.load_cell is None
        assert devices.lockstep
        assert "scene" in devices.notes
        assert find_bus("rig") is not None
        devices.check()
    assert find_bus("rig") is None


def test_lockstep_needs_a_simulated_servo(config: Config) -> None:
    real = config.with_values(servo={"port": "/dev/ttyUSB7"}, load_cell={"backend": "none"})
    with pytest.raises(ConfigError, match=r"clock=lockstep .*'/dev/ttyUSB7'"), open_devices(real):
        pass


@pytest.mark.parametrize(("unit", "backend"), [("camera", "oak"), ("load_cell", "serial")])
def test_a_real_sensor_keeps_no_simulated_time(config: Config, unit: str, backend: str) -> None:
    mixed = config.with_values(**{unit: {"backend": backend}})
    sentence = rf"{unit}\.backend={backend} cannot follow simulated time; set clock=realtime"
    with pytest.raises(ConfigError, match=sentence), open_devices(mixed):
        pass


@pytest.mark.parametrize("unit", ["camera", "load_cell"])
def test_a_simulated_sensor_needs_the_simulated_servo(config: Config, unit: str) -> None:
    none = {"camera": {"backend": "none"}, "load_cell": {"backend": "none"}}
    mixed = config.with_values(servo={"port": "/dev/ttyUSB7"}, **none | {unit: {"backend": "simulated"}})
    with pytest.raises(ConfigError, match=r"set servo\.port=virtual:rig"), open_devices(mixed):
        pass


@pytest.mark.parametrize("unit", ["camera", "load_cell"])
def test_a_recording_that_is_not_there_closes_what_was_open(
    config: Config, unit: str, tmp_path: Path
) -> None:
    plays = config.with_values(**{unit: {"backend": "playback", "path": tmp_path / "none.mcap"}})
    with pytest.raises(LogError, match="No such file"), open_devices(plays):
        pass
    assert find_bus("rig") is None


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Stands in for the servo and the rig and tells the order in which they are closed."""
    calls: list[str] = []

    def device(name: str) -> SimpleNamespace:
        return SimpleNamespace(close=lambda: calls.append(name), start=lambda: calls.append(f"{name} starts"))

    def make_rig(_: Config) -> SimpleNamespace:
        rig = device("rig")
        rig.clock, rig.start_ns, rig.check, rig.notes = MonotonicClock(), 0, lambda: None, dict
        rig.camera, rig.load_cell, rig.render_under_light = device("camera"), device("load cell"), None
        rig.observe_world = rig.wrap_estimator = rig.wrap_file = None
        return rig

    monkeypatch.setattr(backends, "load_servo_class", lambda _: lambda *_: device("servo"))
    monkeypatch.setattr(backends, "_rig_class", lambda: make_rig)
    return calls


def test_playback_needs_the_log_to_play(config: Config) -> None:
    plays = config.with_values(camera={"backend": "playback"})
    with pytest.raises(ConfigError, match=r"camera\.path; set it to the log to play"), open_devices(plays):
        pass


def test_a_recording_plays_as_camera_and_load_cell(config: Config, fused_log: Path) -> None:
    section = {"backend": "playback", "path": fused_log}
    with open_devices(config.with_values(camera=section, load_cell=section)) as devices:
        assert devices.camera is not None
        assert devices.load_cell is not None
        devices.camera.start()
        devices.load_cell.start()
        devices.clock.sleep_until_ns(100_000_000)
        assert devices.camera.newest() is not None
        assert len(devices.load_cell.drain()) > 10


def test_what_was_open_is_closed_where_the_next_can_not_be(config: Config, closed: list[str]) -> None:
    no_log = config.with_values(camera={"backend": "simulated"}, load_cell={"backend": "playback"})
    with pytest.raises(ConfigError), open_devices(no_log):
        pass
    assert closed == ["camera", "rig"]


@pytest.mark.parametrize("error", [DeviceError, KeyboardInterrupt, SystemExit])
def test_everything_is_closed_on_every_way_out(
    config: Config, closed: list[str], error: type[BaseException]
) -> None:
    config = config.with_values(camera={"backend": "simulated"})
    with open_devices(config):
        assert closed == ["rig starts"]
    assert closed[1:] == ["servo", "load cell", "camera", "rig"]
    closed.clear()
    with pytest.raises(error), open_devices(config):
        raise error
    assert closed[1:] == ["servo", "load cell", "camera", "rig"]


def test_the_hosts_clock_sleeps_until_its_time() -> None:
    clock = MonotonicClock()
    begin_ns = clock.now_ns()
    clock.sleep_until_ns(begin_ns - 1)
    clock.sleep_until_ns(begin_ns + 2_000_000)
    assert clock.now_ns() >= begin_ns + 2_000_000


class OwnLoadCell:
    """A third-party load cell without samples."""

    supports_lockstep = True

    def __init__(self, config: LoadCellConfig, clock: Clock) -> None:
        self.options, self.clock = config.options, clock

    def start(self) -> None: ...

    def close(self) -> None: ...

    def drain(self) -> list[LoadCellSample]:
        return []

    def counts(self) -> dict[str, int]:
        return {}


def test_a_third_party_backend_is_opened_with_its_options(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "own_devices", sys.modules[__name__])
    section = {"backend": "own_devices:OwnLoadCell", "options": {"gain": 3}}
    with open_devices(config.with_values(load_cell=section)) as devices:
        cell: Any = devices.load_cell
        assert (cell.options, cell.clock) == ({"gain": 3}, devices.clock)


def test_a_registered_backend_is_opened_by_its_name(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "own_devices", sys.modules[__name__])
    point = EntryPoint("mine", "own_devices:OwnLoadCell", "gripper_force.load_cells")
    monkeypatch.setattr(
        "gripper_force.plugins.entry_points", lambda group: EntryPoints([point]).select(group=group)
    )
    with open_devices(config.with_values(load_cell={"backend": "mine"})) as devices:
        assert devices.load_cell is not None
        assert devices.load_cell.drain() == []
    with (
        pytest.raises(ConfigError, match=r"did you mean 'mine'.*phidget, mine or package"),
        open_devices(config.with_values(load_cell={"backend": "mines"})),
    ):
        pass


OWN_SERVO = """
class OwnServo:
    spec = start = read = write = stop = close = print
"""


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "servo.backend 'own_servo:OwnServo' is not virtual, .* or set servo.backend=dynamixel$"),
        (
            {"camera": {"backend": "none"}, "load_cell": {"backend": "none"}},
            "set clock=realtime, or servo.backend=dyn",
        ),
    ],
)
def test_simulated_sensors_and_time_need_the_simulated_servo_and_not_only_its_port(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keys: dict[str, object], message: str
) -> None:
    (tmp_path / "own_servo.py").write_text(OWN_SERVO)
    monkeypatch.syspath_prepend(tmp_path)
    own = config.with_values(servo={"backend": "own_servo:OwnServo"}, **keys)
    with pytest.raises(ConfigError, match=message), open_devices(own):
        pass
