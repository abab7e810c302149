"""The last word on every command."""

import math

from gripper_force.config import ControlConfig
from gripper_force.control.transmission import Transmission
from gripper_force.errors import NonFiniteError
from gripper_force.types import ServoCommand

_RISE_FACTOR = 4.0
"""The push may rise this many times as fast as the force ramp, unless the force was over its limit."""

_OVER_FORCE_CEILING = 0.95
"""A current that proved too much is not reached again in the same grasp."""

_CERTAIN_SHARE = 0.95
"""Share of the force limit to which the current is held: the torque constant is known to 10 %, and a force
5 % beyond the limit is the most that may happen, whatever vision says."""

_OVER_FORCE_FACTOR = 0.85
"""What is left of the goal current after each cycle that sees too much force: half within 25 ms at 200 Hz."""


_TARGET_SHARE = 0.9
"""Most of the force limit that can be asked for: a tenth is left to overshoot."""


def largest_target_n(force_limit_n: float) -> float:
    """The largest force that may be asked for under a force limit."""
    return _TARGET_SHARE * force_limit_n


class Limits:
    """Bounds goal position and goal current, and puts the current on the servo's own grid.

    One step of an XM430's goal current is 2.69 mA, some 0.1 N at the jaws, which is coarser than the force
    that is asked for. The rounding error is therefore carried into the next cycle (first-order noise
    shaping): the mean is exact, and the jaws' inertia smooths the rest.
    """

    def __init__(self, config: ControlConfig, transmission: Transmission, current_limit_a: float) -> None:
        self._transmission, self._current_limit_a = transmission, current_limit_a
        self._force_limit_n = config.force_limit_n
        self._rise_a_s = abs(transmission.current_a(_RISE_FACTOR * config.ramp_n_s))
        self._step_a = transmission.current_step_a
        ends = (transmission.open_position_rad, transmission.closed_position_rad)
        self._low_rad, self._high_rad = min(ends), max(ends)
        self._lowered_a = math.inf
        self._level_a = 0.0
        self._rounding_a = 0.0
        self._last_a = 0.0
        self._over = False

    def apply(
        self,
        command: ServoCommand,
        force_n: float,
        friction_n: float,
        motor_force_n: float,
        dt_s: float,
        *,
        may_rise: bool,
        opens: bool = False,
    ) -> tuple[ServoCommand, bool]:
        """Bounds a command.

        Args:
            command: What the controller wants.
            force_n: The estimated contact force.
            friction_n: What friction is known to take of the push.
            motor_force_n: The motor's present push, by its current.
            dt_s: Time since the last command.
            may_rise: Whether the goal current may exceed the last one at all.
            opens: Whether the jaws are to open: then a force over its limit is no reason to push less.

        Returns:
            The bounded command, and whether the force estimate is over its limit.

        Raises:
            NonFiniteError: A number of the command, or the estimate, is not finite.
        """
        self._refuse_non_finite(command, force_n, friction_n, motor_force_n)
        ceiling_a = min(self.ceiling_a(friction_n), self._lowered_a)
        if not may_rise:
            ceiling_a = min(ceiling_a, self._last_a)
        over = force_n > self._force_limit_n
        if over and not opens:
            if not self._over:
                self._lowered_a = _OVER_FORCE_CEILING * self._last_a
            # Friction may hold the force up. A push that can't give the limit any more need not fall further.
            eases = motor_force_n > self._force_limit_n - friction_n
            ceiling_a = min(ceiling_a, (_OVER_FORCE_FACTOR if eases else 1.0) * self._last_a)
        self._over = over
        rise_a_s = self._rise_a_s / (1.0 if self._lowered_a == math.inf else _RISE_FACTOR)
        wanted_a = min(max(command.goal_current_a, 0.0), self._level_a + rise_a_s * dt_s, ceiling_a)
        self._level_a = wanted_a
        self._last_a = self._on_grid(wanted_a, ceiling_a)
        position_rad = min(max(command.goal_position_rad, self._low_rad), self._high_rad)
        return ServoCommand(command.t_ns, position_rad, self._last_a), over

    def begin(self) -> None:
        """A new grasp, or its end: what was too much for the last one no longer counts."""
        self._lowered_a = math.inf

    def ceiling_a(self, friction_n: float) -> float:
        """The most current that the force limit and the servo's own limit leave."""
        most_friction_n = (1 + 3 * self._transmission.friction_std) * self._transmission.friction_n
        most_n = _CERTAIN_SHARE * self._force_limit_n + min(max(friction_n, 0.0), most_friction_n)
        return min(self._current_limit_a, abs(self._transmission.current_a(most_n)))

    def _on_grid(self, wanted_a: float, ceiling_a: float) -> float:
        if self._step_a == 0:
            return wanted_a
        steps = round((wanted_a + self._rounding_a) / self._step_a)
        steps = max(0, min(steps, math.floor(ceiling_a / self._step_a + 1e-9)))
        given_a = min(steps * self._step_a, ceiling_a)
        # Bounded, so that a limit that holds the current down leaves no debt.
        error_a = self._rounding_a + wanted_a - given_a
        self._rounding_a = min(max(error_a, -0.5 * self._step_a), 0.5 * self._step_a)
        return given_a

    @staticmethod
    def _refuse_non_finite(
        command: ServoCommand, force_n: float, friction_n: float, motor_force_n: float
    ) -> None:
        numbers = {
            "goal position": command.goal_position_rad,
            "goal current": command.goal_current_a,
            "force estimate": force_n,
            "friction estimate": friction_n,
            "motor's push": motor_force_n,
        }
        for name, number in numbers.items():
            if not math.isfinite(number):
                raise NonFiniteError(f"control: the {name} is {number}; stop, and see the log of this cycle")
