"""Scripts that measure figures of the documentation."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gripper_force.jobs.dataset import Clip

SCRIPTS = Path(__file__).parents[2] / "scripts"


def module_of(name: str) -> Any:
    """Returns a script as a module."""
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_lower_force_prints_a_row_per_object_and_feedback(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--feedback", "current", "--object", "stapler", "--friction", "1", "--seeds", "1"]
    module_of("lower_force").main(arguments)
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) == 3
    assert shown[2].startswith("| current | stapler | 1 of 1 |")
    assert re.search(r"\| 0 \| (\d+\.\d), \1 % \(1 of 1\) \|$", shown[2])


def test_lost_object_prints_the_time_to_slip(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--feedback", "current", "--object", "stapler", "--target-n", "3", "--seeds", "1"]
    module_of("lost_object").main(arguments)
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) == 3
    assert re.fullmatch(r"\| current \| 3 N \| 1 of 1 \| (\d+), \1 \| [01] \| 0 \|", shown[2])


def test_a_loss_is_reported_although_friction_holds_the_jaws_and_the_view_seems_covered() -> None:
    cheap = {"sim.detail": "coarse", "vision.checkpoint": "small", "camera.rate_hz": 30}
    keys = {"object": "paper_cup", "seed": 1, **cheap}
    time_ms = module_of("lost_object").time_to_slip_ms(keys, 1.0)
    assert time_ms is not None
    assert time_ms < 2000


def test_protocol_check_without_a_folder_says_what_is_missing() -> None:
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / "protocol_check.py")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.endswith("the following arguments are required: data\n")


def test_real_grasps_does_not_use_results_of_other_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script, fitted = module_of("real_grasps"), list[int]()

    def recording(number: int) -> Clip:
        frames, forces_n = np.full((3, 4, 4), number, np.uint8), np.zeros(3, np.float32)
        return Clip(frames, forces_n, np.ones(3, bool), str(number), f"o{number % 2}", str(number))

    def run(training: list[Clip], test: list[Clip], *_: object) -> dict[str, Any]:
        fitted.append(len(training))
        return {"setting": {}, "errors": {"process": {test[0].object: [0.1, 0.2]}}}

    monkeypatch.setattr(script, "run", run)
    monkeypatch.setattr(sys, "argv", ["real_grasps.py", str(tmp_path), "--out", str(tmp_path)])
    for count in (4, 4, 6):
        clips = [recording(number) for number in range(count)]
        monkeypatch.setattr(script, "_read", lambda *_, clips=clips: clips)
        script.main()
    assert fitted == [2, 2, 3, 3]


@pytest.fixture
def calibration_check() -> Any:
    """The script as a module."""
    return module_of("calibration_check")


def test_results_of_another_network_are_not_used(
    calibration_check: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def result(digest: str) -> Any:
        monkeypatch.setattr(calibration_check, "read_model", lambda _: SimpleNamespace(digest=digest))
        monkeypatch.setattr(calibration_check, "grasp", lambda _: {"network": digest})
        return calibration_check.one_grasp("sponge", 0, 1, 2.0, "", "fused", tmp_path)

    assert [result(digest)["network"] for digest in ("a" * 64, "b" * 64, "a" * 64)] == [
        "a" * 64,
        "b" * 64,
        "a" * 64,
    ]
    names = {
        calibration_check.kept_file(tmp_path, "sponge", 0, suffix=end).name for end in (".json", ".yaml")
    }
    assert names == {"sponge-0-aaaaaaaa.json", "sponge-0-aaaaaaaa.yaml"}
    assert len(list(tmp_path.glob("*.json"))) == 2


def test_the_limit_of_a_grasp_is_that_of_the_configuration(
    calibration_check: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = {
        "steady_error_n": 0.1,
        "target_n": 4.0,
        "estimate_mae_n": {"fused": 0.1},
        "result": "held",
    }
    grasps = [{**summary, "peak_n": peak_n} for peak_n in (9.0, 13.9, 14.1)]
    calibration_check.grasps_table({("fused", "no"): grasps})
    assert capsys.readouterr().out.splitlines()[-1].endswith("| 3 of 3 | 1 |")
