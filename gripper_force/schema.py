"""Shared base of YAML-backed models: base class, number types, loading, and error messages."""

import re
from collections.abc import Callable, Hashable, Iterator
from difflib import get_close_matches
from inspect import isclass
from math import isclose
from os import PathLike
from os.path import expanduser
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar, dataclass_transform, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from pydantic.fields import FieldInfo

from gripper_force.errors import ConfigError

# No quantity of a gripper is beyond these bounds, and values computed from it stay finite.
Positive = Annotated[float, Field(ge=1e-9, le=1e9, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]

Tree = dict[str, Any]
"""A mapping of keys to values and subtrees, as read from YAML."""


# Type checkers without a plugin for pydantic see a default in Field(default=1.2), but not in Field(1.2). This makes
# them take each Field(...) for a default, so that users can write ServoConfig(id=2).
@dataclass_transform(kw_only_default=True)
class Section(BaseModel):
    """Base class of every section: immutable; an unknown key is an error.

    Attributes:
        unknown_hint: Sentence for a user who looks for a key that the section does not have.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    unknown_hint: ClassVar[str] = ""

    @field_validator("*", mode="wrap")
    @classmethod
    def _checked(cls, value: Any, validate: Callable[[Any], Any]) -> Any:
        # Some keys of text may hold a path, such as vision.checkpoint.
        valid = validate(str(value) if isinstance(value, Path) else value)
        if isinstance(value, bool) and isinstance(valid, int | float) and not isinstance(valid, bool):
            raise ValueError("it is a number, not true or false")  # noqa: TRY004  # as pydantic needs
        return Path(expanduser(valid)) if isinstance(valid, Path) else valid  # noqa: PTH111  # that one may raise

    def filled(self, **values: Any) -> Self:
        """Returns a copy in which the keys that are None have these values, which are not validated."""
        return self.model_copy(update={k: v for k, v in values.items() if getattr(self, k) is None})


S = TypeVar("S", bound=Section)

_YAML_ERRORS = (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, RecursionError)
"""Exceptions of the YAML parser, among others for a date !!timestamp 2001-99-99, and a tag !!bool x."""

_SCALARS = {
    "bool": "true|True|TRUE|false|False|FALSE",
    "int": "[-+]?(?!0[0-9]*[89])[0-9]+|0x[0-9a-fA-F]+",
    "float": r"([-+]?[0-9]+\.[0-9]*|\.[0-9]+)([eE][-+][0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
    "null": "~|null|Null|NULL|",
    "merge": "<<",
}
"""Patterns of values without quotes that are no text, by tag.

YAML 1.1, as PyYAML writes it without quotes, and the core schema of YAML 1.2
(https://yaml.org/spec/1.2.2/#103-core-schema) agree on these values. The only exception is 010, which is 10 here. Other
values, such as 1e-3 and 08, are text; a key that needs a number converts them.
"""


def as_path(path: object, what: str, remedy: str = "name a file") -> Path:
    """Returns an argument as a path. Raises `ConfigError` for what can't be one."""
    if not isinstance(path, str | PathLike) or "\0" in str(path):
        raise ConfigError(f"{what} must be a path, not {path!r}; {remedy}")
    return Path(path)


def read_tree(path: Path, what: str = "configuration") -> Tree:
    """Reads the keys of a YAML file. Raises `ConfigError` that names the file."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"can't read the {what} {path}: {reason}; name a YAML file") from error
    return tree_from(text, str(path), what)


def tree_from(text: str, where: str, what: str = "configuration") -> Tree:
    """Parses the keys of a YAML text. Raises `ConfigError` that names ``where``."""
    loaded = _parse(text, f"can't read the {what} {where}")
    if not isinstance(loaded, dict | None):
        raise ConfigError(f"{where} must hold a mapping at its top level, with lines such as `key: value`")
    return loaded or {}


def dump(section: Section) -> str:
    """A complete section as YAML."""
    return to_yaml(section.model_dump(mode="json"))


def to_yaml(value: Any, **options: Any) -> str:
    """A value as YAML, with the options of ``yaml.dump``. Text that any YAML reads as a number is in quotes."""
    return str(yaml.dump(value, Dumper=_Dumper, sort_keys=False, **options))


def assign(tree: Tree, assignment: str) -> None:
    """Assigns ``key.path=value`` in a tree; the value is read as YAML. Raises `ConfigError`."""
    key, equals, text = assignment.partition("=")
    if not equals or not key:
        raise ConfigError(f"--set needs key.path=value, got {assignment!r}")
    assign_value(tree, key, _parse(text, f"--set {key}: {text!r} is not a YAML value"))


def assign_value(tree: Tree, key: str, value: Any) -> None:
    """Assigns a value to a key path in a tree. Raises `ConfigError`."""
    *parents, leaf = str(key).split(".")
    for parent in parents:
        tree = tree.setdefault(parent, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"--set {key}: {parent!r} is a value, not a section; name a key of a section")
    tree[leaf] = value


def merged(base: Tree, override: Tree) -> Tree:
    """Merges two trees; where both have a key, the value of ``override`` counts."""
    result = dict(base)
    for key, value in override.items():
        old = result.get(key)
        result[key] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result


def validated(section: type[S], tree: Tree, where: str, what: str = "configuration") -> S:
    """Builds a section from a tree of keys.

    Args:
        section: What to build.
        tree: Keys that differ from the defaults.
        where: Origin of the keys, for the error.
        what: Name of the kind of section, for the error.

    Raises:
        ConfigError: A key or value is wrong.
    """
    try:
        return section.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(_sentence(section, error, where, what)) from error


def check_keys(section: type[Section], tree: Tree, where: str) -> None:
    """Raises `ConfigError` for an unknown key in a tree. Other errors, such as wrong values, are left."""
    try:
        section.model_validate(tree)
    except ValidationError as error:
        if any(one["type"] == "extra_forbidden" for one in error.errors()):
            raise ConfigError(_sentence(section, error, where, "configuration")) from error


def read_section(section: type[S], path: Path, format_: str, what: str) -> S:
    """Reads a YAML file that states its format under the key ``format``.

    Raises:
        ConfigError: It can't be read, is of another format, or a key or value is wrong.
    """
    tree = read_tree(path, what)
    if tree.get("format") != format_:
        raise ConfigError(
            f"{path} does not have the {what} format {format_} (it is {tree.get('format')!r}); make one with "
            "`gripper-force calibrate`"
        )
    return validated(section, tree, str(path), what)


def differences(expected: Tree, run: Tree) -> list[str]:
    """Describes the keys in which a run differs, as text. Missing keys, and lengths within 5 %, do not differ."""
    pairs = [(key, value, run[key]) for key, value in expected.items() if key in run and run[key] != value]
    close = [type(a) is type(b) is float and isclose(a, b, rel_tol=0.05) for _, a, b in pairs]
    return [f"{key} {a}, not {b}" for (key, a, b), is_same in zip(pairs, close, strict=True) if not is_same]


def keys(section: type[Section], under: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Yields the path and the field of every key of a section and its subsections."""
    for name, field in section.model_fields.items():
        kind = field.annotation
        if isclass(kind) and issubclass(kind, Section):
            yield from keys(kind, f"{under}{name}.")
        else:
            yield f"{under}{name}", field


class _Dumper(yaml.SafeDumper):
    """YAML writer, for readers of YAML 1.1 and 1.2."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # libyaml is 10 times as fast
    """YAML 1.2 loader that refuses a key that occurs twice: the first one would be lost."""

    yaml_implicit_resolvers = dict[str, list[Any]]()  # noqa: RUF012  # in place of those of YAML 1.1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        names = [key.value for key, _ in node.value]
        for i, (key, _) in enumerate(node.value):
            if key.value in names[:i] and key.value != "<<":
                line = key.start_mark.line + 1
                raise ValueError(f"line {line}: the key {key.value!r} occurs twice; join its two parts")
        return dict(super().construct_mapping(node, deep))

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        text = str(self.construct_scalar(node))
        return int(text, 16 if text.startswith("0x") else 10)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
for _tag, _pattern in _SCALARS.items():
    for _kind in (_Dumper, _Loader):
        _kind.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"({_pattern})$"), None)


def _parse(text: str, what_fails: str) -> Any:
    try:
        return yaml.load(text, _Loader)  # noqa: S506  # it is a safe loader
    except _YAML_ERRORS as error:
        raise ConfigError(f"{what_fails}: {_reason(error, text)}") from error


def _reason(error: Exception, text: str) -> str:
    """Returns why the parser failed on a text, with the line."""
    if not isinstance(error, yaml.MarkedYAMLError) or (mark := error.problem_mark) is None:
        return " ".join(str(error).split())
    if re.match(rf"(.*\n){{{mark.line}}} *\t", text):
        return f"line {mark.line + 1} is indented with a tab; use spaces"
    return f"line {mark.line + 1}: {error.problem}; check indentation, quotes and brackets up to there"


def _sentence(root: type[Section], error: ValidationError, where: str, what: str) -> str:
    # A misspelt key is the cause of the missing one, too.
    first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
    parts = [str(part) for part in first["loc"]]
    key = ".".join(parts)
    if first["type"] == "extra_forbidden":
        section = _section_at(root, parts[:-1])
        hint = _suggestion(root, parts)
        more = f". {section.unknown_hint}" if section.unknown_hint else ""
        return f"unknown {what} key {key!r} (from {where}){hint}; known here: {', '.join(section.model_fields)}{more}"
    reason = first["msg"].removeprefix("Value error, ").removesuffix(" for <class 'pathlib.Path'>")
    if not parts:
        return f"the {what} (from {where}) is inconsistent: {reason}"
    if first["type"] == "model_type":
        return f"{what} key {key!r} (from {where}) is a section, got {first['input']!r}; write keys below it"
    return f"{what} key {key!r} (from {where}): {reason}, got {first['input']!r}"


def _suggestion(root: type[Section], parts: list[str]) -> str:
    """Names the most similar known key path: first in the same section, then in all sections."""
    prefix = "".join(f"{part}." for part in parts[:-1])
    known = list(_section_at(root, parts[:-1]).model_fields)
    in_section = [f"{prefix}{name}" for name in get_close_matches(parts[-1], known, 1)]
    paths = [path for path, _ in keys(root)]
    same_leaf = [path for path in paths if path.rpartition(".")[2] == parts[-1]]
    matches = in_section or same_leaf or get_close_matches(".".join(parts), paths, 1)
    return f"; did you mean {matches[0]!r}?" if matches else ""


def _section_at(root: type[Section], parts: list[str]) -> type[Section]:
    """Returns the section at a path, through optional sections and tuples of sections."""
    section = root
    for part in parts:
        if part in section.model_fields:
            annotation = section.model_fields[part].annotation
            kinds = (annotation, *get_args(annotation))
            section = next((kind for kind in kinds if isclass(kind) and issubclass(kind, Section)), section)
    return section
