"""Torque constant without a load cell: the motor balances a known mass that hangs on one jaw."""

import math
from dataclasses import dataclass
from typing import Final, NoReturn

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from gripper_calibration.procedures.calibrate_servo import PLAUSIBLE_RATIO
from gripper_calibration.procedures.powered_servo import RATE_HZ, BusCycles, servo_alone, torque_on
from gripper_force.config import Config
from gripper_force.control.transmission import force_bound
from gripper_force.errors import ConfigError, DataError, DeviceError
from gripper_force.profiles.rig_profile import CalibratedValue, torque_settings
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.backends import is_simulated, open_devices
from gripper_force.runtime.resolve import make_controller, resolve
from gripper_force.types import STANDARD_GRAVITY_M_S2

LINKAGES: Final = ("rack", "crank_slider", "table")
"""Linkages whose jaws move along a line, so that a weight on one jaw does the same work everywhere."""

_SPEED_M_S: Final = 0.010
PLACES: Final = (0.3, 0.4, 0.5, 0.6)
"""Places at which the weight is balanced, as shares of the travel."""

_RAMP_N_S: Final = 1.5
_MOVED_RAD: Final = 0.01
_REST_S: Final = 0.3
_MIN_N: Final = 1.0
"""Least force at both jaws that the weight is worth."""

_BEHIND_M: Final = 0.006
"""Distance of a jaw behind its goal above which the weight is too heavy for the current."""

_LEAD_M: Final = 0.02
"""Lead of the goal width while the current alone drives the jaws."""

_AGREES: Final = (0.5, 1.2)
"""Range of the configured friction as shares of the breakaway friction, which is larger."""

_MASS_ERROR: Final = 0.01
"""Relative error of a known mass, and of gravity."""

_FORCE_FACTOR: Final = 2.0
_SPARE_N: Final = 0.5
"""The motor force may reach this multiple of what weight and friction need, and this force more."""


@dataclass(frozen=True, slots=True)
class WeightResult:
    """Result of `calibrate_weight`.

    Attributes:
        nm_per_a: Torque constant at the horn.
        ratio: The same over the configured one.
        friction_n: The configured friction at each jaw, with this torque constant; None if it contradicts the next.
        breakaway_n: Friction at which the jaws begin to move.
        weight_n: Weight of the mass.
        places: Number of places at which it was balanced.
    """

    nm_per_a: CalibratedValue
    ratio: float
    friction_n: float | None
    breakaway_n: float
    weight_n: float
    places: int

    @property
    def settings(self) -> dict[str, float]:
        """The keys of the section `gripper` that follow."""
        keys = torque_settings(self.nm_per_a, CalibratedValue(value=self.friction_n or 0.0))
        used = ("nm_per_a", "gain_std", *(() if self.friction_n is None else ("friction_n",)))
        return {key: keys[key] for key in used}


def masses_kg(config: Config) -> tuple[float, float]:
    """Returns the least and the greatest mass that the gripper can lift and measure, in whole grams.

    Raises:
        ConfigError: A weight does not measure this gripper, or its force limit is too small for one.
    """
    kind = config.gripper.linkage.kind
    if kind not in LINKAGES or len(config.servo.ids) > 1:
        raise ConfigError(
            f"a weight measures jaws on rails that one servo moves (gripper.linkage.kind {', '.join(LINKAGES)}), but "
            f"this gripper has {'two servos' if len(config.servo.ids) > 1 else f'linkage {kind}'}; use a load cell"
        )
    gripper = config.gripper
    max_n = 2 * (config.control.force_limit_n / force_bound(gripper) / _FORCE_FACTOR - gripper.friction_n)
    min_kg = math.ceil(1e3 * 2 * _MIN_N / STANDARD_GRAVITY_M_S2) / 1e3
    max_kg = math.floor(1e3 * max_n / STANDARD_GRAVITY_M_S2) / 1e3
    if max_kg < min_kg:
        raise ConfigError(
            f"with control.force_limit_n {config.control.force_limit_n:g} and gripper.friction_n "
            f"{gripper.friction_n:g} the jaws can't lift a mass of {min_kg:g} kg, the least that measures anything; "
            "raise the limit, or use a load cell"
        )
    return min_kg, max_kg


def is_servo_simulated(config: Config) -> bool:
    """Returns True if nobody has to hang up the mass."""
    return is_simulated(servo_alone(config))


