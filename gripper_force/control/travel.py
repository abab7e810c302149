"""Motion of the jaws in a release or a move."""

from gripper_force.control.free_travel import FreeTravel
from gripper_force.control.trajectory import ACCELERATION_S, TrapezoidalProfile

_LEAD_M = 0.004
"""Largest lead of the profile over one jaw in free travel, so that jaws that were held back do not jump."""

_LET_GO_S = 0.6
"""Time in which the largest motor force of a grip falls to that of free travel after a release. With less motor
force at once, the servo could not brake the jaws, and a springy object pushed them open at four times the wanted
speed."""

_LET_GO_LEAD_S = 0.03
"""Time in which the lead of the goal position reaches its full length after a release. With a full lead at once, the
motor would add to the force of a springy object."""

_FREE_SHARE = 0.4
"""Share of the largest speed above which nothing resists: the motor force is then friction. The profile has half of
that speed."""

_CLOSING_CYCLES = 10
"""Number of cycles that show friction in a move that closes. In later ones it may press a soft object."""

_OPENS_SHARE = 0.25
_PUSH_N_S = 5.0
_PUSH_SHARE = 3.0
"""While a release is slower than `_OPENS_SHARE` of its speed, extra motor force grows at `_PUSH_N_S`, up to
`_PUSH_SHARE` times the motor force of free travel: friction may be larger than configured."""


class Travel:
    """Goal width and motor force of a release or a move.

    Attributes:
        speed_m_s: Largest speed of one jaw.
        goal_width_m: Goal of the distance between the jaws.
        motor_force_n: Largest motor force at each jaw.
        free_travel: Motor force of this travel, where nothing resisted.
    """

    def __init__(self, speed_m_s: float, free_motor_force_n: float, open_width_m: float) -> None:
        self.speed_m_s = speed_m_s
        self._free_motor_force_n = free_motor_force_n
        self._open_width_m = open_width_m
        self._profile = TrapezoidalProfile(ACCELERATION_S)
        self.start(open_width_m, 0.0, opens=True)

    def start(self, width_m: float, grip_n: float, *, opens: bool) -> None:
        """Starts from rest.

        Args:
            width_m: Present distance between the jaws.
            grip_n: Motor force of the grip that ends; 0 for none.
            opens: True if the jaws are to open.
        """
        self.goal_width_m = width_m
        self.motor_force_n = self._free_motor_force_n
        self.free_travel = FreeTravel() if opens else FreeTravel(_CLOSING_CYCLES)
        self._profile.start(width_m, self.speed_m_s)
        self._grip_n, self._push_n = grip_n, 0.0

    def open(self, dt_s: float, t_s: float, width_m: float, closing_m_s: float) -> None:
        """Runs one cycle of a release.

        Args:
            dt_s: Time since the last cycle.
            t_s: Time since the start.
            width_m: Distance between the jaws.
            closing_m_s: Closing speed of one jaw.
        """
        is_slow = -closing_m_s < _OPENS_SHARE * self.speed_m_s
        if is_slow and t_s > 2 * ACCELERATION_S:
            self._push_n = min(self._push_n + _PUSH_N_S * dt_s, _PUSH_SHARE * self._free_motor_force_n)
        self.motor_force_n = self._force_n(t_s) + self._push_n
        goal_width_m = self._profile.step(self._open_width_m, dt_s)
        lead_m = 2 * _LEAD_M
        if self._is_letting_go(t_s):
            # The object drives the jaws: their start is sharp, which shows the lag of the sensors.
            goal_width_m = self._open_width_m
            lead_m *= min(t_s / _LET_GO_LEAD_S, 1.0)
        self.goal_width_m = self._profile.value = min(goal_width_m, width_m + lead_m)

    def move(self, dt_s: float, t_s: float, width_m: float, to_width_m: float) -> None:
        """Runs one cycle of a move to ``to_width_m``. For the other arguments see `open`."""
        self.motor_force_n = self._force_n(t_s)
        goal_width_m = self._profile.step(to_width_m, dt_s)
        self.goal_width_m = min(max(goal_width_m, width_m - 2 * _LEAD_M), width_m + 2 * _LEAD_M)
        self._profile.value = self.goal_width_m

    def note_friction(self, t_s: float, closing_m_s: float, motor_force_n: float, *, opens: bool) -> None:
        """Takes the motor force of one cycle as friction, if nothing resists or helps.

        Args:
            t_s: Time since the start.
            closing_m_s: Closing speed of one jaw.
            motor_force_n: Measured motor force at each jaw.
            opens: True if the jaws are to open.
        """
        sign = -1 if opens else 1
        if not self._is_letting_go(t_s) and sign * closing_m_s > _FREE_SHARE * self.speed_m_s:
            self.free_travel.add(sign * motor_force_n)

    def remaining_grip_n(self, t_s: float) -> float:
        """Returns what is left of the motor force of a grip, ``t_s`` after the start."""
        return self._grip_n * max(1 - t_s / _LET_GO_S, 0.0)

    def _is_letting_go(self, t_s: float) -> bool:
        """Returns True while the object may push the jaws open."""
        return self._grip_n > 0 and t_s < _LET_GO_S

    def _force_n(self, t_s: float) -> float:
        """Returns the motor force of free travel, and at first what remains of a grip."""
        return max(self._free_motor_force_n, self.remaining_grip_n(t_s))
