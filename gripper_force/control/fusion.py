"""Force estimate from motor current and vision.

The motor current gives the force at bus rate without delay, but with the unknown part of friction and gearing
as an error. Vision gives the force at the object, but late and noisy. A Kalman filter with one state
estimates the difference.
"""

import math
import re
from dataclasses import replace
from typing import Final

from gripper_force.config import ControlConfig
from gripper_force.control.current_estimate import FREE_FLOOR_N, CurrentEstimate, combined_variance_n2
from gripper_force.control.object_gain import GATE, KIND_STD, ObjectGain
from gripper_force.control.transmission import Transmission
from gripper_force.types import NS_PER_MS, EstimateSource, Event, FusedForce, ServoState, VisualForce

_DRIFT_N2_S = 0.03**2
"""Growth of the bias variance per second: friction drifts."""

_OPENING_DRIFT_N2_S = 0.15**2
"""Additional growth for jaws that are about to open."""

_VISION_FLOOR_N = 0.05
"""Lower limit of the standard deviation of a visual estimate, whatever it claims."""

_FRAME_NOISE_N = 0.15
"""Standard deviation from frame to frame of a still scene. The rest of the claimed error is constant."""

_INERTIA_SHARE = 0.4
"""Standard deviation of the current estimate after an impact, as a share of friction: inertia carries the jaws to
anywhere within it."""

_PLAY_SHARE = 0.15
"""Error of a steady current estimate after the motor force has fallen within the play, as a share of friction and of
the reversal: 0.11 N at 60 % in simulated grasps. After a lowering: as a share of friction alone."""

_REENTRY_S = 1 / 3
_MIN_REENTRY = 4
"""The filter accepts rejected estimates once they have been on the same side for this time, and at least this many in
a row."""


NO_NEW_ESTIMATE: Final = "no new estimate"
"""Reason of a drop-out of vision without a rejected estimate."""


def drop_out_reason(text: str) -> str | None:
    """Returns the reason in the text of an event that says that vision dropped out; None for other events."""
    match = re.fullmatch("vision (?:dropped out|is not used): (.*); using motor current alone", text)
    return None if match is None else match[1]


def observer_lag_s(frame_hz: float) -> float:
    """Returns the lag of the bias while the jaws are stuck and about to open: 0.13 s at 60 frames per second.

    It is the square root of noise over drift of the steady-state filter.
    """
    return math.sqrt(_FRAME_NOISE_N**2 / (frame_hz * _OPENING_DRIFT_N2_S))


