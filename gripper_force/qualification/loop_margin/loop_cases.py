"""Force loop on difficult plants: verdicts of grasps, and gain margins."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np

from gripper_force.config import Config, ControlConfig
from gripper_force.control.force_loop import tolerance_n
from gripper_force.control.state_machine import GraspController
from gripper_force.qualification.loop_margin.analytic_plant import (
    CYCLE_NS,
    NOISE_A,
    POSITION_LOOP,
    Gripper,
    SimulatedVision,
    transmission_of,
)
from gripper_force.qualification.loop_margin.gain_margin import (
    AMPLITUDE_N,
    CYCLE_S,
    FRAME_S,
    IdentifiedPlant,
    gains_of,
    identify,
    margin_by_lag,
    margin_by_rule,
    margin_with_inertia,
    observed_margin,
)
from gripper_force.qualification.loop_margin.grid import FULL, Field, Grid, Margins, Trial, Trials, Verdict
from gripper_force.qualification.loop_margin.maps import draw_margins, draw_verdicts
from gripper_force.qualification.numerics.numerical_case import NumericalCase
from gripper_force.types import EstimateSource, Outcome, Request, RequestKind

_TARGET_N: Final = 4.0
_MAX_COMPRESSION_M: Final = 0.02  # travel available to compress a soft object
_CONTACT_M: Final = 0.008
_TIME_S: Final = 7.0
_JUDGED_S: Final = 2.0
"""Time at the end of a grasp over which the force is judged."""

_VISION_NOISE_N: Final = 0.1
_OVER_SHARE: Final = 0.05
"""Share over the force limit from which a grasp crushes; `Limits` allows no more."""

_CEILING_SHARE: Final = 1.04
"""Largest static force over the force limit, for the largest torque constant."""

_LOST_SHARE: Final = 0.1
"""Error of the mean force, as a share of the target, from which a grasp does not hold."""

_AGREEMENT: Final = 0.2
"""Bound on the deviation of observed from predicted margins."""

_DPI: Final = 110
_LATE_S: Final = 0.035
"""Delay of vision from which predicted margins have a bound."""


def target_n(stiffness_n_m: float) -> float:
    """Returns the target force of a grasp, which is less for soft objects: the travel is limited."""
    return min(_TARGET_N, _MAX_COMPRESSION_M * stiffness_n_m)


def grasp(config: Config, truth: Gripper, delay_s: float, seed: int) -> Trial:
    """Runs one grasp with the unmodified controller and judges it."""
    control, rig = config.control, truth.transmission
    wanted_n, gripper = target_n(truth.stiffness_n_m), replace(truth)
    controller = GraspController(control, rig, config.servo.current_limit_a, POSITION_LOOP)
    request: Request | None = Request(0, RequestKind.GRASP, wanted_n)
    vision = SimulatedVision(delay_s, _VISION_NOISE_N)
    rng = np.random.default_rng([config.seed, 45, seed])
    bounds = _Bounds(config, truth)
    forces_n, violations = [], 0
    for cycle, (servo_noise, vision_noise) in enumerate(
        rng.standard_normal((round(_TIME_S / CYCLE_S), 2)).tolist()
    ):
        t_ns = cycle * CYCLE_NS
        servo = gripper.read(t_ns, NOISE_A * servo_noise)
        visual = vision.sample(t_ns, gripper.force_n, vision_noise)
        decision = controller.step(t_ns, servo, visual, request)
        request = None
        command = decision.command
        violations += not bounds.contains(command.goal_current_a, command.goal_position_rad)
        forces_n.append(gripper.force_n)
        gripper.advance(command, CYCLE_S)
    last_n = np.array(forces_n[-round(_JUDGED_S / CYCLE_S) :])
    peak_to_peak_n, error_share = float(np.ptp(last_n)), abs(float(last_n.mean()) / wanted_n - 1)
    if gripper.peak_n > (1 + _OVER_SHARE) * control.force_limit_n:
        verdict = Verdict.CRUSHES
    elif peak_to_peak_n > 2 * tolerance_n(wanted_n):
        verdict = Verdict.RINGS
    elif (
        decision.status.outcome in (Outcome.NO_OBJECT, Outcome.STUCK, Outcome.SLIP, Outcome.FAULT)
        or error_share > _LOST_SHARE
    ):
        verdict = Verdict.LOSES
    elif decision.estimate.source == EstimateSource.CURRENT:
        verdict = Verdict.CURRENT
    else:
        verdict = Verdict.HOLDS
    return Trial(verdict, gripper.peak_n, peak_to_peak_n, error_share, violations)


class _Bounds:
    """Limits of every command, computed independently of `gripper_force.control.limits`."""

    def __init__(self, config: Config, truth: Gripper) -> None:
        rig = truth.transmission
        max_friction_n = rig.friction_n * (1 + 3 * rig.friction_std)
        self._max_a = min(
            config.servo.current_limit_a,
            (_CEILING_SHARE * config.control.force_limit_n / rig.torque_constant_bound + max_friction_n)
            / rig.n_per_a(rig.open_position_rad),
        )
        self._low_rad, self._high_rad = rig.goal_range_rad

    def contains(self, current_a: float, position_rad: float) -> bool:
        """Returns True if a command is within the limits; a non-finite one is not."""
        return 0 <= current_a <= self._max_a and self._low_rad <= position_rad <= self._high_rad


def crushing_n_m(control: ControlConfig, truth: Gripper) -> float:
    """Returns the stiffness from which the impact of first contact alone exceeds the force limit."""
    impact_m_s = truth.transmission.impact_m_s(control.force_limit_n)
    speed_m_s = min(control.approach_speed_m_s, impact_m_s, 0.010 * _TARGET_N)
    return ((1 + _OVER_SHARE) * control.force_limit_n / speed_m_s) ** 2 / truth.mass_kg


def cases(config: Config, maps: Path | None, grid: Grid = FULL) -> Iterator[NumericalCase]:
    """Yields the cases of the force loop and draws its maps.

    Args:
        config: Configuration of control, gripper and limits.
        maps: Folder of the maps, or None.
        grid: Values to try.
    """
    truth = Gripper(transmission_of(config.gripper), contact_m=_CONTACT_M)
    verdicts: dict[tuple[str, float], Trials] = {}
    for feedback, factor in product(("fused", "vision"), grid.factors):
        verdicts[feedback, factor] = trials = _run_grid(config, truth, grid, feedback, factor)
        yield _map_row(config, truth, feedback, factor, trials)
    swept = _sweep(config, truth, grid)
    yield from _sweep_rows(grid, swept)
    all_trials = [*swept.values(), *(trial for trials in verdicts.values() for trial in trials.values())]
    yield NumericalCase(
        "commands outside limits or not finite",
        f"goal current and goal position of every cycle of these {len(all_trials)} grasps",
        float(sum(trial.violations for trial in all_trials)),
        0.0,
    )
    plants = {k: identify(config, replace(truth, stiffness_n_m=k)) for k in grid.margin_stiffness_n_m}
    margins = _margins(config, truth, grid, plants)
    yield from _margin_rows(grid, margins)
    yield _tuned_row(config, truth, grid, plants)
    if maps is not None:
        maps.mkdir(parents=True, exist_ok=True)
        crushing = crushing_n_m(config.control, truth)
        draw_verdicts(grid, verdicts, margins, crushing).savefig(maps / "loop-verdicts.png", dpi=_DPI)
        draw_margins(grid, margins).savefig(maps / "loop-margins.png", dpi=_DPI)


def _run_grid(config: Config, truth: Gripper, grid: Grid, feedback: str, factor: float) -> Trials:
    gain = config.control.plant[0] / factor
    config = config.with_values(control={"feedback": feedback, "plant_gain": gain})
    return {
        (stiffness, delay_s): grasp(config, replace(truth, stiffness_n_m=stiffness), delay_s, seed)
        for seed, (stiffness, delay_s) in enumerate(product(grid.stiffness_n_m, grid.delay_s))
    }


def _map_row(config: Config, truth: Gripper, feedback: str, factor: float, trials: Trials) -> NumericalCase:
    """Returns the case of one map. Only the fused loop with its configured gain has a bound."""
    soft = {key: t for key, t in trials.items() if key[0] < crushing_n_m(config.control, truth)}
    bad = sum(trial.verdict not in (Verdict.HOLDS, Verdict.CURRENT) for trial in soft.values())
    return NumericalCase(
        f"{_LOOPS[feedback]}, loop gain x {factor:g}",
        f"{_verdict_counts(trials.values())}; share not held of those that first contact does not crush",
        100 * bad / len(soft),
        0.0 if (feedback, factor) == ("fused", 1.0) else math.inf,
        "%",
    )


def _sweep(config: Config, truth: Gripper, grid: Grid) -> dict[tuple[float, ...], Trial]:
    trials = {}
    for seed, values in enumerate(product(*grid.sweep.values())):
        at = dict(zip(grid.sweep, values, strict=True))
        gripper = replace(
            truth,
            stiffness_n_m=at["stiffness_n_m"],
            gain=at["gain"],
            friction_n=at["friction_n"] * truth.transmission.friction_n,
            play_m=at["play_m"],
            step_a=at["step_a"],
        )
        trials[values] = grasp(config, gripper, at["delay_s"], seed)
    return trials


def _sweep_rows(grid: Grid, swept: dict[tuple[float, ...], Trial]) -> Iterator[NumericalCase]:
    for number, (name, values) in enumerate(grid.sweep.items()):
        for value in values:
            trials = [trial for key, trial in swept.items() if key[number] == value]
            yield NumericalCase(
                f"{_LOOPS['fused']}, {_NAMES[name].format(value)}",
                f"{_verdict_counts(trials)}; share that rings, over all other values",
                100 * sum(trial.verdict == Verdict.RINGS for trial in trials) / len(trials),
                math.inf,
                "%",
            )


def _margins(config: Config, truth: Gripper, grid: Grid, plants: dict[float, IdentifiedPlant]) -> Margins:
    vision, hold = gains_of(config, "vision"), gains_of(config, "fused")

    def field(margin: Callable[[Gripper, IdentifiedPlant, float], float]) -> Field:
        return np.array(
            [
                [margin(replace(truth, stiffness_n_m=k), plants[k], delay_s) for k in plants]
                for delay_s in grid.margin_delay_s
            ]
        )

    return Margins(
        vision=field(lambda gripper, _, delay_s: observed_margin(config, gripper, "vision", delay_s)),
        identified=field(lambda _, plant, delay_s: margin_by_lag(vision, plant, delay_s)),
        inertia=field(lambda gripper, plant, delay_s: margin_with_inertia(vision, plant, gripper, delay_s)),
        fused=field(lambda gripper, _, delay_s: observed_margin(config, gripper, "fused", delay_s)),
        rule=field(lambda _, plant, delay_s: margin_by_rule(hold, plant, delay_s)),
    )


def _margin_rows(grid: Grid, margins: Margins) -> Iterator[NumericalCase]:
    late = np.array(grid.margin_delay_s) >= _LATE_S
    for cells, name, bound in ((late, "from", 100 * _AGREEMENT), (~late, "below", math.inf)):
        for basis, predicted, bound_percent in (
            ("gain, inertia and friction", margins.inertia, bound),
            ("gain and lag alone", margins.identified, math.inf),
        ):
            ratio = (margins.vision / predicted)[cells]
            yield NumericalCase(
                f"margin of vision alone, delay {name} {1e3 * _LATE_S:.0f} ms, by {basis}",
                f"observed over predicted on {ratio.size} cells: {ratio.min():.2f} to {ratio.max():.2f}, "
                f"median {np.median(ratio):.2f}; nine of ten cells agree within",
                100 * float(np.quantile(np.abs(ratio - 1), 0.9)),
                bound_percent,
                "%",
            )
    shortfall = 1 - margins.fused / margins.rule
    yield NumericalCase(
        f"margin of {_LOOPS['fused']}",
        f"minimum {margins.fused.min():.1f}, median {np.median(margins.fused):.1f}; largest shortfall "
        "from the margin of its tuning",
        100 * max(float(shortfall.max()), 0.0),
        100 * _AGREEMENT,
        "%",
    )


def _tuned_row(
    config: Config, truth: Gripper, grid: Grid, plants: dict[float, IdentifiedPlant]
) -> NumericalCase:
    """Returns the case of vision alone with the gains of an object profile."""
    found, predicted = [], []
    for (stiffness, plant), delay_s in product(plants.items(), grid.tuned_delay_s):
        tuned = config.with_values(
            control={
                "plant_gain": plant.gain,
                "plant_lag_ms": 1e3 * plant.lag_s,
                "plant_delay_ms": 1e3 * (delay_s + FRAME_S / 2),
            }
        )
        found.append(observed_margin(tuned, replace(truth, stiffness_n_m=stiffness), "vision", delay_s))
        predicted.append(margin_by_lag(gains_of(tuned, "vision"), plant, delay_s))
    return NumericalCase(
        "margin of vision alone, tuned to the identified plant",
        f"observed {min(found):.2f} to {max(found):.2f}, predicted by gain and lag alone "
        f"{min(predicted):.2f} to {max(predicted):.2f}; cells of {len(found)} where an oscillation "
        f"of {AMPLITUDE_N:g} N grows",
        float(sum(margin < 1 for margin in found)),
        0.0,
    )


def _verdict_counts(trials: Iterable[Trial]) -> str:
    counts = Counter(trial.verdict for trial in trials)
    return ", ".join(f"{verdict} {counts[verdict]}" for verdict in Verdict if counts[verdict])


_LOOPS: Final = {"fused": "current and vision", "vision": "vision alone"}
_NAMES: Final = {
    "stiffness_n_m": "{:g} N/m",
    "delay_s": "delay {:g} s",
    "gain": "torque constant x {:g}",
    "friction_n": "friction x {:g}",
    "play_m": "gear play {:g} m",
    "step_a": "current steps of {:g} A",
}
