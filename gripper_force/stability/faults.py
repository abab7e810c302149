"""The fault matrix: every part fails in mid-grasp, and the log tells what became of the object.

Each row breaks one part of the simulated rig at a seeded moment between the first touch and the end of the
hold. A run without the fault stands beside it. Rows that end a process are real processes in real time.
"""

import math
import multiprocessing
import signal
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

from gripper_force.backends import KILL_TRIAL, load, open_devices
from gripper_force.config import Config, config_from
from gripper_force.errors import DataError, GripperError, LogError
from gripper_force.grasp import TRIAL_OBJECTS, TRIAL_TARGETS_N
from gripper_force.interfaces import Devices
from gripper_force.log import LogReader
from gripper_force.session import checkpoint_of, grasp_in, open_session
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    Event,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Phase,
    ServoCommand,
    Source,
    VisualForce,
)

LIMIT_SHARE: Final = 1.25
"""The force limit of each run over its target; a limit that is far away tests nothing."""

TOLERANCE: Final = 0.05
"""A peak may exceed the limit by this share."""

_BEGIN = "<!-- matrix: made by `gripper-force stability --faults` -->"
_END = "<!-- end of matrix -->"
_AFTER_NS = 300 * NS_PER_MS
_LET_GO = 0.97
_MOST_LOST_MS = 100 + 5
"""A chunk of the log, and a cycle."""

_GRIPPING = (Phase.CONTACT, Phase.RAMP, Phase.HOLD)

Summary = dict[str, Any]


