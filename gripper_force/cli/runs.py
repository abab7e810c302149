"""Commands that use a gripper or the log of one: grasp, replay, doctor, virtual-servo."""

import signal
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gripper_force.cli import console
from gripper_force.cli.options import (
    CORES,
    AsJson,
    ConfigPath,
    Jobs,
    Overrides,
    Ray,
    SummaryFolder,
    config_options,
    load_settings,
    load_settings_before_rig,
)
from gripper_force.cli.output.doctor import changes_table, checks_table, setup_line
from gripper_force.cli.output.runs import (
    differences_table,
    grasp_table,
    replay_table,
    replays_table,
    trials_table,
)
from gripper_force.errors import ConfigError, DataError, GripperError, LogError
from gripper_force.plugins import require

if TYPE_CHECKING:
    from gripper_force.config import Config
    from gripper_force.jobs.checks import RegisterChange
    from gripper_force.jobs.grasp import GraspSummary
    from gripper_force.jobs.replay import Replays
    from gripper_force.progress import Progress, Prompt
    from gripper_force.runtime.log_reader import LogReader

_OPEN_LOOP = (
    "A replay is open loop: estimates and commands are computed again, but servo, camera and load cell keep what they "
    "measured. A changed setting shows other commands, not the force that would have followed; to see that, run "
    "`gripper-force grasp` with it."
)


def grasp(
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
    object_: Annotated[
        str | None, typer.Option("--object", help="Object to grasp, or the file of a simulated one.")
    ] = None,
    target_n: Annotated[float | None, typer.Option(help="Target force in newtons.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the simulated scene.")] = None,
    feedback: Annotated[str | None, typer.Option(help="fused, current or vision.")] = None,
    profile: Annotated[
        str | None, typer.Option(help="Object profile: a name or a path; own: the one named like the object.")
    ] = None,
    trials: Annotated[
        int,
        typer.Option(
            min=0,
            help="Number of grasps, with statistics: of the given object, or in simulation of the four paper objects "
            "in turn; with the given target force, or targets of 1 to 8 N.",
        ),
    ] = 0,
    same_object: Annotated[
        bool,
        typer.Option(
            "--same-object",
            help="With --trials: grasp one object again and again, each time in another place, and pass on what was "
            "learned of its gain.",
        ),
    ] = False,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help=f"Processes for simulated trials. A real device has one. Default: {CORES}.",
        ),
    ] = None,
    yes: Annotated[
        bool,
        typer.Option("--yes", help="Do not wait for Enter before each trial with a real device."),
    ] = False,
    view: Annotated[
        str | None,
        typer.Option(help="Show the run while it goes on, in rerun (also without a value) or foxglove."),
    ] = None,
) -> None:
    """Grasp with a target force and report the error. Exit code 1 if nothing was held."""
    from gripper_force.jobs import grasp as job

    if not trials and (same_object or jobs is not None):
        name = "--same-object" if same_object else "--jobs"
        raise ConfigError(f"{name} only applies to several grasps; add --trials, or leave out {name}")
    if view is not None and trials:
        raise ConfigError("--view shows one grasp; leave out --trials")
    settings = load_settings(
        config,
        set_,
        {
            "object": object_,
            "target_n": target_n,
            "seed": seed,
            "control.feedback": feedback,
            "calibration.object": profile,
        },
    )
    set_keys = {text.partition("=")[0] for text in set_ or ()}
    names_object = object_ is not None or "object" in set_keys or settings.sim.object is not None
    explicit_target_n = settings.target_n if target_n is not None or "target_n" in set_keys else None
    one_object = not trials or bool(job.exclusive_device(settings)) or same_object or names_object
    objects = (settings.object,) if one_object else job.PAPER_OBJECTS
    for text in dict.fromkeys(text for name in objects for text in _notes(settings, name)):
        console.line(text)
    if not trials:
        _grasp_once(settings, view, as_json)
    else:
        _grasp_trials(settings, trials, objects, explicit_target_n, same_object, jobs, yes, as_json)


