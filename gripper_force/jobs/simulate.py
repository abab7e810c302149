"""Simulated training data: logs of randomised presses, taps and grasps.

A *press* ramps to one to three random forces in turn, holds each for a while, and opens, like the paper's
data collection (Shin et al. 2019, section IV-A). A *tap* is one fast touch, with contact in half of its
frames: for training, one more scene is worth more than more frames of a scene. A *grasp* is one touch that
ends like `gripper-force grasp`. All run the controller on motor current alone, so no network is needed to
make the data that one is trained on.

`gripper_force.jobs.paper_protocol` makes the sets of the paper's protocol.
"""

from collections.abc import Generator, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, Protocol

import numpy as np

from gripper_force.config import Config, config_from
from gripper_force.errors import ConfigError
from gripper_force.files import unfinished
from gripper_force.jobs.grasp import PAPER_OBJECTS, exclusive_device, run_grasp
from gripper_force.jobs.processes import Workers
from gripper_force.jobs.recording.record import check_object_file, check_same
from gripper_force.jobs.recording.touches import ramp, wait
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import open_run
from gripper_force.schema import Tree

Kind = Literal["press", "tap", "grasp"]

SAME: Final = ("object", "seed", "target_n", "gripper", "servo", "camera", "load_cell", "sim", "faults")
"""Keys and sections of the configuration that decide what a log contains; most of ``control`` is drawn."""

_MIN_TARGET_N: Final = 0.5
MAX_TARGET_N: Final = 12.5
"""Range of the forces that are drawn: up to a little over the 12 N of the paper's touches."""

_MAX_TARGETS: Final = 3
"""Forces that a press holds in turn, at most."""

_MIN_TAP_N: Final = 4.0
"""Smallest peak of a tap."""


class Plan(Protocol):
    """Logs to make."""

    @property
    def names(self) -> tuple[str, ...]:
        """File names of the logs, relative to the output folder."""

    def check(self, out: Path, config: Tree) -> None:
        """Raises `DataError` if existing logs were made with another configuration; see `make`."""

    def make(self, out: Path, config: Tree) -> list[Path]:
        """Makes the logs that do not exist yet.

        Args:
            out: Output folder.
            config: Configuration as plain data, which can be sent to another process.
        """


@dataclass(frozen=True, slots=True)
class SimulationPlan:
    """One log to make.

    Attributes:
        kind: Kind of the run.
        object: The simulated object, by name or by the path of its file.
        seed: Seed of all random draws.
    """

    kind: Kind
    object: str
    seed: int

    @property
    def name(self) -> str:
        """File name of the log."""
        name = config_from({"object": self.object}, "simulate").object
        return f"{self.kind}-{name}-{self.seed:06d}.mcap"

    @property
    def names(self) -> tuple[str, ...]:
        """The file name, as the only one."""
        return (self.name,)

    def check(self, out: Path, config: Tree) -> None:
        """Raises `DataError` if the existing log was made with another configuration."""
        rng = np.random.default_rng([self.seed, 10])
        drawn = _randomised(config_from({**config, "object": self.object}, "simulate"), self, rng)
        check_same(out / self.name, resolve(drawn, vision=False).config, SAME)

    def make(self, out: Path, config: Tree) -> list[Path]:
        """Makes the log; see `make_log`."""
        return [make_log(self, out, config)]


def plan(
    kind: Kind, count: int, first_seed: int, objects: tuple[str, ...] = PAPER_OBJECTS
) -> list[SimulationPlan]:
    """Plans ``count`` logs, with the objects in turn and one seed per log."""
    return [SimulationPlan(kind, objects[i % len(objects)], first_seed + i) for i in range(count)]


