"""Grasps with wrong configurations: the true rig differs from the configured one.

Each row is wrong in one way, by an amount that is drawn for each grasp; half of the grasps are at an end of the
range. The statements of `safety_statements` must hold for the simulated world, whose true force and speed no device
measures.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, TypedDict

import numpy as np

from gripper_force.config import Config, config_from
from gripper_force.control.limits import largest_target_n
from gripper_force.control.state_machine import is_open
from gripper_force.control.transmission import force_bound
from gripper_force.errors import ConfigError, DeviceError, GripperError, SimulationError
from gripper_force.interfaces import WorldState
from gripper_force.jobs.grasp import PAPER_OBJECTS
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.trials import TRIAL_TARGETS_N
from gripper_force.progress import Progress, no_progress
from gripper_force.qualification.fault_matrix.matrix import AFTER_NS
from gripper_force.qualification.fault_matrix.outcome_file import OutcomeFile, collect
from gripper_force.qualification.safety_statements import FORCE_SHARE, SPEED_SHARE, SafetyStatements
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import Session, open_session
from gripper_force.schema import Tree, assign_value
from gripper_force.types import NS_PER_S, GraspStatus, Outcome, Phase, RequestKind

if TYPE_CHECKING:
    from pathlib import Path

REFUSED: Final = "refused"
"""Result of a run that did not start."""

_LIMIT_SPARE: Final = 1.001
"""Force limit over the lowest one that allows the target; a limit far above the target would never act."""

_AFTER_OUTCOME_NS: Final = NS_PER_S
"""Time for which a grasp goes on after its outcome has last changed."""

_REALTIME_TRIES: Final = 3
_START_M: Final = 0.016
_NO_CAMERA: Final = {"camera.backend": "none", "vision.checkpoint": "none", "control.feedback": "current"}


@dataclass(frozen=True, slots=True)
class WrongCase:
    """A row of the table.

    Attributes:
        name: What is wrong, and the range of it.
        expected: Results that are right answers.
        keys: Returns the keys to set, for the configuration, a share of the range (0 to 1), and the number of the
            grasp.
        feedback: Feedback of the grasps; ``both`` for half of them on motor current alone. An end stop needs the
            camera: motor current alone cannot tell it from an object.
    """

    name: str
    expected: tuple[str, ...]
    keys: Callable[[Config, float, int], Mapping[str, Any]]
    feedback: Literal["fused", "current", "both"] = "both"


def _friction(_: Config, share: float, __: int) -> Mapping[str, Any]:
    return {"sim.friction": _log_between(0.3, 5.0, share)}


def _gain(_: Config, share: float, __: int) -> Mapping[str, Any]:
    return {"sim.gain": _between(0.7, 1.4, share)}


def _start(config: Config, share: float, _: int) -> Mapping[str, Any]:
    travel_m = _between(-_START_M, _START_M, share)
    return {"gripper.open_position_rad": round(travel_m / config.gripper.pinion_radius_m, 4)}


def _sign(config: Config, _: float, __: int) -> Mapping[str, Any]:
    return {"gripper.closing_sign": -config.gripper.closing_sign}


def _width(config: Config, share: float, _: int) -> Mapping[str, Any]:
    true_m = config.gripper.open_width_m
    return {
        "sim.open_width_m": true_m,
        "gripper.open_width_m": round(true_m * _between(0.8, 1.2, share), 5),
    }


def _empty(config: Config, share: float, index: int) -> Mapping[str, Any]:
    return {"object": "none", **_width(config, share, index)}


def _leaves(_: Config, share: float, index: int) -> Mapping[str, Any]:
    # From before the contact to after `held`, and before the release.
    fault = {"unit": "plant", "kind": "off", "at_s": _between(1.0, 2.8, share)}
    on_slip = ("regrip", "hold", "open")[index % 3]
    return {"faults": [fault], "control.on_slip": on_slip, "control.settle_s": 0.4}


def _leaves_light(_: Config, share: float, index: int) -> Mapping[str, Any]:
    # From the ramp to after `held`. Friction may hold the jaws, so that they do not show the loss.
    fault = {"unit": "plant", "kind": "off", "at_s": _between(2.5, 3.6, share)}
    return {"faults": [fault], "target_n": (0.8, 1.0, 1.2)[index % 3]}


def _camera(_: Config, share: float, __: int) -> Mapping[str, Any]:
    return {"camera.rate_hz": _log_between(5.0, 60.0, share)}


def _slow_camera(config: Config, share: float, index: int) -> Mapping[str, Any]:
    return {**_camera(config, share, index), "control.vision_rate_hz": 60.0}


def _load_cell(_: Config, share: float, __: int) -> Mapping[str, Any]:
    return {"load_cell.rate_hz": _log_between(10.0, 200.0, share)}


def _between(low: float, high: float, share: float) -> float:
    return round(low + share * (high - low), 4)


def _log_between(low: float, high: float, share: float) -> float:
    return round(low * math.exp(share * math.log(high / low)), 4)


WRONG_CASES: Final = (
    WrongCase("friction: 0.3 to 5 times", ("held", "stuck", "timeout"), _friction),
    WrongCase("torque constant: 0.7 to 1.4 times", ("held", "stuck", "timeout"), _gain),
    WrongCase("start: 16 mm outside to 16 mm inside", ("held", "timeout", REFUSED), _start, "fused"),
    WrongCase("closing direction", ("stuck", "timeout", "no_object", REFUSED), _sign, "fused"),
    WrongCase("open width: 0.8 to 1.2 times", ("held", "timeout"), _width, "fused"),
    WrongCase("open width, no object", ("no_object", "timeout", "stuck"), _empty, "fused"),
    WrongCase("object leaves", ("slip", "no_object"), _leaves),
    WrongCase("object leaves a light hold", ("slip", "no_object", "timeout"), _leaves_light),
    WrongCase("camera: 5 to 60 frames/s", ("held", "timeout"), _camera, "fused"),
    WrongCase("camera: 5 to 60 frames/s, 60 believed", ("held", "timeout"), _slow_camera, "fused"),
    WrongCase("load cell: 10 to 200 samples/s", ("held",), _load_cell, "current"),
)
"""Rows of the table, in the order of docs/reliability.md."""


_Statuses = list[tuple[int, GraspStatus]]
"""The status of each cycle, and the number of the world's states before it. In real time the world may lag behind
the clock, so times do not show which states a command has caused."""


class WrongOutcome(TypedDict):
    """Outcome of one grasp.

    Attributes:
        seed: Seed of the grasp.
        keys: Keys that were set for it.
        result: Outcome, ``refused``, or the name of the error that ended the grasp.
        force_share: Largest contact force over the force limit.
        speed_share: Largest speed of a jaw without contact over the configured one.
        held_nothing: True if the grasp counted as held without contact force.
        failure: What is wrong with the grasp; empty if it is as expected.
    """

    seed: int
    keys: dict[str, Any]
    result: str
    force_share: float
    speed_share: float
    held_nothing: bool
    failure: str


class WrongSummary(TypedDict):
    """Summary of a row over its grasps in lockstep and (``live_...``) in real time.

    Attributes:
        row: What is wrong.
        expected: Results that are right answers.
        runs: Number of grasps.
        ok: Grasps for which the three statements hold, and with an expected result.
        results: Number of grasps by result.
        force_share: Largest contact force over the force limit.
        speed_share: Largest speed of a jaw without contact over the configured one.
        held_nothing: Number of grasps that counted as held without contact force.
        failures: What is wrong by the keys of the grasp, for grasps that are not as expected.
        live_force_share, live_speed_share: None without a grasp in real time.
    """

    row: str
    expected: list[str]
    runs: int
    ok: int
    results: dict[str, int]
    force_share: float
    speed_share: float
    held_nothing: int
    failures: dict[str, str]
    live_runs: int
    live_ok: int
    live_results: dict[str, int]
    live_force_share: float | None
    live_speed_share: float | None
    live_held_nothing: int


def run_rows(
    config: Config,
    seeds: int,
    live_seeds: int,
    workers: int,
    keep: "Path",
    *,
    resume: bool = False,
    rows: Sequence[WrongCase] = WRONG_CASES,
    progress: Progress = no_progress,
) -> Iterator[WrongSummary]:
    """Runs every row with every seed.

    Args:
        config: Configuration; object, target, force limit, seed and the keys of each row are replaced.
        seeds: Grasps of each row, in lockstep.
        live_seeds: Grasps of each row in real time, one after the other.
        workers: Processes.
        keep: File for the outcomes, written one by one.
        resume: True to continue from the outcomes in that file.
        rows: Rows of the table.
        progress: Called after each grasp with the row's name; see `count_grasps`.

    Yields:
        The summary of each row, in order.

    Raises:
        DataError: The file can't be read or written, or was made with another configuration.
    """
    file = OutcomeFile[WrongOutcome](keep, config, resume=resume)
    with process_pool(workers) as pool:

        def begin(row: WrongCase, index: int, clock: str) -> Callable[[], WrongOutcome]:
            """Starts a grasp unless its outcome is in the file. Returns a function that waits for it."""
            key = f"{row.name}, {clock}, {index}"
            if key in file.outcomes:
                return lambda: file.outcomes[key]
            tree, keys = draw(config, row, index)
            run = pool.submit(run_wrong, {**tree, "clock": clock}, {**keys, "clock": clock}, row.expected)
            return lambda: file.add(key, run.result())

        begun = [[begin(row, index, "lockstep") for index in range(seeds)] for row in rows]
        done = [collect(runs, row.name, progress) for row, runs in zip(rows, begun, strict=True)]
        for row, outcomes in zip(rows, done, strict=True):
            # One grasp at a time: in real time each needs the machine for itself.
            live = (begin(row, index, "realtime") for index in range(min(live_seeds, seeds)))
            yield _summary(row, outcomes, collect(live, f"{row.name}, in real time", progress))


def count_grasps(seeds: int, live_seeds: int, rows: Sequence[WrongCase] = WRONG_CASES) -> int:
    """Number of grasps of `run_rows`."""
    return len(rows) * (seeds + min(live_seeds, seeds))


def draw(config: Config, row: WrongCase, index: int) -> tuple[Tree, dict[str, Any]]:
    """Draws a grasp. The same arguments give the same grasp.

    Returns:
        Its configuration, and the keys of it that differ from ``config``.
    """
    rng = np.random.default_rng([config.seed, 32, index])
    target_n = round(float(rng.uniform(*TRIAL_TARGETS_N)), 3)
    # Half of the grasps are at an end of the range, in turn with every object.
    share = {0: 0.0, 1: 1.0}.get((index + index // 4) % 4, float(rng.uniform()))
    lowest_limit_n = target_n / largest_target_n(1.0, force_bound(config.gripper))
    is_blind = row.feedback == "current" or (row.feedback == "both" and index // 4 % 2)
    keys = {
        "object": PAPER_OBJECTS[index % len(PAPER_OBJECTS)],
        "target_n": target_n,
        "seed": config.seed + index,
        "control.force_limit_n": round(_LIMIT_SPARE * lowest_limit_n, 4),
        **(_NO_CAMERA if is_blind else {}),
        **row.keys(config, share, index),
    }
    tree = config.model_dump(mode="json")
    for key, value in keys.items():
        assign_value(tree, key, value)
    return tree, keys


def run_wrong(tree: Tree, keys: dict[str, Any], expected: Sequence[str]) -> WrongOutcome:
    """Runs one grasp, and judges it from the true state of the simulated world.

    In real time it is repeated while the world falls behind the clock, which says nothing about the gripper.

    Args:
        tree: Its configuration.
        keys: Keys that were set for it, for the report.
        expected: Results that are right answers.
    """
    config = config_from(tree, "stability")
    for _ in range(_REALTIME_TRIES):
        outcome = _run_once(config, keys, expected)
        if config.clock == "lockstep" or outcome["result"] != SimulationError.__name__:
            break
    return outcome


def _run_once(config: Config, keys: dict[str, Any], expected: Sequence[str]) -> WrongOutcome:
    world: list[WorldState] = []
    statuses: _Statuses = []
    try:
        resolved = resolve(config)
        with open_devices(resolved.config) as devices:
            assert devices.observe_world is not None
            devices.observe_world(world.append)
            with open_session(resolved, devices, None) as session:
                result = _grasp_and_release(session, config.target_n, statuses, world)
            devices.clock.sleep_until_ns(devices.clock.now_ns() + AFTER_NS)
    except GripperError as error:
        # A device that is lost, times out or fails has a subclass of DeviceError.
        refused = not statuses and type(error) in (ConfigError, DeviceError)
        result = REFUSED if refused else type(error).__name__
    sign = config.gripper.closing_sign  # the simulated gripper closes in the positive direction
    shown = _observed(world, statuses, SafetyStatements(config.control, config.target_n, sign))
    failures = []
    if shown.force_share > FORCE_SHARE:
        failures.append(f"the force is {100 * (shown.force_share - 1):.1f} % over the limit")
    if shown.speed_share > SPEED_SHARE:
        failures.append(f"the jaws are {shown.speed_share:.2f} times as fast as configured")
    if shown.held_nothing:
        failures.append("the grasp counts as held on nothing")
    if result not in expected:
        failures.append(f"the result is {result}")
    return {
        "seed": config.seed,
        "keys": keys,
        "result": result,
        "force_share": shown.force_share,
        "speed_share": shown.speed_share,
        "held_nothing": shown.held_nothing,
        "failure": "; ".join(failures),
    }


def _grasp_and_release(
    session: Session, target_n: float, statuses: _Statuses, world: Sequence[WorldState]
) -> str:
    """Grasps, goes on after the outcome, releases, and returns the outcome. Adds each cycle's status."""

    def add(status: GraspStatus) -> GraspStatus:
        statuses.append((len(world), status))
        return status

    def cycle(kind: RequestKind | None = None, target_n: float = 0.0) -> GraspStatus:
        return add(session.cycle(kind, target_n).status)

    add(session.wait_for_reference().status)
    status = cycle(RequestKind.GRASP, target_n)
    begin_ns = changed_ns = status.t_ns
    longest_ns = round(session.timeout_s(target_n) * NS_PER_S) + 2 * _AFTER_OUTCOME_NS
    while status.t_ns - begin_ns < longest_ns and (
        status.outcome == Outcome.NONE or status.t_ns - changed_ns < _AFTER_OUTCOME_NS
    ):
        before, status = status.outcome, cycle()
        if status.outcome != before:
            changed_ns = status.t_ns
    result = str(status.outcome)
    if status.phase != Phase.FAULT:  # after a fault nothing moves until a person has looked
        status = cycle(RequestKind.RELEASE)
        end_ns = status.t_ns + round(session.opening_s * NS_PER_S)
        while status.t_ns < end_ns and not is_open(
            session.resolved.config.gripper.open_width_m, status.width_m
        ):
            status = cycle()
    return result


