import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from gripper_calibration.procedures import calibrate_jaws, calibrate_servo
from gripper_calibration.procedures.calibrate_camera import CameraResult
from gripper_calibration.procedures.calibrate_jaws import JawsResult
from gripper_calibration.procedures.calibrate_load_cell import LoadCellResult
from gripper_calibration.procedures.calibrate_servo import ServoResult
from gripper_force import cli
from gripper_force.cli import console
from gripper_force.cli.options import load_settings
from gripper_force.cli.output import calibrate as output
from gripper_force.cli.output.runs import grasp_table, trials_table
from gripper_force.cli.runs import _notes
from gripper_force.config import Config, load_config
from gripper_force.control.limits import largest_target_n
from gripper_force.errors import ConfigError
from gripper_force.jobs import cpu
from gripper_force.jobs.grasp import PAPER_OBJECTS, GraspSummary, summarise_grasp
from gripper_force.jobs.profile_files import update_rig
from gripper_force.jobs.trials import TrialsSummary
from gripper_force.profiles.rig_profile import (
    CalibratedValue,
    CameraCalibration,
    LoadCellCalibration,
    ServoCalibration,
)
from gripper_force.runtime import process
from gripper_force.runtime.log_reader import LogReader
from gripper_force.schema import Section
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.firmware import VirtualServo
from gripper_hw.dynamixel.pty_server import BenchMotor, PtyServer
from gripper_hw.dynamixel.virtual import VirtualBus

ROOT = Path(__file__).parents[2]


class Done(NamedTuple):
    code: int
    out: str
    err: str

    def json(self) -> dict[str, Any]:
        assert self.code == 0, self.err
        (line,) = self.out.splitlines()
        loaded: dict[str, Any] = json.loads(line)
        return loaded


Run = Callable[..., Done]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Iterator[Run]:
    """The command itself, but for the process."""
    monkeypatch.chdir(tmp_path)
    handlers = {number: signal.getsignal(number) for number in process.SIGNALS}

    def call(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["gripper-force", *map(str, arguments)])
        process._received.clear()  # each command is a process of its own
        with pytest.raises(SystemExit) as end:
            cli.main()
        said = capsys.readouterr()
        return Done(int(end.value.code or 0), said.out, said.err)

    yield call
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def sets(quick: list[str], tmp_path: Path) -> list[str]:
    keys = (*quick, "log.report=false", f"log.directory={tmp_path}/runs")
    return [part for one in keys for part in ("--set", one)]


def commands(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, (*path, name))


GROUPS = dict(commands(typer.main.get_command(cli.app)))
LEAVES = {path: command for path, command in GROUPS.items() if not hasattr(command, "commands")}


@pytest.mark.parametrize("path", GROUPS, ids=" ".join)
def test_every_command_explains_itself(path: tuple[str, ...]) -> None:
    result = CliRunner().invoke(cli.app, [*path, "--help"])
    assert result.exit_code == 0
    assert "Usage:" in result.output


def test_every_default_in_a_help_text_is_shown() -> None:
    """Square brackets are markup of the help's renderer, which drops them."""
    for path, command in LEAVES.items():
        for parameter in command.params:
            assert "[default" not in (getattr(parameter, "help", None) or ""), path


@pytest.mark.parametrize(
    "path", sorted((ROOT / "examples").glob("[gs][re]*/*.yaml")), ids=lambda path: path.name
)
def test_every_configuration_that_ships_accepts_its_target(path: Path) -> None:
    config = load_config(path)
    assert config.target_n <= largest_target_n(config.control.force_limit_n, config.gripper.gain_bound)


def test_config_check_finds_what_can_not_be_simulated(run: Run, sets: list[str]) -> None:
    found = run("config", "check", *sets, "--set", "object=spnge")
    assert (found.code, "no simulated object 'spnge'; did you mean 'sponge'?" in found.err) == (2, True), (
        found.err
    )
    assert run("config", "check", *sets).code == 0


def test_an_error_that_an_interrupt_caused_has_the_code_of_the_interrupt(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "is_interrupted", lambda: True)
    monkeypatch.setattr(process, "interrupt_exit_code", lambda: 130)
    assert run("config", "show", "--set", "bogus=1").code == 130


def test_trials_that_hold_nothing_end_with_code_1(run: Run, sets: list[str]) -> None:
    assert run("grasp", "--trials", 1, "--jobs", 1, "--object", "none", *sets).code == 1


def test_wrong_names_end_the_command_before_its_work(run: Run, fused_log: Path) -> None:
    found = run("train", fused_log, "--hold-out", "spnge")
    assert (found.code, "--hold-out: no log is of spnge; there are stapler" in found.err) == (2, True), (
        found.err
    )
    found = run("evaluate", fused_log, "--object", "nope", "--checkpoint", "small")
    assert (found.code, "no log is of nope; there are stapler" in found.err) == (2, True), found.err
    found = run("replay", fused_log, "--compare", "log", "bogus.key=3")
    assert (found.code, "unknown configuration key 'bogus'" in found.err) == (2, True), found.err
    assert "replaying" not in found.err


@pytest.mark.parametrize("command", ["train", "calibrate network"])
def test_a_checkpoint_that_cannot_be_written_is_refused_before_the_logs_are_read(
    run: Run, current_log: Path, tmp_path: Path, command: str
) -> None:
    """The figure of a training has the ending .png, so it would replace a checkpoint of this name."""
    for out, words in (
        (".", "it is a folder"),
        (tmp_path, "it is a folder"),
        ("a.png", "can't write a checkpoint to a.png; name a file that ends in .safetensors"),
        ("a.onnx", "name a file that ends in .safetensors"),
        ("a", "name a file that ends in .safetensors"),
        (current_log / "a.safetensors", "name another file"),
    ):
        found = run(*command.split(), current_log, "--out", out)
        assert (found.code, words in found.err) == (2, True), found.err
        assert "0/1" not in found.err  # logs


def test_every_command_can_be_set_and_read_by_a_script() -> None:
    for path, command in LEAVES.items():
        options = {option for parameter in command.params for option in parameter.opts}
        assert options >= {"--set", "--json"}, path


def test_the_command_line_answers_without_what_is_heavy() -> None:
    code = "import sys, gripper_force.cli; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"torch", "mujoco", "cv2", "matplotlib", "scipy", "numpy", "dynamixel_sdk", "depthai", "mcap"}
    assert not heavy & set(done.stdout.split())


