from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import config_from_text, load_config
from gripper_force.errors import ConfigError
from gripper_force.schema import (
    Section,
    Tree,
    dump,
    merged,
    read_tree,
    tree_from,
    validated,
)


class Part(Section):
    size: int = 1


class Whole(Section):
    part: Part | None = None
    parts: tuple[Part, ...] = ()
    name: str = "one"


trees = st.recursive(
    st.integers(), lambda inner: st.dictionaries(st.sampled_from("abc"), inner, max_size=3), max_leaves=9
)
mappings = st.dictionaries(st.sampled_from("abc"), trees, max_size=3)


@given(mappings, mappings)
def test_merging_keeps_every_key_and_the_second_has_the_last_word(under: Tree, over: Tree) -> None:
    both = merged(under, over)
    assert set(both) == set(under) | set(over)
    assert merged(both, over) == both
    assert merged({}, over) == over == merged(over, {})


def test_what_is_dumped_is_read_back(tmp_path: Path) -> None:
    whole = Whole(part=Part(size=3), parts=(Part(), Part(size=2)))
    path = tmp_path / "whole.yaml"
    path.write_text(dump(whole))
    assert validated(Whole, read_tree(path), "there") == whole


@pytest.mark.parametrize("tree", [{"part": {"sise": 1}}, {"parts": [{}, {"sise": 1}]}])
def test_an_unknown_key_is_named_with_those_of_its_section(tree: Tree) -> None:
    with pytest.raises(
        ConfigError,
        match=r"unknown profile key 'part.*sise' .*; did you mean 'part.*size'\?; known here: size$",
    ):
        validated(Whole, tree, "there", "profile")


def test_a_wrong_value_is_named_with_what_it_is_of() -> None:
    with pytest.raises(ConfigError, match=r"profile key 'part.size' \(from there\): .*, got 'big'"):
        validated(Whole, {"part": {"size": "big"}}, "there", "profile")
    with pytest.raises(ConfigError, match="can't read the profile there"):
        tree_from("a: [1", "there", "profile")


def test_a_key_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    """The first section would be lost, and with it a force limit."""
    path = tmp_path / "rig.yaml"
    path.write_text("control: {force_limit_n: 8}\ncamera: {}\ncontrol: {hold_s: 3}\n")
    with pytest.raises(ConfigError, match=r"line 3: the key 'control' occurs twice; join its two parts"):
        load_config(path)
    path.write_text("a: &base {x: 1}\nb: {<<: *base, x: 2}\n")
    assert read_tree(path)["b"] == {"x": 2}


@pytest.mark.parametrize(
    "key", ["target_n", "servo.id", "control.rate_hz", "camera.device", "budget.error_n"]
)
def test_a_boolean_is_no_number(key: str) -> None:
    with pytest.raises(ConfigError, match=rf"key '{key}.*it is a number, not true or false"):
        load_config(None, [f"{key}=true"])
    for value in ("on", "yes", "true"):
        assert load_config(None, [f"log.report={value}"]).log.report


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("010", 10),
        ("0x1F", 31),
        ("1.5e-3", 1.5e-3),
        ("1.", 1.0),
        (".5", 0.5),
        ("-.inf", float("-inf")),
        ("true", True),
        ("", None),
        *((text, text) for text in ("1:30", "0b", "no", "2026-01-02", "1e", ".", "0o8")),
        *((text, text) for text in ("08", "-09", "0o17", "1e5", "18443010E2", "1.5e3", "-.5")),
    ],
)
def test_a_value_is_read_as_versions_1_1_and_1_2_of_yaml_agree(text: str, value: object) -> None:
    """YAML 1.1 reads 010 as 8, 1:30 as 90, no as false, and 0b not at all; 08 and 1e5 are text there."""
    assert repr(tree_from(f"key: {text}", "there")["key"]) == repr(value)


@pytest.mark.parametrize("name", ["08", "018", "1e5", "18443010E2", "0o17"])
def test_text_that_yaml_1_1_left_without_quotes_is_still_text(name: str) -> None:
    config = load_config(None, {"object": name, "camera.options": {"serial": name}})
    written_earlier = yaml.safe_dump(config.model_dump(mode="json"))
    assert config_from_text(written_earlier, "the log") == config


def test_a_key_that_wants_a_number_takes_each_form_of_it() -> None:
    config = load_config(None, ["servo.id=08", "control.rate_hz=2e2", "gripper.friction_n=1e-3"])
    assert (config.servo.id, config.control.rate_hz, config.gripper.friction_n) == (8, 200.0, 1e-3)


def test_a_number_with_a_leading_zero_is_decimal_and_minutes_are_none(tmp_path: Path) -> None:
    assert load_config(None, ["servo.id=010"]).servo.id == 10
    with pytest.raises(ConfigError, match=r"key 'servo.id' \(from --set\): .*integer.*, got '1:30'"):
        load_config(None, ["servo.id=1:30"])
    (tmp_path / "scene.yaml").write_text("servo: {id: 010}")
    assert load_config(tmp_path / "scene.yaml").servo.id == 10


@given(st.text("0123456789.:-+eExob_nul~yt<", max_size=4))
def test_text_is_written_so_that_any_yaml_reads_text(text: str) -> None:
    written = dump(Whole(name=text))
    assert tree_from(written, "there")["name"] == yaml.safe_load(written)["name"] == text


def test_a_path_may_begin_with_the_home_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    assert load_config(None, ["log.directory=~/runs"]).log.directory == Path("/home/me/runs")
    assert load_config(None, ["log.directory=~nobody-known/runs"]).log.directory == Path("~nobody-known/runs")
