"""Speed and error of the simulated scene: each object at each level of detail, compared with the finest."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from gripper_force.config import GripperConfig
from gripper_force.schema import to_yaml
from gripper_force.types import NS_PER_MS, NS_PER_S
from gripper_hw.sim import detail_level
from gripper_hw.sim.meshes import Detail
from gripper_hw.sim.objects import OBJECTS
from gripper_hw.sim.scene import Scene
from gripper_hw.sim.world import World

_CLOSING_M_S: Final = 0.016
"""Closing speed of the jaws on the path."""

_MAX_FORCE_N: Final = 10.0
"""Force at which a squeeze ends."""

_MAX_NS: Final = 4 * NS_PER_S
"""Longest squeeze, in simulated time."""

_SAMPLE_NS: Final = 5 * NS_PER_MS
"""Interval of the compared forces."""

_REPEATS: Final = 2
"""Runs of each scene; the faster one counts."""

_TABLE_HEADER: Final = (
    "# Made by `gripper-force bench scene --write docs/simulation.md`. Do not edit by hand.\n"
)

Curve = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SceneCost:
    """Cost of an object at a level of detail, squeezed along a fixed path up to 10 N, physics only, no noise.

    Attributes:
        object: Name of the object.
        detail: Level of detail.
        unknowns: Degrees of freedom of the scene.
        step_ms: Time step.
        iterations: Mean number of solver iterations per step.
        speed: Simulated seconds per CPU second.
        error_n: RMS difference of the force to the finest level at equal travel.
        worst_n: Largest difference.
    """

    object: str
    detail: str
    unknowns: int
    step_ms: float
    iterations: float
    speed: float
    error_n: float
    worst_n: float


class _FollowPath:
    """Motor that moves the jaws along the path, with more current than any object needs."""

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        goal_rad = _CLOSING_M_S / GripperConfig().pinion_radius_m * t_ns / NS_PER_S
        return float(np.clip(8.0 * (goal_rad - position_rad) - 0.3 * velocity_rad_s, -1.0, 1.0))


class _Squeeze(NamedTuple):
    """Force every 5 ms of the path in N, (N,), and the cost of the simulation."""

    force_n: Curve
    unknowns: int
    step_ms: float
    iterations: float
    speed: float


def count_rows(names: list[str]) -> int:
    """Number of rows of `scene_costs`."""
    return len(names or OBJECTS) * len(get_args(Detail))


def scene_costs(names: list[str], keep_table: bool) -> Iterator[SceneCost]:
    """Squeezes objects up to 10 N at each level of detail, along one path.

    Args:
        names: Keys of `OBJECTS`; an empty list means all.
        keep_table: True to write the table of ``sim.detail=auto``.

    Raises:
        ConfigError: An object does not exist.
        SimulationError: A simulation became unstable.
    """
    table: dict[str, dict[str, dict[str, float]]] = {}
    for name in names or OBJECTS:
        squeezes = {detail: _squeeze(name, detail) for detail in get_args(Detail)}
        fine_n = squeezes["fine"].force_n
        for detail, one in squeezes.items():
            span = min(len(fine_n), len(one.force_n))
            off_n = one.force_n[:span] - fine_n[:span]
            error_n = float(np.sqrt(np.mean(off_n**2)))
            row = SceneCost(
                object=name,
                detail=detail,
                unknowns=one.unknowns,
                step_ms=one.step_ms,
                iterations=one.iterations,
                speed=one.speed,
                error_n=error_n,
                worst_n=float(np.abs(off_n).max()),
            )
            table.setdefault(name, {})[detail] = {
                "error_n": round(error_n, 3),
                "speed": float(f"{one.speed:.2g}"),
            }
            yield row
    if keep_table:
        detail_level.TABLE.write_text(_TABLE_HEADER + to_yaml(table), encoding="utf-8")


def _squeeze(name: str, detail: Detail) -> _Squeeze:
    """Squeezes an object twice; the shorter time counts."""
    scene = Scene(name, detail)
    cost_s = []
    for _ in range(_REPEATS):
        world = World(scene, GripperConfig(), _FollowPath(), nm_per_a=1.78, seed=0, textured=False)
        force_n, iterations = [], []
        begin_s = time.process_time()
        while world.force_n < _MAX_FORCE_N and world.t_ns < _MAX_NS:
            world.advance_to(world.t_ns + _SAMPLE_NS)
            force_n.append(world.force_n)
            iterations.append(world.iterations)
        cost_s.append(time.process_time() - begin_s)
    speed = world.t_ns / NS_PER_S / min(cost_s)
    step_ms = world.step_ns / NS_PER_MS
    return _Squeeze(np.array(force_n), world.unknowns, step_ms, float(np.mean(iterations)), speed)


def markdown(rows: Iterable[SceneCost]) -> str:
    """Markdown table of the costs."""
    lines = [
        "| object | detail | unknowns | step, ms | iterations | simulated s/s | RMSE, N | worst, N |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        solver = f"{r.unknowns} | {r.step_ms:g} | {r.iterations:.1f}"
        figures = f"{r.speed:.1f} | {r.error_n:.2f} | {r.worst_n:.2f}"
        lines.append(f"| {r.object} | {r.detail} | {solver} | {figures} |")
    return "\n".join(lines)
