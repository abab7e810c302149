"""Two servos, one per finger, as one: a common state, and a goal for each finger.

Angles of both are in the first servo's frame: equal angles are equally far closed fingers.
See docs/decisions/0023-two-fingers-are-one-servo.md.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from gripper_force.config import ServoConfig
from gripper_force.control.safety import is_excess
from gripper_force.errors import DeviceError, HardwareFaultError
from gripper_force.types import ServoCommand, ServoState
from gripper_hw.dynamixel.control_table import VELOCITY_UNIT_RAD_S, ServoModel

_STANDING_RAD_S: Final = 1.5 * VELOCITY_UNIT_RAD_S
"""A finger that is not faster stands: one unit of the velocity is noise."""

_EQUALISING_RAD: Final = 0.05
_LEAST_SHARE: Final = 0.4
"""A finger that is ahead of the mean has a lead that falls with its distance from it, to this share: the other one
catches up. If that one is blocked, this one reaches the object, and the mean speed does not look like a standstill."""

_LEAST_MOVING_SHARE: Final = 0.2
"""The least share while the other finger moves, too."""

_MOST_CURRENT: Final = 1.3
"""Largest goal current of the finger that is behind, as a share of the controller's: its friction may be larger."""

_STATIC_SPARE: Final = 1.3
"""Lead over the one that the goal current needs at rest, as the controller's speed limit has it."""

_INPUT_VOLTAGE_ERROR: Final = 0x01
"""The only hardware error that leaves torque on (https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/#shutdown)."""


