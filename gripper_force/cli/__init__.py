"""The command line: parse, call, and let `gripper_force.cli.output` print.

Every command takes ``--set key.path=value`` and ``--json``. With ``--json`` one JSON object goes to stdout;
progress and messages go to stderr always. Bad input is one sentence on stderr and exit code 2. Exit code 1
says that a command did its work and what came out is not well.

What a command needs is imported when it runs: ``gripper-force --help`` must answer at once.
"""

import json
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from gripper_force.cli import bench, calibrate, console, data, learning, stability
from gripper_force.cli.options import CORES, AsJson, ConfigPath, Jobs, Overrides, load_settings
from gripper_force.cli.output.doctor import changes_table, checks_table, setup_line
from gripper_force.cli.output.runs import grasp_table, phases, replay_table, trials_table
from gripper_force.errors import ConfigError, GripperError

app = typer.Typer(
    help="A robot gripper that feels with its eyes: run, calibrate, replay.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(data.import_app, name="import")
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(bench.app, name="bench")
app.add_typer(stability.app, name="stability")

_INTERRUPTED = 130


def main() -> NoReturn:
    """Entry point: runs a command and turns every foreseen failure into a sentence and an exit code."""
    signal.signal(signal.SIGTERM, _terminate)
    try:
        app()
    except GripperError as error:
        console.err.print(f"[bold red]error:[/] {console.plain(error)}", soft_wrap=True)
        if "--json" in sys.argv:
            sys.stdout.write(json.dumps({"error": str(error)}) + "\n")
        sys.exit(2)
    except SystemExit as end:
        if end.code == _INTERRUPTED:  # what typer makes of a KeyboardInterrupt
            console.err.print("interrupted; what ran was stopped as configured", soft_wrap=True)
        raise
    sys.exit(0)


def grasp(
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
    object_: Annotated[str | None, typer.Option("--object", help="What to grasp.")] = None,
    target_n: Annotated[float | None, typer.Option(help="Wanted force in newtons.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the simulated scene.")] = None,
    feedback: Annotated[str | None, typer.Option(help="fused, current or vision.")] = None,
    profile: Annotated[
        str | None, typer.Option(help="Object profile, by name or path; own: the one with the object's name.")
    ] = None,
    trials: Annotated[
        int, typer.Option(min=0, help="Run so many grasps of all four objects, with targets of 1 to 8 N.")
    ] = 0,
    jobs: Jobs = CORES,
) -> None:
    """Grasp with the wanted force, and report how well. Exit code 1 where nothing was held."""
    from gripper_force.jobs import grasp as job

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
    if not trials:
        log = job.new_log(settings)
        try:
            result = job.grasp(settings, phases(), log)
        except KeyboardInterrupt:
            if log.exists():
                console.err.print(f"what was seen is in {log}: gripper-force replay {log}", soft_wrap=True)
            raise
        console.show(result, as_json, grasp_table)
        if result["result"] != "held":
            raise typer.Exit(1)
        return
    if object_ is not None or target_n is not None:
        raise ConfigError(
            "--trials goes through all four objects with drawn targets; leave --object and --target-n out"
        )
    results = []
    with console.bar("grasping", trials) as advance:
        for one in job.trials(settings, trials, jobs):
            results.append(one)
            advance(f"{one['object']} {one['target_n']:.1f} N: {one['result']}")
    summary = job.overall(results, settings.control.force_limit_n)
    console.show({"trials": results, "summary": summary}, as_json, trials_table)


def replay(
    log: Annotated[Path, typer.Argument(help="Log of a run or of an imported recording.")],
    as_json: AsJson = False,
    checkpoint: Annotated[str | None, typer.Option(help="Estimate with another checkpoint.")] = None,
    set_: Overrides = None,
    recover: Annotated[bool, typer.Option(help="Read what is whole of a truncated log.")] = False,
    report: Annotated[bool, typer.Option(help="Write the report again, beside the log.")] = False,
) -> None:
    """Run estimator and controller again on a log, and compare them with its load cell."""
    from gripper_force.jobs.replay import replay as job

    if report and (set_ or checkpoint):
        raise ConfigError("--report draws the run as it was; leave --set and --checkpoint out, or --report")
    result = job(log, checkpoint, overrides=set_, recover=recover)
    if report:
        from gripper_force.jobs.report import write_report

        result["report"] = str(write_report(log, recover=recover).html)
    console.show(result, as_json, replay_table)


def virtual_servo(
    model: Annotated[str | None, typer.Option(help="Servo model.")] = None,
    ids: Annotated[list[int] | None, typer.Option("--id", help="Servo id. Repeatable.")] = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Serve virtual servos at a device path that any Dynamixel client can open, until Ctrl-C."""
    from gripper_hw.dynamixel.pty_server import serve_virtual_servo

    servo = load_settings(None, set_, {"servo.model": model}).servo
    who = ids or [servo.id]
    with serve_virtual_servo(servo.model, who) as server:
        console.show({"port": server.device_path, "model": servo.model, "ids": who}, as_json)
        sys.stdout.flush()
        console.err.print("serving until Ctrl-C")
        signal.pause()


def doctor(
    config: ConfigPath = None,
    set_: Overrides = None,
    setup: Annotated[
        bool, typer.Option("--setup", help="Show what would change in the servo's registers, ask, change it.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="With --setup: do not ask.")] = False,
    as_json: AsJson = False,
) -> None:
    """Look at every device and this machine, and say what to do. Exit code 1 if something is to be done."""
    from gripper_force.jobs import doctor as job

    settings = load_settings(config, set_, {})
    if setup:
        console.show(
            job.setup(settings, lambda servo, changes: _agreed(servo, changes, yes)),
            as_json,
            setup_line,
        )
        return
    with console.err.status("looking"):
        checks = list(job.doctor(settings))
    ok = all(check.ok is not False for check in checks)
    console.show({"checks": checks, "ok": ok}, as_json, checks_table)
    if not ok:
        raise typer.Exit(1)


for _command in (  # in the order of --help
    grasp,
    replay,
    data.record,
    data.simulate,
    learning.train,
    learning.evaluate,
    learning.reproduce,
    learning.export,
    doctor,
    virtual_servo,
):
    app.command()(_command)


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _agreed(servo: str, changes: list[Any], yes: bool) -> bool:
    changes_table(servo, changes)
    try:
        return yes or typer.confirm(f"Write these to {servo}?", err=True)
    except typer.Abort as abort:
        if not isinstance(abort.__context__, EOFError):
            raise
        console.err.print()
        raise ConfigError(
            f"no answer came, so nothing was written to {servo}; say --yes where nobody can be asked"
        ) from abort
