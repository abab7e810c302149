"""Limit on the speed of the jaws that holds whatever friction and torque constant are."""

import math
from dataclasses import dataclass, replace

from gripper_force.config import ControlConfig
from gripper_force.control.transmission import Transmission
from gripper_force.types import ServoCommand, ServoState

_LEAD_FACTOR = 1.3
"""Lead as a multiple of what the wanted speed, or the goal current, needs. The largest steady speed is this multiple of
the wanted one."""

_UNKNOWN_LEAD_M = 0.002
"""Lead of one jaw with a servo whose position loop is unknown."""

_HOLD_SHARE = 0.5
"""Largest closing speed of a hold, as a share of the approach speed."""

_OVERSPEED = 1.4
"""Multiple of the wanted speed above which the servo brakes."""

_RESISTED_FACTOR = 2.0
"""Multiple of the measured current up to which the lead follows the goal current. Jaws that are blocked come to their
goal current even if the servo draws only half of what its data say, or if one of two fingers is blocked alone."""


@dataclass(frozen=True, slots=True)
class PositionLoop:
    """Position loop inside the servo: it sets a voltage in proportion to the distance from the goal.

    Attributes:
        a_per_rad: Current of the motor at rest per radian of distance.
        gain_per_s: Speed of the motor without load per radian of distance.
    """

    a_per_rad: float
    gain_per_s: float


def hold_speed_m_s(config: ControlConfig, transmission: Transmission) -> float:
    """Returns the largest speed of one jaw in a hold: its object may return to jaws that close."""
    return min(_HOLD_SHARE * config.approach_speed_m_s, transmission.impact_m_s(config.force_limit_n))


class SpeedLimit:
    """Keeps the goal position so close to the present position that the servo cannot be too fast.

    The servo's position loop sets the motor's voltage in proportion to that lead, and back-EMF bounds the speed
    at this voltage. So the limit holds inside the servo, between two cycles, too. Where something resists, the lead is
    not shorter than the goal current needs at rest: the current alone sets the force of a grip. Jaws that nothing
    resists draw far less than their goal. So they get the lead of the wanted speed only: with that of the goal
    current they would be too fast again in the cycle after each brake.
    """

    def __init__(self, transmission: Transmission, loop: PositionLoop | None) -> None:
        self._transmission, self._loop = transmission, loop

    def apply(self, command: ServoCommand, servo: ServoState, speed_m_s: float) -> ServoCommand:
        """Returns the command with a goal position whose lead keeps the speed of one jaw to ``speed_m_s``."""
        distance_rad = command.goal_position_rad - servo.position_rad
        moving_m_s = self._transmission.fastest_closing_m_s(servo.velocity_rad_s, servo.position_rad)
        nears_goal = distance_rad * servo.velocity_rad_s > 0
        if nears_goal and abs(moving_m_s) > _OVERSPEED * speed_m_s:
            return replace(command, goal_position_rad=servo.position_rad)
        resisted_a = _RESISTED_FACTOR * math.copysign(servo.current_a, servo.current_a * distance_rad)
        lead_rad = self._lead_rad(min(command.goal_current_a, resisted_a), servo.position_rad, speed_m_s)
        bounded_rad = min(max(distance_rad, -lead_rad), lead_rad)
        return replace(command, goal_position_rad=servo.position_rad + bounded_rad)

    def rest_error_m(self, current_a: float, position_rad: float) -> float:
        """Returns the distance from a goal width at which the servo's position loop may stop short of this current."""
        if self._loop is None:
            return 0.0
        error_rad = _LEAD_FACTOR * abs(current_a) / self._loop.a_per_rad
        return 2 * error_rad * self._transmission.jaw_m_per_rad(position_rad)

    def _lead_rad(self, rest_a: float, position_rad: float, speed_m_s: float) -> float:
        rad_per_m = 1 / self._transmission.jaw_m_per_rad_range(position_rad)[1]
        if self._loop is None:
            return _UNKNOWN_LEAD_M * rad_per_m
        moving_rad = speed_m_s * rad_per_m / self._loop.gain_per_s
        return _LEAD_FACTOR * max(moving_rad, rest_a / self._loop.a_per_rad)
