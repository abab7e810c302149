"""Final limits on position and current, applied to every command."""

import math

from gripper_force.config import ControlConfig
from gripper_force.control.transmission import Transmission
from gripper_force.errors import NonFiniteError
from gripper_force.types import ServoCommand

_RISE_FACTOR = 4.0
"""The motor force may rise this many times as fast as the force ramp, unless the force was over its limit or the
friction is unknown: jaws that a sudden force accelerates compress a soft object by more than the force at rest does."""

_OVER_FORCE_CEILING = 0.95
"""Until the grasp ends, the current stays below this share of a current that caused an over-force."""

_OVER_FORCE_MOTOR_SHARE = 0.9
"""Until then, the goal current does not rise while the measured motor force is above this share of its value at the
over-force: the motor may draw more than its goal."""

_CEILING_SHARE = 1.04
"""Share of the force limit that sets the current ceiling, for the largest torque constant. The force exceeds its
limit by 5 % at most, whatever vision estimates."""

_OVER_FORCE_FACTOR = 0.85
"""Factor on the goal current in each cycle with too much force: half within 25 ms at 200 Hz."""

_TARGET_SHARE = 0.9
"""Largest target as a share of the force limit: a tenth is left for overshoot."""


def largest_target_n(force_limit_n: float, force_bound: float) -> float:
    """Returns the largest target force that is allowed with a force limit and a bound on the true motor force."""
    return _TARGET_SHARE * force_limit_n / force_bound


def rounded_down(force_n: float) -> str:
    """A force as text that is not above ``force_n``: the largest target is accepted as it is written in a message."""
    return f"{math.floor(1e3 * force_n) / 1e3:g}"


class Limits:
    """Limits goal position and goal current, and quantises the current to the servo's steps.

    One step of an XM430's goal current is 2.69 mA, about 0.1 N at the jaws, which is coarser than the force
    resolution needed. The rounding error is therefore carried into the next cycle (first-order noise
    shaping): the mean is exact, and the inertia of the jaws smooths the rest.
    """

    def __init__(self, config: ControlConfig, transmission: Transmission, current_limit_a: float) -> None:
        self._transmission, self._current_limit_a = transmission, current_limit_a
        self._force_limit_n = config.force_limit_n
        self._rise_n_s = _RISE_FACTOR * config.ramp_n_s
        self._step_a = transmission.current_step_a
        self._low_rad, self._high_rad = transmission.goal_range_rad
        self._over_force_ceiling_a = self._over_force_motor_n = math.inf
        self._unrounded_a = 0.0
        self._rounding_a = 0.0
        self._last_a = 0.0
        self._was_over = False

    def apply(
        self,
        command: ServoCommand,
        force_n: float,
        friction_n: float,
        motor_force_n: float,
        present_rad: float,
        dt_s: float,
        *,
        may_rise: bool,
        opening: bool = False,
        rises_slowly: bool = False,
    ) -> tuple[ServoCommand, bool]:
        """Limits a command.

        Args:
            command: The controller's command.
            force_n: Estimated contact force.
            friction_n: Friction known to reduce the motor force; in a grip only what this grasp measured.
            motor_force_n: Present motor force, by the motor current.
            present_rad: Present servo angle.
            dt_s: Time since the last command.
            may_rise: True if the goal current may exceed the last one.
            opening: True if the jaws are to open; the current is then not lowered for a force over its limit.
            rises_slowly: True if the motor force is to rise no faster than the force ramp.

        Returns:
            The limited command, and True if the force estimate is over its limit.

        Raises:
            NonFiniteError: A number of the command or of the estimate is not finite.
        """
        self._refuse_non_finite(command, force_n, friction_n, motor_force_n, present_rad)
        ceiling_a = min(self.ceiling_a(friction_n, present_rad), self._over_force_ceiling_a)
        if not may_rise or motor_force_n > _OVER_FORCE_MOTOR_SHARE * self._over_force_motor_n:
            ceiling_a = min(ceiling_a, self._last_a)
        is_over = force_n > self._force_limit_n
        if is_over and not opening:
            if not self._was_over:
                self._over_force_ceiling_a = _OVER_FORCE_CEILING * self._last_a
                self._over_force_motor_n = motor_force_n
            # Friction may keep the force up. A motor force too small to reach the limit need not fall.
            must_fall = motor_force_n > self._force_limit_n - friction_n
            ceiling_a = min(ceiling_a, (_OVER_FORCE_FACTOR if must_fall else 1.0) * self._last_a)
        self._was_over = is_over
        rise_a_s = abs(self._transmission.current_a(self._rise_n_s, present_rad))
        rise_a_s /= _RISE_FACTOR if rises_slowly or self._over_force_ceiling_a < math.inf else 1.0
        wanted_a = min(max(command.goal_current_a, 0.0), self._unrounded_a + rise_a_s * dt_s, ceiling_a)
        self._unrounded_a = wanted_a
        self._last_a = self._quantise(wanted_a, ceiling_a)
        position_rad = min(max(command.goal_position_rad, self._low_rad), self._high_rad)
        return ServoCommand(command.t_ns, position_rad, self._last_a), is_over

    def reset(self, *, reverses: bool = False) -> None:
        """Removes the ceiling that an over-force set. Called at the start and the end of a grasp.

        Args:
            reverses: True if opening jaws are to close: the motor force then rises from zero.
        """
        self._over_force_ceiling_a = self._over_force_motor_n = math.inf
        if reverses:
            self._unrounded_a = self._last_a = 0.0

    @property
    def is_at_current_limit(self) -> bool:
        """True if the servo's current limit, and no other limit, holds the goal current down."""
        return self._unrounded_a >= self._current_limit_a

    def ceiling_a(self, friction_n: float, present_rad: float) -> float:
        """Returns the largest current that the force limit and the servo's current limit allow at a servo angle."""
        max_friction_n = (1 + 3 * self._transmission.friction_std) * self._transmission.friction_n
        limit_n = _CEILING_SHARE * self._force_limit_n / self._transmission.torque_constant_bound
        max_n = limit_n + min(max(friction_n, 0.0), max_friction_n)
        max_n *= self._transmission.force_share(present_rad)
        return min(self._current_limit_a, abs(self._transmission.current_a(max_n, present_rad)))

    def _quantise(self, wanted_a: float, ceiling_a: float) -> float:
        if self._step_a == 0:
            return wanted_a
        steps = round((wanted_a + self._rounding_a) / self._step_a)
        steps = min(steps, math.floor(ceiling_a / self._step_a + 1e-9))
        rounded_a = min(steps * self._step_a, ceiling_a)
        # Limited, so that no error accumulates while a limit holds the current down, and no current is negative.
        error_a = self._rounding_a + wanted_a - rounded_a
        self._rounding_a = min(max(error_a, -0.5 * self._step_a), 0.5 * self._step_a)
        return rounded_a

    @staticmethod
    def _refuse_non_finite(
        command: ServoCommand, force_n: float, friction_n: float, motor_force_n: float, present_rad: float
    ) -> None:
        numbers = {
            "goal position": command.goal_position_rad,
            "goal current": command.goal_current_a,
            "force estimate": force_n,
            "friction estimate": friction_n,
            "motor force": motor_force_n,
            "servo position": present_rad,
        }
        for name, number in numbers.items():
            if not math.isfinite(number):
                raise NonFiniteError(
                    f"control: the {name} is {number}, not a finite number; check this cycle in the log"
                )
