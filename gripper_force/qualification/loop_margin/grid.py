"""Grid of plants for the force loop, and the results on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.qualification.loop_margin.analytic_plant import CURRENT_STEP_A


class Verdict(StrEnum):
    """Verdict on a grasp, from best to worst."""

    HOLDS = "holds"
    CURRENT = "holds on current alone"
    LOSES = "does not hold"
    RINGS = "rings"
    CRUSHES = "would crush"


@dataclass(frozen=True, slots=True)
class Grid:
    """Values to try.

    Attributes:
        stiffness_n_m: Stiffnesses of the verdict maps.
        delay_s: Delays of the verdict maps.
        factors: Factors on the loop gain, one map each.
        margin_stiffness_n_m: Stiffnesses of the margin maps.
        margin_delay_s: Delays of the margin maps.
        tuned_delay_s: Delays for which vision alone is retuned.
        sweep: Values to try in all combinations: ``delay_s``, and attributes of `Gripper`; friction as a
            share of the assumed one.
    """

    stiffness_n_m: Sequence[float]
    delay_s: Sequence[float]
    factors: Sequence[float]
    margin_stiffness_n_m: Sequence[float]
    margin_delay_s: Sequence[float]
    tuned_delay_s: Sequence[float]
    sweep: dict[str, Sequence[float]]


FULL: Final = Grid(
    stiffness_n_m=tuple(float(k) for k in np.geomspace(1e2, 1e6, 13)),
    delay_s=(0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.125, 0.15),
    factors=(1.0, 2.0, 4.0),
    margin_stiffness_n_m=(1e2, 3e2, 1e3, 3e3, 1e4, 3e4, 1e5, 3e5, 1e6),
    margin_delay_s=(0.0, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15),
    tuned_delay_s=(0.02, 0.035, 0.075),
    sweep={
        "stiffness_n_m": (1e2, 1e3, 1e4, 1e5, 1e6),
        "delay_s": (0.035, 0.1),
        "gain": (0.9, 1.0, 1.1),
        "friction_n": (0.0, 0.5, 1.0, 2.0),
        "play_m": (0.0, 0.001),
        "step_a": (CURRENT_STEP_A, 0.01),
    },
)


@dataclass(frozen=True, slots=True)
class Trial:
    """Result of a grasp on an analytic plant.

    Attributes:
        verdict: Verdict on the grasp.
        peak_n: Largest contact force.
        peak_to_peak_n: Peak-to-peak force in the last two seconds.
        error_share: Error of the mean force in the last two seconds, as a share of the target.
        violations: Number of commands outside limits or not finite.
    """

    verdict: Verdict
    peak_n: float
    peak_to_peak_n: float
    error_share: float
    violations: int


Trials = dict[tuple[float, float], Trial]
"""Trials by stiffness and delay."""

Field = npt.NDArray[np.float64]
"""Values by delay and stiffness, (D, S)."""


@dataclass(frozen=True, eq=False)
class Margins:
    """Gain margins, each (D, S).

    Attributes:
        vision: Observed with vision alone.
        identified: Predicted with vision alone from gain, lag and delay.
        inertia: Predicted with vision alone from the same gain, with inertia and friction of the jaws.
        fused: Observed with motor current and vision.
        rule: Predicted with motor current and vision by the tuning rule.
    """

    vision: Field
    identified: Field
    inertia: Field
    fused: Field
    rule: Field
