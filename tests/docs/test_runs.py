"""The commands of each page run in order, as a reader runs them: in one new folder, with user folders of its own.

`make test` runs the pages in `QUICK`, `make test-docs` all of them. A block whose first line begins with ``# needs``
(hardware, root, a display) is not run, but see `SIMULATED`. The tables below shorten long commands; they keep the command
and its own options.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import matplotlib
import pytest
from typer.testing import CliRunner

from gripper_force import cli

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^ *```([^\n]*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
README = ROOT / "README.md"
PAGES = [
    README,
    ROOT / "CONTRIBUTING.md",
    *sorted(path for path in (ROOT / "docs").rglob("*.md") if path.parent.name != "decisions"),
]
QUICK = {"docs/commands.md", "docs/index.md"}
"""Pages that take some seconds."""

SIMULATED = {"README.md", "docs/your-own-rig.md"}
"""Pages whose commands for a real rig run, too: on a simulated one, with a simulated object."""

ADDED = {
    "setup": "--yes --set servo.port=virtual:rig",
    "grasp --object tube --target-n 3": "--set camera.rate_hz=20",
    "grasp --object none": "--set camera.rate_hz=20",
    "grasp": "--set sim.detail=coarse --set log.report=false --set control.hold_s=0.3",
    "calibrate object": "--touches 4 --set sim.detail=coarse",
    "teach": "--touches 4 --set sim.detail=coarse --set vision.checkpoint=small",
    "simulate": "--presses 0 --grasps 0 --set sim.detail=coarse",
    "train data/train": "--set steps=2",
    "stability numerics": "--part filter",
    "stability faults": "--table faults --seeds 1 --live 0",
    "bench estimator": "--threads 1",
}
"""Options that shorten a command. They stand before its own, which win."""

REPLACED = {
    r'overrides=\["object=sponge"\]': 'overrides=["object=sponge", "sim.detail=coarse", "camera.rate_hz=20"]',
    r"\bmug\b": "lemon",
    " --pause": "",  # nobody is there to press Enter
    r"\bcontrol\.hold_s=[1-9]\d*": "control.hold_s=0.3",
    r"--trials \d+": "--trials 2",
    r"--(presses|taps|grasps) [1-9]\d*": r"--\1 5",
    r"--sets \d+": "--sets 2",
    r"--touches ([5-9]|\d\d)": "--touches 4",
    r"(\bminutes=|--minutes )\d+": r"\g<1>0.02",
    r"\bsteps=\d+": "steps=2",
}
"""An object that the simulation has, and numbers that turn hours of simulation and training into seconds."""

STAPLER = "gripper-force grasp --object stapler"
PREPARED = {
    "gripper-force replay runs/LOG.mcap": f"test -e runs/LOG.mcap || {{ {STAPLER} && mv runs/*.mcap runs/LOG.mcap; }}",
    "gripper-force view runs/LOG.mcap": f"test -e runs/LOG.mcap || {{ {STAPLER} && mv runs/*.mcap runs/LOG.mcap; }}",
    "gripper-force export network force.": f"cp {ROOT}/gripper_force/vision/small.safetensors force.safetensors",
    "gripper-force export lerobot data/real": f"{STAPLER} --set log.directory=data/real",
    "gripper-force train data/mine": "cp -r data/train data/mine",
    "gripper-force calibrate network data/score": "cp -rn data/busy data/score",
    'python -c \'import gripper_force as gf\n\nwith gf.open_gripper("my.yaml"': "echo 'object: sponge' > my.yaml",
    'python -c \'import gripper_force as gf\n\nlog = gf.LogReader("run.mcap"': f"{STAPLER} && mv runs/*.mcap run.mcap",
}
"""Files that a page needs before a command: a log, a network, or the reader's own."""

NOT_RUN = {
    "pip install": "downloads; the workflow `test` installs the wheel",
    "python3 -m venv": "downloads",
    "GRIPPER_FORCE_CLIENT_PYTHON=": "needs the environment of the line before",
    "lerobot-record": "`make test-lerobot` runs it",
    "gripper-force reproduce": "takes hours; tests/qualification/paper runs it with tiny networks",
    "gripper-force simulate --protocol": "80 logs; tests/jobs runs it",
    "gripper-force bench checkpoints data/stated": "writes into the shipped checkpoints",
    "python -c 'from threading import": "needs an arm; tests/hw/dynamixel shares a port",
    "python -c 'import pytest": "a frame for a class of the reader; tests/examples runs one",
    "python -c 'estimator = ": "needs frames of the reader; tests/vision streams some",
    "python -c 'from lerobot": "`make test-lerobot` reads a dataset",
}
"""Beginnings of commands that are not run, with the reason."""

