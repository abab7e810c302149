"""What a scene takes until its first control cycle: time, memory, and what is loaded and running by then."""

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
from gripper_force.runtime.log import LogWriter
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
"""Modules that only some scenes ask for: libraries, and rooms of our own."""

_SERVO: Final = frozenset({"dynamixel_sdk", "serial"})
_SIMULATED: Final = _SERVO | {"gripper_hw.dynamixel.virtual", "gripper_hw.sim", "mujoco"}
_EYES: Final = frozenset({"gripper_force.vision", "cv2", "safetensors"})


@dataclass(frozen=True, slots=True)
class StartupCase:
    """What is started.

    Attributes:
        name: For the table.
        asks_for: What of `HEAVY` it may load.
        threads: Threads it may have besides the main one.
        settings: Of a grasp, keys of the configuration; ``{servo}``, ``{load_cell}``, ``{log}`` and
            ``{network}`` stand for what `stand_ins` gives.
        command: The arguments of another command, run as a whole.
    """

    name: str
    asks_for: frozenset[str] = frozenset()
    threads: frozenset[str] = frozenset()
    settings: tuple[str, ...] = ()
    command: tuple[str, ...] = ()


PATIENT: Final = ("servo.bus_watchdog_ms=2540", "servo.reply_margin_ms=100")
"""On a busy machine a stand-in for the servo may be late too, and that is not to end what is measured."""

_REAL: Final = ("servo.port={servo}", "clock=realtime", *PATIENT)
_NO_CELL: Final = ("load_cell.backend=none",)
_BLIND: Final = ("camera.backend=none", "control.feedback=current")
_RECORDED: Final = ("camera.backend=playback", "camera.path={log}")
_NO_NETWORK: Final = ("vision.checkpoint=none", "control.feedback=current")

STARTUP_CASES: Final = (
    StartupCase("--help", command=("--help",)),
    StartupCase(
        "doctor, a real servo alone",  # it lists all devices there are, and asks each room
        _SERVO | {"depthai", "gripper_hw.cameras", "gripper_hw.load_cells", "gripper_hw.sim"},
        command=("doctor", *(f"--set={key}" for key in (*_REAL, *_NO_CELL, *_BLIND))),
    ),
    StartupCase("real servo", _SERVO, frozenset({"log_queue"}), (*_REAL, *_NO_CELL, *_BLIND)),
    StartupCase(
        "real servo, serial load cell",
        _SERVO | {"gripper_hw.load_cells"},
        frozenset({"log_queue", "load-cell"}),
        (*_REAL, *_BLIND, "load_cell.backend=serial", "load_cell.port={load_cell}"),
    ),
    StartupCase(
        "real servo, recorded camera",
        _SERVO | {"gripper_hw.playback"},
        frozenset({"log_queue", "perception"}),
        (*_REAL, *_NO_CELL, *_RECORDED, *_NO_NETWORK),
    ),
    *(
        StartupCase(
            f"real servo, recorded camera, {engine}",
            _SERVO | {"gripper_hw.playback", engine} | _EYES,
            frozenset({"log_queue", "perception"}),
            (*_REAL, *_NO_CELL, *_RECORDED, "vision.checkpoint={network}", f"vision.engine={engine}"),
        )
        for engine in ("torch", "openvino", "onnxruntime")
        if find_spec(engine) is not None
    ),
    StartupCase("simulated, motor current alone", _SIMULATED, settings=(*_BLIND, *_NO_CELL)),
    StartupCase("simulated, load cell", _SIMULATED, settings=_BLIND),
    StartupCase(
        "simulated, a whole grasp without report",
        _SIMULATED,
        command=("grasp", *(f"--set={key}" for key in ("object=stapler", *_BLIND, "log.report=false"))),
    ),
    StartupCase("simulated, camera, no network", _SIMULATED | {"cv2"}, settings=_NO_NETWORK),
    StartupCase(
        "simulated, vision (the default)",
        _SIMULATED | _EYES | {"torch"},
        settings=("vision.checkpoint={network}",),
    ),
)
"""What `startup` starts, and what a test holds to what it asks for."""


@dataclass(frozen=True, slots=True)
class Start:
    """What a scene took.

    Attributes:
        scene: Its name.
        time_s: From the start of the process to the end of the first cycle, or of the whole command.
        memory_mb: Resident set then.
        loaded: What of `HEAVY` was loaded then.
        threads: Python's threads then, without the main one.
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
    atexit.register(startup_child.tell, int(fd))
    sys.argv[1:] = arguments
    gripper_force.cli.main()
"""
"""The process of a scene: what the command line does, and a word to this process at the first cycle."""


def startup(scenes: Sequence[StartupCase], times: int = 3) -> Iterator[Start]:
    """Starts each scene in a process of its own, so many times after a first; gives the medians of each.

    At the first, files come into memory, and a network is exported for an engine that needs it so.

    Raises:
        GripperError: A scene did not start.
    """
    with stand_ins() as places:
        for scene in scenes:
            start(scene, places)
            starts = [start(scene, places) for _ in range(times)]
            time_s, memory_mb = np.median([(one.time_s, one.memory_mb) for one in starts], axis=0).tolist()
            yield replace(starts[0], time_s=time_s, memory_mb=memory_mb)


def start(scene: StartupCase, places: dict[str, str]) -> Start:
    """Starts a scene once.

    Args:
        scene: The scene.
        places: What `stand_ins` gives.

    Raises:
        GripperError: It did not start.
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
    told = json.loads(line)
    dotted = [f"{module}." for module in told["modules"]]
    loaded = tuple(name for name in HEAVY if any(module.startswith(f"{name}.") for module in dotted))
    return Start(scene.name, time_s, told["memory_mb"], loaded, tuple(told["threads"]))


@contextmanager
def stand_ins() -> Iterator[dict[str, str]]:
    """A virtual servo and a silent load cell behind pseudo-terminals, a log to play, and a network."""
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
