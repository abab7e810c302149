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

_STATIC_SPARE: Final = 1.3
"""Lead over the one that the goal current needs at rest, as the controller's speed limit has it."""

_INPUT_VOLTAGE_ERROR: Final = 0x01
"""The only hardware error that leaves torque on (https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/#shutdown)."""


class FingerPair:
    """Two servos of one model, one per finger.

    *Estimation uses means*: closing angle, speed and current. A free object is pressed by both fingers alike.

    *Safety uses the worse one*: a hardware error of either, the higher temperature, the lower voltage, and a current
    beyond the goal instead of the mean.

    *Goals.* Both have the same goal current, so the controller's bound on the current holds for each. Both have the
    same lead, so its bound on the speed holds for each; no lead is longer than the controller's. While the fingers
    move, the one that is ahead has a shorter lead. While they stand, each keeps its distance from the other: a push
    at the object meets the goal current, not friction alone.
    """

    def __init__(self, config: ServoConfig, model: ServoModel) -> None:
        self._config = config.second
        self._ids = config.ids
        self._sign = -1 if config.second.mirrored else 1
        self._a_per_rad = model.position_loop_per_rad * model.stall_current_a
        self._states: tuple[ServoState, ServoState] | None = None
        self._standing_difference_rad = 0.0
        self._goal_current_a = 0.0

    def start(self, states: Sequence[ServoState]) -> None:
        """Checks the fingers before torque is turned on. Raises `DeviceError` if they are not equally far open."""
        first, second = self._aligned(states)
        difference_rad = second.position_rad - first.position_rad
        most_rad = self._config.max_difference_rad / 2
        if abs(difference_rad) > most_rad:
            offset_rad = states[1].position_rad - self._sign * states[0].position_rad
            raise DeviceError(
                f"the fingers are {abs(difference_rad):.2f} rad apart at the start, more than the {most_rad:g} rad "
                "that servo.second.max_difference_rad allows; nothing has moved. Open both equally far by hand, or, "
                f"if they are, set servo.second.offset_rad={offset_rad:.3f} and check servo.second.mirrored"
            )
        self._states, self._standing_difference_rad = (first, second), difference_rad
        self._goal_current_a = 0.0

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
        strongest_a = max(first.current_a, second.current_a, key=abs)
        exceeds = is_excess(strongest_a, self._goal_current_a)
        return ServoState(
            t_ns=first.t_ns,
            position_rad=(first.position_rad + second.position_rad) / 2,
            velocity_rad_s=(first.velocity_rad_s + second.velocity_rad_s) / 2,
            current_a=strongest_a if exceeds else (first.current_a + second.current_a) / 2,
            temperature_c=max(first.temperature_c, second.temperature_c),
            voltage_v=min(first.voltage_v, second.voltage_v),
            hardware_error=first.hardware_error | second.hardware_error,
        )

    def split(self, command: ServoCommand) -> tuple[ServoCommand, ServoCommand]:
        """Returns the command of each servo. Without a state, both get the same closing angle."""
        current_a = command.goal_current_a
        if self._states is None:
            goals_rad = (command.goal_position_rad, command.goal_position_rad)
        else:
            goals_rad = self._goals_rad(command, *self._states)
            if any(state.hardware_error & ~_INPUT_VOLTAGE_ERROR for state in self._states):
                current_a = 0.0  # the other finger would push the object and this one away
        self._goal_current_a = current_a
        first = replace(command, goal_position_rad=goals_rad[0], goal_current_a=current_a)
        second_rad = self._config.offset_rad + self._sign * goals_rad[1]
        return first, replace(first, goal_position_rad=second_rad)

    def _goals_rad(self, command: ServoCommand, *states: ServoState) -> tuple[float, float]:
        """Returns the goal position of each finger in the first servo's frame."""
        first_rad, second_rad = (state.position_rad for state in states)
        mean_rad = (first_rad + second_rad) / 2
        lead_rad = command.goal_position_rad - mean_rad
        way = math.copysign(1.0, lead_rad)
        speeds_rad_s = [way * state.velocity_rad_s for state in states]
        static_rad = _STATIC_SPARE * abs(command.goal_current_a) / self._a_per_rad
        if lead_rad and max(speeds_rad_s) > _STANDING_RAD_S and min(speeds_rad_s) > -_STANDING_RAD_S:
            self._standing_difference_rad = second_rad - first_rad

            def goal_rad(position_rad: float) -> float:
                ahead_rad = max(0.0, way * (position_rad - mean_rad))
                share = max(_LEAST_SHARE, 1 - ahead_rad / _EQUALISING_RAD)
                return position_rad + way * max(share * abs(lead_rad), min(static_rad, abs(lead_rad)))

            return goal_rad(first_rad), goal_rad(second_rad)
        most_rad = max(abs(lead_rad), static_rad)
        goals_rad = (
            command.goal_position_rad - self._standing_difference_rad / 2,
            command.goal_position_rad + self._standing_difference_rad / 2,
        )
        return (
            first_rad + min(max(goals_rad[0] - first_rad, -most_rad), most_rad),
            second_rad + min(max(goals_rad[1] - second_rad, -most_rad), most_rad),
        )

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
