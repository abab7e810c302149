"""What the force loop is tried on, and what came of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.qualification.loop_margin.analytic_plant import CURRENT_STEP_A


class Verdict(StrEnum):
    """How a grasp ended. The worse comes later."""

    HOLDS = "holds"
    CURRENT = "holds on current alone"
    LOSES = "does not hold"
    RINGS = "rings"
    CRUSHES = "would crush"


@dataclass(frozen=True, slots=True)
class Grid:
    """What is tried.

    Attributes:
        stiffness_n_m: Of the map of verdicts.
        delay_s: Likewise.
        factors: Of the loop gain, a map each.
        margin_stiffness_n_m: Of the map of margins.
        margin_delay_s: Likewise.
        tuned_delay_s: Delays for which vision alone is tuned anew.
        sweep: Values that are all combined: ``delay_s``, and attributes of `Gripper`; friction as a share of
            what is taken for it.
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
    """A grasp on an analytic plant.

    Attributes:
        verdict: How it ended.
        peak_n: The most the object felt.
        swing_n: How far the force went up and down in the last two seconds.
        off: How far its mean there is from the target, as a share.
        broken: Commands beyond limits, or not finite.
    """

    verdict: Verdict
    peak_n: float
    swing_n: float
    off: float
    broken: int


Trials = dict[tuple[float, float], Trial]
"""By stiffness and delay."""

Field = npt.NDArray[np.float64]
"""A number for each delay and stiffness, (D, S)."""


@dataclass(frozen=True, eq=False)
class Margins:
    """Factors by which the loop gain may be raised, each (D, S).

    Attributes:
        vision: Observed, with vision alone.
        identified: Predicted for it from gain, lag and delay.
        inertia: Predicted for it from the same gain, with inertia and friction of the jaws.
        fused: Observed, with motor current and vision.
        rule: What its tuning promises.
    """

    vision: Field
    identified: Field
    inertia: Field
    fused: Field
    rule: Field
