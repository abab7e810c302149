"""The fault matrix: every part fails in mid-grasp, and the log tells what became of the object.

Each row breaks one part of the simulated rig at a seeded moment between the first touch and the end of the
hold. A run without the fault stands beside it. Rows that end a process are real processes in real time.
"""

import hashlib
import json
import signal
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

from gripper_force import __version__
from gripper_force.config import Config, config_from, dump_config
from gripper_force.errors import DataError, GripperError, LogError
from gripper_force.interfaces import Devices
from gripper_force.jobs.grasp import TRIAL_OBJECTS, TRIAL_TARGETS_N
from gripper_force.jobs.processes import process_pool
from gripper_force.qualification.fault_matrix.cases import ROWS, FaultCase
from gripper_force.qualification.fault_matrix.judge import Grasp, Sound, judge
from gripper_force.qualification.fault_matrix.kill_process import kill_trial
from gripper_force.runtime.assembly import checkpoint_of
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log import LogReader
from gripper_force.runtime.session import grasp_in, open_session
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    GraspStatus,
    LoadCellSample,
    Phase,
    ServoCommand,
)

LIMIT_SHARE: Final = 1.25
"""The force limit of each run over its target; a limit that is far away tests nothing."""

TOLERANCE: Final = 0.05
"""A peak may exceed the limit by this share."""

_AFTER_NS = 300 * NS_PER_MS
_MOST_LOST_MS = 100 + 5
"""A chunk of the log, and a cycle."""

_GRIPPING = (Phase.CONTACT, Phase.RAMP, Phase.HOLD)

Summary = dict[str, Any]


class _Kept:
    """Outcomes that go into a file as they come, so that a matrix that was broken off can go on."""

    def __init__(self, path: Path, config: Config, resume: bool) -> None:
        self._path = path
        self._of = hashlib.sha256(f"{__version__} {dump_config(config)}".encode()).hexdigest()
        self.outcomes: dict[str, Summary] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if not (resume and path.exists()):
                path.write_text("", encoding="utf-8")
            for line in path.read_text(encoding="utf-8").splitlines():
                of, key, outcome = json.loads(line)
                self.outcomes[key] = outcome
                if of != self._of:
                    raise DataError(f"{path} is of another configuration; run without --resume")
        except (OSError, ValueError, TypeError) as error:
            raise DataError(f"can't go on with {path}: {error}; run without --resume") from error

    def add(self, key: str, outcome: Summary) -> Summary:
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([self._of, key, outcome]) + "\n")
        return outcome


def run_matrix(
    config: Config,
    seeds: int,
    live_seeds: int,
    jobs: int,
    keep: Path,
    *,
    resume: bool = False,
    rows: Sequence[FaultCase] = ROWS,
    advance: Callable[[str], None] = lambda _: None,
) -> Iterator[Summary]:
    """Runs every row with every seed.

    Args:
        config: Everything but object, target, force limit, seed and faults.
        seeds: Grasps of each row, in lockstep.
        live_seeds: Grasps of each row in real time, one after the other.
        jobs: Processes.
        keep: File that takes each outcome as it comes.
        resume: Whether to go on from what is kept there.
        rows: Lines of the matrix.
        advance: Called after each grasp, with the row's name; see `count_grasps`.

    Yields:
        For each row, in order: ``row, expected, within_ms, runs, ok, results, peak_over_limit, worst_ms,
        median_ms, lost_records, lost_ms, failures``, and of the real time ``live_runs, live_median_ms,
        live_worst_ms, live_peak_over_limit, live_results``.

    Raises:
        DataError: What is kept can't be read or written, or is of another configuration.
    """
    drawn = [_draw(config, i).model_dump(mode="json") for i in range(seeds)]
    simulated = [row for row in rows if row.unit != "process"]
    kept = _Kept(keep, config, resume)
    with process_pool(jobs) as pool:

        def begin(row: FaultCase, index: int, clock: str) -> Callable[[], Summary]:
            """Starts a grasp, if none is kept; what is returned waits for its outcome."""
            key = f"{row.name}, {clock}, {index}"
            if key in kept.outcomes:
                return lambda: kept.outcomes[key]
            if row.unit == "process":
                run = pool.submit(_kill, drawn[index], row)
            else:
                run = pool.submit(_broken, drawn[index], sound[index], row, clock)
            return lambda: kept.add(key, run.result())

        def end(runs: Iterable[Callable[[], Summary]], name: str) -> list[Summary]:
            outcomes = []
            for run in runs:
                outcomes.append(run())
                advance(name)
            return outcomes

        without = [pool.submit(_sound, tree) for tree in drawn] if simulated else []
        sound = []
        for grasp in without:
            sound.append(grasp.result())
            advance("without a fault")
        begun = {row: [begin(row, i, "lockstep") for i in range(seeds)] for row in simulated}
        done = {row: end(begun[row], row.name) for row in simulated}
        for row in rows:  # real time wants the machine for itself, so one grasp after the other
            if row in done:
                live = (begin(row, i, "realtime") for i in range(min(live_seeds, seeds)))
                yield _summary(row, done[row], end(live, f"{row.name}, in real time"))
            else:
                yield _summary(row, [], end((begin(row, i, "realtime") for i in range(seeds)), row.name))


