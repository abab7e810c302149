"""Calibration of the simulated camera, with known lag, latency and markers."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
import yaml
from typer.testing import CliRunner, Result

from gripper_calibration.fits.camera_fit import estimate_lag
from gripper_calibration.procedures import calibrate_camera as procedure
from gripper_calibration.procedures.calibrate_camera import calibrate_camera, compute_ms, observe
from gripper_force.cli import app
from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError, DataError, DeviceTimeoutError
from gripper_force.jobs.recording.record import record
from gripper_force.profiles.apply import read_profiles, rig_mismatches
from gripper_force.profiles.object_profile import find_object
from gripper_force.profiles.rig_profile import read_rig
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import NS_PER_MS, Frame
from gripper_force.vision.checkpoint_writer import replace_header
from gripper_force.vision.header import read_checkpoint

QUICK = ["object=stapler", "sim.detail=coarse", "vision.checkpoint=none", "seed=2", "camera.rate_hz=30"]
WHOLE = (0, 0, 128, 128)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Path, Path]:
    """The end of the command, its rig profile, and its log of touches with visible markers."""
    rig = tmp_path_factory.mktemp("rig") / "rig.yaml"
    log = tmp_path_factory.mktemp("touches") / "log.mcap"

    def keep(*arguments: Any) -> list[Path]:
        (path,) = record(*arguments)
        shutil.copy(path, log)
        return [path]

    asked = ["calibrate", "camera", "--rig", rig, "--exposure-us", 500, "--exposure-us", 4000, "--json"]
    sets = [part for key in (*QUICK, "sim.markers=true", "sim.lux=550") for part in ("--set", key)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(procedure, "record", keep)
        done = CliRunner().invoke(app, [str(part) for part in (*asked, "--touches", 5, "--seed", 0, *sets)])
    assert done.exit_code == 0, done.stderr
    return done, rig, log


@pytest.fixture
def log(calibrated: tuple[Result, Path, Path]) -> Path:
    """A set of touches with visible markers."""
    return calibrated[2]


@pytest.fixture
def recorded(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes a calibration take the log instead of touches of its own."""
    monkeypatch.setattr(procedure, "record", lambda *_: [log])


def shifted(log: Path, folder: Path, by_ms: float) -> Path:
    """The same set with late camera timestamps."""
    reader, path = LogReader(log), folder / "shifted.mcap"
    with LogWriter(path, config=reader.config, metadata=reader.metadata) as copy:
        for item in reader.records():
            if isinstance(item, Frame):
                late_ns = round(by_ms * NS_PER_MS)
                item = replace(item, t_ns=item.t_ns + late_ns, received_ns=item.received_ns + late_ns)
            copy.write(item)
    return path


@pytest.mark.parametrize("by_ms", [-25.0, 0.0, 25.0])
def test_known_lag_is_within_the_interval(log: Path, tmp_path: Path, by_ms: float) -> None:
    lag = estimate_lag(observe(shifted(log, tmp_path, by_ms), WHOLE).touches)
    assert lag.low is not None
    assert lag.high is not None
    assert lag.low < by_ms < lag.high
    assert lag.half < 12


def test_correlation_with_force_overestimates_the_lag(log: Path) -> None:
    assert all(touch.correlation_ms > 10 for touch in observe(log, WHOLE).touches if touch.force_n > 3)


def test_camera_latency_and_wait_for_a_cycle_are_measured(log: Path) -> None:
    seen = observe(log, None)
    assert 15 <= seen.use_ms <= 20  # a latency of 15 ms, and the next cycle of 5
    assert seen.rate_hz == pytest.approx(30, rel=0.05)  # of whole physics steps
    assert len(seen.widest_markers) == 2
    assert observe(log, WHOLE).markers == []


def test_computing_time_is_measured_in_real_time(log: Path, tiny_checkpoint: Path) -> None:
    gray = observe(log, WHOLE).reference
    assert compute_ms(load_config(None, QUICK), gray) == 0.0
    config = load_config(None, [*QUICK, f"vision.checkpoint={tiny_checkpoint}"])
    assert compute_ms(config, gray) == config.vision.lockstep_compute_ms
    assert 0 < compute_ms(config.with_values(clock="realtime"), gray) < 1000


def test_command_writes_profile_reference_and_report(calibrated: tuple[Result, Path, Path]) -> None:
    done, rig, _ = calibrated
    last = done.stderr.splitlines()[-1]
    assert last.startswith("next: gripper-force calibrate object NAME --seed 0 --set ")
    assert last.endswith(f" --set calibration.rig={rig}")
    result = json.loads(done.stdout)
    found = read_rig(rig).camera
    assert found is not None
    assert (found.exposure_us, found.backend, found.side_px, found.markers) == (4000, "simulated", 128, True)
    assert found.lag_ms.low is not None
    assert found.lag_ms.high is not None
    assert found.lag_ms.low < 0 < found.lag_ms.high
    assert found.delay_ms.value == pytest.approx(result["use_ms"] + 500 / 30 + found.lag_ms.value, abs=1.0)
    assert result["touches"] == 5
    reference = cv2.imread(str(rig.with_name(found.reference)))
    assert reference is not None
    assert reference.shape == (128, 128, 3)
    assert cv2.imread(result["report"]) is not None
    config = load_config(None, [f"calibration.rig={rig}"])
    assert config.vision.region == found.region
    assert config.camera.exposure_us == 4000
    assert config.control.plant_delay_ms == found.delay_ms.value