class Expected(StrEnum):
    """What is to follow from a fault."""

    STOP = "stop, latched"
    STOP_OR_CARRY_ON = "retries carry it, or stop"
    CURRENT_ALONE = "current alone"
    CAP = "the current's cap holds"
    EASED = "eased"
    COMPARISON_INVALID = "control unchanged, comparison marked invalid"
    NO_EFFECT = "no effect"
    CARRY_ON = "control goes on, losses counted"
    WATCHDOG = "the servo's watchdog trips"


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the matrix.

    Attributes:
        name: What breaks.
        unit: Of `gripper_force.config.FAULTS`; ``process`` for a signal.
        kind: Likewise; or the signal's name.
        expected: What is to follow.
        within_ms: In which time; None where only what follows counts.
        for_s: How long the fault lasts.
    """

    name: str
    unit: str
    kind: str
    expected: Expected
    within_ms: float | None
    for_s: float = 1.0


_CYCLE_MS = 5.0
_TWO_FRAMES_MS = 2e3 / 60 + _CYCLE_MS
_THREE_FRAMES_MS = 3e3 / 60 + _CYCLE_MS

ROWS: Final = (
    Row("process killed", "process", "SIGKILL", Expected.WATCHDOG, 60.0),
    Row("process stopped", "process", "SIGSTOP", Expected.WATCHDOG, 60.0),
    Row("control loop wedged", "clock", "stuck", Expected.STOP, None, 0.5),
    Row("bus: adapter unplugged", "bus", "off", Expected.STOP, 20.0),
    Row("bus: answers corrupted", "bus", "garbage", Expected.STOP, 20.0),
    Row("bus: answers with another id", "bus", "wrong", Expected.STOP, 20.0),
    Row("bus: answers too late", "bus", "slow", Expected.STOP, 20.0),
    Row("bus: answers one request behind", "bus", "delayed", Expected.STOP, 20.0),
    Row("bus: half of the answers lost", "bus", "intermittent", Expected.STOP_OR_CARRY_ON, None),
    Row("servo: hardware error", "servo", "wrong", Expected.STOP, _CYCLE_MS),
    Row("servo: watchdog at -1", "servo", "stuck", Expected.STOP, _CYCLE_MS),
    Row("servo: power lost", "servo", "off", Expected.STOP, 20.0),
    Row("servo: brownout, RAM reset", "servo", "intermittent", Expected.STOP, 20.0),
    Row("camera: no frames", "camera", "off", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: picture stands still", "camera", "stuck", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: 5 frames a second", "camera", "slow", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: frames 0.3 s late", "camera", "delayed", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: most frames lost", "camera", "intermittent", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("camera: noise", "camera", "garbage", Expected.CURRENT_ALONE, _THREE_FRAMES_MS),
    Row("camera: wrong exposure", "camera", "wrong", Expected.CURRENT_ALONE, _THREE_FRAMES_MS),
    Row("estimator: not finite", "estimator", "garbage", Expected.CURRENT_ALONE, _CYCLE_MS),
    Row("estimator: exception", "estimator", "off", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("estimator: hangs", "estimator", "stuck", Expected.CURRENT_ALONE, _TWO_FRAMES_MS),
    Row("estimator: a third too low", "estimator", "wrong", Expected.CAP, None),
    Row("load cell: no samples", "load_cell", "off", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: stuck", "load_cell", "stuck", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: garbage", "load_cell", "garbage", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: saturated", "load_cell", "wrong", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: 2 samples a second", "load_cell", "slow", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: 0.5 s late", "load_cell", "delayed", Expected.COMPARISON_INVALID, 100.0),
    Row("load cell: comes and goes", "load_cell", "intermittent", Expected.COMPARISON_INVALID, 400.0),
    Row("over-force: motor gives too much", "plant", "wrong", Expected.EASED, 10.0, 2.0),
    Row("wall clock jumps", "clock", "wrong", Expected.NO_EFFECT, None),
    Row("disk full", "disk", "off", Expected.CARRY_ON, None),
    Row("disk: I/O errors", "disk", "intermittent", Expected.CARRY_ON, None),
    Row("disk slow", "disk", "slow", Expected.CARRY_ON, None),
)


def run_matrix(
    config: Config,
    seeds: int,
    live_seeds: int,
    jobs: int,
    rows: Sequence[Row] = ROWS,
    advance: Callable[[str], None] = lambda _: None,
) -> Iterator[Summary]:
    """Runs every row with every seed.

    Args:
        config: Everything but object, target, force limit, seed and faults.
        seeds: Grasps of each row, in lockstep.
        live_seeds: Grasps of each row in real time, one after the other.
        jobs: Processes.
        rows: Lines of the matrix.
        advance: Called after each grasp, with the row's name; see `count_grasps`.

    Yields:
        For each row, in order: ``row, expected, within_ms, runs, ok, results, peak_over_limit, worst_ms,
        median_ms, lost_records, lost_ms, failures``, and of the real time ``live_runs, live_median_ms,
        live_worst_ms, live_peak_over_limit, live_results``.
    """
    drawn = [_draw(config, i).model_dump(mode="json") for i in range(seeds)]
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:

        def awaited(runs: Iterable[Any], name: str) -> list[Any]:
            results = []
            for run in runs:
                results.append(run.result())
                advance(name)
            return results

        try:
            simulated = [row for row in rows if row.unit != "process"]
            without = [pool.submit(_sound, tree) for tree in drawn] if simulated else []
            sound = awaited(without, "without a fault")
            runs = {
                row: [pool.submit(_broken, *one, row) for one in zip(drawn, sound, strict=True)]
                for row in simulated
            }
            done = {row: awaited(runs[row], row.name) for row in simulated}
            live = list(zip(drawn, sound, strict=False))[:live_seeds]
            for row in rows:  # real time wants the machine for itself
                if row in done:
                    now = (pool.submit(_broken, *one, row, "realtime") for one in live)
                    yield _summary(row, done[row], awaited(now, f"{row.name}, in real time"))
                else:
                    killed = (pool.submit(_kill, tree, row) for tree in drawn)
                    yield _summary(row, [], awaited(killed, row.name))
        finally:
            pool.shutdown(cancel_futures=True)


def count_grasps(seeds: int, live_seeds: int, rows: Sequence[Row] = ROWS) -> int:
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


@dataclass(frozen=True, slots=True)
class _Run:
    """What one grasp left behind."""

    result: str
    start_ns: int
    cycles: int
    lost: int
    peak_n: float
    log: LogReader

    def records(self, kind: type) -> list[Any]:
        return list(self.log.records(kind))


@dataclass(frozen=True, slots=True)
class _Sound:
    """The grasp without the fault: when there was contact, and what was commanded."""

    begin_s: float
    end_s: float
    cycles: int
    peak_n: float
    commands: tuple[ServoCommand, ...]


def _sound(tree: dict[str, Any]) -> _Sound:
    config = config_from(tree, "stability")
    with tempfile.TemporaryDirectory() as folder:
        run = _grasp(config, Path(folder))
        gripping = [s.t_ns / NS_PER_S for s in run.records(GraspStatus) if s.phase in _GRIPPING]
        if not gripping:
            raise GripperError(
                f"the grasp of {config.object!r} with seed {config.seed} fails without a fault"
            )
        return _Sound(gripping[0], gripping[-1], run.cycles, run.peak_n, tuple(run.records(ServoCommand)))


def _broken(tree: dict[str, Any], sound: _Sound, row: Row, clock: str = "lockstep") -> Summary:
    config = config_from(tree, "stability")
    rng = np.random.default_rng([config.seed, 31])
    at_s = float(rng.uniform(sound.begin_s + 0.05, max(sound.end_s - 0.5, sound.begin_s + 0.06)))
    fault = {"unit": row.unit, "kind": row.kind, "at_s": at_s, "for_s": row.for_s}
    config = config_from({**tree, "faults": [fault], "clock": clock}, "stability")
    with tempfile.TemporaryDirectory() as folder:
        run = _grasp(config, Path(folder))
        took_ms, why_not = _judge(row, run, sound, config, run.start_ns + round(at_s * NS_PER_S))
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


def _grasp(config: Config, folder: Path) -> _Run:
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
    return _Run(
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


def _judge(row: Row, run: _Run, sound: _Sound, config: Config, at_ns: int) -> tuple[float | None, str]:
    """When the safe state was there, in ms after the fault, and what is wrong with it, if anything is."""
    live = config.clock == "realtime"  # no two such runs are the same
    match row.expected:
        case Expected.STOP | Expected.STOP_OR_CARRY_ON:
            stop_ns = _stop_ns(run)
            if row.unit == "clock" and stop_ns is not None:
                stop_ns = _let_go_ns(run, at_ns) or stop_ns
            if stop_ns is None:
                return None, "" if row.expected == Expected.STOP_OR_CARRY_ON else f"it went on: {run.result}"
            return _ms(stop_ns - at_ns), ""
        case Expected.CURRENT_ALONE:
            return _judge_vision(row, run, config, at_ns)
        case Expected.CAP:
            return None, "" if run.result in _FINISHED else run.result
        case Expected.EASED:
            return _judge_easing(run, config.control.force_limit_n)
        case Expected.COMPARISON_INVALID:
            told = [e.t_ns for e in run.records(Event) if e.unit == "load_cell" and e.t_ns >= at_ns]
            same = live or tuple(run.records(ServoCommand)) == sound.commands
            return _ms(told[0] - at_ns) if told else None, "" if same else "the commands are not the same"
        case Expected.NO_EFFECT:
            same = live or tuple(run.records(ServoCommand)) == sound.commands
            return None, "" if same else "the commands are not the same"
        case Expected.CARRY_ON:
            missed = 0 if live else sound.cycles - run.cycles
            return None, f"{missed} cycles are missing" if missed else ""
        case _:
            raise AssertionError(row.expected)


_FINISHED: Final = ("held", "timeout", "slip")


def _ms(time_ns: float) -> float:
    return time_ns / NS_PER_MS


def _stop_ns(run: _Run) -> int | None:
    """When the run stopped: the controller at fault, or the session ended by an error."""
    faults = [s.t_ns for s in run.records(GraspStatus) if s.phase == Phase.FAULT]
    errors = [e.t_ns for e in run.records(Event) if e.unit == "session"]
    return min([*faults, *errors], default=None)


def _let_go_ns(run: _Run, at_ns: int) -> int | None:
    """When the force began to fall, for a loop that was not there to see the watchdog trip."""
    cells = [(s.t_ns, s.force_n) for s in run.records(LoadCellSample) if s.t_ns >= at_ns and s.valid]
    return next((t_ns for t_ns, force_n in cells if force_n < _LET_GO * cells[0][1]), None)


def _judge_vision(row: Row, run: _Run, config: Config, at_ns: int) -> tuple[float | None, str]:
    """The time from when the first estimate that the fault took away was due."""
    alone = [f.t_ns for f in run.records(FusedForce) if f.t_ns >= at_ns and f.source == Source.CURRENT]
    if not alone:
        return None, "vision never dropped out"
    compute_ns = round(config.vision.lockstep_compute_ms * NS_PER_MS)
    passes = row.kind in ("slow", "intermittent")  # what still comes is sound
    good = [
        v.ready_ns
        for v in run.records(VisualForce)
        if v.ready_ns <= alone[0] and (passes or v.ready_ns - compute_ns < at_ns)
    ]
    due_ns = max(at_ns, good[-1] + round(NS_PER_S / config.camera.rate_hz)) if good else at_ns
    if row.unit == "estimator" and row.kind == "garbage":
        due_ns = min(v.ready_ns for v in run.records(VisualForce) if not math.isfinite(v.force_n))
    return max(_ms(alone[0] - due_ns), 0.0), "" if run.result in _FINISHED else run.result


def _judge_easing(run: _Run, limit_n: float) -> tuple[float | None, str]:
    """The longest time from an estimate that rises over the limit to a goal current that is lower."""
    over = {f.t_ns: f.force_n > limit_n for f in run.records(FusedForce)}
    worst_ns, since_ns = 0, None
    for before, now in pairwise(run.records(ServoCommand)):
        if over[now.t_ns] and not over[before.t_ns]:
            since_ns = now.t_ns
        if since_ns is not None and (now.goal_current_a < before.goal_current_a or now.goal_current_a == 0):
            worst_ns, since_ns = max(worst_ns, now.t_ns - since_ns), None
    return _ms(worst_ns), ""


def _kill(tree: dict[str, Any], row: Row) -> Summary:
    config = config_from(tree, "stability")
    with tempfile.TemporaryDirectory() as folder:
        try:
            trial = load(KILL_TRIAL)(config, Path(folder), signal.Signals[row.kind])
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


def _summary(row: Row, outcomes: list[Summary], live: list[Summary]) -> Summary:
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
        "| fault | expected | within | runs as expected | result | peak over limit | time: median, worst "
        "| real time: median, worst | lost |\n|---|---|---|---|---|---|---|---|---|\n"
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
        f"{100 * s['peak_over_limit']:+.0f} %",
        _times(s["median_ms"], s["worst_ms"]),
        _times(s["live_median_ms"], s["live_worst_ms"]),
        f"{s['lost_ms']:.0f} ms" if s["lost_ms"] else lost,
    )
    return "| " + " | ".join(cells) + " |\n"


def _times(middle_ms: float | None, worst_ms: float | None) -> str:
    return "-" if middle_ms is None or worst_ms is None else f"{middle_ms:.0f}, {worst_ms:.0f} ms"


def write_between_markers(path: Path, table: str) -> None:
    """Puts the table into a Markdown file, in the place of the last one.

    Raises:
        DataError: The file is not there, or has no place for it.
    """
    try:
        text = path.read_text(encoding="utf-8")
        before, rest = text.split(_BEGIN)
        _, after = rest.split(_END)
    except (OSError, ValueError) as error:
        raise DataError(f"{path} has no lines {_BEGIN!r} and {_END!r} to put the matrix between") from error
    path.write_text(f"{before}{_BEGIN}\n\n{table}\n{_END}{after}", encoding="utf-8")
