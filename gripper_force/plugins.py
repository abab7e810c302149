"""Lookup of classes by name: built-in ones, registered entry points, and ``package.module:Class``."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from numbers import Integral, Real
from operator import attrgetter
from typing import Any, Final

from gripper_force.errors import ConfigError, DeviceError, GripperError

_METHODS: Final = {
    "servos": dict.fromkeys(("spec", "start", "write", "stop", "close"), "object")
    | {"spec": "ServoSpec", "read": "ServoState"},
    "cameras": {"newest": "Frame NoneType", "start": "object", "counts": "dict", "close": "object"},
    "load_cells": {"drain": "list tuple", "start": "object", "counts": "dict", "close": "object"},
    "engines": {"step": "StepOutput", "warm_up": "object", "reset": "object"},
}
"""Methods of each interface, each with the names of the types that it may return.

A class, or the object that a function returns, is checked for the methods before it is used. A wrong type is reported
here, where the class is known. They are names, because importing the types takes time.
"""

_ATTRIBUTES: Final = {"servos": {"stats": "BusStats"}, "engines": {"header": "Header"}}
"""The same for attributes of the objects."""

EXTRAS: Final = {
    **dict.fromkeys(("torch", "onnx", "onnxscript"), "train"),
    "mujoco": "sim",
    "depthai": "oak",
    "scipy": "calibrate",
    "matplotlib": "report",
    **dict.fromkeys(("openvino", "nncf"), "engines"),
    **dict.fromkeys(("rerun", "foxglove"), "view"),
    "lerobot": "lerobot",
    "pyarrow": "parquet",
    "Phidget22": "phidget",
    "ray": "ray",
}
"""Extra of gripper-force that installs each optional module."""


@contextmanager
def importing(purpose: str, alternative: str = "") -> Iterator[None]:
    """Raises `ConfigError` if a package that the block imports is not installed: what needs it, and its extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        remedy = f"pip install 'gripper-force[{extra}]'" if extra else "install it"
        raise ConfigError(
            f"{purpose} needs {error.name}, which is not installed; {remedy}{alternative}"
        ) from error


def require(module: str, purpose: str, alternative: str = "") -> None:
    """Raises `ConfigError` if a module is not installed, without importing it; see `importing`."""
    with importing(purpose, alternative):
        if find_spec(module) is None:
            raise ModuleNotFoundError(name=module)


def load_class(group: str, builtin: Mapping[str, str], name: str, key: str, alternative: str = "") -> Any:
    """Imports the class that a configuration key names.

    Args:
        group: Kind of class, such as ``engines``. Other packages register theirs as entry points of the group
            ``gripper_force.<group>`` (https://packaging.python.org/en/latest/specifications/entry-points/).
        builtin: Built-in names, and the ``module:Class`` of each. They come before registered ones.
        name: A built-in name, a registered name, or ``package.module:Class``.
        key: The configuration key that holds ``name``, for error messages.
        alternative: Another remedy if a package is not installed; see `importing`.

    Returns:
        The class. A class that is not built in is wrapped, and so are its objects: if a method raises, or returns a
        wrong type, the error is a `DeviceError` of one sentence, for an engine a `ConfigError`.

    Raises:
        ConfigError: The name is unknown, its module or a package that it needs is not installed, or what it
            names does not exist or is not a class.
    """
    target = _target(group, builtin, name, key)
    module_name, _, attribute = target.partition(":")
    try:
        with importing(f"{key}={name}", alternative):
            module = import_module(module_name)
    except ConfigError:
        raise
    except Exception as error:  # also of an empty or relative name, and of the module's own code
        raise ConfigError(
            f"{key}={name}: can't import {module_name!r}: {error}; name it as package.module:Class, and install what "
            "its module needs"
        ) from error
    try:
        target_class: Any = attrgetter(attribute)(module)
    except AttributeError as error:
        raise ConfigError(
            f"{key}={name}: the module {module_name} has no attribute {attribute!r}; name one of its classes"
        ) from error
    if not callable(target_class):
        raise ConfigError(f"{key}={name}: {target} is not a class; name a class")
    if isinstance(target_class, type) or group == "servos":  # `spec` is read before a servo is made
        _check_methods(target_class, group, f"{key}={name}: {target}")
    return target_class if name in builtin else _Plugin(target_class, group, f"{key}={name}: {attribute}")


def _check_methods(part: Any, group: str, name: str) -> None:
    if missing := [method for method in _METHODS.get(group, ()) if not callable(getattr(part, method, None))]:
        raise ConfigError(
            f"{name} has no method {missing[0]!r}; name a class with the methods that {_interface(group)} describes"
        )


def _interface(group: str) -> str:
    return f"gripper_force.{'vision.engines.Engine' if group == 'engines' else 'interfaces'}"


