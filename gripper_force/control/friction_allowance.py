"""Friction that the current limit allows for, and the largest motor force while the friction is unknown."""

import math

from gripper_force.config import ControlConfig
from gripper_force.control.transmission import Transmission

_SLOW_SHARE = 0.4
_SLOW_S = 0.3
_SLOWED_S = 0.05
"""Open jaws that have not travelled yet may need their configured friction to break away. Jaws that stay slower than
`_SLOW_SHARE` of their speed for `_SLOW_S`, or `_SLOWED_S` once they have moved, may press on an object."""

_BREAKAWAY_N = 0.1
"""Motor force beyond the configured friction with which jaws may break away in a move."""

_UNKNOWN_SHARE = 0.5
"""Largest motor force while the friction is unknown and the jaws may touch an object, as a share of what the force
limit allows. It is below 1 because the jaws may hit the object at speed."""


class FrictionAllowance:
    """Friction that the limit on the current allows for: only what a motion of this run has shown.

    If the true friction is smaller than assumed, the difference acts on an object as force. That also happens in an
    opening motion if the closing direction is configured wrongly. Jaws that have not moved yet may touch an object, so
    a standstill shows nothing about friction. Only open jaws may break away with the configured friction; others open
    a little first (see `Approach`).

    Attributes:
        shown_n: Least friction that a motion has shown; infinite before.
        was_shown_in_grasp: True if a motion of the present grasp has shown it.
    """

    def __init__(self, config: ControlConfig, transmission: Transmission) -> None:
        self._safe_n = _UNKNOWN_SHARE * config.force_limit_n / transmission.force_bound
        self._true_share = transmission.friction_share
        self._breakaway_n = transmission.friction_n + _BREAKAWAY_N
        self.shown_n = math.inf
        self.was_shown_in_grasp = self._starts_open = self._has_moved = False
        self._slow_s = 0.0

    def start_grasp(self) -> None:
        """Starts a grasp: what was shown before does not count in its grip."""
        self.was_shown_in_grasp = False

    def start_phase(self, *, from_open: bool) -> None:
        """Starts a phase; ``from_open`` is True if its jaws are open and grip nothing."""
        self._starts_open = from_open

    def end_stuck(self) -> None:
        """Lets stuck jaws try again: a person may have removed what held them."""
        self._slow_s = 0.0

    def update(self, dt_s: float, closing_m_s: float, speed_m_s: float, *, closing: bool) -> None:
        """Counts the time of slow closing, across phases: the jaws may press on an object already.

        Args:
            dt_s: Time since the last cycle.
            closing_m_s: Closing speed of one jaw.
            speed_m_s: Its largest speed in this phase.
            closing: True if the jaws are to close, and grip nothing yet.
        """
        if not closing:
            self._has_moved = False
            return
        is_slow = closing_m_s < _SLOW_SHARE * speed_m_s
        self._slow_s = self._slow_s + dt_s if is_slow else 0.0
        self._has_moved |= not is_slow

    def learn(self, friction_n: float | None, *, only_lower: bool) -> None:
        """Takes the friction that a motion shows; None if it shows none.

        With ``only_lower`` friction may only fall: closing jaws may press on a soft object, which looks like friction.
        """
        if friction_n is not None:
            self.was_shown_in_grasp = True
            friction_n *= self._true_share
            self.shown_n = min(friction_n, self.shown_n) if only_lower else friction_n

    def allowance_n(self, friction_n: float, *, opening: bool, closing: bool, gripping: bool) -> float:
        """Returns the part of the assumed ``friction_n`` that the current limit may allow for."""
        # In a grip, a sudden motion adds to the static force.
        if self.shown_n < math.inf and (self.was_shown_in_grasp or not gripping):
            return min(friction_n, self.shown_n)
        return friction_n if opening or (closing and self._may_be_stuck) else 0.0

    def max_closing_force_n(self, *, closing: bool, approaching: bool) -> float:
        """Returns the largest motor force of jaws that are to close; the speed loop of an approach raises it slowly."""
        may_be_stuck = closing and self._may_be_stuck
        if self.shown_n < math.inf or (self._starts_open and (approaching or not may_be_stuck)):
            return math.inf
        return max(self._safe_n, self._breakaway_n) if may_be_stuck else self._safe_n

    @property
    def _may_be_stuck(self) -> bool:
        """True if friction may be all that holds closing jaws."""
        return self._starts_open and self._slow_s <= (_SLOWED_S if self._has_moved else _SLOW_S)
