from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gripper_force.config import (
    HARD_FORCE_LIMIT_N,
    Config,
    LogConfig,
    SimConfig,
    VisionConfig,
    config_from,
    config_from_text,
    dump_config,
    load_config,
)
from gripper_force.errors import ConfigError
from gripper_force.schema import Section

positive = st.floats(1e-6, 1e6)
configs = st.builds(
    lambda tree: config_from(tree, "the test"),
    st.fixed_dictionaries(
        {
            "object": st.text(max_size=20),
            "target_n": positive,
            "seed": st.integers(0, 2**63),
            "vision": st.fixed_dictionaries(
                {
                    "region": st.none() | st.tuples(*[st.integers(-9, 9999)] * 4),
                    "lockstep_compute_ms": positive,
                }
            ),
            "gripper": st.fixed_dictionaries({"nm_per_a": st.none() | positive}),
            "camera": st.fixed_dictionaries({"path": st.none() | st.just("some where/log.mcap")}),
            "sim": st.fixed_dictionaries({"lux": st.none() | positive, "randomise": st.booleans()}),
        }
    ),
)


def test_everything_has_a_default() -> None:
    assert load_config() == Config()


@settings(max_examples=25, deadline=None)
@given(configs)
def test_what_is_dumped_is_read_back_as_it_was(config: Config) -> None:
    assert config_from_text(dump_config(config), "the test") == config


@pytest.mark.parametrize(
    ("key", "known"),
    [("colour", "object, target_n, seed"), ("control.ramp", "rate_hz, feedback, force_limit_n")],
)
def test_an_unknown_key_is_named_with_the_known_ones(tmp_path: Path, key: str, known: str) -> None:
    with pytest.raises(ConfigError, match=f"unknown configuration key '{key}'") as caught:
        load_config(None, [f"{key}=1"])
    assert known in str(caught.value)
    path = tmp_path / "scene.yaml"
    head, *rest = key.split(".")
    path.write_text(f"{head}: {{{rest[0]}: 1}}" if rest else f"{head}: 1")
    with pytest.raises(ConfigError, match=f"'{key}' .*{path}") as caught:
        load_config(path)
    assert known in str(caught.value)


@pytest.mark.parametrize(
    ("assignment", "key"),
    [
        ("target_n=0", "target_n"),
        ("target_n=.nan", "target_n"),
        ("target_n=.inf", "target_n"),
        ("target_n=much", "target_n"),
        ("control.vision_timeout_ms=1e308", "control.vision_timeout_ms"),
        ("control.plant_delay_ms=1e-300", "control.plant_delay_ms"),
        ("gripper.friction_n=1e300", "gripper.friction_n"),
        ("gripper.current_step_a=1e-320", "gripper.current_step_a"),
        ("control.rate_hz=1e9", "control.rate_hz"),
        ("camera.rate_hz=1e9", "camera.rate_hz"),
        ("load_cell.rate_hz=1e9", "load_cell.rate_hz"),
        ("seed=-1", "seed"),
        ("clock=late", "clock"),
        ("servo.id=253", "servo.id"),
        ("load_cell.baud_rate=3000000000", "load_cell.baud_rate"),
        ("servo.bus_watchdog_ms=10", "servo.bus_watchdog_ms"),
        ("gripper.closing_sign=0", "gripper.closing_sign"),
        ("vision.region=[1, 2, 3]", "vision.region"),
        (f"control.force_limit_n={HARD_FORCE_LIMIT_N + 0.1}", "control.force_limit_n"),
        ("control=5", "control"),
    ],
)
def test_a_value_out_of_range_is_refused_with_its_key_and_itself(assignment: str, key: str) -> None:
    with pytest.raises(ConfigError, match=f"configuration key '{key}") as caught:
        load_config(None, [assignment])
    assert "--set" in str(caught.value)
    assert ", got " in str(caught.value)


def test_a_value_that_is_no_path_is_named_in_plain_words() -> None:
    with pytest.raises(
        ConfigError, match=r"'log\.directory' \(from --set\): Input is not a valid path, got 5"
    ):
        load_config(None, ["log.directory=5"])


