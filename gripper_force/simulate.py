"""Training data: logs of randomised touches in the simulated rig.

A *press* closes, ramps to one to three random forces in turn, holds each for a while, and opens, as the
paper's collector does (section IV-A). A *grasp* is one touch that ends as `gripper-force grasp` ends it. Both
run the controller on motor current alone, so no network is needed to make the data that one is trained on.
"""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from gripper_force.backends import open_devices
from gripper_force.config import Config, config_from
from gripper_force.session import Session, open_session, run_grasp
from gripper_force.types import NS_PER_S, Outcome, Phase, RequestKind

Kind = Literal["press", "grasp"]
OBJECTS = ("sponge", "paper_cup", "tube", "stapler")
PEAK_N = 12.5
_MAX_TARGETS = 3


@dataclass(frozen=True, slots=True)
class Plan:
    """One log to make."""

    kind: Kind
    object: str
    seed: int

    @property
    def name(self) -> str:
        """The log's file name."""
        return f"{self.kind}-{self.object}-{self.seed:06d}.mcap"


def plan(kind: Kind, count: int, first_seed: int, objects: tuple[str, ...] = OBJECTS) -> list[Plan]:
    """``count`` logs, the objects in turn, each with a seed of its own."""
    return [Plan(kind, objects[i % len(objects)], first_seed + i) for i in range(count)]


def simulate(plans: list[Plan], out: Path, config: Config, jobs: int) -> Iterator[Path]:
    """Makes the logs that are not there yet, in several processes, and yields each as it is done.

    Raises:
        GripperError: A scene failed; the logs made so far stay.
    """
    out.mkdir(parents=True, exist_ok=True)
    missing = [p for p in plans if not (out / p.name).exists()]
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(make_log, p, out, config.model_dump(mode="json")) for p in missing]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def make_log(task: Plan, out: Path, tree: dict[str, object]) -> Path:
    """Makes one log. It appears under its name only once it is whole, so an interrupted run can go on."""
    rng = np.random.default_rng([task.seed, 10])
    config = _randomised(config_from(tree, "simulate"), task, rng)
    path, unfinished = out / task.name, out / f".{task.name}.part"
    unfinished.unlink(missing_ok=True)
    if task.kind == "grasp":
        run_grasp(config, unfinished)
    else:
        _press(config, unfinished, rng)
    return unfinished.rename(path)


def _randomised(config: Config, task: Plan, rng: np.random.Generator) -> Config:
    control = config.control.model_copy(
        update={
            "feedback": "current",
            "force_limit_n": 1.2 * PEAK_N,
            "approach_speed_m_s": float(rng.uniform(0.02, 0.05)),
            "ramp_n_s": float(np.exp(rng.uniform(np.log(3.0), np.log(25.0)))),
            "hold_s": float(rng.uniform(0.3, 1.0)),
        }
    )
    return config.model_copy(
        update={
            "object": task.object,
            "seed": task.seed,
            "target_n": _target_n(rng),
            "control": control,
            "vision": config.vision.model_copy(update={"checkpoint": "none"}),
        }
    )


def _target_n(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.5, PEAK_N))


def _press(config: Config, path: Path, rng: np.random.Generator) -> None:
    with open_devices(config) as devices, open_session(config, devices, path, None) as session:
        _wait(session, 0.2)
        for _ in range(int(rng.integers(_MAX_TARGETS)) + 1):
            _ramp(session, _target_n(rng), config.control.timeout_s)
            _wait(session, float(rng.uniform(0.05, 0.6)))
        decision = session.cycle(RequestKind.RELEASE)
        while decision.status.phase == Phase.RELEASE:
            decision = session.cycle()


def _ramp(session: Session, target_n: float, timeout_s: float) -> None:
    decision = session.cycle(RequestKind.GRASP, target_n)
    end_ns = decision.status.t_ns + round(timeout_s * NS_PER_S)
    while decision.status.phase != Phase.HOLD and decision.status.t_ns < end_ns:
        if decision.status.outcome != Outcome.NONE:
            return
        decision = session.cycle()


def _wait(session: Session, duration_s: float) -> None:
    decision = session.cycle()
    end_ns = decision.status.t_ns + round(duration_s * NS_PER_S)
    while decision.status.t_ns < end_ns:
        decision = session.cycle()
