"""A grasp in a separate process that is killed or stopped, with the simulated world and servo in this one."""

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
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import NS_PER_MS, NS_PER_S
from gripper_hw.dynamixel.pty_server import PtyServer
from gripper_hw.dynamixel.virtual import find_bus
from gripper_hw.sim.simulated_rig import SimulatedRig

_BUS: Final = "killed"
_CONTACT_NS: Final = 30 * NS_PER_S
"""Time limit for the process to start and grip."""

_TRIP_NS: Final = NS_PER_S
"""Time limit for the watchdog to trip; it is set to tens of ms."""

_AFTER_S: Final = 0.3
"""Time after the trip in which the peak force is still observed."""

_POLL_S: Final = 5e-4


@dataclass(frozen=True, slots=True)
class KillTrial:
    """Result of a killed or stopped grasp.

    Attributes:
        tripped_ms: Time from the signal to the trip of the servo's Bus Watchdog; None if it did not trip.
        peak_n: Highest load-cell force.
        lost_ms: Time before the signal that the log lacks.
    """

    tripped_ms: float | None
    peak_n: float
    lost_ms: float


def kill_trial(config: Config, folder: Path, number: Signals) -> KillTrial:
    """Runs a grasp in another process in real time over a pseudo-terminal, and sends it a signal.

    Args:
        config: Configuration of the grasp. It runs on motor current, without camera.
        folder: Folder for the log.
        number: The signal.

    Raises:
        DeviceTimeoutError: The process did not grip anything.
        SimulationError: This machine is too slow for the scene.
    """
    world = config.with_values(clock="realtime", faults=(), servo={"port": f"virtual:{_BUS}"})
    with ExitStack() as stack:
        rig = SimulatedRig(world)
        stack.callback(rig.close)
        bus = find_bus(_BUS)
        assert bus is not None
        server = stack.enter_context(PtyServer(bus))
        rig.load_cell.start()
        rig.start()
        stderr = stack.enter_context((folder / "stderr.txt").open("w+"))
        child = Popen(_command(config, server.device_path, folder), stdout=DEVNULL, stderr=stderr)
        stack.callback(child.wait)
        stack.callback(child.kill)
        forces_n = [0.0]

        def running() -> bool:
            rig.check()
            forces_n.extend(sample.force_n for sample in rig.load_cell.drain())
            return child.poll() is None

        def gripping() -> bool:
            return forces_n[-1] > 0.5 * config.target_n

        def tripped() -> bool:
            with bus.lock:
                return bus.servos[0].tripped

        if not _wait(gripping, running, _CONTACT_NS):
            stderr.seek(0)
            last = (stderr.read().strip().splitlines() or ["no error output"])[-1]
            raise DeviceTimeoutError(
                f"the process did not grip {config.object!r} within {_CONTACT_NS // NS_PER_S} s: {last}"
            )
        time.sleep(float(np.random.default_rng([config.seed, 32]).uniform(0.0, 0.5)))
        sent_ns = time.monotonic_ns()
        child.send_signal(number)
        did_trip = _wait(tripped, lambda: True, _TRIP_NS)
        tripped_ms = (time.monotonic_ns() - sent_ns) / NS_PER_MS if did_trip else None
        time.sleep(_AFTER_S)
        child.send_signal(SIGKILL)
        child.wait()
        running()
        return KillTrial(tripped_ms, max(forces_n), _lost_ms(folder, sent_ns))


def _wait(condition: Callable[[], bool], running: Callable[[], bool], limit_ns: int) -> bool:
    end_ns = time.monotonic_ns() + limit_ns
    while time.monotonic_ns() < end_ns and running():
        if condition():
            return True
        time.sleep(_POLL_S)
    return condition()


def _command(config: Config, port: str, folder: Path) -> list[str]:
    grasp = config.with_values(
        clock="realtime",
        faults=(),
        # a long margin, as the processes and the simulated world share this machine
        servo={"port": port, "reply_margin_ms": 20.0},
        camera={"backend": "none"},
        load_cell={"backend": "none"},
        control={"feedback": "current", "hold_s": 30.0},
        log={"directory": folder, "report": False},
    )
    path = folder / "grasp.yaml"
    path.write_text(dump_config(grasp), encoding="utf-8")
    program = "from gripper_force.cli import main; main()"
    return [sys.executable, "-c", program, "grasp", "--json", "--config", str(path)]


def _lost_ms(folder: Path, sent_ns: int) -> float:
    """Time before the signal that the log lacks. Both processes use the host's monotonic clock."""
    last_ns = 0
    with suppress(LogError):
        for path in folder.glob("*.mcap"):
            log = LogReader(path, recover=True)
            last_ns = log.start_ns + log.duration_ns
    return max((sent_ns - last_ns) / NS_PER_MS, 0.0)
