"""Hard cases for the simulator: the force error of the time step, and detection of unstable simulations."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config, GripperConfig
from gripper_force.errors import SimulationError
from gripper_force.qualification.numerics.numerical_case import NumericalCase
from gripper_force.types import NS_PER_MS, NS_PER_S
from gripper_hw.sim.meshes import Detail
from gripper_hw.sim.objects import OBJECTS
from gripper_hw.sim.scene import Scene
from gripper_hw.sim.world import World

STEPS_S: Final = (0.00025, 0.0005, 0.001, 0.002, 0.0025, 0.004)
"""Time steps; the first is the reference for the others."""

TOO_LONG_S: Final = (0.005, 0.008)
"""Time steps that must be refused."""

_ERROR_N: Final = 0.25
"""Bound of the RMS force error: 2 % of the force that is reached."""

_DETAIL: Final[Detail] = "medium"
_NM_PER_A: Final = 1.78
_CURRENT_A: Final = 0.3
"""Highest motor current of a squeeze, which gives a grip of 12 N."""

_RAMP_S: Final = 1.6
"""Time in which the current rises to it."""

_TIME_S: Final = 2.0
"""Duration of a squeeze."""

_BRAKE_A_S: Final = 0.03
"""Damping of a squeeze, in A per rad/s."""

_SAMPLE_NS: Final = 4 * NS_PER_MS
"""Interval of the compared forces; no shorter than the longest step."""

_UNTIL_S: Final = 1.0
"""Simulated time within which an unstable simulation must be detected."""

_CHECKS: Final = {
    "warns": "MuJoCo's warning",
    "not finite": "acceleration",
    "deep": "depth",
    "slipped": "rack",
    "reads": "force",
}
"""Words in the messages of `SimulationError`, and the check that raises each."""

Drive = Callable[[float, float], float]
"""Motor current in A from time in s and speed of the horn in rad/s."""

Curve = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Motor:
    drive: Drive

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        return self.drive(t_ns / NS_PER_S, velocity_rad_s)


def _squeeze(t_s: float, velocity_rad_s: float) -> float:
    """Current that rises to a grip of 12 N, with damping so that the jaws close slowly."""
    return _CURRENT_A * min(t_s / _RAMP_S, 1.0) - _BRAKE_A_S * velocity_rad_s


_UNSTABLE: Final[dict[str, Drive]] = {
    "motor current NaN": lambda t_s, _: math.nan if t_s > 0.3 else 0.1,
    "infinite motor current": lambda t_s, _: math.inf if t_s > 0.3 else 0.1,
    "motor current of 1e300 A": lambda t_s, _: 1e300 if t_s > 0.3 else 0.1,
    "constant motor current of 3 A": lambda _t, _v: 3.0,
    "constant motor current of 10 A": lambda _t, _v: 10.0,
    "constant motor current of 100 A": lambda _t, _v: 100.0,
}


def cases(
    _config: Config,
    _maps: Path | None,
    objects: Sequence[str] = tuple(OBJECTS),
    steps_s: Sequence[float] = STEPS_S,
) -> Iterator[NumericalCase]:
    """Yields the cases of the simulator.

    Args:
        objects: Keys of `OBJECTS`.
        steps_s: Time steps, the finest first.
    """
    for name in objects:
        _, finest_s, finest_n, _ = _run(name, steps_s[0])
        for step_s in steps_s[1:]:
            error, times_s, force_n, speed = _run(name, step_s)
            off_n = force_n - np.interp(times_s, finest_s, finest_n)
            error_n = float(np.sqrt(np.mean(off_n**2)))
            yield NumericalCase(
                f"{name}, step {1e3 * step_s:g} ms",
                error
                or f"{speed:.2g} times real time, worst {np.abs(off_n).max():.2f} N; RMS error against "
                f"{1e3 * steps_s[0]:g} ms on a squeeze up to {finest_n[-1]:.0f} N",
                math.nan if error else error_n,
                _ERROR_N,
                "N",
            )
    yield NumericalCase(
        "steps of " + " and ".join(f"{1e3 * step_s:g} ms" for step_s in TOO_LONG_S),
        f"simulations of {', '.join(objects)} that are not refused",
        float(sum(_is_built(name, step_s) for name in objects for step_s in TOO_LONG_S)),
        0.0,
    )
    for case, drive in _UNSTABLE.items():
        detected = Counter(_detecting_check(name, drive) for name in objects)
        undetected = detected.pop("", 0)
        checks = ", ".join(f"{check} {count}" for check, count in detected.most_common())
        detail = f"detected by: {checks}; number of simulations that continue"
        yield NumericalCase(case, detail, float(undetected), 0.0)


def _world(name: str, step_s: float | None, drive: Drive) -> World:
    return World(
        Scene(name, _DETAIL), GripperConfig(), _Motor(drive), _NM_PER_A, seed=0, textured=False, step_s=step_s
    )


def _run(name: str, step_s: float) -> tuple[str, Curve, Curve, float]:
    """Error message, empty if there is none; times in s and forces in N, (N,); speed over real time."""
    world = _world(name, step_s, _squeeze)
    times_s, forces_n, message = [], [], ""
    begin_s = time.process_time()
    try:
        for due_ns in range(_SAMPLE_NS, round(_TIME_S * NS_PER_S), _SAMPLE_NS):
            world.advance_to(due_ns)
            times_s.append(world.t_ns / NS_PER_S)
            forces_n.append(world.force_n)
    except SimulationError as error:
        message = str(error)
    speed = world.t_ns / NS_PER_S / max(time.process_time() - begin_s, 1e-9)
    return message, np.array(times_s), np.array(forces_n), speed


def _is_built(name: str, step_s: float) -> bool:
    try:
        _world(name, step_s, _squeeze)
    except SimulationError:
        return False
    return True


def _detecting_check(name: str, drive: Drive) -> str:
    """Name of the check that ended a simulation, or an empty string if none did."""
    world = _world(name, None, drive)
    try:
        world.advance_to(round(_UNTIL_S * NS_PER_S))
    except SimulationError as error:
        return next((check for word, check in _CHECKS.items() if word in str(error)), "MuJoCo's own error")
    return ""