def count_grasps(seeds: int, live_seeds: int, rows: Sequence[FaultCase] = ROWS) -> int:
    """How many grasps `run_matrix` does."""
    simulated = sum(row.unit != "process" for row in rows)
    return seeds * (len(rows) + bool(simulated)) + min(live_seeds, seeds) * simulated


def _draw(config: Config, index: int) -> Config:
    rng = np.random.default_rng([config.seed, 30, index])
    target_n = round(float(rng.uniform(*TRIAL_TARGETS_N)), 3)
    return config.model_copy(
        update={
            "object": TRIAL_OBJECTS[index % len(TRIAL_OBJECTS)],
            "target_n": target_n,
            "seed": config.seed + index,
            "control": config.control.model_copy(update={"force_limit_n": LIMIT_SHARE * target_n}),
        }
    )


def _sound(tree: dict[str, Any]) -> Sound:
    config = config_from(tree, "stability")
    with tempfile.TemporaryDirectory() as folder:
        run = _grasp(config, Path(folder))
        gripping = [s.t_ns / NS_PER_S for s in run.records(GraspStatus) if s.phase in _GRIPPING]
        if not gripping:
            raise GripperError(
                f"the grasp of {config.object!r} with seed {config.seed} fails without a fault"
            )
        return Sound(gripping[0], gripping[-1], run.cycles, run.peak_n, tuple(run.records(ServoCommand)))


def _broken(tree: dict[str, Any], sound: Sound, row: FaultCase, clock: str = "lockstep") -> Summary:
    config = config_from(tree, "stability")
    rng = np.random.default_rng([config.seed, 31])
    at_s = float(rng.uniform(sound.begin_s + 0.05, max(sound.end_s - 0.5, sound.begin_s + 0.06)))
    fault = {"unit": row.unit, "kind": row.kind, "at_s": at_s, "for_s": row.for_s}
    config = config_from({**tree, "faults": [fault], "clock": clock}, "stability")
    with tempfile.TemporaryDirectory() as folder:
        run = _grasp(config, Path(folder))
        took_ms, why_not = judge(row, run, sound, config, run.start_ns + round(at_s * NS_PER_S))
    peak_n = sound.peak_n if row.unit == "load_cell" else run.peak_n  # the broken cell can't tell
    over = peak_n / config.control.force_limit_n - 1
    if over > TOLERANCE:
        why_not = f"the peak is {100 * over:.1f} % over the limit"
    elif not why_not and row.within_ms is not None and not (took_ms is not None and took_ms <= row.within_ms):
        why_not = f"it took {took_ms} ms"
    return {
        "seed": config.seed,
        "result": run.result,
        "over": over,
        "took_ms": took_ms,
        "lost": run.lost,
        "why_not": why_not,
    }


def _grasp(config: Config, folder: Path) -> Grasp:
    """Grasps, and watches for a while what becomes of the object afterwards."""
    path, checkpoint, result, session = folder / "run.mcap", checkpoint_of(config), "", None
    with open_devices(config) as devices:
        try:
            with open_session(config, devices, path, checkpoint) as session:
                result = grasp_in(session, config, checkpoint is not None)
        except LogError:
            pass  # of the losses, which are counted
        except GripperError as error:
            result = type(error).__name__
        peak_n = _watch(devices)
        start_ns = devices.start_ns
    if session is None:
        raise GripperError(f"the grasp of {config.object!r} with seed {config.seed} never began: {result}")
    log = LogReader(path, recover=True)
    cells_n = [sample.force_n for sample in log.records(LoadCellSample) if sample.valid]
    return Grasp(
        result=result,
        start_ns=start_ns,
        cycles=session.cycles,
        lost=session.lost_records,
        peak_n=max([peak_n, *cells_n]),
        log=log,
    )