@pytest.mark.parametrize(
    ("assignment", "sentence"),
    [
        (
            "control.min_object_width_m=2",
            "control.min_object_width_m must be below gripper.open_width_m, 0.092 m",
        ),
        ("control.settle_s=8", "settle_s 8 must be below timeout_s 8"),
        ("control.approach_force_n=20", "approach_force_n 20 must be below force_limit_n 14"),
        ("control.warm_c=70", "warm_c 70 must be below temperature_limit_c 70"),
    ],
)
def test_values_that_contradict_each_other_are_refused(assignment: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        load_config(None, [assignment])


def test_who_is_wrong_is_named_the_file_or_what_is_set(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("seed: 4")
    with pytest.raises(ConfigError, match=r"'sead' \(from --set\)"):
        load_config(path, ["sead=3"])
    with pytest.raises(ConfigError, match=r"'sead' \(from --set\)"):
        config_from_text("seed: 4", "run.mcap", ["sead=3"])
    with pytest.raises(ConfigError, match=r"'calibration\.rig' \(from --set\)"):
        load_config(path, ["calibration.rig=[1]"])
    path.write_text("sead: 4")
    with pytest.raises(ConfigError, match=r"'sead' \(from .*scene\.yaml\)"):
        load_config(path, ["seed=3"])
    path.write_text("seed: x")
    assert load_config(path, ["seed=3"]).seed == 3


@pytest.mark.parametrize("text", ["format: gripper-force-rig/1", "family: solid"])
def test_a_profile_or_an_object_is_no_configuration(text: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    with pytest.raises(
        ConfigError,
        match=r"rig\.yaml is not a configuration.* --set calibration\.rig=.* --profile .* --object ",
    ):
        load_config(path)


def test_overrides_are_yaml_and_the_last_one_wins(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("object: tube\ntarget_n: 2\nvision: {threads: 3}\n")
    config = load_config(path, ["target_n=5", "target_n=6.5", "vision.region=[1, 2, 30, 40]"])
    assert (config.object, config.target_n, config.vision.threads) == ("tube", 6.5, 3)
    assert config.vision.region == (1, 2, 30, 40)
    assert load_config(None, ["gripper.nm_per_a=null"]).gripper.nm_per_a is None
    assert load_config(None, ["object=a=b"]).object == "a=b"


@pytest.mark.parametrize(
    ("assignment", "sentence"),
    [
        ("target_n", r"--set needs key\.path=value, got 'target_n'"),
        ("=3", r"--set needs key\.path=value, got '=3'"),
        ("target_n=[1", r"--set target_n: '\[1' is not a YAML value"),
        ("target_n=0b_", "key 'target_n' .*unable to parse string as a number, got '0b_'"),
        ("target_n=!!bool x", "--set target_n: '!!bool x' is not a YAML value"),
        ("target_n=!!timestamp x", "is not a YAML value"),
        ("target_n=!!int", "is not a YAML value"),
        ("seed.a.b=3", "'seed' is a value, not a section"),
    ],
)
def test_an_assignment_that_is_none_is_refused(tmp_path: Path, assignment: str, sentence: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("seed: 4")
    with pytest.raises(ConfigError, match=sentence):
        load_config(path, [assignment])


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"- a\n- b\n", "must hold a mapping at its top level"),
        (
            b"a: [1\n",
            "can't read the configuration .*: line 2: .*; check indentation, quotes and brackets up to there",
        ),
        (b"control:\n\trate_hz: 100\n", "line 2 is indented with a tab; use spaces"),
        (b"control:\n  rate_hz: 100\n \thold_s: 2\n", "line 3 is indented with a tab; use spaces"),
        (b"control:\n  rate_hz: 1\n  rate_hz: 2\n", "line 3: the key 'rate_hz' occurs twice"),
        (b"seed: 1\ncontrol:\n", "'control' .* is a section, got None; write keys below it"),
        (b"a: !!timestamp 2001-99-99", "month must be"),
        (b"a: " + b"[" * 2000, "can't read the configuration .*(recursion|nesting)"),
        (b"\xff\xfe\x00", "can't read the configuration"),
        (None, "can't read the configuration .*: No such file or directory; name a YAML file"),
    ],
)
def test_a_file_that_is_no_configuration_is_named(tmp_path: Path, data: bytes | None, sentence: str) -> None:
    path = tmp_path / "scene.yaml"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(ConfigError, match=sentence) as caught:
        load_config(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ({"control.rate": 5}, r"unknown configuration key 'control\.rate' \(from overrides\); did you mean"),
        ({5: 5}, "unknown configuration key '5' "),
        ("seed=1", r"pass \['seed=1'\] instead"),
    ],
)
def test_wrong_overrides_are_named(overrides: Any, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        load_config(None, overrides)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (
            {"contrl": 3},
            "unknown configuration key 'contrl' .*did you mean 'control'.*; known here: object, ",
        ),
        ({"contrl": {"rate_hz": 3}, "seed": "x"}, "'contrl' .*did you mean 'control'"),
        (
            {"control": {"rat_hz": 3}},
            r"'control\.rat_hz' \(from with_values\); did you mean 'control\.rate_hz'",
        ),
    ],
)
def test_a_copy_with_an_unknown_key_is_refused(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        Config().with_values(**values)


def test_the_values_of_a_copy_are_not_yet_validated() -> None:
    config = Config().with_values(seed=-1, vision=VisionConfig(threads=2), control={"rate_hz": -3.0})
    assert (config.seed, config.vision.threads, config.control.rate_hz) == (-1, 2, -3.0)


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("# nothing yet\n")
    assert load_config(path) == Config()


RIG = """
format: gripper-force-rig/1
load_cell:
  {date: 2026-01-02T03:04:05Z, sensor: serial hx711, tare_raw: {value: 8000}, n_per_raw: {value: 1.0e-4},
   force_n: [0, 20], noise_n: 0.01, drift_n_min: {value: 0.0}}
"""


def test_a_rig_profile_stands_before_the_defaults_and_gives_way_to_file_and_set(tmp_path: Path) -> None:
    rig, scene = tmp_path / "rig.yaml", tmp_path / "scene.yaml"
    rig.write_text(RIG)
    scene.write_text(f"calibration: {{rig: {rig}}}\nload_cell: {{tare_raw: 7000, backend: serial}}")
    cell = load_config(scene).load_cell
    assert (cell.tare_raw, cell.n_per_raw, cell.backend) == (7000, 1e-4, "serial")
    cell = load_config(None, [f"calibration.rig={rig}", "load_cell.n_per_raw=2"]).load_cell
    assert (cell.tare_raw, cell.n_per_raw) == (8000, 2)


def test_a_log_keeps_its_values_unless_a_rig_profile_is_named(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG)
    logged = dump_config(load_config(None, [f"calibration.rig={rig}", "load_cell.tare_raw=7000"]))
    again = ["load_cell.n_per_raw=2", f"calibration.rig={rig}"]
    assert config_from_text(logged, "run.mcap", again).load_cell.tare_raw == 8000
    assert config_from_text(logged, "run.mcap", again).load_cell.n_per_raw == 2
    rig.unlink()
    assert config_from_text(logged, "run.mcap").load_cell.tare_raw == 7000


@pytest.mark.parametrize("value", ["/no/such.yaml", "[1]", "3"])
def test_a_rig_profile_that_is_none_is_named(value: str) -> None:
    with pytest.raises(ConfigError, match=r"rig"):
        load_config(None, [f"calibration.rig={value}"])


@pytest.mark.parametrize("text", ["a: [1", "object: {a: 1}"])
def test_a_logs_configuration_that_is_damaged_is_named(text: str) -> None:
    with pytest.raises(ConfigError, match=r"run\.mcap"):
        config_from_text(text, "run.mcap")


def test_a_configuration_can_not_be_changed() -> None:
    config: Any = Config()
    with pytest.raises(ValueError, match="frozen"):
        config.seed = 3


def test_a_copy_has_other_values_and_keeps_the_rest_of_a_section() -> None:
    config = load_config(None, ["sim.rig_seed=3"])
    other = config.with_values(seed=7, sim={"lux": 350.0}, log=LogConfig(report=False))
    assert (other.seed, other.sim.lux, other.sim.rig_seed, other.log.report) == (7, 350.0, 3, False)
    assert (config.seed, config.sim.lux, config.log.report) == (0, Config().sim.lux, True)


@pytest.mark.parametrize(
    ("key", "suggestion"),
    [("control.rate_h", "control.rate_hz"), ("rate_hz", "camera.rate_hz"), ("contol.rate_hz", "control")],
)
def test_an_unknown_key_gets_a_suggestion(key: str, suggestion: str) -> None:
    with pytest.raises(ConfigError, match=f"did you mean '{suggestion}'"):
        load_config(None, {key: 1.0})


def test_overrides_may_be_a_mapping() -> None:
    assert load_config(None, {"control.rate_hz": 100.0, "object": "tube"}) == load_config(
        None, ["control.rate_hz=100", "object=tube"]
    )


def test_a_key_of_text_takes_a_path() -> None:
    keys = ("object", "servo.model", "servo.port", "vision.checkpoint", "calibration.object", "camera.device")
    paths: dict[str, object] = {key: Path("/rig") / key for key in keys}
    texts = load_config(None, [f"{key}={path}" for key, path in paths.items()])
    assert load_config(None, paths) == texts
    assert type(load_config(None, paths).vision.checkpoint) is str
    sim = load_config(None, {"object": Path("mug.yaml")})
    assert (sim.object, sim.sim.object) == ("mug", Path("mug.yaml"))


def test_a_type_checker_without_a_plugin_knows_the_defaults() -> None:
    """Those of `Field(1.2)`, which is no field specifier then (https://peps.python.org/pep-0681/)."""
    transform = vars(Section)["__dataclass_transform__"]
    assert transform["kw_only_default"]
    assert transform["field_specifiers"] == ()


def test_a_configuration_of_version_0_1_with_the_compiled_engine_is_read() -> None:
    assert config_from_text("vision: {engine: compiled}", "a log").vision.engine == "torch"


def test_a_lens_position_that_an_oak_does_not_have_is_refused() -> None:
    with pytest.raises(ConfigError, match="lens_position 999 is above 255, the nearest focus of an OAK"):
        load_config(None, {"camera.backend": "oak", "camera.lens_position": 999})
    assert (
        load_config(None, {"camera.backend": "uvc", "camera.lens_position": 999}).camera.lens_position == 999
    )


def test_the_path_of_an_object_becomes_its_name_and_its_file() -> None:
    for config in (
        load_config(None, ["object=things/mug.yaml", "sim.lux=350"]),
        Config(object="things/mug.yaml", sim=SimConfig(lux=350)),
    ):
        assert (config.object, config.sim.object, config.sim.lux) == ("mug", Path("things/mug.yaml"), 350)
    again = config_from_text(dump_config(config), "a log")
    assert (again.object, again.sim.object) == ("mug", Path("things/mug.yaml"))
    assert load_config(None, {"object": "clip.xml"}).sim.object == Path("clip.xml")
    assert load_config(None, {"object": "mug"}).sim.object is None
