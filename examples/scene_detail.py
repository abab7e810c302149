"""How much detail does a scene need? Speed against error of each level, measured against the finest.

Every level closes the jaws along the same path, and its force is compared at equal travel.

    python examples/scene_detail.py
"""

import time
from typing import get_args

import numpy as np
import numpy.typing as npt

from gripper_force.config import GripperConfig
from gripper_hw.sim.objects import OBJECTS, Detail
from gripper_hw.sim.scene import Scene
from gripper_hw.sim.world import World

CLOSING_M_S = 0.016
MAX_FORCE_N = 10.0
STEP_NS = 5_000_000

Curve = npt.NDArray[np.float64]


class FollowPath:
    """A motor that moves the jaws along the path with more current than any object needs."""

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        """Current of a stiff position loop."""
        goal_rad = CLOSING_M_S / GripperConfig().pinion_radius_m * t_ns * 1e-9
        return float(np.clip(8.0 * (goal_rad - position_rad) - 0.3 * velocity_rad_s, -1.0, 1.0))


def squeeze(name: str, detail: Detail) -> tuple[Curve, float]:
    """Closes on an object up to 10 N: force at each travel, (N, 2), and computing time a simulated second."""
    world = World(Scene(name, detail), GripperConfig(), FollowPath(), nm_per_a=1.78, seed=0)
    points = []
    begin = time.process_time()
    while world.force_n < MAX_FORCE_N and world.t_ns < 4_000_000_000:
        world.advance_to(world.t_ns + STEP_NS)
        points.append((CLOSING_M_S * world.t_ns * 1e-9, world.force_n))
    return np.array(points), (time.process_time() - begin) / (world.t_ns * 1e-9)


def main() -> None:
    """Prints the table."""
    print("| object | detail | s a simulated s | force RMSE against fine, N |\n|---|---|---|---|")
    for name in OBJECTS:
        curves = {detail: squeeze(name, detail) for detail in get_args(Detail)}
        fine, _ = curves["fine"]
        for detail, (curve, cost) in curves.items():
            span = min(len(fine), len(curve))
            rmse_n = float(np.sqrt(np.mean((curve[:span, 1] - fine[:span, 1]) ** 2)))
            print(f"| {name} | {detail} | {cost:.2f} | {rmse_n:.2f} |", flush=True)


if __name__ == "__main__":
    main()
