"""Contact force from motor current."""

import math
from collections import deque
from typing import Final

from gripper_force.config import ControlConfig
from gripper_force.control.free_travel import FREE_NOISE_N, FreeTravel
from gripper_force.control.speed_limit import hold_speed_m_s
from gripper_force.control.transmission import Transmission
from gripper_force.types import NS_PER_S, ServoState

FREE_FLOOR_N: Final = 0.08
"""Standard deviation of friction under load after free travel: viscous friction, variation with position."""

_LOWERING_LAG_SHARE = 0.1
"""Lag of the motor force while the force is lowered, as a share of the plant's."""

_SLIDES_SHARE = 0.4
"""Jaws that close faster than this share of a hold's speed during a steady hold have lost their object. The motor force
alone does not show it if the object returns at once, because it then stays within the play."""


class CurrentEstimate:
    """Contact force from motor current, through the gearing and Coulomb friction, which acts as play.

    Friction is the motor force in free travel. With friction known, the error is that of the gearing.

    The measured current is noisy and quantised (0.1 N per step), and the contact force follows it with the
    plant's lag: one low-pass with that lag serves both.

    Attributes:
        force_n: The estimate.
        friction_n: Coulomb friction.
        friction_variance_n2: Variance of its error.
        reversal: Share of the play by which the motor force has reversed. The larger, the less certain the estimate.
        dt_s: Time since the reading before; 0 at the first one.
        lag_s: Time constant of the low-pass.
        free_travel: The approach of this grasp.
    """

    def __init__(self, config: ControlConfig, transmission: Transmission) -> None:
        _, self.lag_s, _ = config.plant
        self._slides_m_s = _SLIDES_SHARE * hold_speed_m_s(config, transmission)
        self._transmission = transmission
        cycles = math.ceil(config.rate_hz * config.max_frame_age_ms / 1e3) + 2
        self._history: deque[tuple[int, float]] = deque(maxlen=cycles)  # covers the age of any accepted frame
        self._motor_force_n = 0.0
        self.force_n = 0.0
        self.dt_s = self.reversal = 0.0
        self.restart()

    def restart(self) -> None:
        """Resets friction to the configured one, at the start of a grasp."""
        self.friction_n = self._transmission.friction_n
        self.friction_variance_n2 = (self._transmission.friction_std * self.friction_n) ** 2
        self.free_travel = FreeTravel()

    def take_friction(self, friction_n: float) -> None:
        """Uses the friction that an opening of this grasp has shown."""
        self.friction_n, self.friction_variance_n2 = max(friction_n, 0.0), FREE_FLOOR_N**2

    def step(self, servo: ServoState, *, free: bool, holding: bool, lowering: bool) -> None:
        """Runs one cycle.

        Args:
            servo: This cycle's reading, with finite numbers.
            free: True if the jaws move without contact: the force is zero and the motor force is friction.
            holding: True while the force is to stay at the target, if it was not lowered to it.
            lowering: True while the force falls to a lower target.
        """
        previous_n = self.force_n
        closing_m_s = self._transmission.closing_m_s(servo.velocity_rad_s, servo.position_rad)
        damping_n = self._transmission.damping_n_s_m * closing_m_s
        motor_force_n = self._transmission.force_n(servo.current_a, servo.position_rad) - damping_n
        self.dt_s = 0.0
        if self._history:
            self.dt_s = max(servo.t_ns - self._history[-1][0], 0) / NS_PER_S
            # Play keeps the lowest motor force, which the lag of a steady hold would hide.
            lag_s = _LOWERING_LAG_SHARE * self.lag_s if lowering else self.lag_s
            self._motor_force_n += (motor_force_n - self._motor_force_n) * self.dt_s / (self.dt_s + lag_s)
        else:
            self._motor_force_n = motor_force_n
        if free:
            self._learn_friction()
        # Coulomb friction acts as play: the contact force stays until the motor force differs by friction.
        low_n, high_n = self._motor_force_n - self.friction_n, self._motor_force_n + self.friction_n
        self.force_n = min(max(previous_n, low_n), high_n)
        slides_m_s = self._transmission.speed_share(servo.position_rad) * self._slides_m_s
        if holding and closing_m_s > slides_m_s:  # friction acts in full against the motion
            self.force_n = low_n
        if free:
            self.force_n = 0.0
        self.reversal = (
            0.0
            if self.friction_n == 0 or free
            else 0.5 + (self.force_n - self._motor_force_n) / (2 * self.friction_n)
        )
        self._history.append((servo.t_ns, self.force_n))

    def at(self, t_ns: int) -> float:
        """Returns the estimate at a past time, interpolated linearly and held beyond both ends."""
        later_ns, later_n = self._history[-1]
        for earlier_ns, earlier_n in reversed(self._history):
            if earlier_ns <= t_ns:
                if later_ns <= t_ns:
                    return later_n
                share = (t_ns - earlier_ns) / (later_ns - earlier_ns)
                return earlier_n + share * (later_n - earlier_n)
            later_ns, later_n = earlier_ns, earlier_n
        return later_n

    def variance_n2(self, force_n: float) -> float:
        """Returns the variance of the estimate of a force, from the errors of friction and gearing."""
        gearing_n2 = (self._transmission.torque_constant_std * force_n) ** 2
        return self.friction_variance_n2 + FREE_FLOOR_N**2 + gearing_n2

    def _learn_friction(self) -> None:
        self.free_travel.add(self._motor_force_n)
        kalman_gain = self.friction_variance_n2 / (self.friction_variance_n2 + FREE_NOISE_N**2)
        self.friction_n = max(self.friction_n + kalman_gain * (self._motor_force_n - self.friction_n), 0.0)
        self.friction_variance_n2 = combined_variance_n2(self.friction_variance_n2, FREE_NOISE_N**2)


def combined_variance_n2(one_n2: float, other_n2: float) -> float:
    """Returns the variance of two combined estimates. `1 - gain` would cancel if one is much larger."""
    return one_n2 * other_n2 / (one_n2 + other_n2)