PACKAGES = {"gripper-force view": "rerun", "gripper-force export lerobot": "lerobot"}
"""Optional packages, without which a command is not run."""

EXIT_CODES = {
    "gripper-force grasp --object none": 1,
    "gripper-force grasp --object peach.yaml --target-n 3": 1,
    "gripper-force grasp --set sim.friction=4 --set target_n=3": 1,
}
"""Documented exit codes other than 0."""


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def shown_lines(page: Path) -> list[str]:
    """Returns commands and Python of a page's blocks, but not what needs something, or stands in the README, too."""
    lines = []
    for language, body in BLOCK.findall(page.read_text()):
        if page != README and body in README.read_text():
            continue
        mark = re.match(r"\s*# needs (\w+)", body)
        runs = mark is None or (mark[1] == "hardware" and name_of(page) in SIMULATED)
        if language.strip() == "python" and runs:
            lines.append(shlex.join(["python", "-c", body]))
        if language.strip() in ("", "sh") and runs:
            for line in re.sub(r" *\\\n *", " ", body).splitlines():
                lines.append(re.sub(r"\s+# .*|^# .*", "", line).strip())
    return [line for line in lines if line]


def shortened(line: str) -> str:
    """Returns a command with the options that shorten it."""
    for name, options in ADDED.items():
        if " --from " in line:  # which records no touches
            options = options.replace("--touches 4 ", "")
        line = re.sub(rf"(gripper-force {name}) ", rf"\1 {options} ", f"{line} ").strip()
    for pattern, text in REPLACED.items():
        line = re.sub(pattern, text, line)
    return re.sub(r"^make ", "make --dry-run ", line)


def reason_not_to_run(line: str) -> str | None:
    for begin, reason in NOT_RUN.items():
        if line.startswith(begin):
            return reason
    for begin, package in PACKAGES.items():
        if line.startswith(begin) and find_spec(package) is None:
            return f"needs {package}"
    return None


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A folder with what commands use of a clone: they may write into the pages, but not change the project."""
    folder = tmp_path / "clone"
    shutil.copytree(ROOT / "docs", folder / "docs")
    for name in ("Makefile", "pyproject.toml", "examples", "scripts", "tests"):
        (folder / name).symlink_to(ROOT / name)
    (folder / ".venv").symlink_to(sys.prefix)
    return folder


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name_of(page), marks=() if name_of(page) in QUICK else pytest.mark.docs)
        for page in PAGES
        if shown_lines(page)
    ],
)
def test_the_commands_of_a_page_run(page: Path, clone: Path) -> None:
    text = page.read_text()
    for name, shown in re.findall(r"`([\w-]+\.yaml)`:\n\n```yaml\n(.*?)```", text, re.DOTALL):
        (clone / name).write_text(shown)
    env = {
        **os.environ,
        "PATH": f"{sys.prefix}/bin{os.pathsep}{os.environ['PATH']}",
        "MPLCONFIGDIR": matplotlib.get_configdir(),  # its list of fonts takes seconds
        **{f"XDG_{kind}_HOME": str(clone.parent / kind.lower()) for kind in ("DATA", "CACHE", "CONFIG")},
    }
    for line in shown_lines(page):
        if (reason := reason_not_to_run(line)) is not None:
            sys.stdout.write(f"not run, {reason}: {line}\n")
            continue
        command = shortened(line)
        for begin, before in PREPARED.items():
            if line.startswith(begin):
                command = f"{{ {shortened(before)}; }} && {command}"
        begin_s = time.monotonic()
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=clone,
            env=env,
            capture_output=True,
            text=True,
            check=False,
            stdin=subprocess.DEVNULL,
        )
        sys.stdout.write(f"{time.monotonic() - begin_s:.0f} s: {command}\n")
        assert done.returncode == EXIT_CODES.get(line, 0), f"{line}\n{done.stdout}\n{done.stderr}"
        for follows in re.findall(r"^next: gripper-force (.*)", done.stderr, re.MULTILINE):
            help_ = CliRunner().invoke(cli.app, [*shlex.split(follows), "--help"])
            assert help_.exit_code == 0, f"{follows}\n{help_.output}"
