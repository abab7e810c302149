"""The fault matrix: each part fails during a grasp, and the reaction is judged from the log.

Each row injects one fault into the simulated rig at a seeded moment between first contact and the end of the
hold. It is compared with the same grasp without the fault. Rows that kill or stop a process use real
processes in real time.
"""

import signal
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Final, NotRequired, TypedDict

import numpy as np

from gripper_force.config import Config, config_from
from gripper_force.errors import GripperError, LogError
from gripper_force.interfaces import Devices
from gripper_force.jobs.grasp import PAPER_OBJECTS, grasp_and_release
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.trials import TRIAL_TARGETS_N
from gripper_force.progress import Progress, no_progress
from gripper_force.qualification.fault_matrix.cases import ROWS, Expected, FaultCase
from gripper_force.qualification.fault_matrix.judge import FaultFreeGrasp, Grasp, judge
from gripper_force.qualification.fault_matrix.kill_process import kill_trial
from gripper_force.qualification.fault_matrix.outcome_file import OutcomeFile, collect
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import open_session
from gripper_force.schema import Tree
from gripper_force.types import (
    GRIPPING,
    NS_PER_MS,
    NS_PER_S,
    GraspStatus,
    LoadCellSample,
    ServoCommand,
)

LIMIT_SHARE: Final = 1.25
"""Force limit of each run over its target; a limit far above the target would never act."""

_GAIN_BOUND: Final = 1.1
"""The simulated torque constant is within 10 % of the configured one."""

TOLERANCE: Final = 0.05
"""Share by which a peak may exceed the force limit."""

AFTER_NS: Final = 300 * NS_PER_MS
"""Time after the run in which force and speed are still observed."""

_MAX_LOST_MS: Final = 100 + 5
"""Longest allowed gap at the end of a log: one chunk and one control cycle."""

_ONLY_LIVE: Final = frozenset(row.name for row in ROWS if row.unit == "process")
"""Rows whose processes run in real time only: their runs are not counted twice."""


class FaultRunResult(TypedDict):
    """Result of one grasp with a fault.

    Attributes:
        seed: Seed of the grasp.
        result: Result of the grasp, or the name of the error that ended it.
        peak_over_limit: Peak force over the force limit, minus one.
        took_ms: Time from the fault to the safe state, if there was one.
        lost_records: Records that the log lacks.
        lost_ms: Time before the signal that the log lacks, for rows with a process.
        failure: Deviation from the expected reaction; empty if there is none.
    """

    seed: int
    result: str
    peak_over_limit: float
    took_ms: float | None
    lost_records: int
    lost_ms: NotRequired[float]
    failure: str


class RowSummary(TypedDict):
    """Summary of a row over its grasps, in lockstep and (``live_...``) in real time.

    Attributes:
        row: Name of the fault.
        expected: Expected reaction.
        within_ms: Time limit of the reaction, or None.
        runs: Number of grasps.
        ok: Grasps with the expected reaction.
        results: Number of grasps by result.
        peak_over_limit: Highest peak force over the force limit, minus one.
        median_ms: Median time to the safe state.
        worst_ms: Longest time to the safe state.
        lost_records: Most records that a log lacks.
        lost_ms: Longest time before the signal that a log lacks.
        failures: Deviation by seed and clock, for grasps with an unexpected reaction.
    """

    row: str
    expected: str
    within_ms: float | None
    runs: int
    ok: int
    results: dict[str, int]
    peak_over_limit: float
    median_ms: float | None
    worst_ms: float | None
    lost_records: int
    lost_ms: float
    failures: dict[str, str]
    live_runs: int
    live_ok: int
    live_median_ms: float | None
    live_worst_ms: float | None
    live_peak_over_limit: float | None
    live_results: dict[str, int]


