"""Gain of an object: its stiffness over that of its kind, learned from the motor current of earlier grasps.

An image shows how far an object is compressed, not how stiff it is. So every visual estimate of one object is
wrong by one factor, which is the ratio of the motor current's force to the visual force, apart from the errors of
both. The error of friction differs from grasp to grasp and averages out. That of the torque constant does not:
it is common to all grasps with one servo, and bounds what can be learned.

The posterior of the gain's logarithm is that of a mixture of two normal priors, one for an object like those of
its kind, one for an object of any stiffness (C. M. Bishop, "Pattern Recognition and Machine Learning", 2006,
sections 2.3.3 and 2.3.9).
"""

import math
from dataclasses import dataclass
from typing import Final

KIND_STD: Final = 0.029
"""Standard deviation of the gain within a kind of object, +-5 % uniform. The network's claimed error includes it."""

_ANY_STD: Final = 0.35
_ANY_SHARE: Final = 0.1
"""Standard deviation of the logarithm, and share, of objects of any stiffness: a factor of 2 is two deviations."""

_MIN_FRAMES: Final = 30
_MIN_FORCE_N: Final = 0.3
"""Least number of frames of a hold, and least mean force in them, that say something about the gain."""

GATE: Final = 3.29
"""Largest plausible deviation of an innovation or a ratio, in standard deviations; 0.1 % of good ones are beyond it."""

REPEAT_STD: Final = 0.03
"""Standard deviation of the ratio between grasps of one object in different places, beyond the claimed errors."""


@dataclass(frozen=True, slots=True)
class GainEstimate:
    """Posterior of an object's gain.

    Attributes:
        gain: Factor on visual estimates.
        std: Its relative standard deviation.
        shared_std: Part of it that comes from the torque constant, so that motor current has the same error.
    """

    gain: float
    std: float
    shared_std: float

    def corrected(self, force_n: float, std_n: float) -> tuple[float, float]:
        """Returns a visual estimate and its claimed error with this gain."""
        force_n *= self.gain
        variance_n2 = (self.gain * std_n) ** 2 + force_n**2 * (self.std**2 - KIND_STD**2)
        # Frames and places differ, whatever is known about the gain.
        return force_n, math.sqrt(max(variance_n2, (0.5 * self.gain * std_n) ** 2))


class ObjectGain:
    """The gain of one object, from one ratio per grasp.

    Args:
        torque_constant_std: Relative standard deviation of the torque constant.
        earlier_ratio: Ratio of earlier grasps, and its relative standard deviation without that of the torque constant;
            None without any.
    """

    def __init__(self, torque_constant_std: float, earlier_ratio: tuple[float, float] | None = None) -> None:
        self._torque_variance = torque_constant_std**2
        self.reset()
        if earlier_ratio is not None:
            self.add(*earlier_ratio)

    def reset(self) -> None:
        """Forgets everything: the next grasp is of another object."""
        self._weight = self._weighted_log = 0.0
        self._start_grasp()

    def _start_grasp(self) -> None:
        self._frames, self._current_n, self._visual_n, self._error_n2 = 0, 0.0, 0.0, 0.0

    def observe(self, current_n: float, visual_n: float, error_n2: float) -> None:
        """Adds a frame of a hold.

        Args:
            current_n: Current estimate.
            visual_n: Visual estimate without a gain.
            error_n2: Variance of both together that is constant in a grasp, without torque constant and gain.
        """
        if math.isfinite(current_n + visual_n + error_n2):
            self._frames += 1
            self._current_n += current_n
            self._visual_n += visual_n
            self._error_n2 += error_n2

    def finish_grasp(self, *, counts: bool) -> str:
        """Ends the present grasp. Returns a sentence if it was of another object than the earlier ones.

        Args:
            counts: False if the grasp does not count, because no object was held to its end.
        """
        present = self._measured_log_ratio() if counts else None
        self._start_grasp()
        if present is None:
            return ""
        log_ratio, variance = present
        text = ""
        if self._weight:
            earlier_log = self._weighted_log / self._weight
            if abs(log_ratio - earlier_log) > GATE * math.sqrt(variance + 1 / self._weight):
                text = (
                    f"vision and motor current differ by a factor of {math.exp(log_ratio):.2f}, in the grasps before "
                    f"by {math.exp(earlier_log):.2f}: another object, whose gain is learned anew"
                )
                self.reset()
        self._add(log_ratio, variance)
        return text

    def add(self, ratio: float, std: float) -> None:
        """Adds the ratio of earlier grasps, with its relative standard deviation as for ``earlier_ratio``."""
        self._add(math.log(ratio), std**2)

    def _add(self, log_ratio: float, variance: float) -> None:
        self._weight += 1 / variance
        self._weighted_log += log_ratio / variance

    def _measured_log_ratio(self) -> tuple[float, float] | None:
        """Returns logarithm and relative variance of the present grasp's ratio; None if it shows too little."""
        min_n = _MIN_FORCE_N * self._frames
        if self._frames < _MIN_FRAMES or min(self._current_n, self._visual_n) < min_n:
            return None
        variance = self._error_n2 * self._frames / min(self._current_n, self._visual_n) ** 2
        return math.log(self._current_n / self._visual_n), variance + REPEAT_STD**2

    @property
    def ratio(self) -> tuple[float, float] | None:
        """Ratio of the finished grasps and its relative standard deviation, as for ``earlier_ratio``; None if none."""
        if not self._weight:
            return None
        return math.exp(self._weighted_log / self._weight), 1 / math.sqrt(self._weight)

    def estimate(self, *, with_present: bool = False) -> GainEstimate | None:
        """Returns the posterior after the finished grasps; None before the first.

        Args:
            with_present: Adds the present grasp.
        """
        weight, weighted_log = self._weight, self._weighted_log
        if with_present and (present := self._measured_log_ratio()) is not None:
            weight += 1 / present[1]
            weighted_log += present[0] / present[1]
        if not weight:
            return None
        log_ratio, variance = weighted_log / weight, self._torque_variance + 1 / weight
        parts = []  # of the mixture: density, mean and variance, and the weight of the measured ratio in the mean
        for share, prior in ((1 - _ANY_SHARE, KIND_STD**2), (_ANY_SHARE, _ANY_STD**2)):
            total = prior + variance
            density = share * math.exp(-0.5 * min(log_ratio**2 / total, 1400.0)) / math.sqrt(total)
            parts.append((density, prior / total * log_ratio, prior * variance / total, prior / total))
        norm = sum(density for density, *_ in parts)
        mean = sum(density / norm * centre for density, centre, _, _ in parts)
        spread = sum(density / norm * (own + (centre - mean) ** 2) for density, centre, own, _ in parts)
        shared = self._torque_variance * sum(density / norm * weight for density, _, _, weight in parts)
        return GainEstimate(math.exp(mean), math.sqrt(spread), math.sqrt(min(shared, spread)))

    @property
    def problem(self) -> str:
        """Reason why the ratio is implausible for any object, or an empty text."""
        if not self._weight:
            return ""
        log_ratio = self._weighted_log / self._weight
        limit = GATE * math.sqrt(_ANY_STD**2 + self._torque_variance + 1 / self._weight)
        if abs(log_ratio) <= limit:
            return ""
        return (
            f"motor current was {math.exp(log_ratio):.2f} times the visual force in earlier grasps, outside "
            f"{math.exp(-limit):.2f} to {math.exp(limit):.2f}: the network does not know this object"
        )
