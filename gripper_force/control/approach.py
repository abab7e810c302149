"""Approach of the jaws to the object: closing at a bounded speed until they touch it."""

import math
from enum import Enum, auto

from gripper_force.config import ControlConfig
from gripper_force.control.trajectory import ACCELERATION_S
from gripper_force.control.transmission import Transmission
from gripper_force.types import EstimateSource, FusedForce

_IMPACT_M_S_PER_N = 0.010
"""Approach speed of one jaw per newton of target: on the stiffest object, impact stays below the target."""

_CONTACT_SHARE = 0.25
"""Largest contact force before contact is detected, as a share of the target."""

SPEED_GAIN_N_S_M = 10.0
SPEED_INTEGRAL_N_M = 40.0
"""Proportional and integral gain of the approach speed loop. With 1.3 kg of motor and jaw, half of a speed
error is corrected after 40 ms; on stalled jaws the motor force rises by 1 N/s."""

_OVERSPEED = 1.12
_OVERSPEED_DECAY_S = 0.05
"""Above this multiple of the wanted speed the motor force decays with this time constant. It is then far larger than
friction, which must be smaller than configured."""

_STALLED_SHARE = 0.1
_SLOWED_SHARE = 0.6
"""Shares of the approach speed below which the jaws count as stalled, or as slowed."""

_VISUAL_CONTACT_N = 0.4
"""Visual or fused estimate above which slowed jaws count as in contact."""

_STEADY_SHARE = 0.2
_STEADY_S = 0.1
"""The speed counts as steady within this share of the wanted speed, from this time after the acceleration."""

_STEADY_FORCE_N = 0.3
_STEADY_FILTER_S = 0.03
"""The motor force counts as steady if its mean over this time is at most that much above the commanded one. The speed
limit may keep it below."""

_DEBOUNCE_S = 0.05
"""Time for which the signs of contact must persist."""

_STUCK_S = 0.3
"""Time for which the jaws must stand still at the largest motor force before they count as stuck."""

_TRAVEL_M = 0.0015
"""Closing of the jaws before a standstill counts as contact: stuck jaws do not move that far in their gears."""

_BACK_OFF_M = 0.004
_BACK_OFF_SPARE_S = 0.5
"""Jaws that stand still from the start open by this distance and close again: those that already touched an object
then travel to it. The opening may take this much longer than its distance needs."""


class ApproachState(Enum):
    """Result of one cycle of an approach."""

    CLOSING = auto()
    BACKING_OFF = auto()
    CONTACT = auto()
    CLOSED = auto()
    STUCK = auto()