class Fusion:
    """Kalman filter on the difference between the visual and the current estimate, of which a share is used.

    Neither error averages out over frames: friction and gearing are constant, and so is the visual error of
    one object in one pose. The filter therefore tracks only the *difference*, and the estimate adds the share
    of it that follows from the two claimed variances.

    Vision is compared with the estimate of the current at its capture time. It is first multiplied by the object's
    gain, as far as earlier grasps have shown it.

    The claimed error also contains three temporary parts that the filter itself does not use: the lag of the current
    estimate while the force changes; after an impact, the friction that may hold the jaws, until the force has risen
    by that much; and the bias, while vision differs from the motor current by more than both claimed errors allow.

    Without vision for `ControlConfig.vision_gap_ms` the source is the current alone, with the last bias
    and a growing variance.

    Attributes:
        current: The estimate from motor current.
    """

    def __init__(self, config: ControlConfig, transmission: Transmission) -> None:
        self._feedback = config.feedback
        self._timeout_ns = round(config.vision_gap_ms * NS_PER_MS)
        self._max_age_ns = round(config.max_frame_age_ms * NS_PER_MS)
        self._std_limit_n = config.vision_std_n
        self._reentry_count = max(round(_REENTRY_S * config.frame_hz), _MIN_REENTRY)
        self._transmission = transmission
        self._object_gain = ObjectGain(transmission.torque_constant_std, config.object_ratio)
        self._learns_gain = config.learn_gain
        self.current = CurrentEstimate(config, transmission)
        self._newest_visual_ns = -1
        self._last_used_ns: int | None = None
        self._visual_n = 0.0
        self._visual_std_n = 0.0
        self._source = EstimateSource.CURRENT
        self._rejection = ""
        self._nothing_reported = True
        self.restart()

    def restart(self, *, was_held: bool = False, new_object: bool = False) -> None:
        """Resets bias and friction at the start of a grasp.

        Args:
            was_held: True if the grasp before held an object to its end. Only then its gain counts.
            new_object: True if the grasp is of another object than those before, so that their gain is forgotten.
        """
        if new_object:
            self._object_gain.reset()
        self.end_grasp(was_held=was_held)
        self._applied_gain = self._object_gain.estimate() if self._learns_gain else None
        self._difference_n = 0.0
        self._variance_ratio = self._shared_n2 = self._lagged_n = 0.0
        self._contact_start_n: float | None = None
        self._is_contradicted = False
        self.current.restart()
        self._opening_variance_n2 = 0.0
        self._was_lowering = self._has_lowered = False
        self.reset_variance()

    def end_grasp(self, *, was_held: bool) -> tuple[float, float] | None:
        """Ends the present grasp, and returns the ratio that the object's gain rests on (see `ObjectGain.ratio`)."""
        self._gain_event = self._object_gain.finish_grasp(counts=was_held)
        return self._object_gain.ratio

    def reset_variance(self) -> None:
        """Resets the bias variance to its prior.

        At contact the friction force can be anywhere within +- Coulomb friction.
        """
        self._variance_n2 = self._prior_n2(self.current.force_n)
        self._rejection_count = 0

    def step(
        self,
        t_ns: int,
        servo: ServoState,
        visual: VisualForce | None,
        *,
        free: bool = False,
        gripping: bool = False,
        holding: bool = False,
        opening: bool = False,
        lowering: bool = False,
    ) -> tuple[FusedForce, tuple[Event, ...]]:
        """Runs one cycle.

        Args:
            t_ns: Present time.
            servo: This cycle's reading, with finite numbers.
            visual: Newest visual estimate, or None. A repeated one is used once.
            free: True if the jaws move without contact: the force is zero and the motor force is friction.
            gripping: True from the contact until the release.
            holding: True while the force is to stay at the target.
            opening: True if the jaws are opening. Until friction reverses, motor current says little about
                the contact force.
            lowering: True while the force falls to a lower target. The motor force then changes faster than
                vision follows, and the difference of the two is not updated. Afterwards the motor current says
                less than before.

        Returns:
            The estimate, and an event if vision drops out or returns, or if its first estimate is rejected.
        """
        self._has_lowered = (self._has_lowered or lowering) and not free
        unknown_share = 1.0 if opening else _PLAY_SHARE if self._has_lowered else 0.0
        self._opening_variance_n2 = (self.current.friction_n * unknown_share) ** 2
        if self._was_lowering and not lowering:
            self.reset_variance()
        self._was_lowering = lowering
        self._holds = holding and not self._has_lowered
        self._predict(servo, free)
        self._update_temporary_variance(gripping or opening, gripping)
        self._variance_n2 = max(self._variance_n2, self._opening_variance_n2)
        if visual is not None and visual.t_ns > self._newest_visual_ns and self._feedback != "current":
            if visual.t_ns <= t_ns:  # a wrong time in the future would hide all later frames
                self._newest_visual_ns = visual.t_ns
            self._rejection = self._update(t_ns, visual)
            if not self._rejection:
                self._last_used_ns = t_ns
        events = self._switch_source(t_ns)
        if self._gain_event:
            events = (*events, Event(t_ns, "vision", self._gain_event))
            self._gain_event = ""
        return self._estimate(t_ns), events

    def _update_temporary_variance(self, has_force: bool, gripping: bool) -> None:
        """Computes the temporary parts of the claimed error, see the class."""
        if not has_force:
            self._lagged_n, self._contact_start_n, self._temporary_n2 = self.current.force_n, None, 0.0
            return
        if self._contact_start_n is None:
            self._contact_start_n = self.current.force_n
        dt_s, lag_s = self.current.dt_s, self.current.lag_s
        self._lagged_n += (self.current.force_n - self._lagged_n) * dt_s / (dt_s + lag_s)
        risen_n = max(self.current.force_n - self._contact_start_n, 0.0)
        friction_n = max(_INERTIA_SHARE * self.current.friction_n - risen_n, 0.0) if gripping else 0.0
        self._temporary_n2 = (self.current.force_n - self._lagged_n) ** 2 + friction_n**2
        if self._is_contradicted:  # the bias came from estimates of the same network
            self._temporary_n2 += (self._difference_n / (1 + self._variance_ratio)) ** 2

    def _predict(self, servo: ServoState, free: bool) -> None:
        previous_n = self.current.force_n
        self.current.step(servo, free=free, holding=self._holds, lowering=self._was_lowering)
        current_n = self.current.force_n
        if free:
            self._difference_n = 0.0
        if self._was_lowering and previous_n > 0:  # the difference by the gearing falls with the force
            gearing_n2 = (self._transmission.torque_constant_std * previous_n) ** 2
            share = gearing_n2 / (gearing_n2 + self.current.friction_variance_n2 + FREE_FLOOR_N**2)
            self._difference_n *= 1 - share * (1 - current_n / previous_n)
        drift_n2 = (_DRIFT_N2_S + _OPENING_DRIFT_N2_S * self.current.reversal) * self.current.dt_s
        # An error g of the torque constant gives a bias of g * force: its variance grows with the square of the force.
        gearing_n2 = self._transmission.torque_constant_std**2 * abs(current_n**2 - previous_n**2)
        self._variance_n2 = min(self._variance_n2 + drift_n2 + gearing_n2, self._prior_n2(current_n))

    def _update(self, t_ns: int, visual: VisualForce) -> str:
        """Updates the filter with one estimate. Returns the reason of a rejection, or an empty text."""
        age_ns = t_ns - visual.t_ns
        if not (abs(visual.force_n) <= 1e9 and abs(visual.std_n) <= 1e9):
            self._last_used_ns = None  # the earlier estimates of such a network are not trusted either
            return "it is not finite"
        if not 0 <= age_ns <= self._max_age_ns:
            return "its time is in the future" if age_ns < 0 else f"it is {age_ns / NS_PER_MS:.0f} ms old"
        if visual.std_n > self._std_limit_n:
            return f"its standard deviation is {visual.std_n:.2f} N"
        if self._learns_gain and (problem := self._object_gain.problem):
            return problem
        current_n = self.current.at(visual.t_ns)
        if self._holds and self._learns_gain:
            visual_n2 = max(visual.std_n**2 - (KIND_STD * visual.force_n) ** 2, _VISION_FLOOR_N**2)
            play_n = _PLAY_SHARE * self.current.friction_n * self.current.reversal
            current_n2 = self.current.friction_variance_n2 + FREE_FLOOR_N**2 + play_n**2
            self._object_gain.observe(current_n, visual.force_n, current_n2 + visual_n2)
        if (object_gain := self._applied_gain) is not None:
            force_n, std_n = object_gain.corrected(visual.force_n, visual.std_n)
            visual = replace(visual, force_n=force_n, std_n=std_n)
            self._shared_n2 = (object_gain.shared_std * current_n) ** 2
        if self._was_lowering:
            self._visual_n, self._visual_std_n = visual.force_n, visual.std_n
            return ""
        claimed_n2 = max(visual.std_n, _VISION_FLOOR_N) ** 2
        difference_n = visual.force_n - current_n
        innovation_n = difference_n - self._difference_n
        if abs(difference_n) > 3 * math.sqrt(self._prior_n2(current_n) + claimed_n2):
            self._is_contradicted = True
            return f"it differs from the motor current by {difference_n:.2f} N"
        if abs(innovation_n) > GATE * math.sqrt(self._variance_n2 + claimed_n2):
            self._rejection_count = _count_rejections(self._rejection_count, innovation_n)
            if abs(self._rejection_count) < self._reentry_count:
                return f"it jumps by {innovation_n:.2f} N"
            self._variance_n2 = self._prior_n2(current_n)
        self._rejection_count, self._is_contradicted = 0, False
        self._correct(innovation_n, _FRAME_NOISE_N**2)
        # Errors that vision and motor current share do not make either of them better than the other.
        prior_n2 = self._prior_n2(current_n)
        self._shared_n2 = min(self._shared_n2, 0.99 * claimed_n2, 0.99 * prior_n2)
        self._variance_ratio = (claimed_n2 - self._shared_n2) / (prior_n2 - self._shared_n2)
        self._visual_n, self._visual_std_n = visual.force_n, visual.std_n
        return ""

    def _correct(self, innovation_n: float, noise_n2: float) -> None:
        kalman_gain = self._variance_n2 / (self._variance_n2 + noise_n2)
        self._difference_n += kalman_gain * innovation_n
        self._variance_n2 = combined_variance_n2(self._variance_n2, noise_n2)

    def _prior_n2(self, force_n: float) -> float:
        return self.current.variance_n2(force_n) + self._opening_variance_n2

    def _switch_source(self, t_ns: int) -> tuple[Event, ...]:
        is_recent = self._last_used_ns is not None and t_ns - self._last_used_ns <= self._timeout_ns
        source = EstimateSource(self._feedback) if is_recent else EstimateSource.CURRENT
        change = "dropped out"
        if source == self._source:
            if not (self._nothing_reported and self._rejection):
                return ()
            change = "is not used"
        self._source, self._nothing_reported = source, False
        if source != EstimateSource.CURRENT:
            return (Event(t_ns, "vision", f"vision in use; the force estimate is {source}"),)
        text = f"vision {change}: {self._rejection or NO_NEW_ESTIMATE}; using motor current alone"
        return (Event(t_ns, "vision", text),)

    def _estimate(self, t_ns: int) -> FusedForce:
        share = 1 / (1 + self._variance_ratio)
        bias_n = share * self._difference_n
        force_n = self.current.force_n + bias_n
        prior_n2 = self._prior_n2(self.current.force_n)
        shared_n2 = min(self._shared_n2, prior_n2)
        lasting_n2 = self._variance_n2 + self._variance_ratio * share * (prior_n2 - shared_n2) + shared_n2
        std_n = math.sqrt(lasting_n2 + self._temporary_n2)
        if self._source == EstimateSource.VISION:
            force_n, std_n = self._visual_n, max(self._visual_std_n, _VISION_FLOOR_N)
        force_n = max(force_n, 0.0)
        shows_object_gain = self._learns_gain and not self._object_gain.problem
        object_gain = self._object_gain.estimate(with_present=True) if shows_object_gain else None
        return FusedForce(
            t_ns=t_ns,
            force_n=force_n,
            std_n=std_n,
            current_n=self.current.force_n,
            bias_n=bias_n,
            friction_n=self.current.friction_n,
            source=self._source,
            object_gain=0.0 if object_gain is None else object_gain.gain,
            object_gain_std=0.0 if object_gain is None else object_gain.std,
        )


def _count_rejections(count: int, innovation_n: float) -> int:
    """Counts consecutive rejections on one side (the sign); the other side starts a new count."""
    side = 1 if innovation_n > 0 else -1
    return count + side if count * side > 0 else side
