"""Homing: both ends of the jaws' travel, the closing direction and friction, without a load cell."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np

from gripper_calibration.procedures.powered_servo import RATE_HZ, BusCycles, servo_alone, torque_on
from gripper_force.config import Config
from gripper_force.control.approach import SPEED_GAIN_N_S_M, SPEED_INTEGRAL_N_M
from gripper_force.control.transmission import Transmission
from gripper_force.errors import DataError
from gripper_force.interfaces import Devices
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.resolve import resolve
from gripper_force.types import ServoState

_START_N: Final = 1.0
"""Motor force at first. Jaws that friction holds get more; the configured friction may be wrong."""

_MORE: Final = 1.5
"""An end is confirmed with this much more current: friction would let the jaws move on."""

_STILL_RAD: Final = 0.005
_STILL_S: Final = 0.4
"""The jaws stand still if they move by less than this in this time."""

_END_RAD: Final = 0.03
"""Largest difference between two measurements of an end."""

_GIVES_RAD: Final = 0.06
"""Largest motion at an end under more current: pads and stops are elastic, and a linkage presses harder there."""

_MIN_TRAVEL_RAD: Final = 0.2
_MAX_TRAVEL_RAD: Final = 4 * math.pi
_OPEN_SHARE: Final = 0.35
"""Largest distance of the start from the open end, as a share of the travel."""

_WIDTH_SHARE: Final = 0.2
"""Largest difference between the measured and the configured travel."""

_INSET_M: Final = 0.001
"""Distance of the proposed open width from the end."""

_PLACES: Final = (0.3, 0.5, 0.7)
"""Places at which friction is measured, as shares of the travel."""

_RISE_N_S: Final = 1.0
_MOVED_RAD: Final = 0.01
_RUN_S: Final = 0.8
_RUN_SPEED_SHARE: Final = 0.5
_REST_S: Final = 0.3
_MAX_ASYMMETRY: Final = 3.0


@dataclass(frozen=True, slots=True)
class JawsResult:
    """Result of `calibrate_jaws`. Friction is that at one jaw, by the configured torque constant.

    Attributes:
        open_end_rad: Servo angle at the open end.
        closed_end_rad: Servo angle at the closed end.
        repeat_rad: Largest difference between two measurements of an end.
        breakaway_n: Friction at which the jaws begin to move: closing, opening.
        running_n: Friction of moving jaws: closing, opening.
        closing_sign: Proposed `gripper.closing_sign`.
        open_position_rad: Proposed `gripper.open_position_rad`.
        open_width_m: Proposed `gripper.open_width_m`.
        friction_n: Proposed `gripper.friction_n`.
        position_bound_rad: Proposed `gripper.position_bound_rad`; None for a rack, which needs none.
    """

    open_end_rad: float
    closed_end_rad: float
    repeat_rad: float
    breakaway_n: tuple[float, float]
    running_n: tuple[float, float]
    closing_sign: int
    open_position_rad: float
    open_width_m: float
    friction_n: float
    position_bound_rad: float | None

    @property
    def yaml(self) -> str:
        """The proposed configuration."""
        return (
            "gripper:\n"
            f"  closing_sign: {self.closing_sign}\n"
            f"  open_position_rad: {self.open_position_rad:.4f}\n"
            f"  open_width_m: {self.open_width_m:.4f}\n"
            f"  friction_n: {self.friction_n:.2f}\n"
            + (f"  position_bound_rad: {self.position_bound_rad:.2f}\n" if self.position_bound_rad else "")
        )


def calibrate_jaws(config: Config, *, prompt: Prompt, progress: Progress = no_progress) -> JawsResult:
    """Closes and opens the empty jaws with a small current and proposes the configuration.

    The lengths of a linkage are not measured: they must be right.

    Args:
        config: The configuration.
        prompt: Called once, when a person has to open the jaws.
        progress: Called with each step.

    Raises:
        ConfigError: The configuration is not complete.
        DeviceError: A device failed. The servo has no torque.
        DataError: The jaws do not move, have no ends, or the results contradict each other.
    """
    # The configured angle may be wrong, so the travel is assumed around zero, where every servo can be.
    travel_rad = Transmission.from_config(config.gripper, 1.0).linkage.closing_rad(0.0)
    unknown = {
        "open_position_rad": -config.gripper.closing_sign * travel_rad / 2,
        "position_bound_rad": travel_rad,
    }
    config = servo_alone(config).with_values(gripper=unknown)
    config = resolve(config, vision=False).config
    prompt("Take everything from between the jaws and open them by hand")
    with open_devices(config) as devices, _torque_on(config, devices, progress) as jaws:
        start_rad = jaws.state.position_rad
        ends = [jaws.find_ends() for _ in range(2)]
        high_rad, low_rad = (float(np.mean([pair[side] for pair in ends])) for side in (0, 1))
        repeat_rad = max(abs(ends[0][side] - ends[1][side]) for side in (0, 1))
        _check_ends(start_rad, low_rad, high_rad, repeat_rad)
        sign = 1 if start_rad - low_rad < high_rad - start_rad else -1
        jaws.raise_current()
        friction = [jaws.friction(side, low_rad, high_rad) for side in (sign, -sign)]
        jaws.rest()
    open_rad, closed_rad = (low_rad, high_rad) if sign > 0 else (high_rad, low_rad)
    (closing_start_n, closing_n), (opening_start_n, opening_n) = friction
    _check_friction((closing_start_n, opening_start_n), (closing_n, opening_n))
    width_m, position_rad, bound_rad = _proposal(config, open_rad, closed_rad, sign)
    return JawsResult(
        open_end_rad=open_rad,
        closed_end_rad=closed_rad,
        repeat_rad=repeat_rad,
        breakaway_n=(closing_start_n, opening_start_n),
        running_n=(closing_n, opening_n),
        closing_sign=sign,
        open_position_rad=position_rad,
        open_width_m=width_m,
        friction_n=(closing_n + opening_n) / 2,
        position_bound_rad=bound_rad,
    )


def _check_ends(start_rad: float, low_rad: float, high_rad: float, repeat_rad: float) -> None:
    travel_rad = high_rad - low_rad
    if travel_rad < _MIN_TRAVEL_RAD:
        raise DataError(
            f"the jaws move by {travel_rad:.2f} rad only, between {low_rad:.2f} and {high_rad:.2f} rad, with all the "
            "current that servo.current_limit_a and control.force_limit_n allow; remove what blocks them, and check "
            "that they run smoothly"
        )
    if repeat_rad > _END_RAD:
        raise DataError(
            f"two measurements of an end differ by {repeat_rad:.3f} rad; check that the horn is screwed tight and "
            "nothing lies between the jaws"
        )
    if min(start_rad - low_rad, high_rad - start_rad) > _OPEN_SHARE * travel_rad:
        raise DataError(
            f"the jaws were not open at the start: {start_rad:.2f} rad is near the middle of their travel from "
            f"{low_rad:.2f} to {high_rad:.2f} rad, so the closing direction is unknown; open them and start again"
        )


def _check_friction(breakaway_n: tuple[float, float], running_n: tuple[float, float]) -> None:
    if min(running_n) <= 0 or max(running_n) > _MAX_ASYMMETRY * min(running_n):
        raise DataError(
            f"the friction is {running_n[0]:.2f} N while closing and {running_n[1]:.2f} N while opening; check for "
            "a cable or a weight that pulls the jaws, and start again"
        )
    if min(breakaway_n) < min(running_n) / _MAX_ASYMMETRY:
        raise DataError(
            f"the jaws begin to move at {min(breakaway_n):.2f} N and need {min(running_n):.2f} N to keep moving; "
            "check that nothing pushes them, and start again"
        )


def _proposal(
    config: Config, open_rad: float, closed_rad: float, sign: int
) -> tuple[float, float, float | None]:
    """Returns width, angle and bound of the angle's error of the open jaws.

    Raises:
        DataError: The travel contradicts the configuration.
    """
    gripper = config.gripper
    travel_rad = abs(closed_rad - open_rad)
    linkage = Transmission.from_config(gripper, 1.0).linkage
    expected_rad = linkage.closing_rad(0.0)
    if abs(travel_rad - expected_rad) > _WIDTH_SHARE * expected_rad:
        raise DataError(
            f"the jaws move by {travel_rad:.2f} rad between their ends, but the configured geometry has "
            f"{expected_rad:.2f} rad: measure the distance of the open jaws (gripper.open_width_m), check "
            "gripper.pinion_radius_m or gripper.linkage, and that nothing lies between the jaws"
        )
    if gripper.linkage.kind != "rack":  # its geometry determines the width
        bound_rad = math.ceil(100 * (_GIVES_RAD + abs(travel_rad - expected_rad))) / 100
        return gripper.open_width_m, closed_rad - sign * expected_rad, bound_rad
    inset_rad = _INSET_M / (2 * gripper.pinion_radius_m)
    return 2 * gripper.pinion_radius_m * (travel_rad - inset_rad), open_rad + sign * inset_rad, None


@contextmanager
def _torque_on(config: Config, devices: Devices, progress: Progress) -> Iterator["_EmptyJaws"]:
    """Yields jaws under torque, and turns torque off at every end."""
    with torque_on(devices.servo) as (state, raise_if_interrupted):
        yield _EmptyJaws(config, BusCycles(config, devices, state, raise_if_interrupted), progress)


class _Standstill:
    """Tells whether the jaws have stood still for `_STILL_S`."""

    def __init__(self, position_rad: float) -> None:
        self._still_rad, self._cycles = position_rad, 0

    def lasts(self, position_rad: float) -> bool:
        """Takes the position of each cycle."""
        self._cycles += 1
        if abs(position_rad - self._still_rad) > _STILL_RAD:
            self._still_rad, self._cycles = position_rad, 0
        return self._cycles > _STILL_S * RATE_HZ


class _EmptyJaws:
    """Moves jaws whose ends are unknown. Directions are those of the servo's angle."""

    def __init__(self, config: Config, cycles: BusCycles, progress: Progress) -> None:
        self._config, self._cycles, self._progress = config, cycles, progress
        self._transmission, self._limits = cycles.transmission, cycles.limits
        # Half open, where a linkage is far from its dead centres.
        self._middle_rad = self._transmission.position_rad(self._transmission.open_width_m / 2)
        start_n = _START_N
        if len(config.servo.ids) > 1:  # with less, one finger would move and the other stick
            start_n += (1 + 3 * self._transmission.friction_std) * self._transmission.friction_n
        self._end_a = self._current_a(start_n)

    @property
    def state(self) -> ServoState:
        return self._cycles.state

    def _current_a(self, force_n: float) -> float:
        return abs(self._transmission.current_a(force_n, self._middle_rad))

    def _force_n(self, current_a: float) -> float:
        return abs(self._transmission.force_n(current_a, self._middle_rad))

    def cycle(self, side: int, current_a: float, speed_share: float = 0.5) -> None:
        """Runs one bus cycle towards ``side`` (0: at rest), at most at a share of the approach speed."""
        state = self._cycles.read()
        speed_m_s = speed_share * self._cycles.approach_m_s
        self._cycles.write(state.position_rad + side, min(current_a, self._ceiling_a), speed_m_s)

    def rest(self) -> None:
        """Stands still for a moment."""
        for _ in range(round(_REST_S * RATE_HZ)):
            self.cycle(0, self._end_a)

    def find_ends(self) -> tuple[float, float]:
        """Returns the angles at the upper and the lower end. Jaws that friction holds get more current."""
        while True:
            high_rad, low_rad = self._find_end(1), self._find_end(-1)
            if high_rad - low_rad > _MIN_TRAVEL_RAD or self._end_a >= self._ceiling_a:
                return high_rad, low_rad
            self.raise_current()

    def raise_current(self) -> None:
        """Raises the current of the coming motions."""
        self._end_a = min(_MORE * self._end_a, self._ceiling_a)

    @property
    def _ceiling_a(self) -> float:
        return self._limits.ceiling_a(0.0, self._middle_rad)

    def _find_end(self, side: int) -> float:
        """Returns the angle at an end, which more current does not move."""
        self._progress(f"moving to the {'upper' if side > 0 else 'lower'} end", 0)
        self._run_to_standstill(side)
        while True:
            before_rad, self._end_a = self.state.position_rad, self._end_a * _MORE
            self._run_to_standstill(side)
            if abs(self.state.position_rad - before_rad) < _GIVES_RAD:
                self._end_a /= _MORE
                return before_rad
            if self._end_a > self._ceiling_a:
                raise DataError(
                    f"the jaws need more than {self._ceiling_a:.2f} A to move, the current at control.force_limit_n; "
                    "check that nothing lies between them, servo.model and gripper.friction_n"
                )

    def _run_to_standstill(self, side: int) -> None:
        begin_rad = self.state.position_rad
        still = _Standstill(begin_rad)
        while not still.lasts(self.state.position_rad):
            self.cycle(side, self._end_a)
            if abs(self.state.position_rad - begin_rad) > _MAX_TRAVEL_RAD:
                raise DataError(
                    f"the horn turned by {_MAX_TRAVEL_RAD:.0f} rad without an end; check that it is screwed to the "
                    "gripper"
                )

    def friction(self, side: int, low_rad: float, high_rad: float) -> tuple[float, float]:
        """Returns the friction in N of jaws that begin to move towards a side, and of jaws that move."""
        breakaway_a, running_n = [], []
        for share in _PLACES if side > 0 else reversed(_PLACES):
            goal_rad = low_rad + share * (high_rad - low_rad)
            self._move_beyond(goal_rad, -side)
            self.rest()
            breakaway_a.append(self._break_away(side))
            running_n.append(self._run(side, breakaway_a[-1], 0.2 * (high_rad - low_rad)))
        return self._force_n(float(np.median(breakaway_a))), max(float(np.median(running_n)), 0.0)

    def _move_beyond(self, goal_rad: float, side: int) -> None:
        """Passes a goal in both directions, the second time towards ``side``."""
        self._progress("measuring friction", 0)
        for direction in (-side, side):
            still = _Standstill(self.state.position_rad)
            while direction * (goal_rad + direction * 0.05 - self.state.position_rad) > 0:
                self.cycle(direction, self._end_a)
                if still.lasts(self.state.position_rad):
                    raise DataError(
                        f"the jaws stopped at {self.state.position_rad:.2f} rad, although they moved there before; "
                        "check that nothing blocks them"
                    )

    def _break_away(self, side: int) -> float:
        begin_rad, current_a = self.state.position_rad, 0.0
        step_a = self._current_a(_RISE_N_S) / RATE_HZ
        while side * (self.state.position_rad - begin_rad) < _MOVED_RAD:
            current_a += step_a
            if current_a > self._ceiling_a:
                raise DataError(
                    f"the jaws do not move at {begin_rad:.2f} rad with {self._ceiling_a:.2f} A, although they moved "
                    "there before; check that they run smoothly"
                )
            self.cycle(side, current_a)
        return current_a

    def _run(self, side: int, current_a: float, distance_rad: float) -> float:
        """Returns the motor force in N at a constant low speed, less viscous friction.

        The goal leads far, so that the current alone drives the jaws: a goal that moves with them causes a ripple.
        """
        wanted_m_s = _RUN_SPEED_SHARE * self._cycles.approach_m_s
        begin_rad, force_n = self.state.position_rad, self._force_n(current_a)
        forces_n = []
        for _ in range(round(_RUN_S * RATE_HZ)):
            moving_m_s = abs(self._transmission.closing_m_s(self.state.velocity_rad_s, self._middle_rad))
            force_n += SPEED_INTEGRAL_N_M * (wanted_m_s - moving_m_s) / RATE_HZ
            drive_n = max(force_n + SPEED_GAIN_N_S_M * (wanted_m_s - moving_m_s), 0.0)
            self.cycle(side, min(self._current_a(drive_n), self._end_a), 2 * _RUN_SPEED_SHARE)
            forces_n.append(
                self._force_n(self.state.current_a) - self._transmission.damping_n_s_m * moving_m_s
            )
            if side * (self.state.position_rad - begin_rad) > distance_rad:
                break
        return float(np.mean(forces_n[len(forces_n) // 2 :]))