def run_matrix(
    config: Config,
    seeds: int,
    live_seeds: int,
    workers: int,
    keep: Path,
    *,
    resume: bool = False,
    rows: Sequence[FaultCase] = ROWS,
    progress: Progress = no_progress,
) -> Iterator[RowSummary]:
    """Runs every row with every seed.

    Args:
        config: Configuration; object, target, force limit, seed and faults are replaced.
        seeds: Grasps of each row, in lockstep.
        live_seeds: Grasps of each row in real time, one after the other.
        workers: Processes.
        keep: File for the outcomes, written one by one.
        resume: True to continue from the outcomes in that file.
        rows: Rows of the matrix.
        progress: Called after each grasp with the row's name; see `count_grasps` for their number.

    Yields:
        The summary of each row, in order.

    Raises:
        DataError: The file can't be read or written, or was made with another configuration.
        GripperError: A grasp fails without a fault, or does not start.
    """
    drawn = [_draw(config, i).model_dump(mode="json") for i in range(seeds)]
    simulated = [row for row in rows if row.unit != "process"]
    file = OutcomeFile[FaultRunResult](keep, config, resume=resume)
    with process_pool(workers) as pool:

        def begin(row: FaultCase, index: int, clock: str) -> Callable[[], FaultRunResult]:
            """Starts a grasp unless its outcome is in the file. Returns a function that waits for it."""
            key = f"{row.name}, {clock}, {index}"
            if key in file.outcomes:
                return lambda: file.outcomes[key]
            if row.unit == "process":
                run = pool.submit(_run_process_row, drawn[index], row)
            else:
                run = pool.submit(_run_with_fault, drawn[index], fault_free[index], row, clock)
            return lambda: file.add(key, run.result())

        without = [pool.submit(_run_without_fault, tree) for tree in drawn] if simulated else []
        fault_free = []
        for grasp in without:
            fault_free.append(grasp.result())
            progress("without a fault")
        begun = {row: [begin(row, i, "lockstep") for i in range(seeds)] for row in simulated}
        done = {row: collect(begun[row], row.name, progress) for row in simulated}
        for row in rows:  # one grasp at a time: in real time each needs the machine for itself
            if row in done:
                live = (begin(row, i, "realtime") for i in range(min(live_seeds, seeds)))
                yield _summary(row, done[row], collect(live, f"{row.name}, in real time", progress))
            else:
                yield _summary(
                    row, [], collect((begin(row, i, "realtime") for i in range(seeds)), row.name, progress)
                )


def count_grasps(seeds: int, live_seeds: int, rows: Sequence[FaultCase] = ROWS) -> int:
    """Number of grasps of `run_matrix`."""
    simulated = sum(row.unit != "process" for row in rows)
    return seeds * (len(rows) + bool(simulated)) + min(live_seeds, seeds) * simulated


def _draw(config: Config, index: int) -> Config:
    rng = np.random.default_rng([config.seed, 30, index])
    target_n = round(float(rng.uniform(*TRIAL_TARGETS_N)), 3)
    return config.with_values(
        object=PAPER_OBJECTS[index % len(PAPER_OBJECTS)],
        target_n=target_n,
        seed=config.seed + index,
        control={"force_limit_n": LIMIT_SHARE * target_n},
        gripper={"gain_bound": _GAIN_BOUND},
    )


def _run_without_fault(tree: Tree) -> FaultFreeGrasp:
    config = config_from(tree, "stability")
    with tempfile.TemporaryDirectory() as folder:
        run = _grasp(config, Path(folder))
        gripping = [s.t_ns / NS_PER_S for s in run.records(GraspStatus) if s.phase in GRIPPING]
        if not gripping:
            raise GripperError(
                f"the grasp of {config.object!r} with seed {config.seed} fails even without a fault; "
                "check the configuration with gripper-force grasp"
            )
        return FaultFreeGrasp(
            gripping[0], gripping[-1], run.cycles, run.peak_n, tuple(run.records(ServoCommand))
        )


