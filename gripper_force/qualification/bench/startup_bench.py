"""Start-up of a scene up to its first control cycle: time, memory, loaded modules and running threads."""

import json
import os
import pty
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from gripper_force.config import Config, dump_config
from gripper_force.errors import GripperError
from gripper_force.qualification.proc_files import process_text
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import NS_PER_S, Frame
from gripper_hw.dynamixel.pty_server import serve_virtual_servo

HEAVY: Final = (
    "Phidget22",
    "OpenGL",
    "cv2",
    "depthai",
    "dynamixel_sdk",
    "matplotlib",
    "mujoco",
    "onnxruntime",
    "openvino",
    "safetensors",
    "scipy",
    "serial",
    "torch",
    "gripper_calibration",
    "gripper_force.vision",
    "gripper_hw.cameras",
    "gripper_hw.dynamixel.virtual",
    "gripper_hw.load_cells",
    "gripper_hw.playback",
    "gripper_hw.sim",
)
"""Modules that only some scenes need: libraries, and packages of this project."""

_SERVO: Final = frozenset({"dynamixel_sdk", "serial"})
_SIMULATED: Final = _SERVO | {"gripper_hw.dynamixel.virtual", "gripper_hw.sim", "mujoco"}
_VISION: Final = frozenset({"gripper_force.vision", "cv2", "safetensors"})


@dataclass(frozen=True, slots=True)
class StartupCase:
    """A scene to start.

    Attributes:
        name: Name in the table.
        needs: Modules of `HEAVY` that it may load.
        threads: Threads that it may have besides the main one.
        settings: Configuration keys of a grasp; ``{servo}``, ``{load_cell}``, ``{log}`` and ``{network}`` are
            replaced by the values of `simulated_devices`.
        command: Arguments of another command, which is run as a whole.
    """

    name: str
    needs: frozenset[str] = frozenset()
    threads: frozenset[str] = frozenset()
    settings: tuple[str, ...] = ()
    command: tuple[str, ...] = ()


LONG_TIMEOUTS: Final = ("servo.bus_watchdog_ms=2540", "servo.reply_margin_ms=100")
"""On a busy machine the virtual servo may be late too, which must not end the measurement."""

_REAL: Final = ("servo.port={servo}", "clock=realtime", *LONG_TIMEOUTS)
_NO_LOAD_CELL: Final = ("load_cell.backend=none",)
_NO_CAMERA: Final = ("camera.backend=none", "control.feedback=current")
_RECORDED: Final = ("camera.backend=playback", "camera.path={log}")
_NO_NETWORK: Final = ("vision.checkpoint=none", "control.feedback=current")

STARTUP_CASES: Final = (
    StartupCase("--help", command=("--help",)),
    StartupCase(
        "doctor, real servo alone",  # it lists all devices, through every device package
        _SERVO | {"cv2", "depthai", "gripper_hw.cameras", "gripper_hw.load_cells", "gripper_hw.sim"},
        command=("doctor", *(f"--set={key}" for key in (*_REAL, *_NO_LOAD_CELL, *_NO_CAMERA))),
    ),
    StartupCase("real servo", _SERVO, frozenset({"log_queue"}), (*_REAL, *_NO_LOAD_CELL, *_NO_CAMERA)),
    StartupCase(
        "real servo, serial load cell",
        _SERVO | {"gripper_hw.load_cells"},
        frozenset({"log_queue", "load-cell"}),
        (*_REAL, *_NO_CAMERA, "load_cell.backend=serial", "load_cell.port={load_cell}"),
    ),
    StartupCase(
        "real servo, recorded camera",
        _SERVO | {"gripper_hw.playback"},
        frozenset({"log_queue", "perception"}),
        (*_REAL, *_NO_LOAD_CELL, *_RECORDED, *_NO_NETWORK),
    ),
    *(
        StartupCase(
            f"real servo, recorded camera, {engine}",
            _SERVO | {"gripper_hw.playback", engine} | _VISION,
            frozenset({"log_queue", "perception"}),
            (*_REAL, *_NO_LOAD_CELL, *_RECORDED, "vision.checkpoint={network}", f"vision.engine={engine}"),
        )
        for engine in ("torch", "openvino", "onnxruntime")
        if find_spec(engine) is not None
    ),
    StartupCase("simulated, motor current alone", _SIMULATED, settings=(*_NO_CAMERA, *_NO_LOAD_CELL)),
    StartupCase("simulated, load cell", _SIMULATED, settings=_NO_CAMERA),
    StartupCase(
        "simulated, complete grasp without report",
        _SIMULATED,
        command=("grasp", *(f"--set={key}" for key in ("object=stapler", *_NO_CAMERA, "log.report=false"))),
    ),
    StartupCase("simulated, camera, no network", _SIMULATED | {"cv2"}, settings=_NO_NETWORK),
    StartupCase(
        "simulated, vision (the default)",
        _SIMULATED | _VISION | {"onnxruntime"},
        settings=("vision.checkpoint={network}",),
    ),
)
"""Scenes of `startup`. A test checks that each loads only what it needs."""