@pytest.mark.parametrize("first", [("network",), ("network", "small"), (), ("small",)], ids=" ".join)
def test_export_without_a_subcommand_exports_a_network(run: Run, first: tuple[str, ...]) -> None:
    done = run("export", *first, "--out", "force.trt")
    assert done.code == 2
    assert "can't export to force.trt" in done.err


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("camera.backend=oakk", "unknown camera.backend 'oakk' (did you mean 'oak'?)"),
        ("load_cell.backend=no_such_package:Cell", "needs no_such_package, which is not installed"),
        ("vision.engine=torhc", "unknown vision.engine 'torhc' (did you mean 'torch'?)"),
        ("servo.port=/dev/ttyUSB0", "'/dev/ttyUSB0' is not virtual, but a simulated camera or load cell"),
    ],
)
def test_config_check_finds_what_a_run_would_refuse(run: Run, assignment: str, message: str) -> None:
    done = run("config", "check", "--set", assignment)
    assert done.code == 2
    assert message in done.err


REAL = ["clock=realtime", "servo.port=/dev/ttyUSB0", "load_cell.backend=none"]


@pytest.mark.parametrize(
    ("camera", "frame"),
    [
        ("camera.backend=simulated", "128x128"),
        ("camera.backend=uvc camera.device=0 camera.side_px=100", "100x100"),
        ("camera.backend=playback", "128x128"),
    ],
)
def test_config_check_finds_a_region_beyond_the_frame(
    run: Run, quick_vision: list[str], fused_log: Path, camera: str, frame: str
) -> None:
    keys = [*quick_vision, *(REAL if "uvc" in camera else ()), *camera.split()]
    keys += [f"camera.path={fused_log}"] if "playback" in camera else []
    sets = [part for key in keys for part in ("--set", key)]
    done = run("config", "check", *sets, "--set", "vision.region=[0,0,90,300]")
    assert (done.code, f"must lie within the camera's frame of {frame} pixels" in done.err) == (2, True), (
        done.err
    )
    assert run("config", "check", *sets, "--set", "vision.region=[0,0,90,90]").code == 0


GRASP_KEYS = {"result", "object", "target_n", "load_cell_mean_n", "steady_error_n", "overshoot_n", "settle_s"}
GRASP_KEYS |= {"estimator_p50_ms", "estimator_p99_ms", "loop_hz", "log", "report"}
ERROR_KEYS = {"mae_n", "rmse_n", "bias_n", "per_object", "per_bin", "frames"}


def test_grasp_prints_one_json_object(run: Run, sets: list[str]) -> None:
    sets += ["--set", "log.report=true"]
    done = run("grasp", "--json", "--object", "stapler", "--target-n", 2.5, "--seed", 3, *sets)
    result = done.json()
    assert set(result) >= GRASP_KEYS
    assert (result["result"], result["object"], result["target_n"]) == ("held", "stapler", 2.5)
    assert result["estimator_p50_ms"] is None
    assert Path(result["log"]).is_file()
    assert Path(result["report"]) == Path(result["log"]).with_suffix(".html")
    page = Path(result["report"]).read_text(encoding="utf-8")
    assert page.startswith("<!")
    assert "open loop" not in page
    for phase in ("approach", "contact", "ramp", "hold"):
        assert phase in done.err


def test_grasp_prints_a_table_for_people(run: Run, sets: list[str]) -> None:
    done = run("grasp", *sets)
    assert done.code == 0
    for text in ("held", "stapler", "3.00 N", "steady error", "200.0 Hz"):
        assert text in done.out


def test_a_grasp_that_did_not_hold_has_an_exit_code(run: Run, sets: list[str]) -> None:
    fault = "faults=[{unit: servo, kind: wrong, at_s: 0.4}]"
    done = run("grasp", "--json", *sets, "--set", fault)
    assert (json.loads(done.out)["result"], done.code) == ("fault", 1)


def test_trials_print_each_and_a_summary(run: Run, sets: list[str]) -> None:
    result = run("grasp", "--json", "--trials", 2, "--jobs", 1, *sets).json()
    assert set(result) == {"trials", "summary", "figure"}
    assert all(set(trial) >= GRASP_KEYS for trial in result["trials"])
    found = [(trial["object"], trial["target_n"], trial["seed"]) for trial in result["trials"]]
    assert found == [("stapler", 3, 0), ("stapler", 3, 1)]  # object and target of --set
    assert result["summary"]["trials"] == 2
    assert result["summary"]["median_error_percent"] is not None
    assert list(result["summary"]["estimate_mae_n"]) == ["all", "stapler"]


@pytest.fixture
def grasped(monkeypatch: pytest.MonkeyPatch, current_log: Path) -> None:
    """Trials only say that they held their object."""

    def grasp(config: Config, *_: object) -> GraspSummary:
        return {**summarise_grasp(current_log), "object": config.object, "target_n": config.target_n}

    monkeypatch.setattr("gripper_force.jobs.trials.grasp", grasp)


@pytest.mark.usefixtures("grasped")
def test_simulated_trials_are_of_the_papers_objects_in_turn_or_of_the_given_one(run: Run) -> None:
    options = ("--json", "--trials", 5, "--jobs", 1, "--set", "log.report=false")
    trials = run("grasp", *options).json()["trials"]
    assert [trial["object"] for trial in trials] == [*PAPER_OBJECTS, PAPER_OBJECTS[0]]
    assert len({trial["target_n"] for trial in trials}) == 5
    trials = run("grasp", *options, "--object", "tube", "--target-n", 2).json()["trials"]
    assert [(trial["object"], trial["target_n"]) for trial in trials] == 5 * [("tube", 2)]


@pytest.fixture
def port_options(sets: list[str]) -> Iterator[list[str]]:
    """Options of a servo at a serial port, whose jaws soon meet an object."""
    motor = BenchMotor(VirtualServo(1, load_model("XM430-W350")), contact_rad=0.5)
    bus = VirtualBus([motor.servo], before_packet=lambda: motor.advance(time.monotonic_ns()))
    with PtyServer(bus) as server:
        values = (
            "clock=realtime",
            f"servo.port={server.device_path}",
            "servo.reply_margin_ms=300",  # a machine may be busy
            "servo.bus_watchdog_ms=2000",
            "control.rate_hz=50",
            "load_cell.backend=none",
            "object=mug",
        )
        yield [*sets, *(part for value in values for part in ("--set", value))]


