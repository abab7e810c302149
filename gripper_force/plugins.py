"""Lookup of classes by name: built-in ones, registered entry points, and ``package.module:Class``."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from operator import attrgetter
from typing import Any, Final

from gripper_force.errors import ConfigError, DeviceError, GripperError

_METHODS: Final = {
    "servos": dict.fromkeys(("spec", "start", "write", "stop", "close"), "object") | {"read": "ServoState"},
    "cameras": {"newest": "Frame NoneType", "start": "object", "counts": "dict", "close": "object"},
    "load_cells": {"drain": "list tuple", "start": "object", "counts": "dict", "close": "object"},
    "engines": {"step": "StepOutput", "warm_up": "object", "reset": "object"},
}
"""Methods of each interface, each with the names of the types that it may return.

A class, or the object that a function returns, is checked for the methods before it is used. A wrong type is reported
here, where the class is known. They are names, because importing the types takes time.
"""

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
        found: Any = attrgetter(attribute)(module)
    except AttributeError as error:
        raise ConfigError(
            f"{key}={name}: the module {module_name} has no attribute {attribute!r}; name one of its classes"
        ) from error
    if not callable(found):
        raise ConfigError(f"{key}={name}: {target} is not a class; name a class")
    if isinstance(found, type) or group == "servos":  # `spec` is read before a servo is made
        _check_methods(found, group, f"{key}={name}: {target}")
    return found if name in builtin else _Plugin(found, group, f"{key}={name}: {attribute}")


def _check_methods(part: Any, group: str, name: str) -> None:
    if missing := [method for method in _METHODS.get(group, ()) if not hasattr(part, method)]:
        raise ConfigError(
            f"{name} has no method {missing[0]!r}; name a class with the methods that {_interface(group)} describes"
        )


def _interface(group: str) -> str:
    return f"gripper_force.{'vision.engines.Engine' if group == 'engines' else 'interfaces'}"


class _Plugin:
    """A third-party class, or an object that it made: an error of its code names it, its method and the error."""

    def __init__(self, part: Any, group: str, name: str) -> None:
        self._part, self._group, self._name = part, group, name
        self._error_type: type[GripperError] = ConfigError if group == "engines" else DeviceError

    def __getattr__(self, name: str) -> Any:
        # Not self._part: copy and pickle ask an object that has none yet.
        value = getattr(object.__getattribute__(self, "_part"), name)
        return partial(self._call, value, f"{self._name}.{name}") if callable(value) else value

    def __call__(self, *arguments: Any) -> Any:
        made = self._call(self._part, self._name, *arguments)
        _check_methods(made, self._group, f"{self._name}()")
        return _Plugin(made, self._group, self._name)

    def _call(self, function: Callable[..., Any], called: str, *arguments: Any, **named: Any) -> Any:
        try:
            with importing(called):  # a package may be imported only now
                result = function(*arguments, **named)
        except GripperError:
            raise
        except Exception as error:
            raise self._error_type(
                f"{called}() raised {type(error).__name__}: {' '.join(str(error).split())}; it is no part of "
                "gripper-force: correct it, or tell its author"
            ) from error
        expected = _METHODS.get(self._group, {}).get(called.rpartition(".")[2], "object").split()
        if not any(base.__name__ in expected for base in type(result).__mro__):
            found = f"{called}() returned {type(result).__name__}"
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
    close = get_close_matches(name, known, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise ConfigError(f"unknown {key} {name!r}{hint}; use {', '.join(known)} or package.module:Class")
