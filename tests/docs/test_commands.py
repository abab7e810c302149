"""Every command of the pages is parsed by the real command line, with its keys.

A block whose first line is ``# needs hardware`` has commands for a real rig. They are parsed, too.
"""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer

from gripper_force import cli
from gripper_force.cli.output.calibrate import SERVO
from gripper_force.config import Config, load_with_options
from gripper_force.jobs.grasp import GraspSummary, exclusive_device
from gripper_force.jobs.training.recipe import TrainConfig, recipe, section_from
from gripper_force.qualification.paper.models import Scale

ROOT = Path(__file__).parents[2]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
    *sorted(path for path in (ROOT / "docs").rglob("*.md") if path.parent.name != "decisions"),
]
MARK = "# needs hardware"
BLOCK = re.compile(r"^ *```([^\n]*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`]+)`")
WITHOUT_CONFIGURATION = {"bench bus", "bench startup", "bench scene", "bench commands", "bench checkpoints"}
WITHOUT_CONFIGURATION |= {"calibrate network", "view"}


@dataclass(frozen=True)
class Line:
    """A command as a page shows it."""

    page: Path
    text: str
    hardware: bool = False

    @property
    def words(self) -> list[str]:
        return shlex.split(self.text, comments=True)

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}: {self.text}"


@dataclass(frozen=True)
class Call:
    """A parsed command: its name, and the values of its parameters."""

    name: str
    values: dict[str, Any]


def block_lines(page: Path) -> Iterator[Line]:
    """Yields the commands of a page's blocks."""
    for language, body in BLOCK.findall(page.read_text()):
        if language.strip() not in ("", "sh"):
            continue
        hardware = body.lstrip().startswith(MARK)
        for text in body.replace("\\\n", " ").splitlines():
            start = re.search(r"(^|/bin/|--no-python )gripper-force ", text.strip())
            if start is not None and not text.strip().startswith("#"):
                yield Line(page, re.split(r" [<|] ", text.strip()[start.end() :])[0], hardware)


def inline_commands(page: Path) -> Iterator[Line]:
    """Yields the commands in a page's sentences."""
    text = BLOCK.sub("", page.read_text())
    for code in INLINE.findall(text):
        command = " ".join(code.split())
        if command.startswith("gripper-force ") and "..." not in command:
            yield Line(page, command.removeprefix("gripper-force "))


BLOCKS = [line for page in PAGES for line in block_lines(page)]
SENTENCES = [line for page in PAGES for line in inline_commands(page)]


@cache
def recorder() -> tuple[Any, list[Call]]:
    """The command line, whose commands note their call instead of running, and the notes. Making it takes time."""
    calls: list[Call] = []
    root: Any = typer.main.get_group(cli.app)  # of its own: it is changed

    def record(command: Any, name: str) -> None:
        if hasattr(command, "commands"):
            for child, one in command.commands.items():
                record(one, f"{name} {child}".strip())
        else:
            command.callback = lambda **values: calls.append(Call(name, values))

    record(root, "")
    return root, calls


def parse(words: list[str]) -> Call:
    """Parses a command without running it. Raises what the command line raises."""
    root, calls = recorder()
    calls.clear()
    root.main(words, standalone_mode=False)
    (call,) = calls
    return call


def with_files(page: Path, folder: Path) -> None:
    """Writes the files that a page shows: a name in code, a colon, and a block of YAML."""
    for name, text in re.findall(r"`([\w-]+\.yaml)`:\n\n```yaml\n(.*?)```", page.read_text(), re.DOTALL):
        (folder / name).write_text(text)


def check_keys(call: Call) -> Config | None:
    """Checks keys and values of ``--set``. Returns the configuration of commands that have one."""
    overrides = call.values["set_"] or []
    if call.name in WITHOUT_CONFIGURATION:
        assert not overrides
    elif call.name == "train":
        recipe(call.values["recipe"], overrides)
    elif call.name == "bench training":
        section_from(TrainConfig, overrides)
    elif call.name == "reproduce":
        section_from(Scale, overrides)
    else:
        path = call.values.get("config")
        return load_with_options(path if path and path.exists() else None, overrides, {}, new_rig=True)
    return None


def test_the_pages_have_commands() -> None:
    assert len(BLOCKS) > 100
    assert len(SENTENCES) > 20
    assert sum(line.hardware for line in BLOCKS) > 5


@pytest.mark.parametrize("line", BLOCKS, ids=str)
def test_a_command_of_a_block_is_accepted(
    line: Line, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for word in line.words:
        if re.match(r"(examples|docs|hw|calibration)/", word):
            assert (ROOT / word).exists(), word
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    with_files(line.page, tmp_path)
    call = parse(line.words)
    config = check_keys(call)
    if config is None:
        return
    file = call.values.get("config")
    is_virtual = config.servo.port.startswith("virtual:")
    described = file is None or file.exists() or is_virtual_by_key(call)
    real = (not is_virtual and exclusive_device(config) != "") or not described
    assert line.hardware == real, f"a command for a real rig stands in a block that begins with {MARK!r}"


def is_virtual_by_key(call: Call) -> bool:
    """Returns True if ``--set`` makes the rig of a file that does not exist here a simulated one."""
    return any(str(one).startswith("servo.port=virtual:") for one in call.values["set_"] or [])


@pytest.mark.parametrize("line", SENTENCES, ids=str)
def test_a_command_in_a_sentence_is_accepted(line: Line) -> None:
    command: Any = typer.main.get_command(cli.app)
    words = line.words
    while words and hasattr(command, "commands") and words[0] in command.commands:
        command = command.commands[words.pop(0)]
    if not words:
        return  # the name of a command, or of a group
    if hasattr(command, "commands") and "network" in command.commands:
        command = command.commands["network"]  # `export` alone
    known = {name for parameter in command.params for name in parameter.opts} | {"--help"}
    assert not {word.partition("=")[0] for word in words if word.startswith("--")} - known


def test_the_page_has_the_keys_of_a_grasp() -> None:
    table = (ROOT / "docs/commands.md").read_text(encoding="utf-8").split("The keys of `grasp`:")[1]
    rows = re.findall(r"^\| (`[^|]+) \|", table.partition("## ")[0], re.MULTILINE)
    keys = [key for row in rows for key in INLINE.findall(row)]
    assert sorted(keys) == sorted(GraspSummary.__annotations__)


def test_the_tutorial_has_lines_of_calibrate_servo() -> None:
    page = (ROOT / "docs/tutorials/calibrate.md").read_text(encoding="utf-8")
    block = page.partition("```text\n")[2].partition("```")[0]
    names = [re.split(r" {2,}", line)[0] for line in block.splitlines()]
    assert names
    assert set(names) <= set(SERVO.values())
