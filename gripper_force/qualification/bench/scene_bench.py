"""Speed against error of the simulated scene: each object at each level of detail, against the finest."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from gripper_force.config import GripperConfig
from gripper_force.types import NS_PER_MS, NS_PER_S
from gripper_hw.sim.detail_level import write_table
from gripper_hw.sim.objects import OBJECTS, Detail
from gripper_hw.sim.scene import Scene
from gripper_hw.sim.world import World

_CLOSING_M_S: Final = 0.016
_MOST_N: Final = 10.0
_LONGEST_NS: Final = 4 * NS_PER_S
_SAMPLE_NS: Final = 5 * NS_PER_MS
_TIMES: Final = 2

Curve = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SceneCost:
    """An object at a level of detail, squeezed along one path up to 10 N: physics alone, without noise.

    Attributes:
        object: Its name.
        detail: The level.
        unknowns: Degrees of freedom of the scene: how fine the mesh is.
        step_ms: Time step.
        iterations: The solver's iterations in a step, on the average.
        speed: Simulated seconds a second of one CPU.
        error_n: Root mean square difference of its force from the finest level's at equal travel.
        worst_n: The greatest difference.
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
    """A motor that moves the jaws along the path with more current than any object needs."""

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        goal_rad = _CLOSING_M_S / GripperConfig().pinion_radius_m * t_ns / NS_PER_S
        return float(np.clip(8.0 * (goal_rad - position_rad) - 0.3 * velocity_rad_s, -1.0, 1.0))


class _Squeeze(NamedTuple):
    """Force every 5 ms of the path, (N,), and what it took."""

    force_n: Curve
    unknowns: int
    step_ms: float
    iterations: float
    speed: float


def scene_costs(names: list[str], keep_table: bool) -> Iterator[SceneCost]:
    """Squeezes objects up to 10 N at each level, along one path.

    Args:
        names: Keys of `OBJECTS`; none: all.
        keep_table: Whether to keep the table for ``sim.detail=auto``.

    Raises:
        ConfigError: There is no such object.
        SimulationError: A scene broke.
    """
    table: dict[str, dict[str, dict[str, float]]] = {}
    for name in names or OBJECTS:
        seen = {detail: _squeeze(name, detail) for detail in get_args(Detail)}
        fine_n = seen["fine"].force_n
        for detail, one in seen.items():
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
        write_table(table)


def _squeeze(name: str, detail: Detail) -> _Squeeze:
    """Closes on an object; of two times that this takes, the shorter."""
    scene = Scene(name, detail)
    cost_s = []
    for _ in range(_TIMES):
        world = World(scene, GripperConfig(), _FollowPath(), nm_per_a=1.78, seed=0, textured=False)
        force_n, iterations = [], []
        begin_s = time.process_time()
        while world.force_n < _MOST_N and world.t_ns < _LONGEST_NS:
            world.advance_to(world.t_ns + _SAMPLE_NS)
            force_n.append(world.force_n)
            iterations.append(world.iterations)
        cost_s.append(time.process_time() - begin_s)
    speed = world.t_ns / NS_PER_S / min(cost_s)
    step_ms = world.step_ns / NS_PER_MS
    return _Squeeze(np.array(force_n), world.unknowns, step_ms, float(np.mean(iterations)), speed)


def markdown(rows: Iterable[SceneCost]) -> str:
    """The table for a page."""
    lines = [
        "| object | detail | unknowns | step, ms | iterations | simulated s/s | RMSE, N | worst, N |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        solver = f"{r.unknowns} | {r.step_ms:g} | {r.iterations:.1f}"
        figures = f"{r.speed:.1f} | {r.error_n:.2f} | {r.worst_n:.2f}"
        lines.append(f"| {r.object} | {r.detail} | {solver} | {figures} |")
    return "\n".join(lines)
