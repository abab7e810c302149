"""Three statements that hold for every grasp, whatever the configuration wrongly says.

The contact force stays within the force limit and 5 %. Jaws without contact are never faster than 1.5 times the
configured speed, except those that an object pushes open while the motor has no torque. Jaws that move are never
``held`` on nothing for longer than 0.1 s; jaws that friction or an end stop keeps still do not show that their object
is gone, and the camera takes up to 0.5 s and two frame periods. All three are about the true plant.
"""

from typing import Final

from gripper_force.config import ControlConfig
from gripper_force.types import Outcome, Phase

FORCE_SHARE: Final = 1.05
SPEED_SHARE: Final = 1.5
NOTHING_SHARE: Final = 0.05
"""Contact force as a share of the target below which the jaws hold nothing."""

REACTION_S: Final = 0.1
"""Time for which jaws in motion may still count as held after the object has left."""

STILL_REACTION_S: Final = 0.5
STILL_REACTION_FRAMES: Final = 2
"""The same with the time in which they stand still: this time and this many frame periods."""

_STILL_M_S: Final = 0.003
"""Speed below which a jaw stands still: friction creeps."""

_TRAVEL_SHARE: Final = 2.0
"""Speed of a release or a move as a share of the approach speed."""


class SafetyStatements:
    """Observes one grasp for the three statements: its largest force and speed, and a hold on nothing.

    Args:
        control: The configured force limit and speed.
        target_n: Requested force.
        sign: -1 if the configured closing direction is wrong.

    Attributes:
        force_share: Largest contact force over the force limit.
        speed_share: Largest speed of a jaw without contact over the configured one.
        held_nothing: True if the grasp counted as held without contact force.
    """

    def __init__(self, control: ControlConfig, target_n: float, sign: int = 1) -> None:
        self._limit_n, self._speed_m_s = control.force_limit_n, control.approach_speed_m_s
        self._sign = sign
        self.change_target(target_n)
        self._still_reaction_s = STILL_REACTION_S + STILL_REACTION_FRAMES / control.frame_hz
        self._nothing_s = self._moving_s = 0.0
        self.force_share = self.speed_share = 0.0
        self.held_nothing = False

    def change_target(self, target_n: float) -> None:
        """Takes the force of a new request."""
        self._nothing_n = NOTHING_SHARE * target_n

    def observe(
        self,
        dt_s: float,
        phase: str,
        outcome: str,
        *,
        force_n: float,
        object_n: float,
        peak_n: float,
        closing_m_s: float,
        has_torque: bool = True,
    ) -> None:
        """Takes one step of the plant.

        Args:
            dt_s: Length of the step.
            phase: Phase of the controller.
            outcome: Outcome of the grasp so far.
            force_n: Contact force at the end of the step.
            object_n: Contact force on an object.
            peak_n: Largest contact force in the step.
            closing_m_s: Speed of a jaw, positive while it closes.
            has_torque: False if the motor force is zero: then an object may push the jaws open at any speed.
        """
        claims = outcome == Outcome.HELD and phase in (Phase.RAMP, Phase.HOLD)
        if claims and object_n < self._nothing_n:
            self._nothing_s += dt_s
            self._moving_s += dt_s if abs(closing_m_s) >= _STILL_M_S else 0.0
        else:
            self._nothing_s = self._moving_s = 0.0
        self.held_nothing |= self._nothing_s > self._still_reaction_s or self._moving_s > REACTION_S
        self.force_share = max(self.force_share, peak_n / self._limit_n)
        if force_n == 0.0:
            # Opening jaws and moves may be faster. With a wrong sign a release closes the jaws, and a grasp opens them.
            is_move = phase == Phase.MOVE and outcome != Outcome.SLIP
            travels = closing_m_s < 0 or self._sign < 0 or is_move
            if closing_m_s < 0 and not has_torque:
                return
            limit_m_s = self._speed_m_s * (_TRAVEL_SHARE if travels else 1.0)
            self.speed_share = max(self.speed_share, abs(closing_m_s) / limit_m_s)
