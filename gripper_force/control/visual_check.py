"""Check of a grip against the camera."""

import math

from gripper_force.config import ControlConfig
from gripper_force.types import NS_PER_MS, NS_PER_S, VisualForce

_FILTER_S = 0.1
_RISE_SHARE = 0.15
"""The filtered visual estimate must have risen by at least this share of the target since the jaws stopped."""

_NOISE_SHARE = 0.25
"""If it was above the target before the contact, the camera sees forces that are not there, and noise alone reaches the
share of a small target. Until such a grip counts as held, it must also rise by its standard deviation, up to this share
of the target. Unfamiliar frames have no standard deviation. (A light grip of a rigid object may rise as little as its
noise: the impact gives it most of its force.)"""

_BEYOND_SHARE = 1.0
_BEYOND_N = 1.5
"""Excess of the visual estimate over the target, the larger of the two, that no object explains."""

_PROVEN_SHARE = 0.5
"""The motor current proves a grip if it exceeds friction by this share of the target."""


class VisualCheck:
    """Tells whether the camera confirms a grip.

    Jaws may press on an end stop or be held by friction, which the motor current cannot tell from an object. The check
    also uses estimates that fusion does not: those of unfamiliar frames, and those that differ from the motor current.
    A grip makes them rise, too.

    A frame whose estimate is NaN shows that the view is covered or blurred, or that the object is gone: an empty place
    lost its detail, too. If the camera has seen the grip before, the motor current then has to prove it.
    """

    def __init__(self, config: ControlConfig) -> None:
        self._config = config
        self._force_n: float | None = None
        self._std_n, self._t_ns = 0.0, 0
        self.start()

    def start(self) -> None:
        """Starts at the beginning of a grip."""
        self._has_seen = self._has_uncertain = False
        self._covered_ns: int | None = None
        self._before_n = max(self._force_n or 0.0, 0.0)

    def settle(self, friction_n: float) -> None:
        """Ends the contact, before the force rises: until then a network that sees a force in motion lags behind.

        Args:
            friction_n: Contact force that friction may hold after the impact.
        """
        self._before_n = max(self._before_n, (self._force_n or 0.0) - friction_n)

    def add(self, t_ns: int, visual: VisualForce | None, *, gripping: bool) -> None:
        """Filters a new estimate.

        Args:
            t_ns: Present time.
            visual: Newest visual estimate, or None. A repeated one is used once.
            gripping: True between contact and release.
        """
        valid_ns = (self._config.vision_gap_ms + self._config.max_frame_age_ms) * NS_PER_MS
        if t_ns - self._t_ns > valid_ns:
            self._force_n = None
        if self._covered_ns is not None and t_ns - self._covered_ns > valid_ns:
            self._covered_ns = None
        if visual is None or self._config.feedback == "current" or not self._t_ns < visual.t_ns <= t_ns:
            return
        if math.isnan(visual.force_n) and not visual.is_familiar:
            # A view that is covered all the time tells nothing.
            self._covered_ns = visual.t_ns if self._has_seen else None
            return
        self._covered_ns = None
        # A comparison with NaN is false.
        is_sure = not visual.is_familiar or 0 <= visual.std_n <= self._config.vision_std_n
        if not (abs(visual.force_n) <= 1e9 and is_sure):
            self._has_uncertain |= gripping
            return
        self._has_seen |= gripping
        dt_s = (visual.t_ns - self._t_ns) / NS_PER_S
        previous_n = visual.force_n if self._force_n is None else self._force_n
        self._force_n = previous_n + (visual.force_n - previous_n) * dt_s / (dt_s + _FILTER_S)
        self._std_n = visual.std_n if visual.is_familiar else 0.0
        self._t_ns = visual.t_ns

    def objection(self, target_n: float, current_n: float, *, is_held: bool = False) -> str:
        """Returns the observation that speaks against a grip, or an empty text.

        It sees next to no rise of the force, has been too uncertain throughout this grip, or sees far more than the
        target while friction may hold the jaws: a network can give any force for an empty scene. Or the view was
        covered after the camera had seen this grip, while friction may hold the jaws.

        Args:
            target_n: Target force.
            current_n: Motor force beyond friction.
            is_held: True if the grip counts as held. It then takes less to confirm it, so that noise does not end it.
        """
        may_be_friction = current_n < _PROVEN_SHARE * target_n
        if may_be_friction and self._covered_ns is not None:
            return "the object is gone, or the view is covered or blurred"
        if self._force_n is None:
            return "the camera is uncertain" if self._has_uncertain and not self._has_seen else ""
        beyond_n = max(_BEYOND_SHARE * target_n, _BEYOND_N)
        noise_n = 0.0 if is_held or self._before_n <= target_n else min(self._std_n, _NOISE_SHARE * target_n)
        has_risen = self._force_n - self._before_n >= _RISE_SHARE * target_n + noise_n
        if has_risen and not (may_be_friction and self._force_n - target_n > beyond_n):
            return ""
        return f"the camera sees {self._force_n:.1f} N, and saw {self._before_n:.1f} N before the contact"
