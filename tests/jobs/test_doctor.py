import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from gripper_force import cli
from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError
from gripper_force.jobs import doctor
from gripper_force.jobs.checks import Check, judged, keep_only, rate_hz


@pytest.fixture
def sets(quick_vision: list[str]) -> list[str]:
    """A whole simulated rig, and limits that a busy machine keeps."""
    patient = ["control.rate_hz=0.1", "camera.rate_hz=20"]
    return [part for one in (*quick_vision, *patient) for part in ("--set", one)]


@pytest.fixture(autouse=True)
def _short_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_SLEEP_MS", 0)


def run(*arguments: object, answer: str = "") -> Result:
    return CliRunner().invoke(cli.app, ["doctor", *map(str, arguments)], input=answer)


def test_without_any_hardware_the_rig_is_fit(sets: list[str]) -> None:
    done = run("--json", *sets)
    assert (done.exit_code, done.exception) == (0, None)
    report: dict[str, Any] = json.loads(done.stdout)
    assert report["ok"] is True
    assert {check["unit"] for check in report["checks"]} == {
        *("servo", "servo 1", "camera", "load cell", "simulation", "network", "clock", "opencv"),
    }
    assert set(report["checks"][0]) == {"unit", "name", "found", "ok", "advice"}
    assert not [check for check in report["checks"] if check["ok"] is False]


def test_what_is_missing_is_a_problem_with_something_to_do(tmp_path: Path) -> None:
    missing = [
        *("clock=realtime", "servo.port=/dev/nowhere", "camera.backend=uvc", "camera.device=/dev/video99"),
        *("load_cell.backend=serial", "load_cell.port=/dev/nowhere", f"vision.checkpoint={tmp_path}/gone"),
    ]
    sets = [part for one in missing for part in ("--set", one)]
    done = run("--json", *sets)
    assert done.exit_code == 1
    report = json.loads(done.stdout)
    assert report["ok"] is False
    problems = {check["unit"]: check for check in report["checks"] if check["ok"] is False}
    assert set(problems) >= {"servo", "camera", "load cell", "network"}
    assert all(problem["advice"] for problem in problems.values())
    assert problems["servo"]["found"] == "there is no port /dev/nowhere"
    assert problems["servo"]["advice"].startswith("plug it in")


def test_a_defect_of_one_probe_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "PROBES", {"servo": "gripper_hw.nowhere"})
    checks = list(doctor.doctor(load_config(None, ["vision.checkpoint=none"])))
    assert checks[0].ok is False
    assert "ModuleNotFoundError" in checks[0].found
    assert {"clock", "opencv"} <= {check.unit for check in checks}


def test_a_second_opencv_is_found_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (before,) = doctor._opencv()
    assert before.ok
    for name in ("opencv_python", "opencv_python_headless"):  # as pip records them
        folder = tmp_path / f"{name}-4.1.2.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: 4.1.2\n"
        )
    monkeypatch.syspath_prepend(tmp_path)
    (check,) = doctor._opencv()
    assert "opencv-python 4.1.2" in check.found
    assert "opencv-python-headless 4.1.2" in check.found
    assert check.advice.endswith("then pip install opencv-contrib-python-headless")


def test_an_opencv_without_what_is_called_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("cv2.aruco.ArucoDetector")
    (check,) = doctor._opencv()
    assert check.ok is False
    assert "has no cv2.aruco.ArucoDetector" in check.found


def test_the_table_is_for_people(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        Check("servo", "model", "none [bold]", False, "plug it in"),
        Check("camera", "rate", "60.0 Hz", True),
        Check("camera", "listed", "no OAK", None),
    ]
    monkeypatch.setattr(doctor, "doctor", lambda _: iter(found))
    done = run()
    assert done.exit_code == 1
    lines = [line.split() for line in done.stdout.splitlines()]
    assert lines == [
        ["problem", "servo", "model", "none", "[bold]"],
        ["plug", "it", "in"],
        ["ok", "camera", "rate", "60.0", "Hz"],
        ["-", "camera", "listed", "no", "OAK"],
    ]


def test_a_region_is_compared_with_the_frames_of_the_camera(quick_vision: list[str]) -> None:
    config = load_config(None, [*quick_vision, "vision.region=[100, 100, 250, 250]"])
    assert all(check.ok is not False for check in doctor._network(config))
    *_, last = doctor.check_unit(config, "camera")
    assert last.ok is False
    assert "must lie within the camera's frame of 128x128 pixels" in last.found
    within = config.with_values(vision={"region": (20, 20, 100, 100)})
    assert all(check.ok is not False for check in doctor.check_unit(within, "camera"))