def wrong_result(result: Any, expected: str, now_ns: Callable[[], int] | None = None) -> str:
    """Returns what is wrong with a result of third-party code, or an empty text.

    Args:
        result: The result. The fields of a record and the items of a list are checked, too.
        expected: Names of the types that it may have.
        now_ns: Returns the time on the run's clock; None: times are not compared with it. A time more than 10 s after
            it is of another clock, and one below a thousandth of it in another unit. Others may be old: a program that
            calls `Gripper.step` may pause.
    """
    packages = ("builtins", "gripper_force.")  # another class may have the same name
    names = {base.__name__ for base in type(result).__mro__ if base.__module__.startswith(packages)}
    if names.isdisjoint(expected.split()):
        return type(result).__name__
    if expected == "dict":
        wrong = [f"{{{k!r}: {n!r}}}" for k, n in result.items() if not (isinstance(k, str) and _is_count(n))]
        return f"{wrong[0]}, which is no name with a whole number of 0 or more" if wrong else ""
    if isinstance(result, list | tuple):
        return next(filter(None, (wrong_result(item, "LoadCellSample", now_ns) for item in result)), "")
    for field in fields(result) if is_dataclass(result) else ():
        value, kind = getattr(result, field.name), str(getattr(field.type, "__name__", field.type))
        if problem := _wrong_value(field.name, kind, value, now_ns):
            return f"a {type(result).__name__} whose {field.name} is {problem}"
        if field.name == "valid" and value and not math.isfinite(result.force_n):
            return f"a valid LoadCellSample whose force_n is {result.force_n}, which is not finite"
    return ""


def _wrong_value(name: str, kind: str, value: Any, now_ns: Callable[[], int] | None) -> str:
    """Returns the value of a record's field and what is wrong with it, or an empty text."""
    if kind == "float" and not isinstance(value, Real):
        return f"{value!r:.60}, not a number"
    if kind == "int" and not _is_count(value):
        return f"{value!r:.60}, not a whole number of 0 or more"
    if name == "gray" and not (getattr(value, "dtype", "") == "uint8" and value.ndim == 2 and value.size):
        image = f"{getattr(value, 'dtype', type(value).__name__)} {getattr(value, 'shape', '')}".strip()
        return f"{image}, not an image, (H, W) uint8"
    if now_ns and name in ("t_ns", "received_ns"):
        now_s, at_s = now_ns() / 1e9, value / 1e9
        if not (now_s - 1) / 1000 <= at_s <= now_s + 10:
            remedy = "use the clock that the class gets, in nanoseconds"
            return f"{value}, {at_s - now_s:+.3g} s from the present: {remedy}"
    return ""


def _is_count(value: Any) -> bool:
    return isinstance(value, Integral) and 0 <= int(value) < 2**63


class _Plugin:
    """A third-party class, or an object that it made: an error of its code names it, its method and the error."""

    def __init__(self, part: Any, group: str, name: str, now_ns: Callable[[], int] | None = None) -> None:
        self._part, self._group, self._name, self._now_ns = part, group, name, now_ns
        self._error_type: type[GripperError] = ConfigError if group == "engines" else DeviceError

    def __getattr__(self, name: str) -> Any:
        # Not self._part: copy and pickle ask an object that has none yet.
        value = getattr(object.__getattribute__(self, "_part"), name)
        return partial(self._call, value, f"{self._name}.{name}") if callable(value) else value

    def __call__(self, *arguments: Any) -> Any:
        instance = self._call(self._part, self._name, *arguments)
        _check_methods(instance, self._group, f"{self._name}()")
        for name in _ATTRIBUTES.get(self._group, ()):
            self._call(getattr, f"{self._name}.{name}", instance, name, None)  # checks it
        # The second argument of a device is its clock, or the function. No result of an engine has a time.
        clock = next(iter(arguments[1:]), None)
        return _Plugin(instance, self._group, self._name, getattr(clock, "now_ns", clock))

    def _call(self, function: Callable[..., Any], called: str, *arguments: Any, **keywords: Any) -> Any:
        try:
            with importing(called):  # a package may be imported only now
                result = function(*arguments, **keywords)
        except GripperError:
            raise
        except Exception as error:
            raise self._error_type(
                f"{called}() raised {type(error).__name__}: {' '.join(str(error).split())}; it is no part of "
                "gripper-force: correct it, or tell its author"
            ) from error
        types = _METHODS.get(self._group, {}) | _ATTRIBUTES.get(self._group, {})
        if problem := wrong_result(result, types.get(called.rpartition(".")[2], "object"), self._now_ns):
            found = f"{called}() returned {problem}"
            raise self._error_type(f"{found}; return what {_interface(self._group)} says")
        return result


def registered(group: str) -> dict[str, EntryPoint]:
    """Returns the entry points of the group ``gripper_force.<group>`` by name."""
    return {point.name: point for point in entry_points(group=f"gripper_force.{group}")}


def _target(group: str, builtin: Mapping[str, str], name: str, key: str) -> str:
    if name in builtin:
        return builtin[name]
    if ":" in name:
        return name
    points = list(entry_points(group=f"gripper_force.{group}"))
    targets = sorted({f"{point.module}:{point.attr}" for point in points if point.name == name})
    if len(targets) > 1:
        raise ConfigError(
            f"{key}={name} is registered for {' and '.join(targets)}; set {key} to one of these"
        )
    if targets:
        return targets[0]
    known = [*builtin, *sorted({point.name for point in points} - builtin.keys())]
    matches = get_close_matches(name, known, n=1)
    hint = f" (did you mean {matches[0]!r}?)" if matches else ""
    raise ConfigError(f"unknown {key} {name!r}{hint}; use {', '.join(known)} or package.module:Class")