class Terminal:
    """Stands in for standard input at a terminal, and gives these answers, or Ctrl-C."""

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)

    def isatty(self) -> bool:
        return True

    def readline(self) -> str:
        answer = self.answers.pop(0)
        if answer == "Ctrl-C":
            os.kill(os.getpid(), signal.SIGINT)
        return answer


def test_trials_at_one_port_follow_one_another_and_wait_for_the_object(
    run: Run, port_options: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = Terminal("\n", "\n")
    monkeypatch.setattr(sys, "stdin", terminal)
    done = run("grasp", "--trials", 2, "--target-n", 3, *port_options)
    assert (done.code, terminal.answers) == (0, []), done.err
    assert "only one process can open servo.port=/dev/pts/" in done.err
    for number in (1, 2):
        assert f"Put the mug between the jaws for trial {number} of 2, then press Enter" in done.err
    assert done.out.count("mug") == done.out.count(" held ") == 2
    assert "No load cell: force errors, overshoot and peaks can't be measured." in done.out
    assert len(list((tmp_path / "runs").glob("*-mug-3N-*.mcap"))) == 2


@pytest.mark.usefixtures("grasped")
def test_finished_trials_are_shown_if_a_later_one_fails(
    run: Run, port_options: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal("\n", ""))  # Ctrl-D
    done = run("grasp", "--trials", 2, "--object", "cup", *port_options)
    assert done.code == 2
    assert done.out.count(" held ") == 1
    assert "no answer to this: Put the cup between the jaws for trial 2 of 2" in done.err


@pytest.mark.usefixtures("grasped")
def test_finished_trials_are_shown_after_an_interrupt(
    run: Run, port_options: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal("\n", "Ctrl-C"))
    done = run("grasp", "--trials", 3, "--json", *port_options)
    result = json.loads(done.out)
    assert (done.code, len(result["trials"]), result["summary"]["trials"]) == (130, 1, 1)


@pytest.mark.usefixtures("grasped")
def test_without_a_terminal_trials_do_not_wait(run: Run, port_options: list[str]) -> None:
    done = run("grasp", "--json", "--trials", 2, *port_options)
    assert [trial["object"] for trial in done.json()["trials"]] == ["mug", "mug"]
    assert "without a pause" in done.err


def test_replay_prints_one_json_object(run: Run, fused_log: Path, current_log: Path) -> None:
    result = run("replay", fused_log, "--json").json()
    assert set(result) >= ERROR_KEYS | {"identical"}
    assert result["identical"] is True
    table = run("replay", current_log)
    assert table.code == 0
    assert "yes, bit for bit" in table.out
    assert "open loop" not in table.err
    changed = run("replay", current_log, "--set", "control.ramp_n_s=4", "--json").json()
    assert changed["identical"] is False


def write_recording(folder: Path) -> tuple[Path, Path]:
    """A bright bar that widens with the force before a background, and the forces."""
    force_n = np.interp(np.arange(60), [0, 15, 30, 45, 50, 60], [0, 0, 20, 20, 0, 0])
    video, table = folder / "touch.avi", folder / "touch.csv"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 64))
    background = np.random.default_rng(0).integers(20, 100, (16, 16, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    for force in force_n:
        image = background.copy()
        image[:, : 20 + int(force / 4)] = 200
        writer.write(image)
    writer.release()
    rows = [f"{i},{i / 30:.6f},{force:.5f}" for i, force in enumerate(force_n)]
    table.write_text("\n".join(["frame,t_s,force_n", *rows, ""]))
    return video, table


def test_a_recording_is_imported_replayed_and_evaluated(
    run: Run, tmp_path: Path, tiny_checkpoint: Path
) -> None:
    video, table = write_recording(tmp_path)
    imported = run("import", "video", video, table, "--out", "logs", "--object", "foam", "--json").json()
    (row,) = imported["logs"]
    assert (row["object"], row["frames"], row["spikes_rejected"]) == ("foam", 60, 0)
    replayed = run("replay", row["log"], "--checkpoint", tiny_checkpoint, "--json").json()
    assert set(replayed) >= ERROR_KEYS
    assert replayed["identical"] is None
    assert set(replayed["sources"]) == {"visual"}
    people = run("replay", row["log"], "--checkpoint", tiny_checkpoint)
    assert "nothing to compare" in people.out
    evaluated = run(
        "evaluate", "logs", "--checkpoint", tiny_checkpoint, "--object", "foam", "--jobs", 1, "--json"
    ).json()
    assert set(evaluated) >= ERROR_KEYS
    assert set(evaluated["per_object"]) == {"foam"}
    assert evaluated["mae_n"] == pytest.approx(replayed["mae_n"], rel=0.2)


def test_sets_are_recorded_judged_and_kept(run: Run, sets: list[str]) -> None:
    eyes = ("--set", "camera.backend=simulated", "--set", "camera.rate_hz=20", "--set", "control.ramp_n_s=30")
    asked = ("record", "--object", "stapler", "--sets", 1, "--touches", 1, "--out", "data", "--lux", 350)
    result = run(*asked, *sets, *eyes, "--json").json()
    assert set(result) == {"sets", "overall", "warnings"}
    (one,) = result["sets"]
    assert Path(one["log"]) == Path("data/train/stapler-350lux-01.mcap")
    made_ns = Path(one["log"]).stat().st_mtime_ns
    keys = {"frames", "camera_hz", "camera_hz_asked", "frames_lost", "samples_rejected", "histogram"}
    keys |= {"lag_ms", "lag_spread_ms"}
    assert set(one) >= keys
    assert set(result["overall"]) >= keys
    again = run(*asked, *sets, *eyes)
    assert again.code == 0
    for text in ("stapler-350lux-01", "Hz of 20", "lag ms", "0 to 1"):
        assert text in again.out
    assert Path(one["log"]).stat().st_mtime_ns == made_ns
    replayed = run("replay", one["log"], "--json").json()
    assert replayed["identical"] is True
    blind = run("record", *sets, "--json")
    assert (blind.code, "record needs a camera" in blind.err) == (2, True)


def test_a_published_database_is_imported_and_its_damage_told(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "db" / "sponge_30_100"
    folder.mkdir(parents=True)
    for number in range(1, 5):
        cv2.imwrite(str(folder / f"{number}.jpg"), np.full((16, 16, 3), 60 + number, np.uint8))
    (folder / "test.txt").write_text("1,0.0,0\n2,0.5\n3,1.0,0\n4,0.5,0\n")
    (tmp_path / "db" / "notes[1].txt").touch()
    result = run("import", "database", "db", "--out", "logs", "--rate-hz", 100, "--json").json()
    (row,) = result["environments"]
    assert (row["object"], row["degrees"], row["lux"], row["logs"], row["frames"]) == (
        "sponge",
        30,
        750,
        1,
        4,
    )
    assert result["ignored"] == ["notes[1].txt"]
    assert Path("logs/train/sponge_30_100-01.mcap").is_file()
    people = run("import", "database", "db", "--out", "logs", "--rate-hz", 100)
    for text in ("sponge_30_100", "line 2, '2,0.5'", "the first is 2", "not imported notes[1].txt"):
        assert text in people.out
    assert "camera.rate_hz" in run("import", "database", "db", "--rate-hz", 0).err
    assert "name the folder that holds these" in run("import", "database", "logs/train").err


# Bad input.


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--set", "control.ramp=3"], "unknown configuration key 'control.ramp'"),
        (["--set", "seed=x"], "configuration key 'seed'"),
        (["--object", "egg"], "no simulated object 'egg'; there are sponge, paper_cup, tube, stapler"),
        (["--feedback", "guess"], "configuration key 'control.feedback'"),
        (["--target-n", "13"], "a target of 13 N is too close to control.force_limit_n 14 N"),
        (
            ["--set", "camera.backend=oak9"],
            "unknown camera.backend 'oak9' (did you mean 'oak'?); use none, simulated",
        ),
        (["--set", "load_cell.backend=scale"], "unknown load_cell.backend 'scale'"),
        (["--set", "servo.port=/dev/ttyUSB7", "--set", "load_cell.backend=none"], "clock=lockstep needs"),
        (
            [
                "--set",
                "servo.port=/dev/ttyUSB7",
                "--set",
                "load_cell.backend=none",
                "--set",
                "clock=realtime",
            ],
            "there is no port /dev/ttyUSB7",
        ),
        (["--set", "servo.model=XW999"], "XW999"),
        (
            ["--trials", "2", "--jobs", "2", "--set", "servo.port=/dev/ttyUSB7"],
            "only one process can open servo.port=/dev/ttyUSB7, not 2; leave out --jobs",
        ),
        (["--config", "gone.yaml"], "can't read the configuration gone.yaml"),
        (["--set", "camera.backend=simulated", "--set", "vision.checkpoint=gone"], "no checkpoint at gone"),
    ],
)
def test_bad_input_to_grasp_is_one_sentence(
    run: Run, sets: list[str], arguments: list[str], sentence: str
) -> None:
    done = run("grasp", *sets, *arguments)
    assert (done.code, done.out) == (2, "")
    (line,) = done.err.splitlines()
    assert line.startswith("error: ")
    assert sentence in line


def required_words(command: Any) -> list[str]:
    """A word for each parameter that a command needs: a number, and a file that does not exist."""
    needed = [parameter for parameter in command.params if parameter.required]
    return [word for p in needed for word in (*(p.opts if p.param_type_name == "option" else ()), "1")]


@pytest.mark.parametrize("wrong", [["--set", "no.such=1"], ["--no-such-option"]], ids=["key", "option"])
@pytest.mark.parametrize("path", LEAVES, ids=" ".join)
def test_with_json_every_error_is_one_object(run: Run, path: tuple[str, ...], wrong: list[str]) -> None:
    done = run(*path, "--json", *required_words(LEAVES[path]), *wrong)
    assert (done.code, "Traceback" in done.err) == (2, False), done.err
    (line,) = done.out.splitlines()
    assert list(json.loads(line)) == ["error"]


SUCCESSES = [
    "config show",
    "config check",
    "config schema",
    "config file",
]
"""Commands of one group; those of others have tests of their own."""


@pytest.mark.parametrize("command", SUCCESSES)
def test_with_json_a_result_is_one_object(run: Run, command: str) -> None:
    assert run(*command.split(), "--json").json()


def test_an_export_states_its_error_and_the_next_step(
    run: Run, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = {"largest_n": 2e-4, "mean_n": 1e-4, "rms_n": 1.5e-4}
    monkeypatch.setattr("gripper_force.vision.export.export", lambda model, path: errors)
    done = run("export", "network", tiny_checkpoint, "--out", "force.xml", "--json")
    found = done.json()
    assert (found["file"], found["off_torch_n"]) == ("force.xml", errors)
    options = "--set vision.checkpoint=force.xml --set vision.engine=openvino"
    assert done.err.splitlines()[-1] == f"next: gripper-force grasp {options}"


def test_an_int8_export_to_another_format_ends_before_logs_are_read(run: Run, tiny_checkpoint: Path) -> None:
    Path("cut.mcap").write_bytes(b"")
    done = run("export", "network", tiny_checkpoint, "--out", "force.onnx", "--int8", "cut.mcap")
    assert (done.code, "int8 is exported to OpenVINO only" in done.err) == (2, True)


def test_with_json_the_error_is_json_too(run: Run) -> None:
    done = run("grasp", "--json", "--set", "[bold]=3")
    assert done.code == 2
    assert "unknown configuration key '[bold]'" in json.loads(done.out)["error"]
    assert "unknown configuration key '[bold]'" in done.err


def test_a_truncated_log_is_refused_and_recovered_on_request(
    run: Run, fused_log: Path, tmp_path: Path
) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(fused_log.read_bytes()[:-1000])
    done = run("replay", path)
    assert done.code == 2
    assert "are left; read the rest with `gripper-force replay LOG --recover`" in done.err
    assert "leave this log out elsewhere" in run("evaluate", path, "--checkpoint", "small").err
    recovered = run("replay", path, "--recover", "--json")
    assert recovered.json()["frames"] > 100
    assert recovered.err.splitlines()[-1] == f"next: gripper-force replay {path} --recover --report"


def test_a_report_can_be_that_of_a_replay(run: Run, current_log: Path, tmp_path: Path) -> None:
    log = Path(shutil.copy(current_log, tmp_path / "run.mcap"))
    done = run("replay", log, "--report", "--set", "control.ramp_n_s=4", "--json")
    page = Path(done.json()["report"])
    assert page.name == "run-replayed.html"
    assert "replayed with changes, open loop" in page.read_text(encoding="utf-8")
    assert "A replay is open loop" in done.err


def test_a_folder_is_replayed(
    run: Run, current_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        shutil.copy(current_log, tmp_path / f"{name}.mcap")
    found = run("replay", tmp_path, "--json", "--jobs", 1).json()
    assert [Path(log["log"]).stem for log in found["logs"]] == ["a", "b"]
    assert found["summary"]["identical"] == found["summary"]["logs"] == 2
    table = run("replay", tmp_path / "a.mcap", tmp_path / "b.mcap", "--jobs", 1)
    assert "a.mcap" in table.out
    assert "stapler" in table.out
    long = (tmp_path / "b.mcap").rename(tmp_path / f"{'20261128-094116-' * 4}sponge.mcap")
    assert long.name in run("replay", tmp_path, "--jobs", 1).out
    monkeypatch.setattr(console.out, "width", 80)
    table = run("replay", tmp_path, "--jobs", 1)
    assert max(map(len, table.out.splitlines())) <= 80
    names = "".join(line.split(" ")[0] for line in table.out.splitlines()[1:7])
    assert long.name in names  # a terminal of 80 columns cuts nothing off


def test_two_settings_are_compared(
    run: Run, fused_log: Path, current_log: Path, tmp_path: Path, tiny_checkpoint: Path
) -> None:
    same = run("replay", fused_log, "--compare", "log", tiny_checkpoint, "--json").json()
    assert same["differences"]["visual"]["difference_n"] == 0
    for name in ("a", "b"):
        shutil.copy(current_log, tmp_path / f"{name}.mcap")
    done = run("replay", tmp_path, "--compare", "log", "control.ramp_n_s=4", "--jobs", 1)
    assert "95 % interval" in done.out
    assert "A replay is open loop" in done.err
    wrong = run("replay", tmp_path, "--compare", "log", "log", "--report")
    assert (wrong.code, "--compare names its checkpoints" in wrong.err) == (2, True)


def interrupt(
    arguments: list[str], folder: Path, is_time: Callable[[], bool], to: str = "group"
) -> tuple[int, str]:
    """Runs the command, sends Ctrl-C when it is time, and waits for the end of all its processes.

    Args:
        arguments: The command.
        folder: Its folder.
        is_time: Called again and again from when the command line has been imported.
        to: Receiver: the "group", as with a terminal, or the "command" alone.

    Returns:
        Exit code and stderr.
    """
    program = (
        "import sys; from gripper_force.cli import main; print('ready', file=sys.stderr, flush=True); main()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        cwd=folder,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as child:
        assert child.stderr is not None
        assert child.stderr.readline() == "ready\n"
        while not is_time():
            assert child.poll() is None
            time.sleep(0.01)
        if to == "group":
            os.killpg(child.pid, signal.SIGINT)
        else:
            child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=60)  # until no process holds the pipe
    return child.returncode, said


def after(delay_s: float) -> Callable[[], bool]:
    """Returns a condition that holds from this time after its first call."""
    begins_s: list[float] = []

    def is_time() -> bool:
        begins_s.append(time.monotonic())
        return begins_s[-1] - begins_s[0] >= delay_s

    return is_time


def test_an_interrupted_grasp_says_where_its_log_is(sets: list[str], tmp_path: Path) -> None:
    more = ["--set", "control.hold_s=600", "--set", f"log.directory={tmp_path}/my runs"]

    def is_written() -> bool:
        return any(log.stat().st_size > 100_000 for log in tmp_path.rglob("*.mcap"))

    code, said = interrupt(["grasp", *sets, *more], tmp_path, is_written)
    assert (code, "Traceback" in said) == (130, False)
    (log,) = tmp_path.rglob("*.mcap")
    assert f"gripper-force replay '{log}'" in said  # as a shell takes it
    assert LogReader(log).duration_ns > 0


@pytest.mark.parametrize(
    ("name", "moment", "to"),
    [
        ("grasp", "imports", "group"),
        ("grasp", "a log", "command"),
        ("simulate", "a log", "group"),
        ("simulate", "the start of processes", "command"),
    ],
)
def test_an_interrupt_at_any_time_ends_a_command_and_its_processes(
    name: str, moment: str, to: str, sets: list[str], tmp_path: Path
) -> None:
    is_time = {
        "imports": after(0.3),
        "a log": lambda: any(tmp_path.rglob("*.mcap*")),
        "the start of processes": after(1.5),
    }[moment]
    cheap = ("--set", "sim.detail=coarse", "--set", "camera.backend=none")
    options = {"grasp": ("--trials", "400", *sets), "simulate": ("--presses", "400", *cheap)}
    code, said = interrupt([name, *options[name], "--jobs", "2"], tmp_path, is_time, to)
    assert (code, "Traceback" in said) == (130, False), said
    assert said.count("interrupted") == 1


def test_an_interrupt_that_became_another_error_is_an_interrupt(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def converted(*_: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(60)
        except KeyboardInterrupt as interrupt:
            raise ValueError("error in a callback") from interrupt

    monkeypatch.setattr("gripper_force.jobs.grasp.run_grasp", converted)
    done = run("grasp")
    assert done.code == 130
    assert "interrupted" in done.err


def test_a_protocol_and_its_scale_are_known_by_name(run: Run) -> None:
    assert "no protocol 'shin'; use shin2019" in run("simulate", "--protocol", "shin").err
    unknown = run("simulate", "--protocol", "shin2019", "--scale", "huge")
    assert (unknown.code, "use one of full, small" in unknown.err) == (2, True)


@pytest.mark.parametrize(
    ("args", "sentence"),
    [
        (["--scale", "small"], "add --protocol shin2019"),
        (["--instances", "redrawn"], "--instances can only be used with --protocol"),
        (["--protocol", "shin2019", "--presses", "9"], "--presses can't be combined"),
        (["--protocol", "shin2019", "--grasps", "0", "--first-seed", "7"], "--grasps and --first-seed can't"),
        (["--protocol", "shin2019", "--object", "tube"], "--object can't be combined"),
        (["--set", "object=tube", "--set", "seed=1"], "--set object=tube and --set seed=1 can't be used"),
    ],
)
def test_what_a_simulation_would_not_heed_is_an_error(
    args: list[str], sentence: str, run: Run, tmp_path: Path
) -> None:
    done = run("simulate", "--out", tmp_path / "sets", *args)
    assert (done.code, sentence in done.err) == (2, True)
    assert not (tmp_path / "sets").exists()


def test_logs_can_be_made_of_one_object(run: Run, tmp_path: Path) -> None:
    call = "--presses 0 --taps 1 --grasps 0 --jobs 1 --first-seed 100007 --set sim.detail=coarse"
    options = f"{call} --set camera.backend=none".split()
    made = run("simulate", "--out", "hard", "--object", "stapler", *options, "--json")
    assert made.json()["made"] == 1
    assert made.err.splitlines()[-1] == "next: gripper-force train hard --out force.safetensors"
    assert [path.name for path in (tmp_path / "hard").iterdir()] == ["tap-stapler-100007.mcap"]
    unknown = run("simulate", "--out", tmp_path / "none", "--object", "pencil", *options)
    assert (unknown.code, "no simulated object 'pencil'" in unknown.err) == (2, True)


def test_an_imported_recording_that_starts_in_contact_is_named(run: Run, tmp_path: Path) -> None:
    video, table = write_recording(tmp_path)
    rows = table.read_text().splitlines()
    rows[1] = "0,0.0,2.5"
    table.write_text("\n".join(rows))
    assert "touch.mcap starts in contact" in run("import", "video", video, table).out


def test_a_video_needs_its_table(run: Run, tmp_path: Path) -> None:
    video, _ = write_recording(tmp_path)
    assert "needs its load-cell table" in run("import", "video", video).err
    missing = tmp_path / "missing.avi"
    assert f"there is no {missing}" in run("import", "video", missing).err


@pytest.mark.parametrize(("flags", "warned"), [("avx2", True), ("avx512_bf16", False)])
def test_bfloat16_on_a_cpu_that_emulates_it_is_warned_of(
    run: Run,
    tiny_checkpoint: Path,
    fused_log: Path,
    flags: str,
    warned: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cpu, "cpu_info", lambda: [f"flags: {flags}"])
    evaluated = ("evaluate", fused_log.parent, "--checkpoint", tiny_checkpoint, "--jobs", 1)
    slow = run(*evaluated, "--set", "vision.precision=bfloat16")
    assert ("lists no instructions for bfloat16" in slow.err) == warned
    assert "no instructions" not in run(*evaluated).err


def test_an_empty_folder_has_nothing_to_evaluate(run: Run, tmp_path: Path, tiny_checkpoint: Path) -> None:
    done = run("evaluate", tmp_path, "--checkpoint", tiny_checkpoint)
    assert (done.code, done.out) == (2, "")
    assert "no logs (*.mcap)" in done.err


# In between.


def test_a_figure_that_is_no_number_is_null() -> None:
    value = {"a": float("nan"), "b": [1.5, float("inf")], "c": Path("x"), 3: (None, True)}
    assert console.jsonable(value) == {"a": None, "b": [1.5, None], "c": "x", "3": [None, True]}


def test_options_win_over_overrides() -> None:
    config = load_settings(None, ["seed=3", "object=tube"], {"seed": 4, "object": None})
    assert (config.seed, config.object) == (4, "tube")


@pytest.mark.parametrize(
    ("set_", "options", "sentence"),
    [
        (None, {"target_n": -1.0}, r"'target_n' \(from --target-n\)"),
        (["target_n=2"], {"seed": -1, "target_n": 3.0}, r"'seed' \(from --seed\)"),
        (["seed=-1"], {"target_n": 3.0}, r"'seed' \(from --set\)"),
        (None, {"control.feedback": "sight"}, r"'control\.feedback' \(from --feedback\)"),
        (None, {"sim.yaw_deg": 91.0}, r"'sim\.yaw_deg' \(from --degrees\)"),
        (["control=5"], {"control.feedback": "current"}, r"'control' \(from --set\) is a section, got 5"),
        (None, {"control.timeout_s": 0.1, "seed": 1}, r"'control' \(from --timeout-s\): settle_s 1 must"),
        (None, {"gripper.open_width_m": 1e-3, "seed": 1}, r"\(from --open-width-m\) is inconsistent"),
    ],
)
def test_an_error_names_the_option_that_is_wrong(
    set_: list[str] | None, options: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ConfigError, match=sentence):
        load_settings(None, set_, options)


def test_a_path_that_cannot_be_used_is_one_sentence(run: Run) -> None:
    Path("notes.txt").write_text("mine")
    for command in ("simulate --presses 1 --grasps 0 --out", "record --object stapler --out"):
        done = run(*command.split(), "notes.txt", "--json", "--set", "sim.detail=coarse")
        assert done.code == 2
        assert re.search(r"error: can't use notes\.txt\S*: a file is where a folder must be; check", done.err)
        assert "Traceback" not in done.err
        assert set(json.loads(done.out)) == {"error"}
    assert Path("notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    "words",
    [
        ["view", "run.mcap"],
        ["config", "file"],
        ["calibrate", "network", "logs", "--out", "x.safetensors"],
        ["bench", "checkpoints", "logs", "--checkpoint", "default"],
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_a_command_that_uses_no_configuration_says_so(run: Run, words: list[str]) -> None:
    done = run(*words, "--set", "seed=2")
    name = " ".join(words[: 1 if words[0] == "view" else 2])
    assert (done.code, f"{name} uses no configuration; leave out --set seed=2" in done.err) == (2, True)
    assert "Not allowed" in run(*words, "--help").out


def test_files_are_listed_by_the_names_that_print_them(run: Run) -> None:
    listed = {line.split()[0] for line in run("config", "file").out.splitlines()}
    assert listed >= json.loads(run("config", "file", "--json").out).keys()


def test_options_without_effect_are_refused(run: Run) -> None:
    for words, name in ((["--same-object"], "--same-object"), (["--jobs", 1], "--jobs")):
        done = run("grasp", *words)
        assert done.code == 2
        assert f"{name} only applies to several grasps; add --trials, or leave out {name}" in done.err


@pytest.mark.parametrize(
    "words",
    [
        ["stability", "soak", "--seconds"],
        ["calibrate", "load-cell", "--mass-kg", 1, "--seconds"],
        ["bench", "loop", "--seconds"],
        ["bench", "training", "logs", "--minutes"],
    ],
    ids=lambda words: words[1],
)
def test_an_infinite_duration_is_refused(run: Run, words: list[object]) -> None:
    done = run(*words, "inf")
    assert (done.code, f"Invalid value for '{words[-1]}'" in done.err) == (2, True), done.err


def test_a_simulation_of_nothing_is_refused(run: Run) -> None:
    done = run("simulate", "--presses", 0, "--grasps", 0)
    assert (done.code, "there is nothing to simulate; give --presses" in done.err) == (2, True)


def test_reproduce_checks_where_it_writes_before_its_work(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for words, sentence in (
        (["--out", "file"], "can't write in the folder file of --out: File exists"),
        (["--write", "no.md"], "can't write the tables into no.md: it is no file that can be written"),
        (["--write", "."], "can't write the tables into .: it is no file"),
    ):
        done = run("reproduce", "3", "--data", "missing", *words)
        assert (done.code, sentence in done.err) == (2, True), done.err


@pytest.mark.parametrize("in_run", [False, True])
def test_only_a_command_with_a_run_says_that_it_was_stopped(
    run: Run, monkeypatch: pytest.MonkeyPatch, in_run: bool
) -> None:
    """Whatever the command's name is: what counts is whether a gripper was open."""

    def interrupted(*_: object, **__: object) -> None:
        with process.deferred_signals(end) if in_run else nullcontext():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(60)

    def end(_: bool) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gripper_force.config.load_with_options", interrupted)
    for words in (["grasp"], ["calibrate", "jaws"], ["bench", "gain"], ["doctor"]):
        done = run(*words)
        assert done.code == 130
        said = done.err.splitlines()[-1]
        assert said == "interrupted" + ("; the run was stopped as configured" if in_run else ""), words


@pytest.mark.parametrize(("options", "same"), [([], ""), (["--fresh"], " without --fresh")])
def test_the_command_that_continues_an_interrupted_teaching_starts_nothing_over(
    run: Run, options: list[str], same: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal("Ctrl-C"))
    words = ["teach", "stapler", "--pause", "--out", "bundle", "--set", "vision.checkpoint=small"]
    done = run(*words, *options)
    assert done.code == 130
    assert "then press Enter" in done.err
    assert f"is in data/touches/stapler; the same command{same} continues there" in done.err


def test_a_virtual_servo_has_one_id(run: Run) -> None:
    done = run("virtual-servo", "--id", 1, "--id", 1)
    assert (done.code, "--id 1 --id 1 names a servo twice" in done.err) == (2, True)


def test_a_number_beyond_its_range_is_refused(run: Run) -> None:
    for words in (
        ["virtual-servo", "--id", 300],
        ["view", "a.mcap", "--viewer", "foxglove", "--port", 70000],
    ):
        assert run(*words).code == 2
    done = run("replay", "runs", "--ray", "127.0.0.1:70000")
    assert done.code == 2
    assert "Traceback" not in done.err


def test_paths_with_brackets_are_shown_whole(capsys: pytest.CaptureFixture[str]) -> None:
    cli.console.pairs({"log": Path("data/[old]/a[/x].mcap")})
    assert "data/[old]/a[/x].mcap" in capsys.readouterr().out


def test_a_long_path_in_a_pipe_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    path = "/a/home/folder" * 20
    cli.console.pairs({"profile": path})
    assert path in capsys.readouterr().out


def test_a_table_of_trials_fits_80_columns_without_a_broken_word(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    trial: dict[str, Any] = dict.fromkeys((*GRASP_KEYS, "vision_share", "object_gain", "feedback"))
    trial |= {"object": "paper_cup", "target_n": 6.45, "result": "timeout", "fell_back": True}
    summary: dict[str, Any] = {"fell_back": 0, "peak_n": None, "estimate_mae_n": {}}
    monkeypatch.setattr(console.out, "width", 80)
    trials_table([cast(GraspSummary, trial)], cast(TrialsSummary, summary))
    said = capsys.readouterr().out
    assert {"paper_cup", "load cell", "overshoot", "timeout,"} <= set(re.split(r"\s{2,}|\n", said))
    assert max(map(len, said.splitlines()[:4])) <= 80


def test_a_setting_that_a_camera_lacks_is_not_shown(capsys: pytest.CaptureFixture[str]) -> None:
    names = {"image": "settings", "other": "other"}
    output.rig_table({"image": {"sensor": None, "fourcc": "MJPG"}, "other": {"sensor": None}}, names)
    shown = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert shown == [["settings", "fourcc", "MJPG"], ["other", "-"]]


@pytest.mark.parametrize(
    ("section", "result", "names"),
    [
        (LoadCellCalibration, LoadCellResult, output.LOAD_CELL),
        (ServoCalibration, ServoResult, output.SERVO),
        (CameraCalibration, CameraResult, output.CAMERA),
    ],
)
def test_each_value_of_a_calibration_is_named_in_plain_words(
    section: type[Section], result: Any, names: dict[str, str]
) -> None:
    keys = {*section.model_fields, *result.__dataclass_fields__} - {"calibration", "outdated"}
    assert names.keys() == keys
    assert not any("_" in name for name in names.values())


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("held", "held"),
        ("fell_back", "fell back"),
        ("rmse_n", "RMSE, N"),
        ("median_error_percent", "median error, %"),
        ("slope_mb_h", "slope, MB/h"),
        ("n", "n"),
    ],
)
def test_a_key_of_json_is_shown_as_plain_words_with_its_unit(key: str, words: str) -> None:
    assert console.label(key) == words


@pytest.mark.parametrize(("result", "told"), [("timeout", True), ("held", False)])
def test_a_grasp_that_was_not_held_says_why(
    current_log: Path, capsys: pytest.CaptureFixture[str], result: str, told: bool
) -> None:
    summary = summarise_grasp(current_log)
    summary["result"], summary["reason"] = result, "not held within 8 s: the camera sees 0.0 N"
    grasp_table(summary)
    assert (summary["reason"] in capsys.readouterr().out) == told


@pytest.fixture
def servo_calibrated(monkeypatch: pytest.MonkeyPatch, servo_calibration: ServoCalibration) -> None:
    """`calibrate servo` presses no gauge, and writes a calibration all the same."""
    value = CalibratedValue(value=1.0)

    def calibrate(_config: Config, _gauges_m: list[float], rig: Path, **_: object) -> ServoResult:
        update_rig(rig, servo_calibration)
        return ServoResult(servo_calibration, value, value, value, value, value, 6, 12, 0.0, rig, rig)

    monkeypatch.setattr(calibrate_servo, "calibrate_servo", calibrate)


@pytest.mark.usefixtures("servo_calibrated")
def test_a_calibration_does_not_write_its_rig_profile_over_the_rig_file_of_setup(run: Run) -> None:
    rig = Path("rig.yaml")
    rig.write_text("object: block\n")
    text = rig.read_text()
    done = run("calibrate", "servo", "--gauge-mm", "30", "--yes", "--config", "rig.yaml")
    assert done.code == 0, done.err
    assert "calibration.rig=rig_profile.yaml" in done.err
    assert (rig.read_text(), Path("rig_profile.yaml").exists()) == (text, True)


@pytest.mark.usefixtures("servo_calibrated")
def test_a_calibration_replaces_a_damaged_rig_profile_of_its_file(run: Run) -> None:
    Path("old.yaml").write_text("format: gripper-force-rig/0")
    Path("my.yaml").write_text("object: block\ncalibration: {rig: old.yaml}\n")
    options = ("--config", "my.yaml", "--set", "calibration.rig=new.yaml", "--json")
    done = run("calibrate", "servo", "--gauge-mm", "30", "--yes", *options)
    assert done.code == 0, done.err
    assert "next:" in done.err
    assert "calibration.rig=new.yaml" in done.err
    assert "nm_per_a" in json.loads(done.out)
    assert Path("new.yaml").exists()


def test_commands_before_the_first_calibration_need_no_rig_profile(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    jaws = JawsResult(0.0, 2.0, 0.01, (1.0, 1.0), (1.0, 1.0), 1, 0.0, 0.09, 1.0, None)
    monkeypatch.setattr(calibrate_jaws, "calibrate_jaws", lambda *_, **__: jaws)
    new = ("--set", "calibration.rig=rig.yaml", "--set", "object=none", "--set", "sim.detail=coarse")
    assert "closing_sign: 1" in run("calibrate", "jaws", "--yes", *new).out
    checked = run("doctor", *new, "--set", "camera.backend=none", "--set", "vision.checkpoint=none")
    assert "the rig profile rig.yaml does not exist yet" in checked.err
    assert "load cell" in checked.out
    refused = run("grasp", *new)
    assert refused.code == 2
    assert "there is no rig profile rig.yaml yet; `calibrate load-cell`" in refused.err


@pytest.mark.parametrize("name", ["run.mcap", "run"])
def test_a_view_is_not_saved_over_a_log(run: Run, current_log: Path, name: str) -> None:
    log = Path("run.mcap")
    log.write_bytes(current_log.read_bytes())
    done = run("view", log, "--save", name)
    assert (done.code, "name one that ends with .rrd" in done.err) == (2, True)
    assert log.read_bytes() == current_log.read_bytes()


def test_a_folder_of_videos_takes_neither_an_object_nor_a_table(run: Run, tmp_path: Path) -> None:
    for more in (["--object", "mug"], ["forces.csv"]):
        done = run("import", "video", tmp_path, *more)
        assert (done.code, f"leave out {more[0]}" in done.err) == (2, True)


def test_a_virtual_servo_ends_by_a_signal_whose_exception_was_lost(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def sleep(_: float) -> None:
        assert not process.is_interrupted()
        process._received.append((signal.SIGINT, False, 0.0))

    monkeypatch.setattr("gripper_force.cli.runs.time", SimpleNamespace(sleep=sleep))
    assert run("virtual-servo", "--json").code == 0


def test_a_profile_that_is_not_used_is_named(
    quick: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "user"))
    profile = tmp_path / "user" / "gripper-force" / "objects" / "stapler.yaml"
    profile.parent.mkdir(parents=True)
    profile.touch()
    note = f"your profile {profile} is not used; to use it, add --profile stapler"
    seeing = ["camera.backend=simulated", "vision.checkpoint=small"]
    for keys, is_named in ((seeing, True), ([*seeing, "calibration.object=none"], False), ([], False)):
        assert (note in _notes(load_config(None, [*quick, *keys]), "stapler")) == is_named


def test_names_are_shown_as_they_are(run: Run, current_log: Path) -> None:
    named = Path("[red] [b].mcap")
    named.write_bytes(current_log.read_bytes())
    done = run("replay", named, current_log, "--jobs", "1")
    assert (done.code, "[red] [b].mcap" in done.out) == (0, True)


def test_a_log_given_twice_is_replayed_once(run: Run, current_log: Path) -> None:
    Path("run.mcap").write_bytes(current_log.read_bytes())
    done = run("replay", "run.mcap", ".", Path("run.mcap").resolve(), "--json")
    assert json.loads(done.out)["log"] == "run.mcap", "one result, not a list"


def test_a_summary_that_cannot_be_written_gives_one_json_object(run: Run, current_log: Path) -> None:
    Path("out/summary.csv").mkdir(parents=True)
    for more in ([], ["--compare", "log", "control.ramp_n_s=4"]):
        done = run("replay", current_log, "--out", "out", "--json", "--jobs", "1", *more)
        assert (done.code, list(json.loads(done.out))) == (2, ["error"])


def test_a_comparison_goes_on_without_a_broken_first_log(run: Run, current_log: Path) -> None:
    Path("a.mcap").write_bytes(current_log.read_bytes()[:5000])
    Path("b.mcap").write_bytes(current_log.read_bytes())
    done = run("replay", ".", "--compare", "log", "control.ramp_n_s=4", "--json", "--jobs", "1")
    found = json.loads(done.out)
    assert (done.code, found["logs"], list(found["failed"])) == (2, 1, ["a.mcap"])


@pytest.mark.skipif(sys.platform == "darwin", reason="macOS has no such file names")
def test_a_summary_names_a_file_whose_name_is_no_text(run: Run, current_log: Path) -> None:
    Path(os.fsdecode(b"a\xff.mcap")).write_bytes(current_log.read_bytes())
    done = run("replay", ".", "--out", "out", "--jobs", "1")
    assert done.code == 0, done.err
    assert "a\\udcff.mcap" in Path("out/summary.html").read_text()
    assert "a\\udcff.mcap" in Path("out/summary.csv").read_text()


def test_the_next_step_can_be_copied_for_every_path(capsys: pytest.CaptureFixture[str]) -> None:
    console.next_step("train", Path("-my logs"), "--out", "a.safetensors")
    console.next_page(Path("-my logs/run.html"))
    assert capsys.readouterr().err.splitlines() == [
        "next: gripper-force train './-my logs' --out a.safetensors",
        "next: open './-my logs/run.html'",
    ]
