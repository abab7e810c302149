"""Installations without optional packages, and the wheel outside the repository."""

import ast
import json
import math
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import gripper_force as gf
from gripper_force.cli.configuration import shipped_files
from gripper_force.jobs import view
from gripper_force.plugins import EXTRAS
from gripper_force.runtime import backends
from gripper_force.vision.engines import ENGINES

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SOURCES = {"gripper_force": ROOT, "gripper_hw": ROOT / "hw", "gripper_calibration": ROOT / "calibration"}
distributions = cache(metadata.packages_distributions)


def closure(requirements: list[str]) -> set[str]:
    """Canonical names of the distributions that an installation of these requirements brings."""
    found: set[str] = set()
    todo = [Requirement(text) for text in requirements]
    while todo:
        requirement = todo.pop()
        name = canonicalize_name(requirement.name)
        if name in found or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        found.add(name)
        todo += [Requirement(text) for text in metadata.requires(name) or ()]
    return found


def distributions_of(module: str) -> set[str]:
    return {canonicalize_name(name) for name in distributions().get(module, ())}


@cache
def core() -> set[str]:
    return closure(PROJECT["dependencies"])


@cache
def absent() -> set[str]:
    """Modules of this environment that an installation without extras does not have."""
    return {module for module in distributions() if not distributions_of(module) & core()} - set(SOURCES)


ABSENCE = """
import sys
absent, absent_distributions = map(set, {absent})

class Absence:
    def __init__(self, finders):
        self.finders = finders

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in absent:
            return None
        found = (finder.find_spec(name, path, target) for finder in self.finders)
        return next((spec for spec in found if spec is not None), None)

    def find_distributions(self, *arguments):
        for finder in self.finders:
            for found in getattr(finder, "find_distributions", lambda *_: ())(*arguments):
                if found.metadata["Name"] not in absent_distributions:
                    yield found

sys.meta_path[:] = [Absence(list(sys.meta_path))]
"""
"""Hides modules as if their packages were not installed."""

SERVO = """
import time
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.firmware import VirtualServo
from gripper_hw.dynamixel.pty_server import BenchMotor, PtyServer
from gripper_hw.dynamixel.virtual import VirtualBus

motor = BenchMotor(VirtualServo(1, load_model("XM430-W350")), contact_rad=0.5)
server = PtyServer(VirtualBus([motor.servo], before_packet=lambda: motor.advance(time.monotonic_ns())))
sys.argv = [text.replace("SERVO", server.device_path) for text in sys.argv]
"""

REAL = ("clock=realtime", "servo.port=SERVO", "load_cell.backend=none", "log.report=false")
PATIENT = ("servo.bus_watchdog_ms=2540", "servo.reply_margin_ms=100")
"""On a busy machine the virtual servo may be late."""


