"""Speed against error of the simulated scene: each object at each level of detail, beside the finest."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from gripper_force.backends import SCENE_COSTS, load


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


def scene(names: list[str], *, keep: bool) -> Iterator[SceneCost]:
    """Measures objects, level by level.

    Args:
        names: The objects; none: all there are.
        keep: Whether the table becomes the one that ``sim.detail=auto`` chooses by.

    Raises:
        ConfigError: There is no such object.
        SimulationError: A scene broke.
    """
    yield from load(SCENE_COSTS)(names, keep)


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