def _grasp_once(settings: "Config", view: str | None, as_json: bool) -> None:
    from contextlib import nullcontext

    from gripper_force.jobs import grasp as job
    from gripper_force.jobs.view import beside_run

    log = job.new_log(settings)
    viewer = nullcontext() if view is None else beside_run(log, view, console.line)
    try:
        with viewer:
            job.run_grasp(settings, log, console.line)
        result = job.summary_and_report(settings, log)
    except KeyboardInterrupt:
        if log.exists():
            console.err.print(
                f"the run until then is in {log}: {console.command('replay', log)}",
                soft_wrap=True,
                markup=False,
            )
        raise
    console.show(result, as_json, grasp_table)
    if result["report"] is None:
        console.next_step("replay", log, "--report")
    else:
        console.next_page(Path(result["report"]))
    if result["result"] != "held":
        raise typer.Exit(1)


def _grasp_trials(
    settings: "Config",
    count: int,
    objects: Sequence[str],
    target_n: float | None,
    same_object: bool,
    workers: int | None,
    yes: bool,
    as_json: bool,
) -> None:
    from gripper_force.jobs import trials as job
    from gripper_force.jobs.grasp import exclusive_device
    from gripper_force.progress import no_progress

    device = exclusive_device(settings)
    workers = workers or (1 if device or same_object else CORES)
    prompt: Prompt | None = None
    lines: Progress = no_progress
    if device and workers == 1:
        pause = not yes and sys.stdin.isatty()
        console.err.print(
            f"only one process can open {device}, so the trials follow one another, all of them of the object "
            f"{settings.object}" + ("" if pause else ", without a pause"),
            soft_wrap=True,
        )
        prompt, lines = (console.prompt(yes) if pause else None), console.line
    running = job.trials(
        settings,
        count,
        workers,
        objects=objects,
        target_n=target_n,
        same_object=same_object,
        prompt=prompt,
        progress=lines,
    )
    results, failure = _run_trials(running, count, hidden=bool(device))
    if results and not (as_json and isinstance(failure, GripperError)):
        summary = job.summarise_trials(results, settings.control.force_limit_n)
        figure = job.write_figure(settings, results, summary)
        report = {"trials": results, "summary": summary, "figure": figure}
        console.show(report, as_json, lambda _: trials_table(results, summary, figure))
    if failure is not None:
        raise failure
    worst_trial = max(results, key=lambda trial: abs(trial["steady_error_n"] or 0.0))
    console.next_step("replay", worst_trial["log"], "--report")
    if all(trial["result"] != "held" for trial in results):
        raise typer.Exit(1)


def _run_trials(
    running: "Generator[GraspSummary, None, None]", count: int, *, hidden: bool
) -> tuple[list["GraspSummary"], BaseException | None]:
    """Runs trials with a progress bar. Returns their results, and the error or interruption that ended them."""
    results: list[GraspSummary] = []
    with console.bar("grasping", count, hidden=hidden) as progress:
        try:
            with closing(running) as summaries:
                for summary in summaries:
                    results.append(summary)
                    progress(f"{summary['object']} {summary['target_n']:.1f} N: {summary['result']}")
        except (KeyboardInterrupt, GripperError) as end:
            return results, end
    return results, None


def _notes(settings: "Config", name: str) -> list[str]:
    """Returns notes on the bundle that grasps of an object use, and on differences from the rig of its profiles."""
    from gripper_force.profiles.object_profile import user_folder
    from gripper_force.runtime.resolve import resolve

    resolved = resolve(settings.with_values(object=name))
    notes = [text for unit, text in resolved.notes if unit == "session"]
    unused = user_folder() / f"{name}.yaml"
    if resolved.model is not None and resolved.config.calibration.object is None and unused.is_file():
        notes.append(f"your profile {unused} is not used; to use it, add --profile {name}")
    return notes


