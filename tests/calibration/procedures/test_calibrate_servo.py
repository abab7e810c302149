"""Servo calibration on the simulated rig, with known friction and torque."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gripper_calibration.fits.servo_fit import FreePass, ServoPress
from gripper_calibration.procedures import calibrate_servo as procedure
from gripper_calibration.procedures.calibrate_camera import calibrate_camera
from gripper_calibration.procedures.calibrate_load_cell import calibrate_load_cell
from gripper_calibration.procedures.calibrate_servo import calibrate_servo
from gripper_calibration.procedures.servo_measurement import measure
from gripper_force.cli import app
from gripper_force.cli.output.calibrate import SERVO, rig_table
from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError, DataError, DeviceError, RequestError
from gripper_force.jobs.grasp import run_grasp
from gripper_force.jobs.profile_files import update_rig
from gripper_force.profiles.rig_profile import CalibratedValue, LoadCellCalibration, read_rig
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import Event, LoadCellSample
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus
from gripper_hw.load_cells.screening import SampleValidator
from gripper_hw.sim.scene import draw_scene
from gripper_hw.sim.simulated_rig import SimulatedLoadCell

GRIPPERS = Path(__file__).parents[3] / "examples" / "grippers"
QUICK = ["object=block", "sim.detail=coarse", "seed=7"]

MADE_UP = LoadCellCalibration(
    date=datetime(2026, 1, 2, tzinfo=UTC),
    sensor="simulated",
    tare_raw=CalibratedValue(value=0.0),
    n_per_raw=CalibratedValue(value=2.0, low=1.9, high=2.1),
    force_n=(0.0, 10.0),
    noise_n=0.01,
    drift_n_min=CalibratedValue(value=0.0),
)


def config_of(*overrides: str) -> Config:
    return load_config(None, [*QUICK, *overrides])


Measurement = tuple[list[ServoPress], list[FreePass]]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Measurement]:
    """A rig profile, and the presses and passes that it was fitted to."""
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    asked: list[str] = []
    measured: list[Measurement] = []

    def noted(*arguments: Any) -> Measurement:
        measured.append(measure(*arguments))
        return measured[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(procedure, "measure", noted)
        result = calibrate_servo(config_of(), [0.03], path, prompt=lambda text: asked.append(text))
    assert asked == ["Put the load cell with its width of 30 mm between the open jaws"]
    assert Path(result.report).stat().st_size > 20_000
    assert (result.presses, result.passes) == (6, 12)
    assert abs(result.width_shift_m) < 0.002
    assert result.width_remark is None
    return path, measured[0]


@pytest.fixture
def rig(calibrated: tuple[Path, Measurement]) -> Path:
    return calibrated[0]


def about(estimate: CalibratedValue, truth: float, share: float) -> bool:
    """True if the value is close to the truth and the interval is plausible."""
    return (
        abs(estimate.value - truth) < min(share * truth, 2 * estimate.half) and estimate.half < share * truth
    )


def test_torque_and_friction_of_the_scene_are_found(rig: Path) -> None:
    found = read_rig(rig).servo
    assert found is not None
    config = config_of()
    scene, radius_m = draw_scene("block", config.seed, config.sim), config.gripper.pinion_radius_m
    friction_n = scene.servo_friction_nm / (2 * radius_m) + scene.jaw_friction_n
    assert found.model == config.servo.model
    assert about(found.nm_per_a, load_model(found.model).nm_per_a * scene.nm_per_a, 0.01)
    assert about(found.friction_n, friction_n, 0.06)
    assert about(found.damping_n_s_m, scene.servo_damping_nm_s / (2 * radius_m**2) + 2.0, 0.25)
    assert found.open_position_rad.value == pytest.approx(scene.backlash_m / radius_m, abs=5e-4)
    assert found.pinion_radius_m == CalibratedValue(value=radius_m)
    assert found.force_n[0] < 1
    assert 9 < found.force_n[1] < 10
    assert load_config(None, [f"calibration.rig={rig}"]).gripper.nm_per_a == found.nm_per_a.value


def test_a_gauge_of_another_width_than_named_is_noticed(
    calibrated: tuple[Path, Measurement], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    presses, passes = calibrated[1]
    named = [replace(press, gauge_m=0.036) for press in presses]
    monkeypatch.setattr(procedure, "measure", lambda *_: (named, passes))
    sets = [part for one in QUICK for part in ("--set", one)]
    rig = ["--rig", str(tmp_path / "rig.yaml")]
    end = CliRunner().invoke(app, ["calibrate", "servo", "--gauge-mm", "36", "--yes", "--json", *rig, *sets])
    assert json.loads(end.stdout)["width_shift_m"] == pytest.approx(0.006, abs=0.002)
    assert "every width is 6 mm larger than the configuration said" in " ".join(end.stderr.split())


@pytest.mark.parametrize(("scale", "ratio"), [(0.6, r"0\.6\d"), (1.6, r"1\.7\d")])
def test_an_implausible_torque_constant_is_refused(
    calibrated: tuple[Path, Measurement],
    scale: float,
    ratio: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    presses, passes = calibrated[1]
    scaled = [replace(press, force_n=scale * press.force_n) for press in presses]
    monkeypatch.setattr(procedure, "measure", lambda *_: (scaled, passes))
    with pytest.raises(DataError, match=rf"Nm/A, {ratio} times the expected .*: calibrate the load cell"):
        calibrate_servo(config_of(), [0.03], tmp_path / "rig.yaml", prompt=lambda text: None)
    assert not list(tmp_path.iterdir())


def test_torque_is_found_through_a_linkage_with_little_free_travel(tmp_path: Path) -> None:
    config = load_config(GRIPPERS / "rotary_finger.yaml", QUICK)
    calibrate_servo(config, [0.03], tmp_path / "rig.yaml", prompt=lambda text: None)
    found = read_rig(tmp_path / "rig.yaml").servo
    assert found is not None
    scene = draw_scene("block", config.seed, config.sim)
    assert about(found.nm_per_a, load_model(found.model).nm_per_a * scene.nm_per_a, 0.02)
    assert found.open_position_rad.value == pytest.approx(0.0, abs=0.03)


def test_target_above_the_calibrated_force_is_refused(rig: Path, tmp_path: Path) -> None:
    config = config_of(f"calibration.rig={rig}", "control.force_limit_n=20", "target_n=11")
    with pytest.raises(RequestError, match=r"target of 11 N is above the 9\.\d+ N that the rig profile"):
        run_grasp(config, tmp_path / "run.mcap")


def test_profile_of_another_servo_is_refused_or_reported(rig: Path, tmp_path: Path) -> None:
    another = [f"calibration.rig={rig}", "servo.model=XM430-W210", "camera.backend=none", "target_n=2"]
    another += ["control.settle_s=0.3", "control.hold_s=0.3"]
    path = tmp_path / "run.mcap"
    with pytest.raises(ConfigError, match=r"rig profile .* was made with servo XM430-W350, not XM430-W210"):
        run_grasp(config_of(*another), path)
    assert not path.exists()
    run_grasp(config_of(*another, "calibration.on_mismatch=warn"), path)
    said = [record.text for record in LogReader(path).records(Event) if "rig profile" in record.text]
    assert len(said) == 1


@pytest.mark.parametrize(
    ("overrides", "gauge_m", "kind", "sentence"),
    [
        (["load_cell.backend=none"], 0.03, ConfigError, "calibrate servo needs a load cell"),
        ([], 0.09, ConfigError, "a gauge of 90 mm does not fit between jaws that open to 92 mm"),
        (["object=sponge"], 0.03, ConfigError, "object is 'sponge'; pass --set object=block --gauge-mm 30"),
        ([], 0.06, DataError, "the jaws met the gauge of 60 mm at a width of 30 mm"),
        (["faults=[{unit: load_cell, kind: 'off'}]"], 0.03, DataError, "no valid sample for 5 s"),
        (["faults=[{unit: load_cell, kind: wrong}]"], 0.03, DataError, "no valid sample for 5 s"),
        (["gripper.closing_sign=-1"], 0.03, DataError, "the jaws closed without a force on the load cell"),
        (
            ["gripper.open_position_rad=0.5"],
            0.03,
            DeviceError,
            r"outside their travel.*nothing has moved.*gripper\.open_position_rad",
        ),
        (
            ["faults=[{unit: load_cell, kind: stuck, at_s: 1}]"],
            0.03,
            DeviceError,
            "no valid sample for 1.5 s in closing on the gauge",
        ),
        (["faults=[{unit: servo, kind: wrong, at_s: 3}]"], 0.03, DeviceError, "hardware error"),
        (
            ["sim.friction=4"],
            0.03,
            DataError,
            r"the jaws do not move with 0\.\d\d A, twice gripper.friction_n",
        ),
        (["servo.current_limit_a=0.15"], 0.03, DataError, r"[\d.]+ A give [\d.]+ N instead of [\d.]+ N"),
    ],
)
def test_failures_are_named_and_leave_the_torque_off(
    overrides: list[str], gauge_m: float, kind: type[Exception], sentence: str, tmp_path: Path
) -> None:
    buses: list[VirtualBus | None] = []

    def progress(text: str, steps: int = 1) -> None:
        buses.append(find_bus("rig"))

    with pytest.raises(kind, match=sentence) as caught:
        calibrate_servo(
            config_of(*overrides),
            [gauge_m],
            tmp_path / "rig.yaml",
            prompt=lambda text: None,
            progress=progress,
        )
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
    assert all(bus is not None and bus.servos[0].get("torque_enable") == 0 for bus in buses)


@pytest.fixture
def true_force_n(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """True forces of the simulated world, one for each reading of the servo."""
    return noted_state(monkeypatch, "force_n")


@pytest.fixture
def true_closing_m_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """True closing speeds of a jaw, one for each reading of the servo."""
    return noted_state(monkeypatch, "closing_m_s")


def noted_state(monkeypatch: pytest.MonkeyPatch, name: str) -> list[float]:
    values: list[float] = []
    drain = SimulatedLoadCell.drain

    def noted(cell: SimulatedLoadCell) -> list[LoadCellSample]:
        values.append(getattr(cell._world, name))
        return drain(cell)

    monkeypatch.setattr(SimulatedLoadCell, "drain", noted)
    return values


def test_slow_load_cell_that_is_silent_at_first_is_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, true_force_n: list[float]
) -> None:
    """As of a board with an HX711 at 10 samples/s, which resets when its port is opened."""
    noted = SimulatedLoadCell.drain
    validators: dict[int, SampleValidator] = {}

    def drain(cell: SimulatedLoadCell) -> list[LoadCellSample]:
        validator = validators.setdefault(id(cell), SampleValidator(0.0, 1.0))
        now_ns = cell._start_ns + cell._world.t_ns
        for sample in noted(cell):
            if sample.t_ns > cell._start_ns + 1_600_000_000:
                validator.add(sample.t_ns, sample.force_n)
        return validator.take(now_ns)

    monkeypatch.setattr(SimulatedLoadCell, "drain", drain)
    config = config_of("load_cell.rate_hz=10")
    calibrate_servo(config, [0.03], tmp_path / "rig.yaml", prompt=lambda text: None)
    found = read_rig(tmp_path / "rig.yaml").servo
    assert found is not None
    scene = draw_scene("block", config.seed, config.sim)
    assert about(found.nm_per_a, load_model(found.model).nm_per_a * scene.nm_per_a, 0.05)
    assert max(true_force_n) < config.control.force_limit_n


def end_presses(text: str, steps: int = 1) -> None:
    if "free travel" in text:
        raise DataError("after the presses")


@pytest.mark.parametrize(
    ("scale", "overrides"),
    [(0.05, []), (0.3, []), (0.6, []), (0.5, ["sim.gain=1.4", "sim.friction=0.3"])],
)
def test_load_cell_with_a_wrong_scale_cannot_raise_the_force_above_its_limit(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    true_force_n: list[float],
    scale: float,
    overrides: list[str],
) -> None:
    noted = SimulatedLoadCell.drain

    def drain(cell: SimulatedLoadCell) -> list[LoadCellSample]:
        return [replace(sample, force_n=scale * sample.force_n) for sample in noted(cell)]

    monkeypatch.setattr(SimulatedLoadCell, "drain", drain)
    config = config_of(*overrides)
    with pytest.raises(
        DataError, match=r"the jaws closed without a force|A give .* N instead of|after the presses"
    ):
        calibrate_servo(config, [0.03], tmp_path / "rig.yaml", prompt=lambda text: None, progress=end_presses)
    assert max(true_force_n) < 1.05 * config.control.force_limit_n


def test_load_cell_that_leaves_the_jaws_during_a_press_does_not_let_them_shut_fast(
    tmp_path: Path, true_closing_m_s: list[float]
) -> None:
    config = config_of("faults=[{unit: plant, kind: 'off', at_s: 8}]")
    with pytest.raises(DataError, match="the jaws closed without a force"):
        calibrate_servo(config, [0.03], tmp_path / "rig.yaml", prompt=lambda text: None)
    assert 0.02 < max(true_closing_m_s) < 1.5 * config.control.approach_speed_m_s


def test_table_shows_values_with_intervals(capsys: pytest.CaptureFixture[str]) -> None:
    measured, given = {"value": 1.7, "low": 1.6, "high": 1.8}, {"value": 0.02, "low": None, "high": None}
    values = {"nm_per_a": measured, "pinion_radius_m": given, "force_n": [0.3, 9.5]}
    rig_table(values, {key: SERVO[key] for key in values})
    printed = capsys.readouterr().out
    for told in ("torque constant, Nm/A", "1.7 (1.6 to 1.8)", "0.02 (given)", "0.3 to 9.5"):
        assert told in printed


def test_profile_with_another_load_cell_scale_is_refused(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    update_rig(rig, MADE_UP)
    with pytest.raises(
        ConfigError,
        match=r".* has [\d.]+ N per raw unit for this load cell, but load_cell\.n_per_raw is None",
    ):
        calibrate_servo(config_of(), [0.03], rig, prompt=lambda text: None)


def test_rig_profile_in_the_configuration_is_written_though_it_does_not_exist(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Config, Path]] = []

    def noted(config: Config, _gauges_m: list[float], rig: Path, **_more: Any) -> None:
        asked.append((config, rig))
        raise DataError("noted")

    monkeypatch.setattr(procedure, "calibrate_servo", noted)
    named, other = tmp_path / "named.yaml", tmp_path / "other.yaml"
    arguments = ["calibrate", "servo", "--gauge-mm", "30", "--yes", "--set", f"calibration.rig={named}"]
    for more in ([], ["--rig", str(named)]):
        assert str(CliRunner().invoke(app, [*arguments, *more]).exception) == "noted"
    assert [(config.calibration.rig, rig) for config, rig in asked] == [(None, named)] * 2
    end = CliRunner().invoke(app, [*arguments, "--rig", str(other)])
    assert isinstance(end.exception, ConfigError)
    assert str(named) in str(end.exception)
    update_rig(named, MADE_UP)
    CliRunner().invoke(app, [*arguments, "--rig", str(other)])
    assert (asked[-1][0].calibration.rig, asked[-1][1]) == (named, other)


@pytest.mark.parametrize("obstacle", ["file above it", "folder of its name"])
@pytest.mark.parametrize("calibrate", ["servo", "camera", "load_cell"])
def test_a_rig_profile_that_can_not_be_written_is_named_before_anything_happens(
    calibrate: str, obstacle: str, tmp_path: Path
) -> None:
    def refuse(text: str, steps: int = 1) -> None:
        pytest.fail(text)

    rig = tmp_path / "place" / "rig.yaml"
    if obstacle == "file above it":
        rig.parent.touch()
    else:
        rig.mkdir(parents=True)
    with pytest.raises(ConfigError, match=r"can't write .*rig\.yaml: .*; name (another|a) file"):
        if calibrate == "servo":
            calibrate_servo(config_of(), [0.03], rig, prompt=refuse)
        elif calibrate == "camera":
            calibrate_camera(config_of(), rig, progress=refuse)
        else:
            calibrate_load_cell(config_of("load_cell.backend=serial"), 5.0, rig, prompt=refuse)


def test_without_a_terminal_the_command_is_refused(tmp_path: Path) -> None:
    arguments: list[Any] = ["calibrate", "servo", "--gauge-mm", "30", "--set", "object=block"]
    arguments += ["--rig", str(tmp_path / "rig.yaml")]
    end = CliRunner().invoke(app, arguments)
    assert isinstance(end.exception, ConfigError)
    assert "this needs a person at a terminal: Put the load cell" in str(end.exception)
    assert str(end.exception).endswith("; run it in a terminal, or pass --yes if it is done")
