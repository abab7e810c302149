"""Torque constant and friction without a load cell: the motor lifts and lowers a known mass that hangs on one jaw."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import t as student

from gripper_force.config import Config
from gripper_force.control.limits import Limits
from gripper_force.control.safety import Safety
from gripper_force.control.transmission import Transmission
from gripper_force.errors import ConfigError, DataError, DeviceError
from gripper_force.interfaces import Devices, Progress, Prompt, no_progress
from gripper_force.profiles.rig_profile import CalibratedValue
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.resolve import resolve
from gripper_force.types import NS_PER_S, ServoCommand, ServoState

STANDARD_GRAVITY_M_S2: Final = 9.80665
KINDS: Final = ("rack", "crank_slider", "table")
"""Linkages whose jaws move along a line, so that a weight on one jaw does the same work everywhere."""

_RATE_HZ: Final = 200.0
_SPEED_M_S: Final = 0.010
_ENDS: Final = (0.3, 0.7)
"""Ends of the measured stretch, as shares of the travel of a jaw."""

_REPEATS: Final = 4
_REST_S: Final = 0.3
_LEAST_N: Final = 1.0
"""Least force at both jaws that the weight is worth."""

_BEHIND_M: Final = 0.006
"""Distance of a jaw behind its goal above which the weight is too heavy for the current."""

_MASS_ERROR: Final = 0.01
"""Relative error of a known mass, and of gravity."""

_PLAUSIBLE_RATIO: Final = 1.4


@dataclass(frozen=True, slots=True)
class WeightResult:
    """Result of `calibrate_weight`.

    Attributes:
        nm_per_a: Torque constant at the horn.
        friction_n: Coulomb friction at each jaw.
        weight_n: Weight of the mass.
        passes: Number of lifts, each with a lowering.
    """

    nm_per_a: CalibratedValue
    friction_n: CalibratedValue
    weight_n: float
    passes: int


def calibrate_weight(
    config: Config, mass_kg: float, *, prompt: Prompt, progress: Progress = no_progress
) -> WeightResult:
    """Moves the jaws up and down slowly, empty and with the mass on one jaw.

    The weight acts on one jaw, while a motor force acts on both. So by virtual work it balances half of its size as
    a motor force at each jaw. The mean of lifting and lowering is free of friction, and the difference of loaded and
    empty is free of the jaws' own weight.

    Args:
        config: The configuration, with geometry and friction as found by `calibrate_jaws`.
        mass_kg: The mass.
        prompt: Called when a person has to turn the gripper, and to hang up the mass.
        progress: Called with each pass.

    Raises:
        ConfigError: The geometry or the mass is not suitable.
        DeviceError: A device failed. The servo has no torque.
        DataError: The jaws do not lift the mass, or the results contradict each other.
    """
    kind = config.gripper.linkage.kind
    if kind not in KINDS or len(config.servo.ids) > 1:
        raise ConfigError(
            f"a weight measures jaws on rails that one servo moves ({', '.join(KINDS)}), but gripper.linkage.kind is "
            f"{kind} and servo.second.id {config.servo.second.id}; use a load cell"
        )
    none = {
        name: getattr(config, name).model_copy(update={"backend": "none"}) for name in ("camera", "load_cell")
    }
    config = resolve(config.model_copy(update=none), vision=False).config
    weight_n = mass_kg * STANDARD_GRAVITY_M_S2
    most_n = 2 * (config.control.force_limit_n / config.gripper.gain_bound - 2 * config.gripper.friction_n)
    if not 2 * _LEAST_N <= weight_n <= most_n:
        raise ConfigError(
            f"a mass of {mass_kg:g} kg does not fit this gripper; use {2 * _LEAST_N / STANDARD_GRAVITY_M_S2:.1f} to "
            f"{most_n / STANDARD_GRAVITY_M_S2:.1f} kg"
        )
    prompt("Turn the gripper so that one jaw moves straight up while the jaws close, with nothing between them")
    empty = _lift(config, 0.0, "empty", progress)
    prompt(f"Hang {mass_kg:g} kg on a thread from the jaw that moves up while the jaws close")
    loaded = _lift(config, weight_n, "loaded", progress)
    return _fit(config, empty, loaded, weight_n)


def _fit(config: Config, empty: "_Passes", loaded: "_Passes", weight_n: float) -> WeightResult:
    expected = config.gripper.nm_per_a
    assert expected is not None
    steps_n = (loaded.lifting_n + loaded.lowering_n - empty.lifting_n - empty.lowering_n) / 2
    step_n = float(steps_n.mean())
    if step_n <= 0 or not 1 / _PLAUSIBLE_RATIO < weight_n / 2 / step_n < _PLAUSIBLE_RATIO:
        raise DataError(
            f"the mass of {weight_n / STANDARD_GRAVITY_M_S2:g} kg changes the motor force at each jaw by {step_n:.2f} "
            f"N instead of about {weight_n / 2:.2f} N; check that it hangs freely on the jaw that moves up while "
            "closing, and check servo.model and gripper.pinion_radius_m"
        )
    ratio = weight_n / 2 / step_n
    half = ratio * math.hypot(_half(steps_n) / step_n, _MASS_ERROR)
    frictions_n = ratio * (empty.lifting_n - empty.lowering_n) / 2 - config.gripper.damping_n_s_m * _SPEED_M_S
    return WeightResult(
        nm_per_a=_around(expected * ratio, expected * half),
        friction_n=_around(float(frictions_n.mean()), _half(frictions_n)),
        weight_n=weight_n,
        passes=2 * _REPEATS,
    )


def _around(value: float, half: float) -> CalibratedValue:
    return CalibratedValue(value=value, low=value - half, high=value + half)


def _half(values: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> float:
    """Half of the 95 % interval of a mean."""
    return float(student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values)))


@dataclass(frozen=True, slots=True)
class _Passes:
    """Mean motor forces at each jaw while the jaws close and open, one of each per repeat, (R,)."""

    lifting_n: "np.ndarray[tuple[int], np.dtype[np.float64]]"
    lowering_n: "np.ndarray[tuple[int], np.dtype[np.float64]]"


def _lift(config: Config, weight_n: float, load: str, progress: Progress) -> _Passes:
    with open_devices(config) as devices, _torque_on(config, devices, weight_n) as jaws:
        jaws.move(_ENDS[0])
        lifting, lowering = [], []
        for number in range(1, _REPEATS + 1):
            progress(f"{load}: lift {number} of {_REPEATS}", 0)
            lifting.append(jaws.move(_ENDS[1]))
            lowering.append(jaws.move(_ENDS[0]))
        jaws.move(0.0)
    return _Passes(np.array(lifting), np.array(lowering))


@contextmanager
def _torque_on(config: Config, devices: Devices, weight_n: float) -> Iterator["_Jaws"]:
    """Yields jaws under torque, and turns torque off at every end."""
    state = devices.servo.start()  # if this raises, it has turned torque off itself
    try:
        yield _Jaws(config, devices, state, weight_n)
    finally:
        devices.servo.stop(hold=False)


class _Jaws:
    """Moves the jaws at one low speed."""

    def __init__(self, config: Config, devices: Devices, state: ServoState, weight_n: float) -> None:
        gripper = config.gripper
        self._devices, self._state = devices, state
        self._transmission = transmission = Transmission.from_config(
            gripper, gripper.nm_per_a or 0.0, gripper.current_step_a or 0.0
        )
        self._safety = Safety(config.control)
        limits = Limits(config.control, transmission, config.servo.current_limit_a)
        middle_rad = transmission.position_rad(transmission.open_width_m / 2)
        # Twice the load, friction and the losses that grow with the load; never above the force limit.
        wanted_a = abs(transmission.current_a(2 * (weight_n / 2 + gripper.friction_n) + 0.5, middle_rad))
        self._current_a = min(wanted_a, limits.ceiling_a(math.inf, middle_rad))
        self._period_ns = round(NS_PER_S / _RATE_HZ)
        self._due_ns = devices.clock.now_ns()
        self._width_m = transmission.width_m(state.position_rad)

    def move(self, share: float) -> float:
        """Moves to a share of the travel. Returns the mean motor force at each jaw on the way."""
        transmission = self._transmission
        goal_m = (1 - share) * transmission.open_width_m
        step_m = 2 * _SPEED_M_S / _RATE_HZ
        forces_n = []
        while abs(goal_m - self._width_m) > step_m:
            self._width_m += math.copysign(step_m, goal_m - self._width_m)
            self._cycle()
            forces_n.append(transmission.force_n(self._state.current_a, self._state.position_rad))
        for _ in range(round(_REST_S * _RATE_HZ)):
            self._cycle()
        used = forces_n[round(0.25 * len(forces_n)) : round(0.9 * len(forces_n))]
        return float(np.mean(used)) if used else 0.0

    def _cycle(self) -> None:
        devices, transmission = self._devices, self._transmission
        self._due_ns = max(self._due_ns + self._period_ns, devices.clock.now_ns())
        devices.clock.sleep_until_ns(self._due_ns)
        devices.check()
        self._state = state = devices.servo.read()
        if self._safety.check(state, self._current_a, 1 / _RATE_HZ, over_force=False):
            raise DeviceError(f"stopped: {self._safety.reason}; remove the cause and start again")
        behind_m = abs(transmission.width_m(state.position_rad) - self._width_m) / 2
        if behind_m > _BEHIND_M:
            raise DataError(
                f"the jaws are {1e3 * behind_m:.0f} mm behind their goal at {self._current_a:.2f} A; take a smaller "
                "mass, and check that it hangs on the jaw that moves up while closing and that nothing blocks it"
            )
        goal_rad = transmission.position_rad(max(self._width_m, 0.0))
        devices.servo.write(ServoCommand(self._due_ns, goal_rad, self._current_a))