def replay(
    logs: Annotated[
        list[Path], typer.Argument(help="Logs of runs or of imported recordings, or folders with them.")
    ],
    as_json: AsJson = False,
    checkpoint: Annotated[str | None, typer.Option(help="Estimate with another checkpoint.")] = None,
    set_: Overrides = None,
    compare: Annotated[
        tuple[str, str] | None,
        typer.Option(
            help="Replay each log twice and compare the errors: each of A and B is a checkpoint, a changed key "
            "(key=value), or log (unchanged).",
            metavar="A B",
        ),
    ] = None,
    recover: Annotated[bool, typer.Option(help="Read the intact part of a truncated log.")] = False,
    report: Annotated[
        bool,
        typer.Option(
            help="Write the report again, beside the log; with --set or --checkpoint that of the replay."
        ),
    ] = False,
    out: SummaryFolder = None,
    jobs: Jobs = CORES,
    ray: Ray = None,
) -> None:
    """Run estimator and controller again on logs, and compare the estimates with their load cells.

    A replay is open loop: it shows what the controller would have commanded with another setting, but not the
    force that would have followed. Exit code 2 if a log could not be read; the others are replayed.
    """
    from functools import partial

    from gripper_force.jobs import replay as job
    from gripper_force.jobs.dataset import find_logs
    from gripper_force.jobs.summary_files import check_writable, replay_tables, write_summary

    if compare is not None and (checkpoint or report):
        raise ConfigError(
            "--compare names its checkpoints and writes no report; leave out --checkpoint and --report"
        )
    if report:
        require("matplotlib", "--report")
    if compare is not None:
        require("scipy", "--compare")
    paths = find_logs(logs)
    replay_all = partial(job.replay_each, paths, recover=recover, workers=jobs, ray=ray)
    if out is not None:
        check_writable(out)
    console.tell_missing_parquet(out)
    if compare is not None:
        _compare(compare, paths, replay_all, set_, recover, out, as_json)
        return
    with console.bar("replaying", len(paths), hidden=len(paths) == 1) as progress:
        replays = replay_all(checkpoint=checkpoint, overrides=set_, progress=progress)
    console.warn_of_other_rig(text for result in replays.results for text in result.other_rig)
    pages: list[str] = []
    unreported: dict[str, GripperError] = {}
    if report:
        readable = [path for path in paths if str(path) not in replays.failed]
        pages, unreported = _write_reports(readable, checkpoint, set_, recover)
    if out is not None:
        title = f"Replay of {len(replays.results)} logs"
        write_summary(out, title, replay_tables({"": replays}), replays.columns)
    report_problems = {log: str(error) for log, error in unreported.items()}
    _show_replays(replays, pages, report_problems, as_json, is_single=len(paths) == 1)
    if out is not None:
        console.err.print(f"summary: {out / 'summary.html'}", soft_wrap=True, markup=False)
    if set_ or checkpoint:
        console.err.print(_OPEN_LOOP, soft_wrap=True)
    if pages:
        console.next_page(Path(pages[0]))
    elif len(replays.results) == 1 and not unreported:
        console.next_step(
            "replay", *logs, *_changes(checkpoint, set_), *(["--recover"] if recover else ()), "--report"
        )
    console.end_with_failures(replays.failed, len(paths), unreported)


def _write_reports(
    logs: Sequence[Path], checkpoint: str | None, overrides: list[str] | None, recover: bool
) -> tuple[list[str], dict[str, GripperError]]:
    """Writes the report of each log. Returns the pages, and the problem of each log without one."""
    from functools import partial

    from gripper_force.jobs.processes import Workers
    from gripper_force.jobs.report import write_report

    write = partial(write_report, recover=recover, checkpoint=checkpoint, overrides=overrides)
    with console.bar("writing reports", len(logs), hidden=len(logs) == 1) as progress:
        try:
            reports, problems = Workers().read_logs(write, logs, "report of", progress)
        except GripperError as error:  # all failed: the figures are shown all the same
            reports, problems = {}, {0: error}
    pages = [str(report.html) for report in reports.values()]
    return pages, {str(logs[number]): error for number, error in problems.items()}


