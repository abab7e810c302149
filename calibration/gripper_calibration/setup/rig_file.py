"""The rig file of a setup: a configuration whose comments say where each value comes from; and its state."""

import json
import shlex
from collections.abc import Iterable, Mapping
from itertools import count
from pathlib import Path
from typing import Any, Final, Self

from gripper_calibration.setup.step import ANSWERED, Found
from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.jobs.profile_files import check_writable, write_all
from gripper_force.schema import Tree, assign, assign_value, read_tree, to_yaml

FORMAT: Final = "gripper-force-setup/1"
_COMMENT_COLUMN: Final = 44


class RigFile:
    """A rig file, and in a folder beside it the state of its setup.

    Attributes:
        path: The rig file.
        folder: Folder of state, pictures and measurements.
        given: Values that a person wrote into the file or passed, by key path.
        found: Values that steps found.
        steps: Finished steps: date, summary, remarks, and the values of the keys that they rest on.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.folder = path, path.with_name(f"{path.stem}-setup")
        self.given: dict[str, Found] = {}
        self.found: dict[str, Found] = {}
        self.steps: dict[str, Tree] = {}
        self._keep_original = False

    @classmethod
    def load(cls, path: Path, overrides: list[str] | None, *, fresh: bool) -> Self:
        """Reads file and state, which need not exist; ``fresh`` forgets what steps found.

        Raises:
            ConfigError: One can't be read.
        """
        rig = cls(path)
        tree = read_tree(path) if path.exists() else {}
        rig._keep_original = bool(tree) and not rig._state.exists()
        for key, value in flat(tree).items():
            rig.given[key] = Found(value, "given in this file")
        for key, old in rig._read_state().items():
            if key in rig.given and rig.given[key].value == old.value:
                del rig.given[key]
                if not fresh:
                    rig.found[key] = old
        overridden: Tree = {}
        for assignment in overrides or []:
            assign(overridden, assignment)
        for key, value in flat(overridden).items():
            rig.found.pop(key, None)
            rig.given[key] = Found(value, "given with --set")
        if fresh:
            rig.steps = {}
        return rig

    def copy_before_fresh(self) -> Path | None:
        """Copies the rig file into the folder, before a fresh start replaces it.

        Returns:
            The copy; None if there is no rig file.

        Raises:
            ConfigError: The copy can't be written.
        """
        if not self.path.exists():
            return None
        content = self.path.read_bytes()
        copies = (
            self.folder / f"before-fresh{'' if number == 1 else f'-{number}'}.yaml" for number in count(1)
        )
        # The same content is there if a fresh start ended before its first step.
        copy = next(one for one in copies if not one.exists() or one.read_bytes() == content)
        if not copy.exists():
            write_all({copy: content})
        return copy

    @property
    def _state(self) -> Path:
        return self.folder / "state.json"

    @property
    def values(self) -> dict[str, Found]:
        """All values, by key path; those that a person gave before others."""
        return {**self.found, **self.given}

    def tree(self) -> Tree:
        """Keys of the configuration."""
        tree: Tree = {}
        for key, (value, _) in self.values.items():
            assign_value(tree, key, value)
        return tree

    def take(self, values: Mapping[str, Found]) -> None:
        """Takes values that a step found. They replace given ones that differ."""
        for key, found in values.items():
            if key not in self.given or self.given[key].value != found.value:
                self.given.pop(key, None)
                self.found[key] = found

    def forget(self, name: str) -> None:
        """Drops what a step found when it ran before, but not a person's answers.

        The value that an earlier step found for the same key applies again.
        """
        for key, value in self.steps.get(name, {}).get("values", {}).items():
            if key in self.found and self.found[key].value == value[0] and value[1] != ANSWERED:
                earlier_values = [
                    s["values"][key]
                    for n, s in self.steps.items()
                    if n != name and key in s.get("values", {})
                ]
                if earlier_values:
                    self.found[key] = Found(*earlier_values[-1])
                else:
                    del self.found[key]

    def outdate(self, name: str) -> list[str]:
        """Marks the later steps that refine what a step has found anew: they run again. Returns their names."""
        order = list(self.steps)
        new_values = self.steps[name]["values"]
        outdated = [
            step
            for step in order[order.index(name) + 1 :]
            if new_values.keys() & self.steps[step].get("values", {}).keys()
        ]
        for step in outdated:
            self.steps[step]["outdated_by"] = name
        if outdated:
            self.write()
        return outdated

    def keep(self, values: Mapping[str, Found]) -> None:
        """Takes values at once, because a device has them already, and writes the rig file."""
        self.take(values)
        self.write()

    def finish(self, name: str, step: Tree, order: Iterable[str] = ()) -> None:
        """Notes a finished step, and writes the rig file and the state.

        Args:
            name: Its name.
            step: Its entry in the state.
            order: Names of all steps, in the order in which they refine each other's values.

        Raises:
            ConfigError: One can't be written.
        """
        self.steps[name] = step
        self.steps = {one: self.steps[one] for one in (*order, *self.steps) if one in self.steps}
        self.write()

    def check_writable(self) -> None:
        """Raises `ConfigError` if the rig file or the state can't be written."""
        for path in (self.path, self._state):
            check_writable(path)

    def write(self) -> None:
        """Writes the rig file and the state.

        Raises:
            ConfigError: One can't be written.
        """
        files = {self.path: self._text().encode(), self._state: self._state_text().encode()}
        if self._keep_original:
            files[self.folder / "original.yaml"] = self.path.read_bytes()
            self._keep_original = False
        write_all(files)

    def _read_state(self) -> dict[str, Found]:
        if not self._state.exists():
            return {}
        try:
            state = json.loads(self._state.read_text(encoding="utf-8"))
            steps = dict(state["steps"])
            found = {key: Found(*one) for key, one in state["found"].items()}
            format_ = state["format"]
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise ConfigError(
                f"can't read the state of the setup, {self._state}: {error}; delete it, and the steps run again"
            ) from error
        if format_ != FORMAT:
            raise ConfigError(
                f"{self._state} has the format {format_!r}, not {FORMAT!r}; delete it, and the steps run again"
            )
        self.steps = steps
        return found

    def _state_text(self) -> str:
        state = {"format": FORMAT, "steps": self.steps, "found": self.found}
        return json.dumps(state, indent=1, default=str) + "\n"

    def _text(self) -> str:
        origins = {key: found.origin for key, found in self.values.items()}
        head = (
            "# Written by `gripper-force setup`. You may change values; comments are lost when it runs again.\n"
            f"# gripper-force grasp --config {shlex.quote(str(self.path))} --target-n 3\n"
        )
        return head + "".join(f"{line}\n" for line in _lines(self.tree(), origins, list(Config.model_fields)))


def flat(tree: Tree, prefix: str = "") -> dict[str, Any]:
    """Returns the leaves of a tree by key path; an empty section is a leaf."""
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict) and value:
            leaves |= flat(value, f"{prefix}{name}.")
        else:
            leaves[f"{prefix}{name}"] = value
    return leaves


def _lines(tree: Tree, origins: Mapping[str, str], order: list[str], prefix: str = "") -> list[str]:
    lines = []
    indent = "  " * prefix.count(".")
    for name in sorted(tree, key=lambda one: order.index(one) if one in order else len(order)):
        value = tree[name]
        if isinstance(value, dict) and value:
            lines += [f"{indent}{name}:", *_lines(value, origins, [], f"{prefix}{name}.")]
            continue
        text = to_yaml(value, default_flow_style=True, width=10_000).removesuffix("...\n").strip()
        lines.append(f"{f'{indent}{name}: {text}':{_COMMENT_COLUMN}}  # {origins[f'{prefix}{name}']}")
    return lines