class Approach:
    """Speed loop of the closing jaws, at most at ``max_m_s``, with the decision on contact.

    A standstill is a contact only after the jaws have travelled: jaws whose friction is larger than configured
    do not move at all, and stand still without an object. Jaws that stand still from the start open a little
    and close again; if they still do not travel, they are stuck.

    Attributes:
        speed_m_s: Wanted speed of one jaw.
        motor_force_n: Motor force at each jaw.
        is_backing_off: True while the jaws open to close again.
    """

    def __init__(self, config: ControlConfig, transmission: Transmission, max_m_s: float) -> None:
        self._config, self._transmission, self._max_m_s = config, transmission, max_m_s
        self.speed_m_s = self.motor_force_n = 0.0
        self.is_backing_off = False
        self._target_n = 0.0

    def start(self, width_m: float, target_n: float) -> None:
        """Starts at a width, for a target force."""
        self.set_target(target_n)
        self._has_backed_off = self.is_backing_off = False
        self._begin(width_m)

    def set_target(self, target_n: float) -> None:
        """Changes the target force during the approach."""
        self._target_n = target_n
        self.speed_m_s = self.speed_for_m_s(target_n)

    def speed_for_m_s(self, target_n: float) -> float:
        """Returns the wanted speed of one jaw for a target force."""
        return min(self._max_m_s, _IMPACT_M_S_PER_N * target_n)

    def _begin(self, width_m: float) -> None:
        self._start_m = width_m
        self._time_s = self._contact_s = self._stuck_s = 0.0
        self._integral_n = self._mean_force_n = 0.0
        self._has_moved = self._at_limit = self._is_weak = False

    @property
    def _max_contact_n(self) -> float:
        """Largest force on an object whose contact is not detected yet."""
        return min(self._config.approach_force_n, _CONTACT_SHARE * self._target_n)

    def moves_freely(self, closing_m_s: float, measured_n: float) -> bool:
        """Returns True if the jaws move freely at a steady speed: the motor force is then friction.

        Args:
            closing_m_s: Closing speed of one jaw.
            measured_n: Motor force at each jaw by the measured current.
        """
        if self.is_backing_off or self._time_s < ACCELERATION_S + _STEADY_S:
            return False
        has_steady_speed = abs(closing_m_s - self.speed_m_s) < _STEADY_SHARE * self.speed_m_s
        return has_steady_speed and self._mean_force_n - self.motor_force_n < _STEADY_FORCE_N

    def step(
        self,
        dt_s: float,
        width_m: float,
        closing_m_s: float,
        measured_n: float,
        estimate: FusedForce,
        max_n: float = math.inf,
    ) -> ApproachState:
        """Runs one cycle: sets `motor_force_n`, and returns how far the approach is.

        Args:
            dt_s: Time since the last cycle.
            width_m: Distance between the jaws.
            closing_m_s: Closing speed of one jaw.
            measured_n: Motor force at each jaw by the measured current.
            estimate: The force estimate.
            max_n: Largest motor force while friction is unknown.
        """
        self._time_s += dt_s
        if self.is_backing_off:
            return self._step_back_off(width_m)
        self._mean_force_n += (measured_n - self._mean_force_n) * dt_s / (dt_s + _STEADY_FILTER_S)
        self._drive(dt_s, closing_m_s, estimate, max_n)
        self._has_moved |= closing_m_s > _SLOWED_SHARE * self.speed_m_s
        if width_m < self._config.min_object_width_m:
            return ApproachState.CLOSED
        has_travelled = self._start_m - width_m > _TRAVEL_M
        is_contact = has_travelled and self._detects_contact(closing_m_s, estimate)
        self._contact_s = self._contact_s + dt_s if is_contact else 0.0
        if self._contact_s >= _DEBOUNCE_S:
            return ApproachState.CONTACT
        # Too little motor force lets the jaws creep. So they open, which shows friction.
        share = _SLOWED_SHARE if self._is_weak else _STALLED_SHARE
        stands_still = self._at_limit and closing_m_s < share * self.speed_m_s
        may_be_stuck = not has_travelled or self._is_weak
        self._stuck_s = self._stuck_s + dt_s if stands_still and may_be_stuck else 0.0
        if self._stuck_s < _STUCK_S:
            return ApproachState.CLOSING
        if self._has_backed_off:
            return ApproachState.STUCK
        self._has_backed_off = self.is_backing_off = True
        self._begin(width_m)
        return ApproachState.BACKING_OFF

    def _step_back_off(self, width_m: float) -> ApproachState:
        self.motor_force_n = self._config.approach_force_n + self._transmission.friction_n
        opened_m = width_m - self._start_m
        is_late = self._time_s > _BACK_OFF_SPARE_S + 0.5 * _BACK_OFF_M / self.speed_m_s
        if opened_m < 0.9 * _BACK_OFF_M and not is_late:
            return ApproachState.BACKING_OFF
        self.is_backing_off = False
        if opened_m < _TRAVEL_M:
            return ApproachState.STUCK
        self._begin(width_m)
        return ApproachState.CLOSING

    @property
    def back_off_width_m(self) -> float:
        """Width to which the jaws open while they back off."""
        return self._start_m + _BACK_OFF_M

    def _drive(self, dt_s: float, closing_m_s: float, estimate: FusedForce, max_n: float) -> None:
        """Speed loop whose motor force is limited to friction, damping and the contact limit."""
        wanted_m_s = self.speed_m_s * min(self._time_s / ACCELERATION_S, 1.0)
        error_m_s = wanted_m_s - closing_m_s
        damping_n_s_m = self._transmission.damping_n_s_m
        unlimited_n = (
            self._transmission.friction_n + damping_n_s_m * wanted_m_s + SPEED_GAIN_N_S_M * error_m_s
        )
        # Force that the current estimate counts as contact and vision does not is friction, too.
        friction_n = estimate.friction_n - estimate.bias_n + 2 * estimate.std_n
        usual_max_n = friction_n + self._max_contact_n + damping_n_s_m * max(closing_m_s, 0.0)
        self._is_weak = max_n < usual_max_n
        max_n = min(usual_max_n, max_n)
        self._integral_n += SPEED_INTEGRAL_N_M * error_m_s * dt_s
        if closing_m_s > _OVERSPEED * self.speed_m_s:
            self._integral_n -= self.motor_force_n * dt_s / _OVERSPEED_DECAY_S
        self._integral_n = min(max(self._integral_n, -unlimited_n), max_n - unlimited_n)
        self.motor_force_n = unlimited_n + self._integral_n
        self._at_limit = self.motor_force_n > (0.9 if self._is_weak else 0.99) * max_n

    def _detects_contact(self, closing_m_s: float, estimate: FusedForce) -> bool:
        is_pressing = estimate.current_n + estimate.bias_n > 0.5 * self._max_contact_n
        is_stalled = closing_m_s < _STALLED_SHARE * self.speed_m_s
        is_slowed = self._has_moved and closing_m_s < _SLOWED_SHARE * self.speed_m_s
        is_seen = estimate.source != EstimateSource.CURRENT and estimate.force_n > _VISUAL_CONTACT_N
        return (is_stalled and is_pressing) or (is_slowed and is_seen)
