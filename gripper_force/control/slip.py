"""Detection of an object that leaves the jaws."""

from gripper_force.config import ControlConfig

_FREE_SPEED_SHARE = 0.4
_SHORTFALL_SHARE = 0.5
_SHORTFALL_N = 0.2
_FREE_S = 0.015
_FREE_FILTER_S = 0.015
"""Free closing: the closing speed is above `_FREE_SPEED_SHARE` of the largest one in a hold, and the motor force falls
short of its goal by more than `_SHORTFALL_SHARE` of the reference and `_SHORTFALL_N`, both for `_FREE_S`. The jaws
then press on nothing. Speed and shortfall are filtered: the speed limit may brake jaws without resistance in every
second cycle."""

_RECEDED_M = 0.0005
_RECEDED_FORCE_N = 0.1
"""A hold has lost its object if the jaws close by this much in one motion and the motor force is within this of that
at their last rest. Against an object they would need more force."""

_COLLAPSE_SHARE = 0.5
_COLLAPSE_S = 0.1
"""A force below this share of the target, for this time, is a slip. A cycle in which the jaws close counts twice."""


class SlipMonitor:
    """Watches the jaws of a grip.

    Args:
        config: Widths that are a slip or no object.
        hold_m_s: Largest closing speed of one jaw in a hold.
    """

    def __init__(self, config: ControlConfig, hold_m_s: float) -> None:
        self._config = config
        self._closes_m_s = _FREE_SPEED_SHARE * hold_m_s
        self.start()

    def start(self) -> None:
        """Starts at the beginning of a grip."""
        self._free_s = self._collapsed_s = 0.0
        self._closing_m_s = self._shortfall_n = 0.0
        self._rest: tuple[float, float] | None = None

    def loss_reason(
        self, dt_s: float, width_m: float, closing_m_s: float, shortfall_n: float, reference_n: float
    ) -> str:
        """Returns why there is nothing between the jaws, or an empty text.

        On an object the motor reaches its goal current. Jaws in free motion do not: the speed limit keeps the
        servo's voltage too low for it.

        Args:
            dt_s: Time since the last cycle.
            width_m: Distance between the jaws.
            closing_m_s: Closing speed of one jaw.
            shortfall_n: Commanded less measured motor force at each jaw.
            reference_n: Wanted contact force.
        """
        share = dt_s / (dt_s + _FREE_FILTER_S)
        self._closing_m_s += (closing_m_s - self._closing_m_s) * share
        self._shortfall_n += (shortfall_n - self._shortfall_n) * share
        free_n = max(_SHORTFALL_SHARE * reference_n, _SHORTFALL_N)
        closes_freely = self._closes(self._closing_m_s) and self._shortfall_n > free_n
        self._free_s = self._free_s + dt_s if closes_freely else 0.0
        if self._free_s >= _FREE_S:
            return "the jaws close without resistance"
        return "the jaws closed" if width_m < self._config.min_object_width_m else ""

    def recession_reason(
        self, width_m: float, held_width_m: float, closing_m_s: float, motor_force_n: float
    ) -> str:
        """Returns why a held object is no longer there, or an empty text. To be called in each cycle after ``held``.

        It finds the loss of a small force, for which the motor need not fall short.

        Args:
            width_m: Distance between the jaws.
            held_width_m: The same when the object was held. Jaws that were pulled open may close to it.
            closing_m_s: Closing speed of one jaw.
            motor_force_n: Commanded motor force at each jaw.
        """
        if not self._closes(closing_m_s):
            self._rest = min(width_m, held_width_m), motor_force_n
        if self._rest is None:
            return ""
        rest_m, rest_n = self._rest
        if rest_m - width_m > _RECEDED_M and abs(motor_force_n - rest_n) < _RECEDED_FORCE_N:
            return "the jaws close without more motor force"
        return ""

    def _closes(self, closing_m_s: float) -> bool:
        return closing_m_s > self._closes_m_s

    def slip_reason(
        self, dt_s: float, force_n: float, target_n: float, closed_m: float, closing_m_s: float
    ) -> str:
        """Returns why the object slips, or an empty text.

        Args:
            dt_s: Time since the last cycle.
            force_n: Estimated contact force.
            target_n: Target force.
            closed_m: Closing of the jaws since the object was held.
            closing_m_s: Closing speed of one jaw.
        """
        counted_s = 2 * dt_s if self._closes(closing_m_s) else dt_s
        self._collapsed_s = self._collapsed_s + counted_s if force_n < _COLLAPSE_SHARE * target_n else 0.0
        if self._collapsed_s >= _COLLAPSE_S:
            return f"the force fell to {force_n:.2f} N"
        if closed_m > self._config.slip_width_m:
            return f"the jaws closed by {closed_m * 1e3:.1f} mm"
        return ""