class FingerPair:
    """Two servos of one model, one per finger.

    *Estimation uses means*: closing angle, speed and current. A free object is pressed by both fingers alike.

    *Safety uses the worse one*: a hardware error of either, the higher temperature, the lower voltage, and a current
    beyond the goal instead of the mean.

    *Goals.* Standing fingers have the same goal current, so a fixed object is pressed by both alike, and each keeps its
    distance from the other, so a push at the object meets the goal current and not friction alone. No lead is longer
    than the controller's, so its bound on the speed holds for each. While the fingers move, the one that is ahead has
    a shorter lead, and the other one the current that the first leaves, up to `_MOST_CURRENT` of its own.
    """

    def __init__(self, config: ServoConfig, model: ServoModel) -> None:
        self._config = config.second
        self._ids = config.ids
        self._sign = -1 if config.second.mirrored else 1
        self._a_per_rad = model.position_loop_per_rad * model.stall_current_a
        self._states: tuple[ServoState, ServoState] | None = None
        self._kept_half_rad = 0.0  # half of the distance that the fingers keep
        self._way, self._furthest_rad = 0.0, 0.0  # direction of the lead, and how far the mean has come
        self._goals_a = (0.0, 0.0)

    def difference_rad(self, first_rad: float, second_rad: float) -> float:
        """Returns by how much the second finger's closing angle exceeds the first's, at two servo positions."""
        return self._sign * (second_rad - self._config.offset_rad) - first_rad

    def start_problem(self, first_rad: float, second_rad: float) -> str:
        """Returns why two servo positions are no start, or an empty text."""
        difference_rad = abs(self.difference_rad(first_rad, second_rad))
        most_rad = self._config.max_difference_rad / 2
        if difference_rad <= most_rad:
            return ""
        return (
            f"the fingers are {difference_rad:.2f} rad apart, more than the {most_rad:g} rad, half of "
            "servo.second.max_difference_rad, that a start allows; open both equally far by hand, or, if they are, set "
            f"servo.second.offset_rad={second_rad - self._sign * first_rad:.3f} and check servo.second.mirrored"
        )

    def start(self, states: Sequence[ServoState]) -> None:
        """Begins with a first pair of states. Raises `DeviceError` if the fingers are not equally far open."""
        first_rad, second_rad = (state.position_rad for state in states)
        if problem := self.start_problem(first_rad, second_rad):
            raise DeviceError(problem)
        self._states, self._way = self._aligned(states), 0.0
        self._kept_half_rad = self.difference_rad(first_rad, second_rad) / 2
        self._goals_a = (0.0, 0.0)

    def combine(self, states: Sequence[ServoState]) -> ServoState:
        """Returns the common state. Raises `HardwareFaultError` if the fingers differ too much."""
        first, second = self._states = self._aligned(states)
        difference_rad = abs(second.position_rad - first.position_rad)
        if difference_rad > self._config.max_difference_rad:
            raise HardwareFaultError(
                f"the fingers of the servos {self._ids[0]} and {self._ids[1]} are {difference_rad:.2f} rad apart, more "
                f"than servo.second.max_difference_rad {self._config.max_difference_rad:g}; check that both move "
                "freely and that the object is in the middle, then start again"
            )
        currents_a = (first.current_a, second.current_a)
        excesses_a = [
            current_a
            for current_a, goal_a in zip(currents_a, self._goals_a, strict=True)
            if is_excess(current_a, goal_a)
        ]
        return ServoState(
            t_ns=first.t_ns,
            position_rad=(first.position_rad + second.position_rad) / 2,
            velocity_rad_s=(first.velocity_rad_s + second.velocity_rad_s) / 2,
            current_a=max(excesses_a, key=abs) if excesses_a else sum(currents_a) / 2,
            temperature_c=max(first.temperature_c, second.temperature_c),
            voltage_v=min(first.voltage_v, second.voltage_v),
            hardware_error=first.hardware_error | second.hardware_error,
        )

    def split(self, command: ServoCommand) -> tuple[ServoCommand, ServoCommand]:
        """Returns the command of each servo."""
        if self._states is None:  # the port is closed
            return command, command
        leads_rad, self._goals_a = self._leads_and_currents(command, self._states)
        if any(state.hardware_error & ~_INPUT_VOLTAGE_ERROR for state in self._states):
            self._goals_a = (0.0, 0.0)  # the other finger would push the object and this one away
        first_rad, second_rad = (
            state.position_rad + lead_rad for state, lead_rad in zip(self._states, leads_rad, strict=True)
        )
        second_rad = self._config.offset_rad + self._sign * second_rad
        return (
            replace(command, goal_position_rad=first_rad, goal_current_a=self._goals_a[0]),
            replace(command, goal_position_rad=second_rad, goal_current_a=self._goals_a[1]),
        )

    def _leads_and_currents(
        self, command: ServoCommand, states: tuple[ServoState, ServoState]
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """Returns the lead and the goal current of each finger."""
        first, second = states
        mean_rad = (first.position_rad + second.position_rad) / 2
        half_rad = (second.position_rad - first.position_rad) / 2
        lead_rad, goal_a = command.goal_position_rad - mean_rad, command.goal_current_a
        way = math.copysign(1.0, lead_rad)
        self._follow(way, mean_rad, half_rad)
        static_rad = _STATIC_SPARE * abs(goal_a) / self._a_per_rad
        most_rad = max(abs(lead_rad), static_rad)
        shift_rad = self._kept_half_rad - half_rad
        leads_rad = [
            min(max(lead_rad - shift_rad, -most_rad), most_rad),
            min(max(lead_rad + shift_rad, -most_rad), most_rad),
        ]
        goals_a = [goal_a, goal_a]
        slowest_rad_s, fastest_rad_s = sorted(way * state.velocity_rad_s for state in states)
        if slowest_rad_s > -_STANDING_RAD_S and fastest_rad_s > _STANDING_RAD_S:
            ahead, behind = (1, 0) if way * half_rad > 0 else (0, 1)
            least_share = _LEAST_SHARE if slowest_rad_s < _STANDING_RAD_S else _LEAST_MOVING_SHARE
            share = 1 - abs(half_rad) / _EQUALISING_RAD
            shorter_rad = max(max(share, least_share) * abs(lead_rad), static_rad)
            leads_rad[ahead] = min(max(leads_rad[ahead], -shorter_rad), shorter_rad)
            spare_a = max(goal_a - abs(states[ahead].current_a), 0.0)
            goals_a[behind] = min(goal_a + (1 - max(share, 0.0)) * spare_a, _MOST_CURRENT * goal_a)
        return (leads_rad[0], leads_rad[1]), (goals_a[0], goals_a[1])

    def _follow(self, way: float, mean_rad: float, half_rad: float) -> None:
        """Lets the kept distance of the fingers follow the present one, as far as the mean makes headway.

        A finger that moves alone moves the mean, too. A push at the object moves the fingers by as much to either side.
        """
        if way != self._way:
            self._way, self._furthest_rad = way, way * mean_rad
        headway_rad = max(way * mean_rad - self._furthest_rad, 0.0)
        self._furthest_rad += headway_rad
        self._kept_half_rad += min(max(half_rad - self._kept_half_rad, -headway_rad), headway_rad)

    def _aligned(self, states: Sequence[ServoState]) -> tuple[ServoState, ServoState]:
        """Returns both states in the first servo's frame."""
        first, second = states
        return first, replace(
            second,
            position_rad=self._sign * (second.position_rad - self._config.offset_rad),
            velocity_rad_s=self._sign * second.velocity_rad_s,
            current_a=self._sign * second.current_a,
        )

    def range_rad(self, low_rad: float, high_rad: float) -> tuple[float, float]:
        """Returns the angles at which both servos are within a range of their own."""
        ends = [self._sign * (end_rad - self._config.offset_rad) for end_rad in (low_rad, high_rad)]
        return max(low_rad, min(ends)), min(high_rad, max(ends))
