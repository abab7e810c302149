"""The public names, what importing them costs, and how much code an embedding program can reach."""

import ast
import inspect
import io
import json
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import grimp
import pytest

import gripper_force as gf

ROOT = Path(__file__).parents[1]
HEAVY = {"torch", "mujoco", "depthai", "typer"}

PUBLIC = [
    "__version__",
    "AttentionMap",
    "BusStats",
    "Camera",
    "CameraConfig",
    "CheckpointError",
    "Clock",
    "Comparison",
    "Config",
    "ConfigError",
    "DataError",
    "DeviceError",
    "DeviceLostError",
    "DeviceNotFoundError",
    "DeviceTimeoutError",
    "EstimateSource",
    "Evaluation",
    "Event",
    "ForceEstimate",
    "ForceEstimator",
    "Frame",
    "FusedForce",
    "GraspResult",
    "GraspStatus",
    "Gripper",
    "GripperError",
    "GripperState",
    "HardwareFaultError",
    "LoadCell",
    "LoadCellConfig",
    "LoadCellSample",
    "Lock",
    "LogError",
    "LogReader",
    "NonFiniteError",
    "ObjectCalibration",
    "Outcome",
    "Phase",
    "Progress",
    "Prompt",
    "Record",
    "ReplayResult",
    "Request",
    "RequestError",
    "RequestKind",
    "Servo",
    "ServoCommand",
    "ServoConfig",
    "ServoSpec",
    "ServoState",
    "SharedPort",
    "SimulationError",
    "Taught",
    "UnfamiliarFrameError",
    "VisualForce",
    "calibrate_object",
    "evaluate",
    "load_config",
    "open_gripper",
    "own_process",
    "replay",
    "teach",
]


def test_the_public_names_are_these() -> None:
    """A change here is a change of the public interface: see the rules of versions in CONTRIBUTING.md."""
    assert gf.__all__ == PUBLIC
    assert set(PUBLIC) <= set(dir(gf))
    assert all(getattr(gf, name) is not None for name in gf.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'grip'"):
        _ = gf.grip


@pytest.mark.parametrize("name", PUBLIC[1:])
def test_every_public_name_has_a_docstring(name: str) -> None:
    value = getattr(gf, name)
    if not inspect.isclass(value) and not callable(value):
        return  # a type alias
    text = inspect.getdoc(value) or ""
    assert len(text) > 10
    assert not text.startswith(
        ("What ", "How ", "Whether ", "Where ", "When ", "Who ", "Is ", "Are ", "Does ")
    )
    if inspect.isfunction(value):
        assert "Raises:" in text or name == "own_process"
        assert all(parameter in text for parameter in inspect.signature(value).parameters)


def test_no_docstring_begins_with_a_question_word() -> None:
    begin = re.compile(r'^ *"""(What|How|Whether|Where)\b.*', re.MULTILINE)
    paths = [
        path
        for root in ("gripper_force", "hw", "calibration", "examples")
        for path in (ROOT / root).rglob("*.py")
    ]
    found = {str(path): match[0] for path in paths if (match := begin.search(path.read_text()))}
    assert not found


def modules_after(code: str, *arguments: str) -> set[str]:
    program = f"import json, sys\n{code}\nprint(json.dumps(list(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True, timeout=120
    )
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_the_import_loads_nothing_heavy() -> None:
    modules = modules_after("import gripper_force")
    assert not modules & (HEAVY | {"numpy", "pydantic", "yaml", "serial"})
    assert {name for name in modules if name.startswith("gripper_")} == {"gripper_force"}


def test_a_gripper_on_motor_current_loads_nothing_heavy() -> None:
    code = """
import gripper_force as gf
from gripper_hw.dynamixel.pty_server import serve_virtual_servo
with serve_virtual_servo("XM430-W350") as server:
    o = {"clock": "realtime", "servo.port": server.device_path, "camera.backend": "none"}
    o |= {"load_cell.backend": "none", "control.feedback": "current", "servo.bus_watchdog_ms": 2540}
    with gf.open_gripper(overrides=o) as gripper:
        gripper.move(0.08)
"""
    modules = modules_after(code)
    assert not modules & HEAVY
    assert not {
        name for name in modules if name.startswith(("gripper_force.qualification", "gripper_force.cli"))
    }


NO_CODE = (
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)
VIRTUAL = tuple(f"gripper_hw.dynamixel.{name}" for name in ("firmware", "memory_port", "packets", "virtual"))
SIMULATED = ("gripper_hw.playback", "gripper_hw.sim", *VIRTUAL)
"""Simulated devices, which a program with a real gripper does not load. The driver reaches `VIRTUAL` by a port's name."""


def test_the_code_that_an_embedding_program_reaches_is_small() -> None:
    from gripper_force.runtime import backends
    from gripper_force.vision.engines import ENGINES

    graph = grimp.build_graph(
        "gripper_force",
        "gripper_hw",
        "gripper_calibration",
        exclude_type_checking_imports=True,
        cache_dir=None,
    )
    backend_paths = [*backends.SERVOS.values(), *backends.CAMERAS.values(), *backends.LOAD_CELLS.values()]
    start = {path.split(":")[0] for path in (*backend_paths, *ENGINES.values()) if path}
    start.add("gripper_force.runtime.gripper")

    def reach(modules: set[str]) -> set[str]:
        return modules.union(*(graph.find_upstream_modules(module) for module in modules))

    reached = reach(start)
    core = reach({module for module in start if not module.startswith(SIMULATED)}) - set(VIRTUAL)
    packages = {".".join(name.split(".")[:2]) for name in reached}
    assert not packages & {f"gripper_force.{name}" for name in ("cli", "qualification", "jobs", "testing")}

    assert "gripper_hw.sim.world" in reached - core
    assert 5_000 < sum(map(_lines_of_code, core)) <= 8_555
    assert sum(map(_lines_of_code, reached - core)) <= 3_030


def _lines_of_code(module: str) -> int:
    """Lines with code; documentation, comments and empty lines are free."""
    text = _file(module).read_text()
    documented = {
        number
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        for number in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    code = (token for token in tokens if token.type not in NO_CODE)
    return len({n for token in code for n in range(token.start[0], token.end[0] + 1)} - documented)


def _file(module: str) -> Path:
    roots = {"gripper_force": ROOT, "gripper_hw": ROOT / "hw", "gripper_calibration": ROOT / "calibration"}
    path = roots[module.split(".")[0]].joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def test_versions_agree() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "gripper_force", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == f"gripper-force {gf.__version__}"
