"""The force loop on hard plants: where it holds, rings or would crush, and how much gain it would bear."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np

from gripper_force.config import Config, ControlConfig
from gripper_force.control.force_loop import tolerance_n
from gripper_force.control.state_machine import GraspController
from gripper_force.qualification.loop_margin.analytic_plant import (
    CYCLE_NS,
    NOISE_A,
    Gripper,
    SimulatedVision,
    transmission_of,
)
from gripper_force.qualification.loop_margin.gain_margin import (
    FRAME_S,
    SWING_N,
    Identified,
    by_identified_plant,
    by_rule,
    gains_of,
    identify,
    observed,
    with_inertia,
)
from gripper_force.qualification.loop_margin.grid import FULL, Field, Grid, Margins, Trial, Trials, Verdict
from gripper_force.qualification.loop_margin.maps import draw_margins, draw_verdicts
from gripper_force.qualification.numerics.suite import NumericalCase
from gripper_force.types import NS_PER_S, EstimateSource, Outcome, Request, RequestKind

_TARGET_N: Final = 4.0
_TRAVEL_M: Final = 0.02  # what a soft object leaves of the stroke
_CONTACT_M: Final = 0.008
_TIME_S: Final = 7.0
_LAST_S: Final = 2.0
_VISION_NOISE_N: Final = 0.1
_OVER: Final = 0.05
_LOST: Final = 0.1
_AGREE: Final = 0.2
_DPI: Final = 110
_FROM_S: Final = 0.035
_CYCLE_S: Final = CYCLE_NS / NS_PER_S


def target_n(stiffness_n_m: float) -> float:
    """What is asked of a grasp: soft objects leave no travel for more."""
    return min(_TARGET_N, _TRAVEL_M * stiffness_n_m)


def grasp(config: Config, truth: Gripper, delay_s: float, seed: int) -> Trial:
    """Grasps once with the unmodified controller."""
    control, rig = config.control, truth.transmission
    wanted_n, gripper = target_n(truth.stiffness_n_m), replace(truth)
    controller = GraspController(control, rig, config.servo.current_limit_a)
    request: Request | None = Request(0, RequestKind.GRASP, wanted_n)
    vision = SimulatedVision(delay_s, _VISION_NOISE_N)
    rng = np.random.default_rng([config.seed, 45, seed])
    bounds = _Bounds(config, truth)
    forces_n, broken = [], 0
    for cycle, (servo_noise, vision_noise) in enumerate(
        rng.standard_normal((round(_TIME_S / _CYCLE_S), 2)).tolist()
    ):
        t_ns = cycle * CYCLE_NS
        servo = gripper.read(t_ns, NOISE_A * servo_noise)
        visual = vision.sample(t_ns, gripper.force_n, vision_noise)
        decision = controller.step(t_ns, servo, visual, request)
        request = None
        command = decision.command
        broken += not bounds.keep(command.goal_current_a, command.goal_position_rad)
        forces_n.append(gripper.force_n)
        gripper.advance(command, _CYCLE_S)
    last_n = np.array(forces_n[-round(_LAST_S / _CYCLE_S) :])
    swing_n, off = float(np.ptp(last_n)), abs(float(last_n.mean()) / wanted_n - 1)
    if gripper.peak_n > (1 + _OVER) * control.force_limit_n:
        verdict = Verdict.CRUSHES
    elif swing_n > 2 * tolerance_n(wanted_n):
        verdict = Verdict.RINGS
    elif decision.status.outcome in (Outcome.NO_OBJECT, Outcome.SLIP, Outcome.FAULT) or off > _LOST:
        verdict = Verdict.LOSES
    elif decision.estimate.source == EstimateSource.CURRENT:
        verdict = Verdict.CURRENT
    else:
        verdict = Verdict.HOLDS
    return Trial(verdict, gripper.peak_n, swing_n, off, broken)


class _Bounds:
    """What no command may leave, reckoned apart from `gripper_force.control.limits`."""

    def __init__(self, config: Config, truth: Gripper) -> None:
        rig = truth.transmission
        most_friction_n = rig.friction_n * (1 + 3 * rig.friction_std)
        self._most_a = min(
            config.servo.current_limit_a, (config.control.force_limit_n + most_friction_n) / rig.n_per_a
        )
        self._low_rad, self._high_rad = sorted((rig.open_position_rad, rig.closed_position_rad))

    def keep(self, current_a: float, position_rad: float) -> bool:
        """Whether a command is within; what is not finite is not."""
        return 0 <= current_a <= self._most_a and self._low_rad <= position_rad <= self._high_rad


def crushing_n_m(control: ControlConfig, truth: Gripper) -> float:
    """Stiffness from which the impact of the first touch alone is beyond the force limit."""
    speed_m_s = min(control.approach_speed_m_s, 0.010 * _TARGET_N)
    return ((1 + _OVER) * control.force_limit_n / speed_m_s) ** 2 / truth.mass_kg


def cases(config: Config, maps: Path | None, grid: Grid = FULL) -> Iterator[NumericalCase]:
    """Rows of the force loop; its maps go into ``maps``.

    Args:
        config: Whose control, gripper and limits are tested.
        maps: Folder, or None.
        grid: What is tried.
    """
    truth = Gripper(transmission_of(config.gripper), contact_m=_CONTACT_M)
    verdicts: dict[tuple[str, float], Trials] = {}
    for feedback, factor in product(("fused", "vision"), grid.factors):
        verdicts[feedback, factor] = trials = _try_all(config, truth, grid, feedback, factor)
        yield _map_row(config, truth, feedback, factor, trials)
    swept = _sweep(config, truth, grid)
    yield from _sweep_rows(grid, swept)
    everything = [*swept.values(), *(trial for trials in verdicts.values() for trial in trials.values())]
    yield NumericalCase(
        "commands beyond limits, or not finite",
        f"goal current and goal position of every cycle of these {len(everything)} grasps",
        float(sum(trial.broken for trial in everything)),
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


def _try_all(config: Config, truth: Gripper, grid: Grid, feedback: str, factor: float) -> Trials:
    gain = config.control.plant[0] / factor
    control = config.control.model_copy(update={"feedback": feedback, "plant_gain": gain})
    config = config.model_copy(update={"control": control})
    return {
        (stiffness, delay_s): grasp(config, replace(truth, stiffness_n_m=stiffness), delay_s, seed)
        for seed, (stiffness, delay_s) in enumerate(product(grid.stiffness_n_m, grid.delay_s))
    }


def _map_row(config: Config, truth: Gripper, feedback: str, factor: float, trials: Trials) -> NumericalCase:
    """The fused loop is to hold with the gain that it has; of anything else the map tells."""
    soft = {key: t for key, t in trials.items() if key[0] < crushing_n_m(config.control, truth)}
    bad = sum(trial.verdict not in (Verdict.HOLDS, Verdict.CURRENT) for trial in soft.values())
    return NumericalCase(
        f"{_LOOPS[feedback]}, loop gain x {factor:g}",
        f"{_counted(trials.values())}; share that is not held of those that the touch alone does not crush",
        100 * bad / len(soft),
        0.0 if (feedback, factor) == ("fused", 1.0) else math.inf,
        "%",
    )


def _sweep(config: Config, truth: Gripper, grid: Grid) -> dict[tuple[float, ...], Trial]:
    trials = {}
    for seed, values in enumerate(product(*grid.sweep.values())):
        changed: dict[str, Any] = dict(zip(grid.sweep, values, strict=True))
        delay_s = changed.pop("delay_s")
        changed["friction_n"] *= truth.transmission.friction_n
        trials[values] = grasp(config, replace(truth, **changed), delay_s, seed)
    return trials


def _sweep_rows(grid: Grid, swept: dict[tuple[float, ...], Trial]) -> Iterator[NumericalCase]:
    for number, (name, values) in enumerate(grid.sweep.items()):
        for value in values:
            trials = [trial for key, trial in swept.items() if key[number] == value]
            yield NumericalCase(
                f"{_LOOPS['fused']}, {_NAMES[name].format(value)}",
                f"{_counted(trials)}; share that rings, all else combined",
                100 * sum(trial.verdict == Verdict.RINGS for trial in trials) / len(trials),
                math.inf,
                "%",
            )


def _margins(config: Config, truth: Gripper, grid: Grid, plants: dict[float, Identified]) -> Margins:
    vision, hold = gains_of(config, "vision"), gains_of(config, "fused")

    def field(margin: Callable[[Gripper, Identified, float], float]) -> Field:
        return np.array(
            [
                [margin(replace(truth, stiffness_n_m=k), plants[k], delay_s) for k in plants]
                for delay_s in grid.margin_delay_s
            ]
        )

    return Margins(
        vision=field(lambda gripper, _, delay_s: observed(config, gripper, "vision", delay_s)),
        identified=field(lambda _, plant, delay_s: by_identified_plant(vision, plant, delay_s)),
        inertia=field(lambda gripper, plant, delay_s: with_inertia(vision, plant, gripper, delay_s)),
        fused=field(lambda gripper, _, delay_s: observed(config, gripper, "fused", delay_s)),
        rule=field(lambda _, plant, delay_s: by_rule(hold, plant, delay_s)),
    )


def _margin_rows(grid: Grid, margins: Margins) -> Iterator[NumericalCase]:
    late = np.array(grid.margin_delay_s) >= _FROM_S
    for cells, name, bound in ((late, "from", 100 * _AGREE), (~late, "below", math.inf)):
        for how, predicted, least in (
            ("gain, inertia and friction", margins.inertia, bound),
            ("gain and lag alone", margins.identified, math.inf),
        ):
            ratio = (margins.vision / predicted)[cells]
            yield NumericalCase(
                f"margin of vision alone, delay {name} {1e3 * _FROM_S:.0f} ms, by {how}",
                f"observed over predicted on {ratio.size} cells: {ratio.min():.2f} to {ratio.max():.2f}, "
                f"median {np.median(ratio):.2f}; nine cells of ten agree within",
                100 * float(np.quantile(np.abs(ratio - 1), 0.9)),
                least,
                "%",
            )
    short = 1 - margins.fused / margins.rule
    yield NumericalCase(
        f"margin of {_LOOPS['fused']}",
        f"least {margins.fused.min():.1f}, median {np.median(margins.fused):.1f}; most that it falls short "
        "of what its tuning promises",
        100 * max(float(short.max()), 0.0),
        100 * _AGREE,
        "%",
    )


def _tuned_row(config: Config, truth: Gripper, grid: Grid, plants: dict[float, Identified]) -> NumericalCase:
    """Vision alone with the gains that an object profile gives it."""
    found, promised = [], []
    for (stiffness, plant), delay_s in product(plants.items(), grid.tuned_delay_s):
        known = {
            "plant_gain": plant.gain,
            "plant_lag_ms": 1e3 * plant.lag_s,
            "plant_delay_ms": 1e3 * (delay_s + FRAME_S / 2),
        }
        tuned = config.model_copy(update={"control": config.control.model_copy(update=known)})
        found.append(observed(tuned, replace(truth, stiffness_n_m=stiffness), "vision", delay_s))
        promised.append(by_identified_plant(gains_of(tuned, "vision"), plant, delay_s))
    return NumericalCase(
        "margin of vision alone, tuned by what was identified",
        f"observed {min(found):.2f} to {max(found):.2f}, predicted by gain and lag alone "
        f"{min(promised):.2f} to {max(promised):.2f}; of {len(found)} cells those where a swing of "
        f"{SWING_N:g} N grows",
        float(sum(margin < 1 for margin in found)),
        0.0,
    )


def _counted(trials: Iterable[Trial]) -> str:
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