def simulate(
    plans: Sequence[Plan], out: Path, config: Config, workers: int, ray: str | None = None
) -> Generator[Path, None, None]:
    """Makes the logs that do not exist yet, in several processes, and yields each once it is complete.

    Args:
        plans: Logs to make.
        out: Output folder.
        config: Configuration; the plans set object, seed, target and some of ``control``.
        workers: Number of processes.
        ray: Address of a Ray cluster to use instead, see `gripper_force.jobs.ray_pool`; None for none.

    Raises:
        ConfigError: A device is not simulated.
        DataError: An existing log was made with another configuration, or with another content of an object's file.
        GripperError: A simulation failed; logs made so far are kept.
    """
    if device := exclusive_device(config):
        raise ConfigError(f"simulate moves no real gripper, but the configuration has {device}; leave it out")
    out.mkdir(parents=True, exist_ok=True)
    tree = config.model_dump(mode="json")
    missing, objects = [], dict[str, tuple[Path, str]]()
    for plan in plans:
        existing = [path for name in plan.names if (path := out / name).exists()]
        if existing:  # also if not all are: the others must fit to them
            plan.check(out, tree)
        for path in existing:
            check_object_file(path, objects)
        if len(existing) < len(plan.names):
            missing.append(plan)
    with Workers(workers, ray).pool() as pool:
        futures = [pool.submit(p.make, out, tree) for p in missing]
        for future in as_completed(futures):
            for path in future.result():
                check_object_file(path, objects)
                yield path


def make_log(task: SimulationPlan, out: Path, config: Tree) -> Path:
    """Makes one log.

    The log gets its name once it is complete, so an interrupted simulation can be continued.

    Args:
        task: The log.
        out: Folder of the log.
        config: Configuration as plain data.
    """
    rng = np.random.default_rng([task.seed, 10])
    drawn = _randomised(config_from({**config, "object": task.object}, "simulate"), task, rng)
    with unfinished(path := out / task.name) as part:
        if task.kind == "grasp":
            run_grasp(drawn, part)
        else:
            (_tap if task.kind == "tap" else _press)(drawn, part, rng)
    return path


def _randomised(config: Config, task: SimulationPlan, rng: np.random.Generator) -> Config:
    return config.with_values(
        seed=task.seed,
        control={  # drawn before the target: each seed keeps its draws
            "feedback": "current",
            "force_limit_n": 1.3 * MAX_TARGET_N * config.gripper.gain_bound,
            "approach_speed_m_s": float(rng.uniform(0.02, 0.05)),
            "ramp_n_s": float(np.exp(rng.uniform(np.log(3.0), np.log(25.0)))),
            "hold_s": float(rng.uniform(0.3, 1.0)),
        },
        gripper={"position_bound_rad": 0.0},  # the simulated rig is as configured
        target_n=_draw_target_n(rng),
        vision={"checkpoint": "none"},
    )


def _draw_target_n(rng: np.random.Generator) -> float:
    return float(rng.uniform(_MIN_TARGET_N, MAX_TARGET_N))


def _press(config: Config, path: Path, rng: np.random.Generator) -> None:
    with open_run(config, path, vision=False) as session:
        wait(session, 0.2)
        for _ in range(int(rng.integers(_MAX_TARGETS)) + 1):
            ramp(session, _draw_target_n(rng), config.control.timeout_s)
            wait(session, float(rng.uniform(0.05, 0.6)))
        session.release()


def _tap(config: Config, path: Path, rng: np.random.Generator) -> None:
    fast = {"approach_speed_m_s": 0.05, "ramp_n_s": float(np.exp(rng.uniform(np.log(10.0), np.log(30.0))))}
    config = config.with_values(control=fast)
    with open_run(config, path, vision=False) as session:
        wait(session, 0.1)
        peak_n = float(rng.uniform(_MIN_TAP_N, MAX_TARGET_N))
        ramp(session, peak_n, config.control.timeout_s)
        wait(session, float(rng.uniform(0.03, 0.2)))
        if rng.random() < 0.5:
            ramp(session, float(rng.uniform(_MIN_TARGET_N, peak_n)), config.control.timeout_s)
        session.release()