def _watch(devices: Devices) -> float:
    """The highest force after the run has ended and nobody is in charge any more."""
    devices.clock.sleep_until_ns(devices.clock.now_ns() + _AFTER_NS)
    samples = devices.load_cell.drain() if devices.load_cell is not None else []
    return max((sample.force_n for sample in samples if sample.valid), default=0.0)


def _kill(tree: dict[str, Any], row: FaultCase) -> Summary:
    config = config_from(tree, "stability")
    with tempfile.TemporaryDirectory() as folder:
        try:
            trial = kill_trial(config, Path(folder), signal.Signals[row.kind])
        except GripperError as error:
            return {
                "seed": config.seed,
                "result": "never gripped",
                "over": -1.0,
                "took_ms": None,
                "lost": 0,
                "why_not": str(error),
            }
    over = trial.peak_n / config.control.force_limit_n - 1
    why_not = "" if trial.tripped_ms is not None else "the watchdog did not trip"
    if trial.lost_ms > _MOST_LOST_MS:
        why_not = f"the log lacks the last {trial.lost_ms:.0f} ms"
    return {
        "seed": config.seed,
        "result": "watchdog tripped" if trial.tripped_ms is not None else "goes on",
        "over": over,
        "took_ms": trial.tripped_ms,
        "lost": 0,
        "lost_ms": trial.lost_ms,
        "why_not": why_not,
    }


def _summary(row: FaultCase, outcomes: list[Summary], live: list[Summary]) -> Summary:
    both = outcomes or live
    return {
        "row": row.name,
        "expected": str(row.expected),
        "within_ms": row.within_ms,
        "runs": len(both),
        "ok": sum(not o["why_not"] for o in both),
        "results": dict(Counter(o["result"] for o in both)),
        "peak_over_limit": max(o["over"] for o in both),
        "median_ms": _median_ms(outcomes),
        "worst_ms": _worst_ms(outcomes),
        "lost_records": max(o["lost"] for o in both),
        "lost_ms": max(o.get("lost_ms", 0.0) for o in both),
        "failures": {o["seed"]: o["why_not"] for o in both if o["why_not"]},
        "live_runs": len(live),
        "live_median_ms": _median_ms(live),
        "live_worst_ms": _worst_ms(live),
        "live_peak_over_limit": max((o["over"] for o in live), default=None),
        "live_results": dict(Counter(o["result"] for o in live)),
    }


def _median_ms(outcomes: list[Summary]) -> float | None:
    took_ms = [o["took_ms"] for o in outcomes if o["took_ms"] is not None]
    return median(took_ms) if took_ms else None


def _worst_ms(outcomes: list[Summary]) -> float | None:
    return max((o["took_ms"] for o in outcomes if o["took_ms"] is not None), default=None)


def markdown(summaries: Sequence[Summary]) -> str:
    """The matrix as a table in Markdown."""
    head = (
        "| fault | expected | within | runs as expected | result | peak over limit: lockstep, real time "
        "| time: median, worst | real time: median, worst | lost |\n|---|---|---|---|---|---|---|---|---|\n"
    )
    return head + "".join(_markdown_row(s) for s in summaries)


def _markdown_row(s: Summary) -> str:
    results = ", ".join(f"{name} {count}" for name, count in sorted(s["results"].items()))
    lost = f"{s['lost_records']} records" if s["lost_records"] else "-"
    cells = (
        s["row"],
        s["expected"],
        "-" if s["within_ms"] is None else f"{s['within_ms']:.0f} ms",
        f"{s['ok']} of {s['runs']}",
        results,
        _peaks(s["peak_over_limit"], s["live_peak_over_limit"]),
        _times(s["median_ms"], s["worst_ms"]),
        _times(s["live_median_ms"], s["live_worst_ms"]),
        f"{s['lost_ms']:.0f} ms" if s["lost_ms"] else lost,
    )
    return "| " + " | ".join(cells) + " |\n"


def _peaks(lockstep: float, live: float | None) -> str:
    return f"{100 * lockstep:+.0f} %" + ("" if live is None else f", {100 * live:+.0f} %")


def _times(middle_ms: float | None, worst_ms: float | None) -> str:
    return "-" if middle_ms is None or worst_ms is None else f"{middle_ms:.0f}, {worst_ms:.0f} ms"
