"""Lookup of classes by name: built-in ones, registered entry points, and ``package.module:Class``."""

from collections.abc import Mapping
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from operator import attrgetter
from typing import Any, Final

from gripper_force.errors import ConfigError

_METHODS: Final = {"servos": "spec", "cameras": "newest", "load_cells": "drain", "engines": "step"}
"""A method of each interface, which tells its classes from others before one is called."""


def load_class(
    group: str, builtin: Mapping[str, str], name: str, key: str, *, extra: str | None = None
) -> Any:
    """Imports the class that a configuration key names.

    Args:
        group: Kind of class, such as ``engines``. Other packages register theirs as entry points of the group
            ``gripper_force.<group>`` (https://packaging.python.org/en/latest/specifications/entry-points/).
        builtin: Built-in names, and the ``module:Class`` of each. They come before registered ones.
        name: A built-in name, a registered name, or ``package.module:Class``.
        key: The configuration key that holds ``name``, for error messages.
        extra: Extra of gripper-force that installs the packages of the built-in classes.

    Raises:
        ConfigError: The name is unknown, its module or a package that it needs is not installed, or what it
            names does not exist or is not a class.
    """
    target = _target(group, builtin, name, key)
    module_name, _, attribute = target.partition(":")
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        install = f"pip install 'gripper-force[{extra}]'" if extra and name in builtin else "install it"
        raise ConfigError(f"{key}={name} needs {error.name}, which is not installed; {install}") from error
    except (ImportError, ValueError, TypeError) as error:  # the last two: an empty or relative name
        raise ConfigError(
            f"{key}={name}: can't import {module_name!r}: {error}; name it as package.module:Class"
        ) from error
    try:
        found: Any = attrgetter(attribute)(module)
    except AttributeError as error:
        raise ConfigError(
            f"{key}={name}: the module {module_name} has no attribute {attribute!r}; name one of its classes"
        ) from error
    if not callable(found):
        raise ConfigError(f"{key}={name}: {target} is not a class; name a class")
    if isinstance(found, type) and group in _METHODS and not hasattr(found, _METHODS[group]):
        raise ConfigError(
            f"{key}={name}: {target} has no method {_METHODS[group]!r}; name a class with the methods of the "
            "interface (docs/api.md)"
        )
    return found


def registered(group: str) -> dict[str, EntryPoint]:
    """Returns the entry points of the group ``gripper_force.<group>`` by name."""
    return {point.name: point for point in entry_points(group=f"gripper_force.{group}")}


def _target(group: str, builtin: Mapping[str, str], name: str, key: str) -> str:
    if name in builtin:
        return builtin[name]
    if ":" in name:
        return name
    points = registered(group)
    if name in points:
        return f"{points[name].module}:{points[name].attr}"
    known = [*builtin, *sorted(points.keys() - builtin.keys())]
    close = get_close_matches(name, known, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise ConfigError(f"unknown {key} {name!r}{hint}; use {', '.join(known)} or package.module:Class")