def _run_with_fault(
    tree: Tree, fault_free: FaultFreeGrasp, row: FaultCase, clock: str = "lockstep"
) -> FaultRunResult:
    config = config_from(tree, "stability")
    rng = np.random.default_rng([config.seed, 31])
    earliest_s, latest_s = fault_free.begin_s + 0.05, max(fault_free.end_s - 0.5, fault_free.begin_s + 0.06)
    at_s = float(rng.uniform(earliest_s, latest_s))
    fault = {"unit": row.unit, "kind": row.kind, "at_s": at_s, "for_s": row.for_s}
    config = config_from({**tree, "faults": [fault], "clock": clock}, "stability")
    with tempfile.TemporaryDirectory() as folder:
        run = _grasp(config, Path(folder))
        took_ms, failure = judge(row, run, fault_free, config, run.start_ns + round(at_s * NS_PER_S))
    peak_n = run.true_peak_n if row.unit == "load_cell" else run.peak_n  # the faulty cell can't measure it
    over = peak_n / config.control.force_limit_n - 1
    unneeded = row.expected is Expected.CURRENT_LOWERED and took_ms is None
    late = row.within_ms is not None and (took_ms is None or took_ms > row.within_ms) and not unneeded
    if over > TOLERANCE:
        failure = f"the peak force is {100 * over:.1f} % over the limit"
    elif late and not failure:
        failure = f"the reaction took {took_ms} ms"
    return {
        "seed": config.seed,
        "result": run.result,
        "peak_over_limit": over,
        "took_ms": took_ms,
        "lost_records": run.lost,
        "failure": failure,
    }


def _grasp(config: Config, folder: Path) -> Grasp:
    """Runs a grasp, and observes the force for a while afterwards."""
    path, resolved, result, session = folder / "run.mcap", resolve(config), "", None
    forces_n = [0.0]
    with open_devices(resolved.config) as devices:
        if devices.observe_world is not None:
            devices.observe_world(lambda state: forces_n.append(max(state.force_n, forces_n.pop())))
        try:
            with open_session(resolved, devices, path) as session:
                result = grasp_and_release(session, config.target_n)
        except LogError:
            pass  # reports lost records, which are counted below
        except GripperError as error:
            result = type(error).__name__
        peak_n = _peak_after(devices)
        start_ns = devices.start_ns
    if session is None:
        raise GripperError(f"the grasp of {config.object!r} with seed {config.seed} did not start: {result}")
    log = LogReader(path, recover=True)
    cells_n = [sample.force_n for sample in log.records(LoadCellSample) if sample.valid]
    return Grasp(
        result=result,
        start_ns=start_ns,
        cycles=session.cycles,
        lost=session.lost_records,
        peak_n=max([peak_n, *cells_n]),
        true_peak_n=forces_n[0],
        log=log,
    )


def _peak_after(devices: Devices) -> float:
    """Highest force in N within `AFTER_NS` after the end of the run."""
    devices.clock.sleep_until_ns(devices.clock.now_ns() + AFTER_NS)
    samples = devices.load_cell.drain() if devices.load_cell is not None else []
    return max((sample.force_n for sample in samples if sample.valid), default=0.0)


def _run_process_row(tree: Tree, row: FaultCase) -> FaultRunResult:
    config = config_from(tree, "stability")
    with tempfile.TemporaryDirectory() as folder:
        try:
            trial = kill_trial(config, Path(folder), signal.Signals[row.kind])
        except GripperError as error:
            return {
                "seed": config.seed,
                "result": "no grip",
                "peak_over_limit": -1.0,
                "took_ms": None,
                "lost_records": 0,
                "failure": str(error),
            }
    over = trial.peak_n / config.control.force_limit_n - 1
    failure = "" if trial.tripped_ms is not None else "the watchdog did not trip"
    if trial.lost_ms > _MAX_LOST_MS:
        failure = f"the log lacks the last {trial.lost_ms:.0f} ms"
    if trial.tripped_ms is not None and row.within_ms is not None and trial.tripped_ms > row.within_ms:
        failure = f"the watchdog took {trial.tripped_ms:.0f} ms"
    if over > TOLERANCE:
        failure = f"the peak force is {100 * over:.1f} % over the limit"
    return {
        "seed": config.seed,
        "result": "watchdog tripped" if trial.tripped_ms is not None else "not tripped",
        "peak_over_limit": over,
        "took_ms": trial.tripped_ms,
        "lost_records": 0,
        "lost_ms": trial.lost_ms,
        "failure": failure,
    }