def calibrate_weight(
    config: Config, mass_kg: float, *, prompt: Prompt, progress: Progress = no_progress
) -> WeightResult:
    """Finds the motor force that balances the jaws, empty and with the mass on one jaw.

    The weight acts on one jaw, while a motor force acts on both. So by virtual work it balances half of its size as
    a motor force at each jaw. The force rises slowly until the jaws move up, and falls until they move down. The mean
    of both is free of friction, and the difference of loaded and empty is free of the jaws' own weight.

    Args:
        config: The configuration, with geometry and friction as found by `calibrate_jaws`.
        mass_kg: The mass.
        prompt: Called when a person has to turn the gripper, and to hang up the mass.
        progress: Called with each place.

    Raises:
        ConfigError: Geometry or mass is not suitable.
        DeviceError: A device failed, or the jaws start outside their travel. The servo has no torque.
        DataError: The jaws do not lift the mass, or the result contradicts the configuration.
    """
    min_kg, max_kg = masses_kg(config)
    if not min_kg <= mass_kg <= max_kg:
        raise ConfigError(
            f"a mass of {mass_kg:g} kg does not suit this gripper and control.force_limit_n; use one of "
            f"{min_kg:g} to {max_kg:g} kg"
        )
    hung_kg = config.sim.hanging_mass_kg or mass_kg
    config = servo_alone(config)
    simulated = is_simulated(config)
    if simulated:
        config = _simulated(config, 0.0)
    config = resolve(config, vision=False).config
    prompt(
        "Turn the gripper so that one jaw moves straight up while the jaws close, open them, and take everything from "
        "between them"
    )
    empty = _balance(config, 0.0, 0.0, "empty", progress)
    prompt(
        f"Hang {mass_kg:g} kg on a thread from the jaw that moves up while the jaws close, and keep your hands away: "
        "it drops to the open position whenever torque is off"
    )
    if simulated:
        config = _simulated(config, hung_kg)
    weight_n = mass_kg * STANDARD_GRAVITY_M_S2
    loaded = _balance(config, weight_n, weight_n / 2, "loaded", progress)
    if abs(error_n := float(_steps_n(empty, loaded).mean()) - weight_n / 2) > _breakaway_n(empty) / 2:
        # The jaws began beyond the band in which friction holds them: once more from the balance that was found.
        loaded = _balance(config, weight_n, weight_n / 2 + error_n, "loaded, again", progress)
    return _fit(config, empty, loaded, weight_n)


def _simulated(config: Config, hung_kg: float) -> Config:
    return config.with_values(object="none", sim={"hanging_mass_kg": hung_kg})


def _fit(config: Config, empty: "_Balance", loaded: "_Balance", weight_n: float) -> WeightResult:
    gripper = config.gripper
    expected = gripper.nm_per_a
    assert expected is not None
    steps_n = _steps_n(empty, loaded)
    step_n = float(steps_n.mean())
    ratio = weight_n / 2 / step_n if step_n > 0 else math.inf
    if not 1 / PLAUSIBLE_RATIO < ratio < PLAUSIBLE_RATIO:
        raise DataError(
            f"the mass of {weight_n / STANDARD_GRAVITY_M_S2:g} kg changes the motor force at each jaw by {step_n:.2f} "
            f"N instead of about {weight_n / 2:.2f} N; check that it hangs freely on the jaw that moves up while "
            "closing, and check servo.model and gripper.pinion_radius_m"
        )
    half = expected * ratio * math.hypot(_half(steps_n) / step_n, _MASS_ERROR)
    friction_n, breakaway_n = ratio * gripper.friction_n, ratio * _breakaway_n(empty)
    agrees = _AGREES[0] * breakaway_n <= friction_n <= _AGREES[1] * breakaway_n
    return WeightResult(
        nm_per_a=CalibratedValue(
            value=expected * ratio, low=expected * ratio - half, high=expected * ratio + half
        ),
        ratio=ratio,
        friction_n=friction_n if agrees else None,
        breakaway_n=breakaway_n,
        weight_n=weight_n,
        places=len(PLACES),
    )


def _steps_n(empty: "_Balance", loaded: "_Balance") -> npt.NDArray[np.float64]:
    """Motor forces that balance the weight, (P,)."""
    return (loaded.up_n + loaded.down_n - empty.up_n - empty.down_n) / 2


def _breakaway_n(empty: "_Balance") -> float:
    return float((empty.up_n - empty.down_n).mean()) / 2