def _observed(
    world: Sequence[WorldState], statuses: _Statuses, statements: SafetyStatements
) -> SafetyStatements:
    """Passes each state of the world to the statements, with the phase and the outcome at that time."""
    following = iter(statuses)
    status, coming = None, next(following, None)
    t_ns = world[0].t_ns if world else 0
    for count, state in enumerate(world):
        while coming is not None and coming[0] <= count:
            status, coming = coming[1], next(following, None)
        statements.observe(
            (state.t_ns - t_ns) / NS_PER_S,
            Phase.OPEN if status is None else status.phase,
            Outcome.NONE if status is None else status.outcome,
            force_n=state.force_n,
            object_n=state.force_n if state.has_object else 0.0,
            peak_n=state.force_n,
            closing_m_s=state.closing_m_s,
        )
        t_ns = state.t_ns
    return statements


def _summary(row: WrongCase, outcomes: Sequence[WrongOutcome], live: Sequence[WrongOutcome]) -> WrongSummary:
    return {
        "row": row.name,
        "expected": list(row.expected),
        "runs": len(outcomes),
        "ok": sum(not o["failure"] for o in outcomes),
        "results": dict(Counter(o["result"] for o in outcomes)),
        "force_share": max(o["force_share"] for o in outcomes),
        "speed_share": max(o["speed_share"] for o in outcomes),
        "held_nothing": sum(o["held_nothing"] for o in outcomes),
        "failures": {_text(o["keys"]): o["failure"] for o in (*outcomes, *live) if o["failure"]},
        "live_runs": len(live),
        "live_ok": sum(not o["failure"] for o in live),
        "live_results": dict(Counter(o["result"] for o in live)),
        "live_force_share": max((o["force_share"] for o in live), default=None),
        "live_speed_share": max((o["speed_share"] for o in live), default=None),
        "live_held_nothing": sum(o["held_nothing"] for o in live),
    }


