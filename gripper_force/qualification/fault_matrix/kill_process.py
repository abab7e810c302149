"""A grasp in a process of its own that is killed or stopped, with the world and its servo in this one."""

import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from signal import SIGKILL, Signals
from subprocess import DEVNULL, Popen
from typing import Final

import numpy as np

from gripper_force.config import Config, dump_config
from gripper_force.errors import DeviceTimeoutError, LogError
from gripper_force.runtime.log import LogReader
from gripper_force.types import NS_PER_MS, NS_PER_S
from gripper_hw.dynamixel.pty_server import PtyServer
from gripper_hw.dynamixel.virtual import find_bus
from gripper_hw.sim.simulated_rig import SimulatedRig

_BUS: Final = "killed"
_CONTACT_NS: Final = 30 * NS_PER_S
_TRIP_NS: Final = NS_PER_S
_AFTER_S: Final = 0.3
_POLL_S: Final = 5e-4


@dataclass(frozen=True, slots=True)
class KillTrial:
    """What became of the grip.

    Attributes:
        tripped_ms: Time from the signal to the trip of the servo's Bus Watchdog; None: it never tripped.
        peak_n: Highest force at the load cell.
        lost_ms: Time before the signal that the log lacks.
    """

    tripped_ms: float | None
    peak_n: float
    lost_ms: float


def kill_trial(config: Config, folder: Path, number: Signals) -> KillTrial:
    """Lets another process grasp in real time over a pseudo-terminal, and sends it a signal in mid-grasp.

    Args:
        config: The grasp. It runs without camera, on the motor current.
        folder: Where the log goes.
        number: The signal.

    Raises:
        DeviceTimeoutError: The process never came to grip anything.
        SimulationError: This machine is too slow for the scene.
    """
    world = config.model_copy(
        update={
            "clock": "realtime",
            "faults": (),
            "servo": config.servo.model_copy(update={"port": f"virtual:{_BUS}"}),
        }
    )
    with ExitStack() as stack:
        rig = SimulatedRig(world)
        stack.callback(rig.close)
        bus = find_bus(_BUS)
        assert bus is not None
        server = stack.enter_context(PtyServer(bus))
        rig.load_cell.start()
        rig.start()
        said = stack.enter_context((folder / "said.txt").open("w+"))
        child = Popen(_command(config, server.device_path, folder), stdout=DEVNULL, stderr=said)
        stack.callback(child.wait)
        stack.callback(child.kill)
        forces_n = [0.0]

        def goes_on() -> bool:
            rig.check()
            forces_n.extend(sample.force_n for sample in rig.load_cell.drain())
            return child.poll() is None

        def grips() -> bool:
            return forces_n[-1] > 0.5 * config.target_n

        def tripped() -> bool:
            with bus.lock:
                return bus.servos[0].tripped

        if not _wait(grips, goes_on, _CONTACT_NS):
            said.seek(0)
            last = (said.read().strip().splitlines() or ["it said nothing"])[-1]
            raise DeviceTimeoutError(
                f"the process that was to grip {config.object!r} and be killed never did: {last}"
            )
        time.sleep(float(np.random.default_rng([config.seed, 32]).uniform(0.0, 0.5)))
        sent_ns = time.monotonic_ns()
        child.send_signal(number)
        fell = _wait(tripped, lambda: True, _TRIP_NS)
        tripped_ms = (time.monotonic_ns() - sent_ns) / NS_PER_MS if fell else None
        time.sleep(_AFTER_S)
        child.send_signal(SIGKILL)
        child.wait()
        goes_on()
        return KillTrial(tripped_ms, max(forces_n), _lost_ms(folder, sent_ns))


def _wait(condition: Callable[[], bool], goes_on: Callable[[], bool], most_ns: int) -> bool:
    end_ns = time.monotonic_ns() + most_ns
    while time.monotonic_ns() < end_ns and goes_on():
        if condition():
            return True
        time.sleep(_POLL_S)
    return condition()


def _command(config: Config, port: str, folder: Path) -> list[str]:
    changes = {
        # three processes share this machine with the world
        "servo": {"port": port, "reply_margin_ms": 20.0},
        "camera": {"backend": "none"},
        "load_cell": {"backend": "none"},
        "control": {"feedback": "current", "hold_s": 30.0},
        "log": {"directory": folder, "report": False},
    }
    sections = {name: getattr(config, name).model_copy(update=update) for name, update in changes.items()}
    grasp = config.model_copy(update={"clock": "realtime", "faults": (), **sections})
    path = folder / "grasp.yaml"
    path.write_text(dump_config(grasp), encoding="utf-8")
    program = "from gripper_force.cli import main; main()"
    return [sys.executable, "-c", program, "grasp", "--json", "--config", str(path)]


def _lost_ms(folder: Path, sent_ns: int) -> float:
    """Both processes share the host's monotonic clock, which is the log's."""
    last_ns = 0
    with suppress(LogError):
        for path in folder.glob("*.mcap"):
            log = LogReader(path, recover=True)
            last_ns = log.start_ns + log.duration_ns
    return max((sent_ns - last_ns) / NS_PER_MS, 0.0)