def _show_replays(
    replays: "Replays", pages: list[str], unreported: dict[str, str], as_json: bool, *, is_single: bool
) -> None:
    """Shows one result, or with several logs the results and the errors over all."""
    from gripper_force.jobs.replay.comparison import summarise_replays

    results = replays.results
    failures = {"unreported": unreported} if unreported else {}
    if is_single:
        report = {"report": pages[0]} if pages else {}
        result = {**console.jsonable(results[0]), **report, **failures}
        console.show(result, as_json, lambda _: replay_table(results[0], pages[0] if pages else None))
        return
    overall = summarise_replays(results)
    unread = {log: str(error) for log, error in replays.failed.items()}
    result_of_all = {
        "logs": results,
        "summary": overall,
        **({"failed": unread} if unread else {}),
        **({"reports": pages} if pages else {}),
        **failures,
    }
    console.show(result_of_all, as_json, lambda _: replays_table(results, overall, pages))


def _compare(
    names: tuple[str, str],
    paths: Sequence[Path],
    replay_all: "Callable[..., Replays]",
    set_: list[str] | None,
    recover: bool,
    out: Path | None,
    as_json: bool,
) -> None:
    """Replays the logs with two settings, and shows how the errors differ."""
    import numpy as np

    from gripper_force.jobs.replay.comparison import paired_differences
    from gripper_force.jobs.replay.feed import changed_config
    from gripper_force.jobs.summary_files import replay_tables, write_summary
    from gripper_force.vision.model_files import read_model

    if names[0] == names[1]:
        raise ConfigError(f"--compare {names[0]} {names[1]} compares a setting with itself; name two")
    sides = [_parse_side(text) for text in names]
    first_log = _first_readable(paths, recover)
    for checkpoint, changes in sides:
        if checkpoint is not None:
            read_model(checkpoint)  # a wrong side ends the command before the first one is computed
        if first_log is not None:
            changed_config(first_log, checkpoint, [*(set_ or []), *changes])
    with console.bar("replaying", 2 * len(paths)) as progress:
        first, second = (
            replay_all(checkpoint=checkpoint, overrides=[*(set_ or []), *changes], progress=progress)
            for checkpoint, changes in sides
        )
    console.warn_of_other_rig(text for one in (*first.results, *second.results) for text in one.other_rig)
    failed = {**first.failed, **second.failed}
    first_pairs, second_pairs = (
        [(r, one) for r, one in zip(side.results, side.columns, strict=True) if r.log not in failed]
        for side in (first, second)
    )
    frames = [one for _, one in first_pairs], [one for _, one in second_pairs]
    differences = paired_differences([r for r, _ in first_pairs], [r for r, _ in second_pairs], frames)
    if not differences and not failed:
        raise DataError(_why_no_difference(names, first, second))
    result = {"logs": len(first_pairs), "first": names[0], "second": names[1], "differences": differences}
    if failed:
        result["failed"] = {log: str(error) for log, error in failed.items()}
    if out is not None:
        tables = replay_tables(dict(zip(names, (first, second), strict=True)), differences)
        columns = [
            {"setting": np.full(len(one["log"]), name), **one}
            for name, side in zip(names, (first, second), strict=True)
            for one in side.columns
        ]
        write_summary(out, f"Replay with {names[0]} and with {names[1]}", tables, columns)
    console.show(result, as_json, lambda _: differences_table(*names, differences))
    if out is not None:
        console.err.print(f"summary: {out / 'summary.html'}", soft_wrap=True, markup=False)
    console.err.print(_OPEN_LOOP, soft_wrap=True)
    console.end_with_failures(failed, len(paths))


