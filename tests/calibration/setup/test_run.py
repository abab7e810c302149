"""The steps of `setup` on a simulated rig."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from gripper_calibration.setup.rig_file import RigFile, flat
from gripper_calibration.setup.run import STEPS, Setup, StepReport
from gripper_calibration.setup.step import ANSWERED, Found
from gripper_force.config import load_config
from gripper_force.errors import ConfigError
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.sim.scene import draw_scene

EXAMPLES = Path(__file__).parents[3] / "examples/setups"
PAGE = (Path(__file__).parents[3] / "docs/your-own-rig.md").read_text(encoding="utf-8")
SIMULATED = ["servo.port=virtual:setup", "load_cell.backend=none", "sim.detail=coarse"]


class Script:
    """Answers with yes and with defaults, and keeps what it was told."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def tell(self, text: str) -> None:
        self.told.append(text)

    def do(self, text: str) -> None:
        self.told.append(text)

    def agrees(self, question: str) -> bool:
        self.told.append(question)
        return True

    def choose(self, question: str, answers: Sequence[str], option: str) -> str:
        raise ConfigError(f"{question}; pass {option}")

    def number(self, question: str, option: str, default: float | None = None) -> float:
        if default is None:
            raise ConfigError(f"{question}; pass {option}")
        return default


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[StepReport]]:
    """A rig file of all steps without a load cell, interrupted after the jaws, and the reports after that."""
    path = tmp_path_factory.mktemp("finished") / "rig.yaml"
    running = Setup(path, SIMULATED).run(Script())
    assert [next(running).name for _ in range(3)] == ["scan", "servo", "jaws"]
    return path, list(Setup(path).run(Script()))


@pytest.fixture
def rig_file(finished: tuple[Path, list[StepReport]], tmp_path: Path) -> Path:
    """A copy of the finished rig file with its folder."""
    path, _ = finished
    return Path(shutil.copytree(path.parent, tmp_path / "copy")) / path.name


def test_a_setup_without_a_load_cell_ends_with_a_rig_file_and_continues_there(
    finished: tuple[Path, list[StepReport]],
) -> None:
    path, reports = finished
    assert [report.result for report in reports] == 3 * ["kept"] + 3 * ["done"]
    by_name = {report.name: report for report in reports}
    assert (
        "`calibrate camera`, `calibrate object`, `record`, `teach` and training"
        in by_name["load-cell"].remarks[0]
    )
    intervals_n = by_name["torque"].details["intervals_n"]
    assert intervals_n["4"][0] < 4 < intervals_n["4"][1]
    assert Path(by_name["camera"].files["picture"]).stat().st_size > 1000
    config = load_config(path)
    assert config.servo.baud_rate == 1_000_000
    assert config.gripper.open_width_m == pytest.approx(0.0995, abs=0.002)
    # The simulated jaws are 92 mm apart at 0 rad, and a rack moves both.
    open_rad = (0.092 - config.gripper.open_width_m) / 2 / config.gripper.pinion_radius_m
    assert config.gripper.open_position_rad == pytest.approx(open_rad, abs=0.03)
    assert "homed" in path.read_text(encoding="utf-8")


def test_a_changed_key_repeats_only_the_steps_that_rest_on_it(rig_file: Path) -> None:
    again = Setup(rig_file, ["camera.rate_hz=30"]).run(Script())
    assert [report.name for report in again if report.result == "done"] == ["camera"]
    # Some cameras have no other exposure than an automatic one.
    (changed,) = Setup(rig_file, ["camera.exposure_us=null"], only="camera").run(Script())
    assert "automatic exposure" in changed.summary
    assert load_config(rig_file).camera.exposure_us is None
    # What a person sets is kept, also if no step has to run again.
    kept = list(Setup(rig_file, ["camera.exposure_us=3000"]).run(Script()))
    assert [report.result for report in kept] == 6 * ["kept"]
    assert load_config(rig_file).camera.exposure_us == 3000


def test_a_known_mass_takes_the_place_of_a_load_cell(rig_file: Path) -> None:
    """It is given later, so only the step that uses it runs again, once."""
    for expected in ("done", "kept"):
        *others, torque = Setup(rig_file, mass_kg=0.5, gauge_mm=30).run(script := Script())
        assert [report.result for report in (*others, torque)] == [*5 * ["kept"], expected]
        assert script.told[-1].startswith("--gauge-mm 30 was not used: with this rig, no step")
        again = "torque runs again, because these changed: --mass-kg, now 0.5"
        assert (again in script.told) == (expected == "done")
        assert any("Hang 0.5 kg" in text for text in script.told) == (expected == "done")
        if expected == "done":
            low_n, high_n = torque.details["intervals_n"]["4"]
    assert 3.7 < low_n < 4 < high_n < 4.3
    config = load_config(rig_file)
    true = load_model(config.servo.model).nm_per_a * draw_scene("none", config.seed, config.sim).nm_per_a
    assert config.gripper.nm_per_a == pytest.approx(true, rel=0.02)
    assert "balanced 500 g" in rig_file.read_text(encoding="utf-8")