def test_a_network_that_knows_its_views_is_timed_with_an_image_that_it_does_not_know() -> None:
    config = load_config(None, ["camera.backend=simulated", "vision.checkpoint=small", "clock=lockstep"])
    *_, step = doctor._network(config)
    assert step.found.endswith("of 50")


@pytest.mark.parametrize(("median_ms", "good"), [(12.0, True), (70.0, False)])
def test_a_network_that_is_slower_than_the_camera_has_alternatives(
    median_ms: float, good: bool, quick_vision: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "time_ms", lambda *_: (median_ms, median_ms))
    (step,) = (
        check
        for check in doctor._network(
            load_config(None, [*quick_vision, "clock=realtime", "camera.rate_hz=20"])
        )
        if check.name == "step"
    )
    assert step.ok is good
    assert ("vision.engine=auto" in step.advice) != good


def test_a_wrong_key_is_bad_input() -> None:
    assert isinstance(run("--set", "servo.prot=x").exception, ConfigError)


@pytest.mark.parametrize(
    ("options", "answer", "applied"), [((), "n", False), ((), "y", True), (("--yes",), "", True)]
)
def test_setup_shows_and_asks(sets: list[str], options: tuple[str, ...], answer: str, applied: bool) -> None:
    done = run("--setup", "--json", *options, *sets, answer=answer)
    assert done.exit_code == 0
    report = json.loads(done.stdout.splitlines()[-1])  # the runner echoes the answer before it
    assert report["applied"] is applied
    assert {"register": "return_delay_time", "old": "500 us", "new": "0 us"} in report["changes"]
    assert "500 us" in done.stderr
    assert ("Write these to servo 1?" in done.stderr) is not bool(options)


def test_setup_ends_with_a_sentence(sets: list[str]) -> None:
    assert run("--setup", *sets, answer="n").stdout.endswith("servo 1: unchanged\n")
    assert run("--setup", "--yes", *sets).stdout == "servo 1: written and read back\n"
    assert "the question was not answered, so nothing was written to servo 1" in str(
        run("--setup", *sets).exception
    )
    odd = ["--set", "servo.port=/dev/nowhere"]
    assert "no port /dev/nowhere" in str(run("--setup", *sets, *odd).exception)


# In between.


def test_only_one_sensor_is_kept() -> None:
    kept = keep_only(Config(), "camera")
    assert kept.object == "none"  # a simulated object that does not fit is no problem of a device
    assert (kept.camera.backend, kept.load_cell.backend) == ("simulated", "none")
    assert keep_only(Config(), "servo").camera.backend == "none"


def test_a_rate_counts_what_is_between() -> None:
    assert rate_hz([0, 10_000_000, 20_000_000]) == pytest.approx(100.0)
    assert np.isfinite(rate_hz([5, 5]))


def test_advice_is_for_what_is_not_good() -> None:
    assert judged("u", "n", "f", True, "do") == Check("u", "n", "f", True, "")
    assert judged("u", "n", "f", False, "do") == Check("u", "n", "f", False, "do")
    assert judged("u", "n", "f", False, "do", harmless=True) == Check("u", "n", "f", True, "do")


def test_a_third_party_servo_is_not_looked_for_on_a_dynamixel_bus(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_servo.py").write_text(
        "class OwnServo:\n    spec = start = read = write = stop = close = print\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    config = load_config(None, ["servo.backend=own_servo:OwnServo"])
    *_, last = doctor.check_unit(config, "servo")
    assert last == Check("servo", "backend", "own_servo:OwnServo, which only a run checks", None)
    with pytest.raises(ConfigError, match="only Dynamixel servos"):
        doctor.setup(config, lambda *_: True)
    *_, last = doctor.check_unit(config.with_values(servo={"backend": "own_servo:None"}), "servo")
    assert (last.name, last.ok) == ("usable", False)


def test_the_network_is_loaded_before_the_devices_and_listed_after_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun = []

    def rows(unit: str) -> Iterator[Check]:
        begun.append(unit)
        yield Check(unit, "", "", True)

    monkeypatch.setattr(doctor, "_network", lambda _: rows("network"))
    monkeypatch.setattr(doctor, "check_unit", lambda _, unit: rows(unit))
    listed = [found.unit for found in doctor.doctor(load_config())]
    assert begun == ["network", *doctor.PROBES]
    assert listed[: len(begun)] == [*doctor.PROBES, "network"]