@dataclass(frozen=True, slots=True)
class Start:
    """Cost of starting a scene.

    Attributes:
        scene: Name of the scene.
        time_s: Time from the start of the process to the end of the first cycle, or of the whole command.
        memory_mb: Resident memory at that time.
        loaded: Modules of `HEAVY` loaded at that time.
        threads: Python threads at that time, without the main one.
    """

    scene: str
    time_s: float
    memory_mb: float
    loaded: tuple[str, ...]
    threads: tuple[str, ...]


_PROGRAM: Final = """
import atexit, sys
import gripper_force.cli
from gripper_force.qualification.bench import startup_child
fd, kind, *arguments = sys.argv[1:]
if kind == "grasp":
    import gripper_force.jobs.grasp
    startup_child.first_cycle(int(fd), arguments)
else:
    atexit.register(startup_child.report, int(fd))
    sys.argv[1:] = arguments
    gripper_force.cli.main()
"""
"""Program of a scene's process: it runs as the command line does, and reports at the first cycle."""


def startup(scenes: Sequence[StartupCase], times: int = 3) -> Iterator[Start]:
    """Starts each scene in its own process, and gives the medians over ``times`` starts.

    A first start is not counted: it loads files into the page cache, and exports a network if the engine needs
    it.

    Raises:
        GripperError: A scene did not start.
    """
    process_text("statm")  # which each process reads
    with simulated_devices() as places:
        for scene in scenes:
            start(scene, places)
            starts = [start(scene, places) for _ in range(times)]
            time_s, memory_mb = np.median([(one.time_s, one.memory_mb) for one in starts], axis=0).tolist()
            yield replace(starts[0], time_s=time_s, memory_mb=memory_mb)


def start(scene: StartupCase, places: dict[str, str]) -> Start:
    """Starts a scene once.

    Args:
        scene: The scene.
        places: Values of `simulated_devices`.

    Raises:
        GripperError: The scene did not start.
    """
    arguments = [text.format(**places) for text in (*scene.settings, *scene.command)]
    kind = "command" if scene.command else "grasp"
    reading, writing = os.pipe()
    with TemporaryDirectory() as folder, (Path(folder) / "stderr").open("w+", encoding="utf-8") as stderr:
        begin_s = time.monotonic()
        with subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, str(writing), kind, *arguments],
            cwd=folder,
            pass_fds=[writing],
            stdout=subprocess.DEVNULL,
            stderr=stderr,
        ):
            os.close(writing)
            with os.fdopen(reading) as pipe:
                line = pipe.readline()
            time_s = time.monotonic() - begin_s
        if not line:
            stderr.seek(0)
            raise GripperError(f"the scene {scene.name!r} did not start: {stderr.read().strip()[-500:]}")
    report = json.loads(line)
    dotted = [f"{module}." for module in report["modules"]]
    loaded = tuple(name for name in HEAVY if any(module.startswith(f"{name}.") for module in dotted))
    return Start(scene.name, time_s, report["memory_mb"], loaded, tuple(report["threads"]))


@contextmanager
def simulated_devices() -> Iterator[dict[str, str]]:
    """Yields a virtual servo and a silent load cell at pseudo-terminals, a log to play, and a network."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        servo = stack.enter_context(serve_virtual_servo(Config().servo.model))
        for end in (pair := pty.openpty()):
            stack.callback(os.close, end)
        log = folder / "noise.mcap"
        rng = np.random.default_rng(0)
        with LogWriter(log, config=dump_config(Config()), metadata={}) as writer:
            for i in range(60):
                t_ns = i * NS_PER_S // 60
                writer.write(Frame(t_ns, t_ns, i, rng.integers(0, 256, (128, 128), np.uint8)))
        load_cell = os.ttyname(pair[1])
        yield {"servo": servo.device_path, "load_cell": load_cell, "log": str(log), "network": "default"}