def without_extras(
    *arguments: str, cwd: Path, code: str, path: str | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs a program in a process that has only the core's packages."""
    hidden = {name for module in absent() for name in distributions()[module]}
    absence = ABSENCE.format(absent=[sorted(absent()), sorted(hidden)])
    environment = {
        **os.environ,
        **({"PYTHONPATH": path} if path else {}),
        "XDG_CACHE_HOME": str(cwd / "cache"),
    }
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", absence + code, *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def settings(*keys: str) -> list[str]:
    return [f"--set={key}" for key in keys]


def test_the_absence_is_real(tmp_path: Path) -> None:
    code = """
from importlib import import_module
import cv2, google.protobuf, mcap, numpy, onnxruntime, pydantic, safetensors, serial, typer, yaml
for module in sys.argv[1:]:
    try:
        import_module(module)
    except ModuleNotFoundError as error:
        print(error)
"""
    optional = ("torch", "mujoco", "matplotlib", "scipy", "depthai")
    assert absent() >= set(optional)
    done = without_extras(*optional, cwd=tmp_path, code=code)
    assert done.stdout.splitlines() == [f"No module named '{module}'" for module in optional], done.stderr


VISION = """
from pathlib import Path
from gripper_force.config import Config, dump_config
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import Frame
import numpy as np

rng = np.random.default_rng(0)
scene = rng.integers(40, 200, (128, 128))
with LogWriter(Path("frames.mcap"), config=dump_config(Config()), metadata={}) as writer:
    for i in range(120):
        gray = (scene + rng.integers(-3, 4, scene.shape)).astype(np.uint8)
        writer.write(Frame(i * 16_666_667, i * 16_666_667, i, gray))
"""


CURRENT = settings(*REAL, *PATIENT, "camera.backend=none", "control.feedback=current", "control.hold_s=0.3")
PLAYBACK = ("camera.backend=playback", "camera.path=frames.mcap")
SEEN = settings(
    *REAL, *PATIENT, *PLAYBACK, "vision.checkpoint=small", "control.feedback=fused", "control.hold_s=0.3"
)
WORKING = {
    "a grasp on motor current": ["grasp", "--target-n=3", "--json", *CURRENT],
    "a grasp with vision": ["grasp", "--target-n=3", "--json", *SEEN],
    "doctor": ["doctor", "--json", *CURRENT],
}
"""Commands that need the core only."""

LINKAGE = "gripper.linkage={kind: table, table: [[0, 0.092], [1, 0.05], [2, 0]]}"


MISSING: list[tuple[list[str], str, str]] = [
    (["grasp"], "log.report=true needs matplotlib", "report"),
    (["grasp", *settings("log.report=false")], "servo.port=virtual:rig needs mujoco", "sim"),
    (["grasp", "--trials=2"], "log.report=true needs matplotlib", "report"),
    (
        [
            "grasp",
            *settings(*REAL, *PLAYBACK, "vision.engine=torch"),
        ],
        "vision.engine=torch needs torch",
        "train",
    ),
    (
        ["grasp", *settings(*REAL, "camera.backend=none", LINKAGE)],
        "gripper.linkage.kind=table needs scipy",
        "calibrate",
    ),
    (
        ["config", "check", *settings(*REAL, "camera.backend=oak")],
        "camera.backend=oak needs depthai",
        "oak",
    ),
    (
        [
            "grasp",
            *settings(*REAL, "camera.backend=none", "load_cell.backend=phidget", "load_cell.rate_hz=80"),
        ],
        "load_cell.backend=phidget needs the package Phidget22",
        "phidget",
    ),
    (["train", "data"], "train needs torch", "train"),
    (["evaluate", "data"], "evaluate needs torch", "train"),
    (["teach", "mug"], "teach needs torch", "train"),
    (["calibrate", "object", "mug"], "calibrate object needs scipy", "calibrate"),
    (["calibrate", "load-cell", "--mass-kg=1", "--yes"], "this command needs scipy", "calibrate"),
    (["export", "small", "--out=small.onnx"], "this command needs torch", "train"),
    (
        ["replay", "frames.mcap", "--report"],
        "--report needs matplotlib",
        "report",
    ),
    (["replay", "frames.mcap", "--out=summary"], "--out needs scipy", "calibrate"),
    (["replay", "frames.mcap", "--compare", "log", "small"], "--compare needs scipy", "calibrate"),
    (["replay", "frames.mcap", "--ray=auto"], "--ray needs ray", "ray"),
    (["simulate", "--presses=1"], "needs mujoco", "sim"),
    (["view", "frames.mcap"], "the viewer rerun needs rerun", "view"),
]
"""Arguments of a command, what it needs, and the extra that has it."""

EACH = """
import contextlib, io, json
from gripper_force.cli import main

done = []
for arguments in json.loads(sys.argv[1]):
    sys.argv[1:] = arguments
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            code = end.code
    done.append((code, *(stream.seek(0) or stream.read() for stream in (out, err))))
print(json.dumps(done))
"""
"""Runs commands, one after the other: the start of a process takes most of the time."""


class Done(NamedTuple):
    """The end of a command."""

    code: int
    out: str
    err: str


def each_without_extras(
    commands: Iterable[list[str]], cwd: Path, before: str = "", path: str | None = None
) -> list[Done]:
    """Runs commands in one process that has only the core's packages."""
    done = without_extras(json.dumps([*commands]), cwd=cwd, code=before + EACH, path=path)
    assert done.returncode == 0, done.stderr
    return [Done(*one) for one in json.loads(done.stdout.splitlines()[-1])]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `ends`."""
    return tmp_path_factory.mktemp("core")


@pytest.fixture(scope="module")
def ends(folder: Path) -> dict[str, Done]:
    """The ends of the commands in `WORKING` and `MISSING`."""
    commands = {**WORKING, **{" ".join(arguments): arguments for arguments, *_ in MISSING}}
    done = each_without_extras(commands.values(), folder, VISION + SERVO)
    return dict(zip(commands, done, strict=True))


def test_a_grasp_on_motor_current_needs_the_core_only(ends: dict[str, Done], folder: Path) -> None:
    code, out, err = ends["a grasp on motor current"]
    assert code == 0, err
    result = json.loads(out)
    assert result["result"] == "held"
    assert (folder / result["log"]).is_file()


def test_a_grasp_with_vision_needs_the_core_only(ends: dict[str, Done], folder: Path) -> None:
    code, out, err = ends["a grasp with vision"]
    assert code in (0, 1), err  # noise is no object, so the outcome does not count
    result = json.loads(out)
    assert result["estimator_p50_ms"] > 0
    visual = list(gf.LogReader(folder / result["log"]).records(gf.VisualForce))
    assert len(visual) > 10


def test_doctor_works_without_extras(ends: dict[str, Done]) -> None:
    checks = json.loads(ends["doctor"].out)["checks"]
    assert not [check for check in checks if "defect" in check["advice"]]
    assert "no OAK can be listed: pip install 'gripper-force[oak]'" in [check["found"] for check in checks]


@pytest.mark.parametrize(
    ("command", "needs", "extra"), [(" ".join(row[0]), *row[1:]) for row in MISSING], ids=lambda value: value
)
def test_a_missing_package_is_named_with_its_extra(
    ends: dict[str, Done], command: str, needs: str, extra: str
) -> None:
    code, _, err = ends[command]
    assert code == 2, err
    assert needs in err
    assert f"pip install 'gripper-force[{extra}]'" in err
    assert len([line for line in err.splitlines() if "error" in line]) == 1
    assert "Traceback" not in err


def test_a_library_user_gets_a_typed_error(tmp_path: Path, tiny_checkpoint: Path) -> None:
    code = """
import gripper_force as gf
for call in (
    lambda: gf.teach,
    lambda: gf.open_gripper().__enter__(),
    lambda: gf.ForceEstimator.load(engine="torch"),
    lambda: gf.ForceEstimator.load(sys.argv[1]),  # its folder has no exported network
):
    try:
        call()
    except gf.GripperError as error:
        print(error)
"""
    done = without_extras(str(tiny_checkpoint), cwd=tmp_path, code=code)
    *errors, not_exported = done.stdout.splitlines()
    assert errors == [
        "gripper_force.teach needs torch, which is not installed; pip install 'gripper-force[train]'",
        "servo.port=virtual:rig needs mujoco, which is not installed; pip install 'gripper-force[sim]'",
        "vision.engine=torch needs torch, which is not installed; pip install 'gripper-force[train]', or set "
        "vision.engine=onnxruntime",
    ], done.stderr
    assert "needs torch, which is not installed" in not_exported
    assert (
        "or run `gripper-force export network` on another machine and set vision.checkpoint to its file"
        in not_exported
    )


Trees = dict[str, list[ast.stmt]]


@pytest.fixture(scope="module")
def trees() -> Trees:
    """The statements of each module, by its name."""
    found: Trees = {}
    for package, root in SOURCES.items():
        for path in sorted((root / package).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
            found[name] = ast.parse(path.read_text()).body
    return found


def imports(body: list[ast.stmt], *, lazy: bool) -> Iterator[str]:
    """Modules that statements import; without ``lazy`` only those that are imported with the module itself."""
    for node in body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            yield node.module or ""
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        elif lazy or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            for part in ("body", "orelse", "finalbody", "handlers"):
                yield from imports(list(getattr(node, part, ())), lazy=lazy)


def third_party(names: set[str]) -> set[str]:
    tops = {name.partition(".")[0] for name in names}
    return tops - set(sys.stdlib_module_names) - set(SOURCES)


def test_every_import_is_declared(trees: Trees) -> None:
    """In the core, or in an extra that `EXTRAS` names for messages."""
    declared = {canonicalize_name(Requirement(text).name) for text in PROJECT["dependencies"]}
    names = {"foxglove": "foxglove-sdk", "rerun": "rerun-sdk", "Phidget22": "phidget22"}
    for name, body in trees.items():
        for module in third_party(set(imports(body, lazy=True))):
            sources = distributions_of(module) or {names.get(module, module)}
            if not sources & declared and not (
                module == "pytest" and name.startswith("gripper_force.testing")
            ):
                assert any(
                    EXTRAS.get(module) == extra
                    for extra, texts in PROJECT["optional-dependencies"].items()
                    for text in texts
                    if canonicalize_name(Requirement(text).name) in sources
                ), f"{name} imports {module}, which no extra declares"


def test_extras_of_messages_are_declared() -> None:
    assert set(EXTRAS.values()) <= set(PROJECT["optional-dependencies"])


def loaded_with(start: str, trees: Trees) -> dict[str, str]:
    """Third-party modules that an import of a module loads, and through which module."""
    seen: set[str] = set()
    found: dict[str, str] = {}
    todo = [start]
    while todo:
        name = todo.pop()
        if name in seen or name not in trees:
            continue
        seen.add(name)
        direct = set(imports(trees[name], lazy=False))
        found |= {module: name for module in third_party(direct) if module not in found}
        for one in {*direct, name}:
            parts = one.split(".")
            todo += [".".join(parts[:i]) for i in range(1, len(parts) + 1)]
    return found


def own_class_modules() -> list[str]:
    built_in: list[Mapping[str, str]] = [backends.SERVOS, backends.CAMERAS, backends.LOAD_CELLS, ENGINES]
    return sorted({path.partition(":")[0] for table in built_in for path in table.values() if path})


def test_the_oldest_viewers_are_those_of_the_extra() -> None:
    extra = [Requirement(text) for text in PROJECT["optional-dependencies"]["view"]]
    oldest = {f"{viewer}-sdk": f">={version}" for viewer, version in view.OLDEST.items()}
    assert {one.name: str(min(one.specifier, key=lambda s: s.operator != ">=")) for one in extra} == oldest


def test_optional_packages_are_reached_only_lazily(trees: Trees) -> None:
    """Commands, the runtime and every class that a run names load the core's packages, and their own one."""
    own = {
        "gripper_hw.sim.simulated_rig": {"mujoco"},
        "gripper_hw.cameras.oak": {"depthai"},
        "gripper_force.vision.engines.pytorch": {"torch"},
        "gripper_force.vision.engines.openvino": {"openvino"},
    }
    jobs = ("trials", "replay", "doctor", "recording.record", "view", "simulate")
    starts = ["gripper_force.cli", "gripper_force.runtime.gripper", "gripper_force.vision.estimator"]
    starts += [f"gripper_force.jobs.{job}" for job in jobs] + own_class_modules()
    for start in starts:
        loaded = loaded_with(start, trees)
        optional = {module: via for module, via in loaded.items() if not distributions_of(module) & core()}
        assert set(optional) <= own.get(start, set()), f"{start}: {optional}"


# --- the wheel -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, unpacked outside the repository as pip does."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=120)
    (archive,) = folder.glob("*.whl")
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(folder / "site")
    return folder / "site"


def test_the_wheel_has_every_file_of_the_packages(wheel: Path) -> None:
    tracked = subprocess.run(
        ["git", "ls-files", *SOURCES, "hw", "calibration"], cwd=ROOT, capture_output=True, text=True
    )
    if tracked.returncode:
        pytest.skip("not a git repository")
    for line in tracked.stdout.splitlines():
        inside = re.sub("^(hw|calibration)/", "", line)
        assert (wheel / inside).is_file(), f"{line} is not in the wheel"
    assert {path.name for path in wheel.iterdir()} == {*SOURCES, f"gripper_force-{gf.__version__}.dist-info"}


def test_files_of_the_package_come_with_the_wheel(wheel: Path, tmp_path: Path) -> None:
    examples = wheel / "gripper_force" / "examples"
    shown = (examples / "xm430.yaml", examples / "setups" / "xm430_oak_hx711.yaml")
    commands = [["config", "file", "--json"]]
    commands += [
        command
        for path in shown
        for command in (["config", "file", path.name], ["config", "show", f"--config={path}"])
    ]
    listed, *printed = each_without_extras(commands, tmp_path, path=str(wheel))
    files = {name: Path(path) for name, path in json.loads(listed.out).items()}
    assert set(files) == set(shipped_files())
    assert {"99-gripper-force.rules", "foxglove_layout.json"} <= set(files)
    assert all(path.is_relative_to(wheel) and path.is_file() for path in files.values())
    for path, file, configuration in zip(shown, printed[::2], printed[1::2], strict=True):
        assert (files[path.name], file.out) == (path, path.read_text())
        assert configuration.code == 0, configuration.err


def test_messages_name_no_file_of_the_repository(trees: Trees) -> None:
    """Such as docs/servos.md, which an installation does not have; but a command may write such a page."""
    paths = re.compile(r"(?<!--write )(?<!such as )\b(docs|hw|examples|calibration|scripts|tests)/[\w/.]+")
    for name, body in trees.items():
        nodes = [node for statement in body for node in ast.walk(statement)]
        docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        for node in nodes:
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
                assert "://" in node.value or not paths.search(node.value), f"{name}: {node.value}"


def test_a_robot_runs_a_shipped_network_that_the_wheel_brings(wheel: Path, tmp_path: Path) -> None:
    code = """
import gripper_force as gf
import numpy as np
estimator = gf.ForceEstimator.load("small")
frame = np.random.default_rng(0).integers(0, 256, (128, 128), np.uint8)
assert [estimator.update(frame) for _ in range(3)] == [None] * 3
try:
    estimator.update(frame)
except gf.UnfamiliarFrameError as error:  # noise is no view that the network knows, but it has run
    print(gf.__file__, "force", error.force_n)
"""
    done = without_extras(cwd=tmp_path, code=code, path=str(wheel))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(wheel))
    assert math.isfinite(float(done.stdout.rpartition("force ")[2]))