@pytest.mark.usefixtures("recorded")
def test_automatic_exposure_stays_automatic(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    calibrate_camera(load_config(None, [*QUICK, "camera.exposure_us=null"]), rig, region=WHOLE)
    found = read_rig(rig).camera
    assert found is not None
    assert found.exposure_us is None
    named = load_config(None, [*QUICK, f"calibration.rig={rig}"])
    assert named.camera.exposure_us is None
    assert mismatches(named) == []


def mismatches(config: Config) -> list[str]:
    return rig_mismatches(config, read_profiles(config))


@pytest.mark.usefixtures("recorded")
def test_different_camera_is_refused_or_reported(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    calibrate_camera(load_config(None, QUICK), rig, region=(4, 4, 120, 120), exposures_us=[4000])
    found = read_rig(rig).camera
    assert found is not None
    assert (found.region, found.markers) == ((4, 4, 120, 120), False)
    named = [*QUICK, f"calibration.rig={rig}"]
    assert mismatches(load_config(None, named)) == []
    another = load_config(None, [*named, "camera.exposure_us=500", "camera.side_px=64"])
    why = "with camera.side_px 128, not 64; camera.exposure_us 4000, not 500; teach or calibrate"
    with pytest.raises(ConfigError, match=why):
        mismatches(another)
    with pytest.raises(
        ConfigError, match=r"camera\.resolution_px None, not \[640, 400\]; camera\.lens_position None"
    ):
        mismatches(load_config(None, [*named, "camera.resolution_px=[640, 400]", "camera.lens_position=90"]))
    warned = load_config(None, [*named, "camera.exposure_us=500", "calibration.on_mismatch=warn"])
    assert mismatches(warned) == ["camera.exposure_us 4000, not 500"]
    assert mismatches(load_config(None, [*named, "camera.backend=none"])) == []


@pytest.mark.usefixtures("recorded")
def test_without_markers_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(procedure, "find_markers", lambda _: {})
    with pytest.raises(
        DataError,
        match=r"no image shows both markers completely: of [\d.]+ images, marker [\d.]+ in [\d.]+ and mark",
    ):
        calibrate_camera(load_config(None, QUICK), tmp_path / "rig.yaml", exposures_us=[4000])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("sets", "exposures_us", "error", "why"),
    [
        (
            ["sim.lux=90000"],
            [500, 4000],
            DataError,
            r"the image is dark or clipped at every exposure \(500 us: mean 233, 76\.3 % clipped, 4000 u",
        ),
        (["sim.lux=1"], [500, 4000], DataError, r"4000 us: mean \d+, 0.0 % clipped"),
        (
            [],
            [17_000],
            ConfigError,
            r"every candidate exposure is longer than half a frame \(16667 us at camera\.rate_hz 30\)",
        ),
        (
            ["camera.backend=none"],
            [4000],
            ConfigError,
            r"calibrate camera needs a camera with settings, but camera\.backend is none",
        ),
        (
            ["faults=[{unit: camera, kind: off}]"],
            [4000],
            DeviceTimeoutError,
            "no frame for 3 s with camera.exposure_us=4000",
        ),
    ],
)
def test_unusable_cameras_are_refused_before_anything_moves(
    tmp_path: Path, sets: list[str], exposures_us: list[int], error: type[Exception], why: str
) -> None:
    with pytest.raises(error, match=why):
        calibrate_camera(load_config(None, [*QUICK, *sets]), tmp_path / "rig.yaml", exposures_us=exposures_us)


@pytest.mark.parametrize(
    ("region", "why"),
    [
        ("10,10,200,100", "must lie within the camera's frame of 128x128 pixels"),
        ("10,10,100", "--region needs left,top,width,height in pixels, got '10,10,100'"),
    ],
)
def test_given_region_is_checked(tmp_path: Path, region: str, why: str) -> None:
    sets = [part for key in QUICK for part in ("--set", key)]
    asked = ["calibrate", "camera", "--rig", str(tmp_path / "rig.yaml"), "--region", region, *sets]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code != 0
    assert isinstance(done.exception, ConfigError)
    assert why in str(done.exception)


def test_a_new_exposure_names_what_it_outdates(
    tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    folder = tmp_path / "gripper-force" / "objects"
    folder.mkdir(parents=True)
    sponge = yaml.safe_load(find_object("sponge").read_text())
    for path, exposure_us in (("mug.yaml", 4000), ("taught/profile.yaml", 4000), ("old.yaml", 1000)):
        (folder / path).parent.mkdir(exist_ok=True)
        tree = {**sponge, "camera": {**sponge["camera"], "camera.exposure_us": exposure_us}}
        (folder / path).write_text(yaml.safe_dump(tree))
    (folder / "damaged.yaml").write_text("no profile")
    network = tmp_path / "network.safetensors"
    settings = {"rigs": 1, **load_config().rig_settings()}
    header = read_checkpoint(tiny_checkpoint)[2].model_copy(update={"trained_on": settings})
    replace_header(tiny_checkpoint, header, network)
    before = load_config(None, [f"vision.checkpoint={network}"])
    after = load_config(None, [f"vision.checkpoint={network}", "camera.exposure_us=2000"])
    why = "(camera.exposure_us 4000, not 2000)"
    assert procedure._outdated(before, after) == (
        f"the profile {folder / 'mug.yaml'} {why}",
        f"the bundle {folder / 'taught/profile.yaml'} {why}",
        f"the network {network} {why}",
    )
    assert procedure._outdated(before, before) == ()