def _summary(row: FaultCase, outcomes: list[FaultRunResult], live: list[FaultRunResult]) -> RowSummary:
    both = outcomes or live
    return {
        "row": row.name,
        "expected": str(row.expected),
        "within_ms": row.within_ms,
        "runs": len(both),
        "ok": sum(not o["failure"] for o in both),
        "results": dict(Counter(o["result"] for o in both)),
        "peak_over_limit": max(o["peak_over_limit"] for o in both),
        "median_ms": _median_ms(outcomes),
        "worst_ms": _worst_ms(outcomes),
        "lost_records": max(o["lost_records"] for o in both),
        "lost_ms": max(o.get("lost_ms", 0.0) for o in both),
        "failures": {
            f"{o['seed']}{clock}": o["failure"]
            for clock, some in (("", outcomes), (" in real time", live))
            for o in some
            if o["failure"]
        },
        "live_runs": len(live),
        "live_ok": sum(not o["failure"] for o in live),
        "live_median_ms": _median_ms(live),
        "live_worst_ms": _worst_ms(live),
        "live_peak_over_limit": max((o["peak_over_limit"] for o in live), default=None),
        "live_results": dict(Counter(o["result"] for o in live)),
    }


def _median_ms(outcomes: list[FaultRunResult]) -> float | None:
    took_ms = [o["took_ms"] for o in outcomes if o["took_ms"] is not None]
    return median(took_ms) if took_ms else None


def _worst_ms(outcomes: list[FaultRunResult]) -> float | None:
    return max((o["took_ms"] for o in outcomes if o["took_ms"] is not None), default=None)


def markdown(summaries: Sequence[RowSummary]) -> str:
    """Markdown table of the matrix."""
    head = (
        "| fault | expected | within | runs as expected | result | peak over limit: lockstep, real time "
        "| time: median, worst | real time: median, worst | lost |\n|---|---|---|---|---|---|---|---|---|\n"
    )
    return head + "".join(_markdown_row(s) for s in summaries)


def _markdown_row(s: RowSummary) -> str:
    results = ", ".join(f"{name} {count}" for name, count in sorted(s["results"].items()))
    lost = f"{s['lost_records']} records" if s["lost_records"] else "-"
    live = f", {s['live_ok']} of {s['live_runs']}" if s["live_runs"] and s["row"] not in _ONLY_LIVE else ""
    cells = (
        s["row"],
        s["expected"],
        "-" if s["within_ms"] is None else f"{s['within_ms']:.0f} ms",
        f"{s['ok']} of {s['runs']}{live}",
        results,
        _peaks(s["peak_over_limit"], s["live_peak_over_limit"]),
        _times(s["median_ms"], s["worst_ms"]),
        _times(s["live_median_ms"], s["live_worst_ms"]),
        f"{s['lost_ms']:.0f} ms" if s["lost_ms"] else lost,
    )
    return "| " + " | ".join(cells) + " |\n"


def _peaks(lockstep: float, live: float | None) -> str:
    return f"{100 * lockstep:+.0f} %" + ("" if live is None else f", {100 * live:+.0f} %")


def _times(median_ms: float | None, worst_ms: float | None) -> str:
    return "-" if median_ms is None or worst_ms is None else f"{median_ms:.0f}, {worst_ms:.0f} ms"