def _half(values: npt.NDArray[np.float64]) -> float:
    """Half of the 95 % interval of a mean."""
    return float(stdtrit(len(values) - 1, 0.975) * values.std(ddof=1) / math.sqrt(len(values)))


@dataclass(frozen=True, slots=True)
class _Balance:
    """Motor forces at each jaw at which they begin to move up and down, one of each per place, (P,)."""

    up_n: npt.NDArray[np.float64]
    down_n: npt.NDArray[np.float64]


def _balance(config: Config, weight_n: float, expected_n: float, load: str, progress: Progress) -> _Balance:
    with open_devices(config) as devices, torque_on(devices.servo) as (state, raise_if_interrupted):
        if problem := make_controller(config).start_problem(state):
            raise DeviceError(problem)
        jaws = _Jaws(config, BusCycles(config, devices, state, raise_if_interrupted), weight_n, expected_n)
        up_n: list[float] = []
        down_n: list[float] = []
        for number, share in enumerate(PLACES, start=1):
            progress(f"{load}: place {number} of {len(PLACES)}", 0)
            for side, forces_n in ((1, up_n), (-1, down_n)):
                jaws.move(share)
                forces_n.append(jaws.break_away(side))
        jaws.move(0.0)
    return _Balance(np.array(up_n), np.array(down_n))


class _Jaws:
    """Moves the jaws with a limited motor force."""

    def __init__(self, config: Config, cycles: BusCycles, weight_n: float, expected_n: float) -> None:
        self._config, self._cycles = config, cycles
        transmission, friction_n = cycles.transmission, config.gripper.friction_n
        middle_rad = transmission.position_rad(transmission.open_width_m / 2)
        ceiling_n = abs(transmission.force_n(cycles.limits.ceiling_a(0.0, middle_rad), middle_rad))
        self._max_n = min(_FORCE_FACTOR * (weight_n / 2 + friction_n) + _SPARE_N, ceiling_n)
        self._expected_n, self._is_loaded = expected_n, weight_n > 0
        self._speed_m_s = min(_SPEED_M_S, cycles.approach_m_s)

    @property
    def _width_m(self) -> float:
        return self._cycles.transmission.width_m(self._cycles.state.position_rad)

    def move(self, share: float) -> None:
        """Moves to a share of the travel at a low speed, and rests there."""
        goal_m, next_m = (1 - share) * self._cycles.transmission.open_width_m, self._width_m
        step_m = 2 * self._speed_m_s / RATE_HZ
        rest = round(_REST_S * RATE_HZ)
        while rest > 0:
            rest -= next_m == goal_m
            next_m += min(max(goal_m - next_m, -step_m), step_m)
            self._cycle(next_m, self._max_n)
            if abs(self._width_m - next_m) / 2 > _BEHIND_M:
                self._raise_stuck("are far behind their goal")

    def break_away(self, side: int) -> float:
        """Raises (1) or lowers (-1) the closing motor force from the expected one until the jaws follow. Returns it."""
        begin_m, force_n = self._width_m, self._expected_n
        moved_m = 2 * _MOVED_RAD * self._cycles.transmission.jaw_m_per_rad(self._cycles.state.position_rad)
        while side * (begin_m - self._width_m) < moved_m:
            force_n += side * _RAMP_N_S / RATE_HZ
            if abs(force_n) > self._max_n:
                self._raise_stuck("do not move")
            self._cycle(self._width_m - math.copysign(_LEAD_M, force_n), abs(force_n))
        return force_n

    def _raise_stuck(self, problem: str) -> NoReturn:
        remedy = "check gripper.closing_sign and gripper.friction_n with `calibrate jaws`, and that nothing blocks them"
        if self._is_loaded:
            remedy = (
                "take a smaller mass, and check that it hangs on the jaw that moves up while closing, and that nothing "
                "blocks it"
            )
        raise DataError(
            f"the jaws {problem} at {1e3 * self._width_m:.0f} mm with a motor force of {self._max_n:.1f} N; {remedy}"
        )

    def _cycle(self, goal_width_m: float, force_n: float) -> None:
        cycles, transmission = self._cycles, self._cycles.transmission
        state = cycles.read()
        current_a = abs(transmission.current_a(force_n, state.position_rad))
        cycles.write(transmission.position_rad(goal_width_m), current_a, cycles.approach_m_s)