def test_a_gauge_of_another_width_than_named_is_a_remark(tmp_path: Path) -> None:
    keys = ["servo.port=virtual:gauge", "load_cell.backend=simulated", "sim.detail=coarse"]
    (report,) = Setup(tmp_path / "rig.yaml", keys, only="torque", gauge_mm=36).run(Script())
    shift, reference = report.remarks
    assert "mm larger than the configuration said" in shift
    assert reference.startswith("force by motor current alone")


def test_values_that_a_person_writes_are_kept_and_named(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("servo: {id: 3}\n", encoding="utf-8")
    rig = RigFile.load(path, ["camera.rate_hz=30"], fresh=False)
    rig.take({"servo.id": Found(3, "found"), "servo.baud_rate": Found(57600, "found")})
    rig.finish("scan", {"summary": "done"})
    text = path.read_text(encoding="utf-8")
    assert "id: 3" in text
    assert "# given in this file" in text
    assert (rig.folder / "original.yaml").read_text(encoding="utf-8") == "servo: {id: 3}\n"
    again = RigFile.load(path, None, fresh=False)
    assert again.steps == {"scan": {"summary": "done"}}
    assert flat(again.tree()) == {"servo.id": 3, "servo.baud_rate": 57600, "camera.rate_hz": 30}
    assert not RigFile.load(path, None, fresh=True).found


def test_a_fresh_start_keeps_a_copy_and_takes_no_step(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    copies = [tmp_path / "rig-setup" / name for name in ("before-fresh.yaml", "before-fresh-2.yaml")]
    for number, copy in enumerate(copies):
        path.write_text(f"servo: {{id: {number}}}\n", encoding="utf-8")
        for _ in range(2):  # the second run copies nothing new
            next(Setup(path, SIMULATED, fresh=True).run(script := Script()))
            assert f"the earlier rig file is kept as {copy}" == script.told[0]
            path.write_text(f"servo: {{id: {number}}}\n", encoding="utf-8")
    assert [copy.read_text(encoding="utf-8") for copy in copies] == ["servo: {id: 0}\n", "servo: {id: 1}\n"]
    assert len(list((tmp_path / "rig-setup").glob("before-fresh*"))) == 2
    with pytest.raises(ConfigError, match=r"--fresh forgets .* --step torque .* leave out --fresh"):
        Setup(path, fresh=True, only="torque")
    next(Setup(new := tmp_path / "new.yaml", SIMULATED, fresh=True).run(script := Script()))
    assert new.exists()
    assert not any("kept" in text for text in script.told)


@pytest.mark.parametrize("place", ["file/rig.yaml", "rig.yaml"])
def test_a_place_that_can_not_be_written_is_named_before_the_servo_is_changed(
    tmp_path: Path, place: str
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "rig-setup").touch()  # where the state would be
    script = Script()
    with pytest.raises(ConfigError, match=r"can't write .*; name another file"):
        next(Setup(tmp_path / place, SIMULATED, only="servo").run(script))
    assert script.told == []


def test_a_finished_setup_is_shown_from_a_place_that_can_not_be_written(
    finished: tuple[Path, list[StepReport]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, _ = finished

    def refuse(_: RigFile) -> None:
        raise ConfigError("can't write")

    monkeypatch.setattr(RigFile, "check_writable", refuse)
    assert [report.result for report in Setup(path).run(Script())] == 6 * ["kept"]


def test_a_step_that_runs_again_forgets_what_it_found_before(tmp_path: Path) -> None:
    rig = RigFile(tmp_path / "rig.yaml")
    jaws = {"gripper.friction_n": Found(0.5, "homed"), "gripper.pinion_radius_m": Found(0.015, ANSWERED)}
    torque = {"gripper.friction_n": Found(0.7, "pressed"), "gripper.nm_per_a": Found(1.9, "pressed")}
    for name, values in (("jaws", jaws), ("torque", torque)):
        rig.take(values)
        rig.finish(name, {"values": values, "rests_on": {}})
    again = RigFile.load(rig.path, None, fresh=False)
    again.forget("torque")
    assert flat(again.tree()) == {"gripper.friction_n": 0.5, "gripper.pinion_radius_m": 0.015}
    again = RigFile.load(rig.path, None, fresh=False)
    again.forget("jaws")
    assert flat(again.tree())["gripper.pinion_radius_m"] == 0.015, "an answer is kept"
    assert again.outdate("jaws") == ["torque"]
    rig = RigFile(tmp_path / "other.yaml")  # the steps ran in another order
    for name, values in (("torque", torque), ("jaws", jaws)):
        rig.finish(name, {"values": values, "rests_on": {}}, STEPS)
    assert rig.outdate("jaws") == ["torque"]


@pytest.mark.parametrize(
    ("change", "steps"),
    [
        ("servo.port=virtual:other", {"servo", "jaws", "torque"}),
        ("servo.homing_offset=500", {"jaws", "torque"}),
        ("servo.model=XC330-T288", {"servo", "jaws", "torque"}),
    ],
)
def test_what_the_jaws_are_found_with_decides_what_is_found_again(
    tmp_path: Path, change: str, steps: set[str]
) -> None:
    first = Setup(tmp_path / "rig.yaml", SIMULATED)
    for name in STEPS:
        first.rig.finish(name, {"rests_on": first._inputs(STEPS[name])})
    changed = Setup(tmp_path / "rig.yaml", [change])
    assert {name for name in STEPS if changed._changed(name, STEPS[name])} >= steps


@pytest.mark.parametrize(
    ("keys", "option", "step"),
    [
        (["load_cell.backend=serial"], "mass_kg", "load-cell"),
        (["load_cell.backend=serial"], "gauge_mm", "torque"),
        (["load_cell.backend=simulated"], "gauge_mm", "torque"),
        (["load_cell.backend=none"], "mass_kg", "torque"),
        (["load_cell.backend=simulated"], "mass_kg", None),
        (["load_cell.backend=none"], "gauge_mm", None),
        (["load_cell.backend=none", "control.force_limit_n=1"], "mass_kg", None),
    ],
)
def test_another_mass_or_width_repeats_the_step_that_uses_it(
    tmp_path: Path, keys: list[str], option: str, step: str | None
) -> None:
    path = tmp_path / "rig.yaml"
    first = Setup(path, ["servo.port=virtual:setup", *keys])
    for name in STEPS:
        used = {"used": {option: 0.3}} if name == step else {}
        first.rig.finish(name, {"rests_on": first._inputs(STEPS[name]), **used})
    for value, changed in ((0.3, []), (0.5, [] if step is None else [step])):
        again = Setup(path, **{option: value})  # type: ignore[arg-type]
        assert [name for name in STEPS if again._changed_options(name, STEPS[name])] == changed
        assert not again.pending, "without the option nothing has to run"
        again._tell_unused(script := Script())
        assert len(script.told) == (value == 0.5 or step is None)


def test_a_baud_rate_is_saved_though_the_step_fails(tmp_path: Path) -> None:
    rig = RigFile.load(tmp_path / "rig.yaml", ["servo.baud_rate=57600"], fresh=False)
    rig.keep({"servo.baud_rate": Found(1_000_000, "written to the servo")})
    assert load_config(rig.path).servo.baud_rate == 1_000_000
    assert RigFile.load(rig.path, None, fresh=False).steps == {}


class Wrong(Script):
    """Answers each question for a number with the same one."""

    def __init__(self, answer: float) -> None:
        super().__init__()
        self._answer = answer

    def number(self, question: str, option: str, default: float | None = None) -> float:
        return self._answer


@pytest.mark.parametrize("answer", [0.0, -20.0, float("nan"), float("inf")])
def test_a_length_that_can_not_be_is_refused_before_the_jaws_move(tmp_path: Path, answer: float) -> None:
    path = tmp_path / "rig.yaml"
    with pytest.raises(ConfigError, match=r"can't answer this: Pitch radius .*--set gripper.pinion_radius_m"):
        list(Setup(path, SIMULATED, only="jaws").run(Wrong(answer)))
    for option, name in (("mass_kg", "--mass-kg"), ("gauge_mm", "--gauge-mm")):
        with pytest.raises(ConfigError, match=f"{name} is .* pass a positive number"):
            Setup(path, **{option: answer})  # type: ignore[arg-type]


def test_named_steps_run_in_their_order(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    reports = Setup(path, ["servo.port=virtual:order", "load_cell.backend=none"], only=["servo", "scan"]).run(
        Script()
    )
    assert [report.name for report in reports] == ["scan", "servo"]


def test_a_damaged_state_and_an_unknown_step_are_named(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    rig = RigFile(path)
    rig.finish("scan", {})
    (rig.folder / "state.json").write_text("{", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"state\.json.*delete it"):
        RigFile.load(path, None, fresh=False)
    with pytest.raises(ConfigError, match="no step 'jaw'; use one of scan, servo, jaws"):
        Setup(tmp_path / "new.yaml", only="jaw")


def test_the_jaws_of_a_linkage_get_a_smaller_bound(tmp_path: Path) -> None:
    linkage = load_config(EXAMPLES / "viperx_oak.yaml").gripper.linkage
    keys = {key: value for key, value in linkage.model_dump().items() if value}
    overrides = [*SIMULATED, f"gripper.linkage={keys}", "gripper.open_width_m=0.072"]
    (report,) = Setup(tmp_path / "rig.yaml", overrides, only="jaws").run(Script())
    bound_rad = report.values["gripper.position_bound_rad"]
    assert 0.05 < bound_rad < 0.25
    assert load_config(tmp_path / "rig.yaml").gripper.position_bound_rad == bound_rad


@pytest.mark.parametrize("name", ["xm430_oak_hx711", "xl330_webcam_hx711", "viperx_oak"])
def test_an_example_to_start_from_is_valid(name: str) -> None:
    config = load_config(EXAMPLES / f"{name}.yaml")
    assert config.clock == "realtime"
    assert f"{name}.yaml" in PAGE


def test_the_page_has_every_step() -> None:
    section = PAGE.split("## Setup")[1].split("\n## ")[0]
    assert [name for name in STEPS if f"| `{name}` |" not in section] == []