def _why_no_difference(names: tuple[str, str], first: "Replays", second: "Replays") -> str:
    for name, side in zip(names, (first, second), strict=True):
        seen, refused = (sum(getattr(r, key) for r in side.results) for key in ("seen", "refused"))
        if 0 < refused == seen:
            return (
                f"the network of {name!r} knows none of the {seen} frames, so that there is nothing to compare; name "
                "one that knows their object and view (`evaluate` also counts frames that a network does not know)"
            )
    return "the logs have no load cell to compare with; replay logs of runs with one"


def _changes(checkpoint: str | None, overrides: list[str] | None) -> list[str]:
    return [*(() if checkpoint is None else ("--checkpoint", checkpoint)), *config_options(None, overrides)]


def _first_readable(paths: Sequence[Path], recover: bool) -> "LogReader | None":
    from gripper_force.runtime.log_reader import LogReader

    for path in paths:
        with suppress(LogError):
            return LogReader(path, recover=recover)
    return None


def _parse_side(side: str) -> tuple[str | None, list[str]]:
    """Returns the checkpoint and the changed keys that one side of --compare names."""
    if side == "log":
        return None, []
    return (None, [side]) if "=" in side else (side, [])


def doctor(
    config: ConfigPath = None,
    set_: Overrides = None,
    setup: Annotated[
        bool, typer.Option("--setup", help="Show changes of the servo's registers, ask, and write them.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="With --setup: write without asking.")] = False,
    as_json: AsJson = False,
) -> None:
    """Check every device and this machine, and suggest fixes. Exit code 1 if there is a problem."""
    from gripper_force.jobs import doctor as job

    settings, new_rig = load_settings_before_rig(config, set_, {})
    if new_rig is not None:
        console.err.print(
            f"the rig profile {new_rig} does not exist yet, so its values are the defaults", soft_wrap=True
        )
    if setup:
        result = job.setup(settings, lambda servo, changes: _confirmed(servo, changes, yes))
        console.show(result, as_json, setup_line)
        return
    with console.err.status("checking"):
        checks = list(job.doctor(settings))
    ok = all(check.ok is not False for check in checks)
    console.show({"checks": checks, "ok": ok}, as_json, lambda _: checks_table(checks))
    if not ok:
        raise typer.Exit(1)
    console.next_step("grasp", *config_options(config, set_))


def virtual_servo(
    model: Annotated[str | None, typer.Option(help="Servo model.")] = None,
    ids: Annotated[
        list[int] | None, typer.Option("--id", min=0, max=252, help="Servo id. Repeatable.")
    ] = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Serve virtual servos at a device path that any Dynamixel client can open, until Ctrl-C."""
    from gripper_force.runtime import process
    from gripper_hw.dynamixel.pty_server import serve_virtual_servo

    if ids is not None and len(set(ids)) < len(ids):
        raise ConfigError(f"--id {' --id '.join(map(str, ids))} names a servo twice; give each its own id")
    servo = load_settings(None, set_, {"servo.model": model}).servo
    servo_ids = ids or list(servo.ids)
    with serve_virtual_servo(servo.model, servo_ids) as server:
        with suppress(KeyboardInterrupt):
            console.show({"port": server.device_path, "model": servo.model, "ids": servo_ids}, as_json)
            sys.stdout.flush()
            console.err.print("serving until Ctrl-C")
            # Python ignores an exception in a finaliser, and signal.pause() would miss a signal just before it.
            while not process.is_interrupted():
                time.sleep(0.2)
        if process.interrupt_exit_code() != 128 + signal.SIGINT:
            raise KeyboardInterrupt  # SIGTERM or a lost terminal; Ctrl-C is the way to end it


def _confirmed(servo: str, changes: "list[RegisterChange]", yes: bool) -> bool:
    changes_table(servo, changes)
    unanswered = f"the question was not answered, so nothing was written to {servo}; pass --yes in scripts"
    with console.answering(unanswered):
        return yes or typer.confirm(f"Write these to {servo}?", err=True)