def test_metadata_of_the_wheel(wheel: Path) -> None:
    (folder,) = wheel.glob("*.dist-info")
    about = metadata.PathDistribution(folder)
    assert about.version == gf.__version__
    assert set(about.metadata.get_all("Provides-Extra") or ()) == set(PROJECT["optional-dependencies"])
    text = (folder / "METADATA").read_text().partition("\n\n")[2]
    assert "# gripper-force" in text
    targets = re.findall(r"\]\(([^)]+)\)", text)
    assert targets
    assert all(target.startswith(("https://", "#")) for target in targets)
    repository = PROJECT["urls"]["Repository"]
    own = [target for target in targets if target.startswith((repository, "https://raw."))]
    assert own
    assert all(f"/v{gf.__version__}/" in target for target in own)


# --- the repository --------------------------------------------------------------------------------------------


def test_the_integrations_have_the_same_version() -> None:
    for path in (ROOT / "integrations").glob("*/pyproject.toml"):
        project = tomllib.loads(path.read_text())["project"]
        assert project["version"] == gf.__version__
        (own,) = [Requirement(text) for text in project["dependencies"] if text.startswith("gripper-force")]
        assert own.specifier.contains(gf.__version__, prereleases=True)


def test_one_address_of_the_repository() -> None:
    repository = PROJECT["urls"]["Repository"].removeprefix("https://github.com/")
    text = (ROOT / "pyproject.toml").read_text()
    owners = set(re.findall(r"(?:github\.com|githubusercontent\.com)/([\w-]+/[\w-]+)", text))
    assert owners == {repository}


def test_workflows_are_valid() -> None:
    """By the schema of GitHub Actions."""
    workflows = map(str, (ROOT / ".github/workflows").glob("*.yml"))
    check = [
        sys.executable,
        "-m",
        "check_jsonschema",
        "--builtin-schema",
        "vendor.github-workflows",
        *workflows,
    ]
    done = subprocess.run(check, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_image_installs_no_more_than_make_grasp() -> None:
    """The same system packages, and extras of which none brings PyTorch."""
    makefile, dockerfile = (ROOT / "Makefile").read_text(), (ROOT / "Dockerfile").read_text()
    packages = re.search(r"EGL_PACKAGES := (.+)", makefile)
    ours, images = (
        re.search(r"/installed: EXTRAS := (.+)", makefile),
        re.search(r"/src\[(.+)\]", dockerfile),
    )
    assert packages is not None
    assert packages[1] in dockerfile
    assert ours is not None
    assert images is not None
    assert set(images[1].split(",")) == {*ours[1].split(","), "calibrate"} - {"train"}
