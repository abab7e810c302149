import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import Config, config_from_text, load_config
from gripper_force.control import state_machine
from gripper_force.errors import ConfigError, DataError, DeviceError
from gripper_force.interfaces import Devices, LoadCell
from gripper_force.jobs.dataset import load_clip
from gripper_force.jobs.recording import record as module
from gripper_force.jobs.recording.record import RecordingPlan, record
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    Frame,
    GraspStatus,
    LoadCellSample,
    Phase,
    Request,
    RequestKind,
)
from gripper_force.vision.preprocess import Preprocess
from gripper_hw.dynamixel import virtual
from gripper_hw.sim.simulated_rig import SimulatedLoadCell


@pytest.fixture
def config(quick: list[str]) -> Config:
    """The cheapest rig that can record."""
    return load_config(None, [*quick, "camera.backend=simulated", "camera.rate_hz=20", "control.ramp_n_s=30"])


def made(config: Config, plan: RecordingPlan, out: Path) -> list[Path]:
    return list(record(config, plan, out))


def test_paths_of_sets() -> None:
    plan = RecordingPlan(15, degrees=10, lux=350.0)
    paths = plan.paths(load_config(None, ["object=paper_cup"]), Path("data"))
    assert paths[0] == Path("data/train/paper_cup-10deg-350lux-01.mcap")
    assert [int(path.stem[-2:]) for path in paths if path.parent.name == "test"] == [5, 10, 15]
    assert RecordingPlan(1).paths(load_config(), Path())[0] == Path("train/sponge-01.mcap")


def test_set_is_a_log_for_training(config: Config, tmp_path: Path) -> None:
    progress: list[str] = []
    prompts: list[str] = []
    plan = RecordingPlan(1, 2, 5.0, degrees=10, lux=350)
    (path,) = record(
        config, plan, tmp_path, lambda text, steps=1: progress.append(text), lambda text: prompts.append(text)
    )
    assert list(tmp_path.rglob("*.*")) == [path]
    assert path == tmp_path / "train" / "stapler-10deg-350lux-01.mcap"
    log = LogReader(path)
    about = {key: log.metadata[key] for key in ("object", "set", "split", "degrees", "lux")}
    assert about == {
        "object": "stapler",
        "set": "stapler-10deg-350lux-01",
        "split": "train",
        "degrees": "10",
        "lux": "350",
    }
    used = config_from_text(log.config, str(path))
    assert (used.control.feedback, used.vision.checkpoint) == ("current", "none")
    requests = list(log.records(Request))
    assert [r.kind for r in requests] == [RequestKind.GRASP, RequestKind.RELEASE] * 2 + [RequestKind.RELEASE]
    assert all(1 <= r.target_n <= 5 for r in requests if r.kind == RequestKind.GRASP)
    assert sum(frame.received_ns < requests[0].t_ns for frame in log.records(Frame)) >= 10
    last = list(log.records(GraspStatus))[-1]
    assert last.phase == Phase.OPEN
    assert last.width_m == pytest.approx(used.gripper.open_width_m, abs=0.004)
    clip = load_clip(path, Preprocess(size=32), None)
    assert clip.valid.all()
    assert clip.forces_n[:10].max() < 0.1
    assert 0.8 < clip.forces_n.max() < 6
    assert {text.split(":")[0] for text in progress} == {"at rest", "touch 1 of 2", "touch 2 of 2"}
    assert max(float(text.split()[-2]) for text in progress) > 0.5
    assert prompts == ["Put the object between the jaws for set 1"]


def test_existing_sets_are_kept(config: Config, tmp_path: Path) -> None:
    plan = RecordingPlan(2, 1)
    kept, missing = plan.paths(config, tmp_path)
    assert made(config, RecordingPlan(1, 1), tmp_path) == [kept]
    recorded_before = kept.read_bytes()
    leftover = missing.with_name(f".{missing.name}.part")
    leftover.write_bytes(b"half a log")
    assert made(config, plan, tmp_path) == [kept, missing]
    assert kept.read_bytes() == recorded_before
    assert not leftover.exists()
    peak_n = next(LogReader(missing).records(Request)).target_n
    assert peak_n == np.random.default_rng([config.seed + 1, 12]).uniform(1, 9)
    missing_bytes = missing.read_bytes()
    retared = config.with_values(load_cell={"tare_raw": 0.2})
    assert made(retared, plan, tmp_path) == [kept, missing]
    assert missing.read_bytes() == missing_bytes
    dimmed = config.with_values(sim={"lux": 100.0})
    with pytest.raises(DataError, match=r"stapler-01\.mcap exists already .* sim\.lux None, not 100"):
        made(dimmed, plan, tmp_path)
    with pytest.raises(DataError, match=r"target_n 9\.0, not 5\.0; use another folder"):
        made(config, RecordingPlan(2, 1, peak_n=5.0), tmp_path)
    with pytest.raises(DataError, match=r"with 1 touches, not 4; use another folder, pass --touches 1, or"):
        made(config, RecordingPlan(2, 4), tmp_path)


