"""Two servos, one per finger, as one: see docs/decisions/0023-two-fingers-are-one-servo.md.

Angles of both are in the first servo's frame: at equal angles both fingers are equally far closed.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from gripper_force.config import ServoConfig
from gripper_force.control.safety import exceeds_goal_current, is_back_driven
from gripper_force.errors import DeviceError, HardwareFaultError
from gripper_force.types import ServoCommand, ServoState
from gripper_hw.dynamixel.control_table import VELOCITY_UNIT_RAD_S, ServoModel

_STANDING_RAD_S: Final = 1.5 * VELOCITY_UNIT_RAD_S
"""A finger that is not faster stands: one unit is noise."""

_EQUALISING_RAD: Final = 0.05
_MIN_SHARE: Final = 0.4
_MIN_MOVING_SHARE: Final = 0.2
"""The lead of the finger that is ahead of the mean falls with its distance from it, to the first share, and to the
second one if the other finger moves, too. With less, the mean speed would look like a standstill."""

_MAX_CURRENT: Final = 1.3
"""Largest goal current of the finger that is behind, whose friction may be larger, as a share of the controller's."""

_STATIC_SPARE: Final = 1.3
"""Lead over the one that the goal current needs at rest, as in the controller's speed limit."""


class FingerPair:
    """Two servos of one model, one per finger.

    *The state* has the means of angle, speed and current, the higher temperature, the lower voltage, the errors of
    both, and a current beyond its goal instead of the mean.

    *Standing fingers* have the same goal current, so they press a fixed object alike, and keep their distance, so that
    a push at the object meets the goal current and not friction alone.

    *Moving fingers* equalise: the one ahead has a shorter lead, and the other one the current that the first leaves.
    No lead is longer than the controller's, so its bound on the speed holds for each.
    """

    def __init__(self, config: ServoConfig, model: ServoModel) -> None:
        self._config, self._ids = config.second, config.ids
        self._sign = -1 if config.second.mirrored else 1
        self._stopping_errors = model.stopping_errors
        self._a_per_rad = model.position_loop_per_rad * model.stall_current_a
        self._states: tuple[ServoState, ServoState] | None = None
        self._kept_half_rad = 0.0  # half of the distance that the fingers keep
        self._direction, self._furthest_rad = 0.0, 0.0  # direction of the lead, and how far the mean has come
        self._goals_a = [0.0, 0.0]

    def range_rad(self, low_rad: float, high_rad: float) -> tuple[float, float]:
        """Returns the angles at which both servos are within a range of their own."""
        ends = [self._sign * (end_rad - self._config.offset_rad) for end_rad in (low_rad, high_rad)]
        return max(low_rad, min(ends)), min(high_rad, max(ends))

    def difference_rad(self, first_rad: float, second_rad: float) -> float:
        """Returns the second finger's angle less the first's, at two servo positions."""
        return self._sign * (second_rad - self._config.offset_rad) - first_rad

    def start_problem(self, first_rad: float, second_rad: float) -> str:
        """Returns why a run can't start at two servo positions, or an empty text."""
        difference_rad = abs(self.difference_rad(first_rad, second_rad))
        max_rad = self._config.max_difference_rad / 2
        if difference_rad <= max_rad:
            return ""
        return (
            f"the fingers are {difference_rad:.2f} rad apart, more than the {max_rad:g} rad, half of "
            "servo.second.max_difference_rad, that a start allows; open both equally far by hand, or, if they are, set "
            f"servo.second.offset_rad={second_rad - self._sign * first_rad:.3f} and check servo.second.mirrored"
        )

    def start(self, states: Sequence[ServoState]) -> None:
        """Begins with a first pair of states. Raises `DeviceError` if the fingers are not equally far open."""
        first_rad, second_rad = (state.position_rad for state in states)
        if problem := self.start_problem(first_rad, second_rad):
            raise DeviceError(problem)
        self._kept_half_rad = self.difference_rad(first_rad, second_rad) / 2
        self._direction, self._goals_a = 0.0, [0.0, 0.0]

    def combine(self, states: Sequence[ServoState]) -> ServoState:
        """Returns the common state. Raises `HardwareFaultError` if the fingers differ too much."""
        first, second = states
        second = replace(
            second,
            position_rad=self._sign * (second.position_rad - self._config.offset_rad),
            velocity_rad_s=self._sign * second.velocity_rad_s,
            current_a=self._sign * second.current_a,
        )
        self._states = first, second
        difference_rad = abs(second.position_rad - first.position_rad)
        if difference_rad > self._config.max_difference_rad:
            raise HardwareFaultError(
                f"the fingers of the servos {self._ids[0]} and {self._ids[1]} are {difference_rad:.2f} rad apart, more "
                f"than servo.second.max_difference_rad {self._config.max_difference_rad:g}; check that both move "
                "freely and that the object is in the middle, then start again"
            )
        excess_a = [
            state.current_a
            for state, goal_a in zip(self._states, self._goals_a, strict=True)
            if exceeds_goal_current(state.current_a, goal_a) and not is_back_driven(state)
        ]
        return ServoState(
            t_ns=first.t_ns,
            position_rad=(first.position_rad + second.position_rad) / 2,
            velocity_rad_s=(first.velocity_rad_s + second.velocity_rad_s) / 2,
            current_a=max(excess_a, key=abs) if excess_a else (first.current_a + second.current_a) / 2,
            temperature_c=max(first.temperature_c, second.temperature_c),
            voltage_v=min(first.voltage_v, second.voltage_v),
            hardware_error=first.hardware_error | second.hardware_error,
        )

    def split(self, command: ServoCommand) -> tuple[ServoCommand, ...]:
        """Returns the command of each servo."""
        if self._states is None:  # the port is closed
            return command, command
        first, second = self._states
        mean_rad = (first.position_rad + second.position_rad) / 2
        half_rad = (second.position_rad - first.position_rad) / 2
        lead_rad, goal_a = command.goal_position_rad - mean_rad, command.goal_current_a
        direction = math.copysign(1.0, lead_rad)
        self._follow(direction, mean_rad, half_rad)
        static_rad = _STATIC_SPARE * abs(goal_a) / self._a_per_rad
        max_rad = max(abs(lead_rad), static_rad)
        shift_rad = self._kept_half_rad - half_rad
        leads_rad = [
            min(max(lead, -max_rad), max_rad) for lead in (lead_rad - shift_rad, lead_rad + shift_rad)
        ]
        self._goals_a = [goal_a, goal_a]
        slowest_rad_s, fastest_rad_s = sorted(direction * state.velocity_rad_s for state in self._states)
        if slowest_rad_s > -_STANDING_RAD_S and fastest_rad_s > _STANDING_RAD_S:
            leader = int(direction * half_rad > 0)
            min_share = _MIN_SHARE if slowest_rad_s < _STANDING_RAD_S else _MIN_MOVING_SHARE
            share = 1 - abs(half_rad) / _EQUALISING_RAD
            shorter_rad = max(max(share, min_share) * abs(lead_rad), static_rad)
            leads_rad[leader] = min(max(leads_rad[leader], -shorter_rad), shorter_rad)
            spare_a = max(goal_a - abs(self._states[leader].current_a), 0.0)
            self._goals_a[1 - leader] = min(goal_a + (1 - max(share, 0.0)) * spare_a, _MAX_CURRENT * goal_a)
        if any(state.hardware_error & self._stopping_errors for state in self._states):
            self._goals_a = [0.0, 0.0]  # one finger alone would push the object and the other one away
        goals_rad = (
            first.position_rad + leads_rad[0],
            self._config.offset_rad + self._sign * (second.position_rad + leads_rad[1]),
        )
        return tuple(
            replace(command, goal_position_rad=goal_rad, goal_current_a=goal_a)
            for goal_rad, goal_a in zip(goals_rad, self._goals_a, strict=True)
        )

    def _follow(self, direction: float, mean_rad: float, half_rad: float) -> None:
        """Lets the kept distance follow the present one, as far as the mean makes headway.

        A finger that moves alone moves the mean. A push at the object moves the fingers by as much to either side.
        """
        if direction != self._direction:
            self._direction, self._furthest_rad = direction, direction * mean_rad
        headway_rad = max(direction * mean_rad - self._furthest_rad, 0.0)
        self._furthest_rad += headway_rad
        self._kept_half_rad += min(max(half_rad - self._kept_half_rad, -headway_rad), headway_rad)