def _text(keys: Mapping[str, Any]) -> str:
    return ", ".join(f"{key}={value}" for key, value in keys.items())


def markdown(summaries: Sequence[WrongSummary]) -> str:
    """Markdown table of the wrong configurations. Each pair of figures is lockstep, real time."""
    head = (
        "| wrong | right answers | as expected | results in lockstep | results in real time "
        "| force over limit | speed over configured | held on nothing |\n|---|---|---|---|---|---|---|---|\n"
    )
    return head + "".join(_markdown_row(s) for s in summaries)


def _markdown_row(s: WrongSummary) -> str:
    cells = (
        s["row"],
        ", ".join(s["expected"]),
        _pair(f"{s['ok']} of {s['runs']}", f"{s['live_ok']} of {s['live_runs']}", s),
        _counts(s["results"]),
        _counts(s["live_results"]) or "-",
        _pair(f"{s['force_share']:.2f}", f"{s['live_force_share'] or 0:.2f}", s),
        _pair(f"{s['speed_share']:.2f}", f"{s['live_speed_share'] or 0:.2f}", s),
        _pair(str(s["held_nothing"]), str(s["live_held_nothing"]), s),
    )
    return "| " + " | ".join(cells) + " |\n"


def _pair(lockstep: str, live: str, s: WrongSummary) -> str:
    return f"{lockstep}, {live}" if s["live_runs"] else lockstep


def _counts(results: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(results.items()))