@pytest.mark.parametrize(
    ("overrides", "plan", "sentence"),
    [
        (["camera.backend=none"], RecordingPlan(1), r"needs a camera, but camera\.backend is none"),
        (["load_cell.backend=none"], RecordingPlan(1), r"needs a load cell, but load_cell\.backend is none"),
        (["object=../egg"], RecordingPlan(1), r"object '\.\./egg' can't be part of a file name"),
        (
            [],
            RecordingPlan(1, peak_n=12.0),
            r"up to 12 N are not within 1 to 9 N, the range for control\.force_limit_n 14 N",
        ),
        ([], RecordingPlan(1, peak_n=0.5), "up to 0.5 N are not within 1 to 9 N"),
    ],
)
def test_wrong_configuration_raises_before_any_motion(
    overrides: list[str], plan: RecordingPlan, sentence: str, quick: list[str], tmp_path: Path
) -> None:
    config = load_config(None, [*quick, "camera.backend=simulated", *overrides])
    with pytest.raises(ConfigError, match=sentence):
        made(config, plan, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("unit", "kind", "sentence"),
    [
        ("load_cell", "off", r"load cell has given no valid sample for 0\.5 s in set 1"),
        ("load_cell", "stuck", r"no valid sample for 0\.5 s in set 1 \(rejected: [0-9]+ stuck\)"),
        ("load_cell", "wrong", "load cell is saturated in set 1, where it last read -?0.0 N"),
        ("camera", "off", r"camera has given no frame for 0\.5 s in set 1"),
        ("servo", "wrong", "set 1 ended with a fault: the servo reports hardware error 0x20"),
    ],
)
def test_device_failure_ends_recording(
    unit: str, kind: str, sentence: str, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_SILENT_NS", NS_PER_S // 2)
    broken = load_config(None, [f"faults=[{{unit: {unit}, kind: {kind}, at_s: 0.2}}]"]).faults
    with pytest.raises(DeviceError, match=sentence):
        made(config.with_values(faults=broken), RecordingPlan(1), tmp_path)
    assert not list(tmp_path.rglob("*.mcap"))


def test_board_that_is_silent_at_first_is_waited_for(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one that resets when its port is opened."""
    monkeypatch.setattr(module, "_SILENT_NS", 300 * NS_PER_MS)
    monkeypatch.setattr(module, "FIRST_SAMPLE_NS", NS_PER_S)
    drain = SimulatedLoadCell.drain
    boots_ns = NS_PER_S // 2

    def late(cell: SimulatedLoadCell) -> list[LoadCellSample]:
        return [sample for sample in drain(cell) if sample.t_ns > cell._start_ns + boots_ns]

    monkeypatch.setattr(SimulatedLoadCell, "drain", late)
    (path,) = made(config, RecordingPlan(1, 1, 3.0), tmp_path)
    boots_ns = 10 * NS_PER_S
    with pytest.raises(DeviceError, match=r"no valid sample for 1 s in set 1 \(rejected: none\)"):
        made(config, RecordingPlan(1, 1, 3.0), tmp_path / "again")
    first = next(iter(LogReader(path).records(Request)))
    assert next(iter(LogReader(path).records(LoadCellSample))).t_ns < first.t_ns


def test_jaws_that_do_not_open_first_are_named(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_machine, "_OPENING_SPARE_S", -1.8)
    narrow = config.with_values(gripper={"open_position_rad": -0.3})  # open jaws seem to be 80 mm apart
    with pytest.raises(DeviceError, match="have not opened within"):
        made(narrow, RecordingPlan(1), tmp_path)


def test_jaws_open_after_fault_if_configured(config: Config, tmp_path: Path) -> None:
    overrides = ["faults=[{unit: plant, kind: wrong, at_s: 1.0}]", "control.on_fault=open"]
    faulty = load_config(None, overrides)
    opening = config.with_values(faults=faulty.faults, control={"on_fault": faulty.control.on_fault})
    with pytest.raises(DeviceError, match="set 1 ended with a fault"):
        made(opening, RecordingPlan(1), tmp_path)
    (left,) = tmp_path.rglob("*.part")
    widths_m = [status.width_m for status in LogReader(left).records(GraspStatus)]
    assert min(widths_m) < 0.08
    assert widths_m[-1] > 0.085


@pytest.fixture
def change_load_cell(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[float], float]], None]:
    """Returns a function that replaces the readings of the rig's load cell."""

    class Changed:
        def __init__(self, cell: LoadCell, change: Callable[[float], float]) -> None:
            self._cell, self._change = cell, change

        def __getattr__(self, name: str) -> object:
            return getattr(self._cell, name)

        def drain(self) -> list[LoadCellSample]:
            return [replace(s, force_n=self._change(s.force_n)) for s in self._cell.drain()]

    def change(to: Callable[[float], float]) -> None:
        @contextmanager
        def opened(config: Config) -> Iterator[Devices]:
            with open_devices(config) as devices:
                assert devices.load_cell is not None
                devices.load_cell = Changed(devices.load_cell, to)  # type: ignore[assignment]
                yield devices

        monkeypatch.setattr(module, "open_devices", opened)

    return change


def test_force_at_rest_raises(
    change_load_cell: Callable[[Callable[[float], float]], None], config: Config, tmp_path: Path
) -> None:
    change_load_cell(lambda force_n: force_n + 0.8)
    with pytest.raises(DataError, match=r"reads 0\.[78][0-9]* N with open jaws; .* set load_cell\.tare_raw="):
        made(config, RecordingPlan(1), tmp_path)


def test_touch_that_load_cell_does_not_measure_raises(
    change_load_cell: Callable[[Callable[[float], float]], None], config: Config, tmp_path: Path
) -> None:
    change_load_cell(lambda force_n: -force_n)
    with pytest.raises(
        DataError, match=r"touch 1 of set 1 pressed with .* N .* measured 0\.[0-9]* N; check that"
    ):
        made(config, RecordingPlan(1), tmp_path)


def test_sets_of_an_object_file_that_was_changed_are_not_mixed(config: Config, tmp_path: Path) -> None:
    file = tmp_path / "foam.yaml"
    text = "family: solid\nsize_m: [0.05, 0.05, 0.05]\nmodulus_pa: 200000\n"
    file.write_text(text)
    own = config.with_values(object="foam", sim={"object": file})
    list(record(own, RecordingPlan(1, touches=1, peak_n=3, test_every=None), tmp_path / "out"))
    file.write_text(text.replace("200000", "300000"))
    with pytest.raises(DataError, match=r"file has changed between .*foam-01\.mcap and .*foam-02\.mcap"):
        list(record(own, RecordingPlan(2, touches=1, peak_n=3, test_every=None), tmp_path / "out"))


def test_recording_continues_with_the_detail_that_auto_chose(config: Config, tmp_path: Path) -> None:
    auto = config.with_values(sim={"detail": "auto"}, budget={"sim_speed": 0.01})
    first = made(auto, RecordingPlan(1, touches=1), tmp_path)
    assert made(auto, RecordingPlan(2, touches=1), tmp_path)[0] == first[0]


def test_touch_that_reaches_no_force_raises(config: Config, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"touch 1 of set 1 reached no force: .* is between the jaws"):
        made(config.with_values(control={"timeout_s": 0.3}), RecordingPlan(1), tmp_path)
    assert not list(tmp_path.rglob("*.mcap"))


@pytest.mark.usefixtures("own_process")
def test_interrupted_recording_stops_servo_and_keeps_complete_sets(config: Config, tmp_path: Path) -> None:
    torque: list[int] = []

    def interrupt(text: str, steps: int = 1) -> None:
        bus = virtual.find_bus("rig")
        assert bus is not None
        torque.append(bus.servos[0].get("torque_enable"))
        if text.startswith("touch 2 of 3"):
            rig.append(bus)
            os.kill(os.getpid(), signal.SIGTERM)

    rig: list[virtual.VirtualBus] = []
    done: list[Path] = []
    with pytest.raises(KeyboardInterrupt):
        done.extend(record(config, RecordingPlan(3, 1), tmp_path, interrupt))
    assert set(torque) == {1}
    assert rig[0].servos[0].get("torque_enable") == 0
    assert [path.name for path in tmp_path.rglob("*.mcap")] == ["stapler-01.mcap"]


def test_peak_follows_force_limit() -> None:
    _, peak_n = module._checked(load_config(None, ["control.force_limit_n=5"]), RecordingPlan(1))
    assert peak_n == pytest.approx(4.5 / 1.4)
    _, peak_n = module._checked(load_config(None, ["control.force_limit_n=20"]), RecordingPlan(1))
    assert np.isclose(peak_n, 12)
