import re
from copy import copy
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from gripper_force import plugins
from gripper_force.errors import ConfigError
from gripper_force.plugins import EXTRAS, load_class, wrong_result
from gripper_force.types import LoadCellSample

BUILTIN = {"fraction": "fractions:Fraction", "decimal": "decimal:Decimal"}


def load(name: str, alternative: str = "") -> Any:
    return load_class("shapes", BUILTIN, name, "shape.kind", alternative)


@pytest.fixture(autouse=True)
def points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Entry points of other packages, of which one has a built-in name."""
    found = [
        EntryPoint("fraction", "nowhere:Nothing", "gripper_force.shapes"),
        EntryPoint("path", "pathlib:Path", "gripper_force.shapes"),
        EntryPoint("twice", "pathlib:PurePath", "gripper_force.shapes"),
        EntryPoint("twice", "fractions:Fraction", "gripper_force.shapes"),
        EntryPoint("gone", "no_such_package.shapes:Shape", "gripper_force.shapes"),
    ]
    monkeypatch.setattr(
        plugins, "entry_points", lambda group: [point for point in found if point.group == group]
    )


def test_finds_builtin_registered_and_named_classes() -> None:
    from fractions import Fraction

    assert load("fraction") is Fraction
    assert load("path").cwd() == load("pathlib:Path").cwd() == Path.cwd()


@pytest.mark.parametrize(
    ("group", "method", "interface"),
    [
        ("servos", "spec", "interfaces"),
        ("cameras", "newest", "interfaces"),
        ("load_cells", "drain", "interfaces"),
        ("engines", "step", "vision.engines.Engine"),
    ],
)
def test_a_class_of_another_kind_is_refused(group: str, method: str, interface: str) -> None:
    found = f"x.backend=pathlib:Path: pathlib:Path has no method '{method}'; "
    with pytest.raises(ConfigError, match=re.escape(found) + rf".* gripper_force\.{interface} describes$"):
        load_class(group, {}, "pathlib:Path", "x.backend")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "fractoin",
            r"^unknown shape\.kind 'fractoin' \(did you mean 'fraction'\?\); use fraction, decimal, ",
        ),
        ("zzz", r"'zzz'; use fraction, decimal, gone, path, twice or package\.module:Class$"),
        (
            "twice",
            r"^shape\.kind=twice is registered for fractions:Fraction and pathlib:PurePath; set shape\.kind",
        ),
        (
            "no_such_package.a:B",
            r"^shape\.kind=no_such_package\.a:B needs no_such_package, which is not inst",
        ),
        ("gone", r"needs no_such_package, which is not installed; install it"),
        ("pathlib:Paht", r"the module pathlib has no attribute 'Paht'; name one of its classes"),
        ("pathlib:", r"the module pathlib has no attribute ''"),
        (":Path", r"can't import ''.*; name it as package\.module:Class"),
        (".a:Path", r"can't import '\.a'"),
        ("math:pi", r"math:pi is not a class; name a class"),
    ],
)
def test_errors_name_key_and_problem(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load(name)


@pytest.mark.parametrize("name", ["gone", "no_such_package:Shape"])
def test_a_missing_package_names_its_extra(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setitem(BUILTIN, "gone", "no_such_package:Shape")
    with pytest.raises(ConfigError, match=r"needs no_such_package, which is not installed; install it$"):
        load(name)
    monkeypatch.setitem(EXTRAS, "no_such_package", "shapes")
    with pytest.raises(ConfigError, match=r"; pip install 'gripper-force\[shapes\]', or draw it$"):
        load(name, ", or draw it")


def test_a_class_without_one_of_the_methods_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    methods = dict.fromkeys(("start", "newest", "close"), print)
    monkeypatch.setattr("fractions.Half", type("Half", (), methods), raising=False)
    with pytest.raises(ConfigError, match="fractions:Half has no method 'counts'"):
        load_class("cameras", {}, "fractions:Half", "camera.backend")


def test_what_a_function_makes_is_checked_as_a_class_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_maker.py").write_text(
        "class Engine:\n    def step(self, frame): ...\n\ndef make(*arguments):\n    return Engine()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for name, found in (("Engine", "own_maker:Engine"), ("make", "make()")):
        sentence = (
            f"x.engine=own_maker:{name}: {found} has no method 'warm_up'; name a class with the methods "
        )
        with pytest.raises(ConfigError, match=re.escape(sentence)):
            load_class("engines", {}, f"own_maker:{name}", "x.engine")("model")
    with pytest.raises(ConfigError, match=r"own_maker:make has no method 'spec'"):
        load_class("servos", {}, "own_maker:make", "servo.backend")


def test_a_missing_system_library_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_vendor.py").write_text("import ctypes\n\nctypes.CDLL('libvendor_is_missing.so')\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        ConfigError, match=r"can't import 'own_vendor': libvendor_is_missing\.so.*; .*install what"
    ):
        load("own_vendor:Camera")


def test_a_package_that_a_third_party_class_imports_late_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "class Shape:\n    def __init__(self):\n        import vendor_is_missing\n"
    (tmp_path / "own_late.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match="needs vendor_is_missing, which is not installed; install it"):
        load("own_late:Shape")()


def test_a_third_party_object_can_be_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_shape.py").write_text("class Shape:\n    sides = 3\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert copy(load("own_shape:Shape")()).sides == 3


@pytest.mark.parametrize(
    ("now_s", "at_s", "is_right"),
    [
        (0.0, 0.0, True),
        (0.5, 0.0, True),  # the first frame of a simulation
        (3600.0, 3601.0, True),
        (3600.0, 1800.0, True),  # the program made a pause between two cycles
        (3600.0, 3600e-9, False),  # seconds
        (3600.0, 3600e-6, False),  # milliseconds
        (3600.0, 1.8e9, False),  # seconds since 1970
    ],
)
def test_a_time_of_another_clock_or_unit_is_told_from_an_old_one(
    now_s: float, at_s: float, is_right: bool
) -> None:
    sample = LoadCellSample(round(1e9 * at_s), 1.0, 1.0)
    problem = wrong_result([sample], "list", lambda: round(1e9 * now_s))
    assert ("from the present: use the clock" in problem) is not is_right
    assert bool(problem) is not is_right
