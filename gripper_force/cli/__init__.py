"""The command line: parse, call, and let `gripper_force.console` print.

Every command takes ``--set key.path=value`` and ``--json``. With ``--json`` one JSON object goes to stdout;
progress and messages go to stderr always. Bad input is one sentence on stderr and exit code 2. Exit code 1
says that a command did its work and what came out is not well.

What a command needs is imported when it runs: ``gripper-force --help`` must answer at once.
"""

import json
import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from gripper_force import console
from gripper_force.cli import bench, calibrate, stability
from gripper_force.cli.options import CORES, AsJson, ConfigPath, Jobs, Overrides, load_settings
from gripper_force.errors import ConfigError, DataError, GripperError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
import_app = typer.Typer(no_args_is_help=True, help="Turn other recordings into logs.")
app.add_typer(import_app, name="import")
app.add_typer(calibrate.app, name="calibrate")

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


@app.command()
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
    from gripper_force import grasp as job

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
        result = job.grasp(settings, progress=lambda s: console.err.print(console.phase_line(s)))
        console.show(result, as_json, console.grasp_table)
        if result["result"] != "held":
            raise typer.Exit(1)
        return
    results = []
    with console.bar("grasping", trials) as advance:
        for one in job.trials(settings, trials, jobs):
            results.append(one)
            advance(f"{one['object']} {one['target_n']:.1f} N: {one['result']}")
    summary = job.overall(results, settings.control.force_limit_n)
    console.show({"trials": results, "summary": summary}, as_json, console.trials_table)


@app.command()
def replay(
    log: Annotated[Path, typer.Argument(help="Log of a run or of an imported recording.")],
    as_json: AsJson = False,
    checkpoint: Annotated[str | None, typer.Option(help="Estimate with another checkpoint.")] = None,
    set_: Overrides = None,
    recover: Annotated[bool, typer.Option(help="Read what is whole of a truncated log.")] = False,
    report: Annotated[bool, typer.Option(help="Write the report again, beside the log.")] = False,
) -> None:
    """Run estimator and controller again on a log, and compare them with its load cell."""
    from gripper_force.replay import replay as job

    result = job(log, checkpoint, overrides=set_, recover=recover)
    if report:
        from gripper_force.report import write_report

        result["report"] = str(write_report(log, recover=recover).html)
    console.show(result, as_json, console.replay_table)


@app.command()
def simulate(
    folder: Annotated[Path, typer.Option("--out", help="Folder for the logs.")] = Path("data/sim"),
    presses: Annotated[
        int | None, typer.Option(min=0, help="Logs of random forces, one after the other.  [default: 200]")
    ] = None,
    taps: Annotated[
        int | None,
        typer.Option(min=0, help="Logs of one fast touch: more scenes in less time.  [default: 0]"),
    ] = None,
    grasps: Annotated[int | None, typer.Option(min=0, help="Logs of grasps.  [default: 20]")] = None,
    first_seed: Annotated[
        int | None,
        typer.Option(min=0, help="Seed of the first log. Training data start at 100000.  [default: 100000]"),
    ] = None,
    object_: Annotated[
        list[str] | None,
        typer.Option("--object", help="Make logs of this object. Repeatable.  [default: all four, in turn]"),
    ] = None,
    protocol: Annotated[
        str | None, typer.Option(help="shin2019: the paper's sets instead, into OUT/train and OUT/test.")
    ] = None,
    scale: Annotated[
        str | None,
        typer.Option(
            help="With --protocol: full (720 logs) or small (80: 0 and 30 degrees, one light).  "
            "[default: full]"
        ),
    ] = None,
    jobs: Jobs = CORES,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Write logs of randomised touches, to train and to evaluate on. Goes on where it was broken off."""
    from gripper_force import simulate as job

    plans: list[Any]
    if protocol is None:
        if scale is not None:
            raise ConfigError("--scale is of a protocol's sets: add --protocol shin2019, or leave it out")
        settings = load_settings(config, set_, {})
        seed, plans = 100_000 if first_seed is None else first_seed, []
        objects = tuple(object_ or job.OBJECTS)
        plans += job.plan("press", 200 if presses is None else presses, seed, objects)
        plans += job.plan("tap", taps or 0, seed + len(plans), objects)
        plans += job.plan("grasp", 20 if grasps is None else grasps, seed + len(plans), objects)
    elif protocol == "shin2019":
        given = {
            "--presses": presses,
            "--taps": taps,
            "--grasps": grasps,
            "--first-seed": first_seed,
            "--object": object_,
        }
        if idle := [name for name, value in given.items() if value is not None]:
            raise ConfigError(
                f"the sets of --protocol are fixed, so {' and '.join(idle)} can't be heeded: leave out one "
                "or the other"
            )
        settings = load_settings(config, [f"camera.rate_hz={job.PROTOCOL_RATE_HZ}", *(set_ or [])], {})
        plans = list(job.plan_protocol(scale or "full"))
    else:
        raise ConfigError(f"no protocol {protocol!r}; there is shin2019")
    names = [name for p in plans for name in p.names]
    made = 0
    with console.bar("simulating", len(names)) as advance:
        advance("", sum((folder / name).exists() for name in names))
        for path in job.simulate(plans, folder, settings, jobs):
            made += 1
            advance(path.name)
    console.show({"logs": len(names), "made": made, "folder": str(folder)}, as_json)


@app.command()
def record(
    folder: Annotated[Path, typer.Option("--out", help="Folder for the logs.")] = Path("data/real"),
    object_: Annotated[str | None, typer.Option("--object", help="What lies between the jaws.")] = None,
    sets: Annotated[int, typer.Option(min=1, help="Sets in all, with those that are there already.")] = 15,
    touches: Annotated[int, typer.Option(min=1, help="Touches of each set.")] = 4,
    peak_n: Annotated[
        float | None,
        typer.Option(help="Touches press up to 1 N to this. By default 12, or what the force limit leaves."),
    ] = None,
    degrees: Annotated[
        float | None,
        typer.Option(help="Angle of the press, noted in logs and names; a simulated object is turned so."),
    ] = None,
    lux: Annotated[
        float | None, typer.Option(help="Light level, noted likewise; a simulated rig is lit so.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the peaks, and of simulated scenes.")] = None,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Record sets of touches with servo, camera and load cell, to train and to evaluate on.

    The jaws open, rest, and press with random forces. Every fifth set goes into OUT/test, the others into
    OUT/train. At the end each set is judged: frames, losses, forces, and whether camera and load cell agree
    in time. Sets that are there already are kept, so a recording that was broken off goes on.
    """
    from gripper_force.recording import record as job
    from gripper_force.recording.summary import summarise

    options = {"object": object_, "seed": seed, "sim.yaw_deg": degrees, "sim.lux": lux}
    settings = load_settings(config, set_, options)
    plan = job.Plan(sets, touches, peak_n, degrees, lux)
    paths = plan.paths(settings, folder)
    with console.bar("recording", sets) as advance:
        advance("", sum(path.exists() for path in paths))

        def tell(number: int, touch: int, force_n: float) -> None:
            what = f"touch {touch} of {touches}" if touch else "at rest"
            advance(f"set {number}, {what}: {force_n:.1f} N", 0)

        for path in job.record(settings, plan, folder, tell):
            advance(path.name)
    console.show(summarise(paths), as_json, console.sets_table)


@app.command()
def train(
    data: Annotated[Path, typer.Argument(help="Folder with logs.")],
    checkpoint: Annotated[Path, typer.Option("--out", help="Checkpoint to write.")] = Path(
        "force.safetensors"
    ),
    recipe: Annotated[
        str, typer.Option(help="short_clips, our own, or shin2019, the paper's.")
    ] = "short_clips",
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Set one key of the recipe: key=value. Repeatable.")
    ] = None,
    hold_out: Annotated[
        list[str] | None, typer.Option(help="Object to leave out of the training. Repeatable.")
    ] = None,
    validation: Annotated[
        Path | None,
        typer.Option(
            help="Folder with logs to measure the claimed error on; without, sets held out of DATA."
        ),
    ] = None,
    init: Annotated[str | None, typer.Option(help="Checkpoint to begin with.")] = None,
    resume: Annotated[bool, typer.Option(help="Go on from the states of a run that was broken off.")] = False,
    jobs: Jobs = CORES,
    as_json: AsJson = False,
) -> None:
    """Train the force network on logs; under `torchrun`, in several processes."""
    from gripper_force.dataset import load_clips
    from gripper_force.training.recipe import recipe as named
    from gripper_force.training.train import train as job
    from gripper_force.vision.checkpoint import load_checkpoint

    settings = named(recipe, set_)
    quiet = os.environ.get("RANK", "0") != "0"  # of torchrun's processes the first one speaks
    clips = load_clips(data, settings.preprocess, workers=jobs, quiet=quiet)
    clips = [clip for clip in clips if clip.object not in (hold_out or [])]
    unseen = load_clips(validation, settings.preprocess, workers=jobs, quiet=quiet) if validation else None
    start = load_checkpoint(init) if init else None
    result = job(settings, clips, checkpoint, validation_clips=unseen, init=start, resume=resume)
    metrics = result.header.metrics
    if not quiet:
        console.show({"checkpoint": str(checkpoint), "digest": result.digest, **metrics}, as_json)


@app.command()
def evaluate(
    data: Annotated[Path, typer.Argument(help="Folder with logs that training has not seen.")],
    checkpoint: Annotated[str | None, typer.Option(help="Checkpoint, or `default`.")] = None,
    profile: Annotated[
        str | None, typer.Option(help="Object profile, by name or path; own: the one with each log's object.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option("--object", help="Only logs of this object. Repeatable.")
    ] = None,
    jobs: Jobs = CORES,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Compare a checkpoint's estimates with the load cell, over all logs of a folder."""
    from gripper_force.dataset import load_clips
    from gripper_force.evaluate import evaluate as job
    from gripper_force.profiles import correction_of
    from gripper_force.vision.checkpoint import load_checkpoint

    settings = load_settings(None, set_, {"vision.checkpoint": checkpoint, "calibration.object": profile})
    vision = settings.vision
    loaded = load_checkpoint(vision.checkpoint)
    clips = load_clips(data, loaded.header.preprocess, vision.region, workers=jobs)
    clips = [clip for clip in clips if not only or clip.object in only]
    if not clips:
        raise DataError(f"no log in {data} is of {', '.join(only or [])}")

    def correct(clip: Any) -> Any:
        return correction_of(settings.model_copy(update={"object": clip.object}), loaded)

    corrected = None if settings.calibration.object is None else correct
    console.show(dict(job(loaded, clips, corrected)), as_json, console.errors_table)


@app.command()
def export(
    out: Annotated[Path, typer.Option("--out", help="File to write: .onnx, or .xml for OpenVINO.")],
    checkpoint: Annotated[str, typer.Argument(help="A path, or default or small.")] = "default",
    int8: Annotated[
        Path | None,
        typer.Option(help="Compute the convolutions in int8, scaled on this folder of logs (.xml only)."),
    ] = None,
    jobs: Jobs = CORES,
    as_json: AsJson = False,
) -> None:
    """Write a network's streaming step for another engine, checked against PyTorch."""
    from gripper_force.dataset import load_clips
    from gripper_force.vision.export import export as job
    from gripper_force.vision.exported import read_model

    model = read_model(checkpoint)
    frames = None
    if int8 is not None:
        frames = [clip.frames for clip in load_clips(int8, model.header.preprocess, workers=jobs)]
    with console.err.status("exporting"):
        errors = job(model, out, frames)
    console.show({"file": str(out), "digest": model.digest, "off_torch_n": errors}, as_json)


@app.command()
def reproduce(
    what: Annotated[str, typer.Argument(help="3, 4, 5, 6, 7, 8, 9, fig6, fig7, fig8, fig9, claims or all.")],
    scale: Annotated[
        str, typer.Option(help="small (two CPU cores, some two hours) or full (for a GPU).")
    ] = "small",
    data: Annotated[
        Path | None,
        typer.Option(help="Folder with logs in train/ and test/. By default they are simulated first."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the networks; what is there is not trained again."),
    ] = None,
    write: Annotated[
        Path | None, typer.Option(help="Page with places for tables and figures, such as docs/paper.md.")
    ] = None,
    jobs: Jobs = CORES,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Set one key of the scale: key=value. Repeatable.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make the paper's tables and figures again, beside its own numbers. Goes on where it was broken off."""
    from gripper_force.reproduce import page
    from gripper_force.reproduce.models import SCALES, Scale
    from gripper_force.schema import section_from

    names = page.asked_for(what)
    if scale not in SCALES:
        raise ConfigError(f"no scale {scale!r}; there are {', '.join(SCALES)}")
    settings = section_from(Scale, [*(f"{k}={json.dumps(v)}" for k, v in SCALES[scale]), *(set_ or [])])
    out_ = folder or Path("runs/paper") / scale
    result, test = page.reproduce(names, settings, data, out_, jobs, console.bar)
    pictures = write.with_suffix("") if write else out_
    pictures.mkdir(parents=True, exist_ok=True)
    for name, figure in result.figures.items():
        figure.savefig(pictures / f"{name}.png")
    if write is not None:
        from gripper_force.report.markers import write_between

        for place, text in page.markdown(result, scale, settings, test, pictures.name).items():
            write_between(write, place, text)
    drawn = {name: str(pictures / f"{name}.png") for name in result.figures}
    console.show({"tables": list(result.tables.values()), "figures": drawn}, as_json, console.paper_tables)


@import_app.command("video")
def import_video(
    video: Annotated[Path, typer.Argument(help="Clip, or a folder of recordings.")],
    forces: Annotated[Path | None, typer.Argument(help="Table with frame, t_s and force_n.")] = None,
    folder: Annotated[Path, typer.Option("--out", help="Folder for the logs.")] = Path("data/imported"),
    object_: Annotated[str | None, typer.Option("--object", help="What was grasped.")] = None,
    align: Annotated[
        bool, typer.Option(help="Set forces right that come late or early beyond doubt.")
    ] = True,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Import a video and its load-cell table, or a folder of them. Spikes, tare and lag are told."""
    from gripper_force import video_import as job

    region = load_settings(None, set_, {}).vision.region

    if video.is_dir():
        summaries = job.import_folder(video, folder, region=region, align=align)
    elif forces is None:
        raise DataError(f"{video} needs its load-cell table: import video CLIP.avi FORCES.csv")
    else:
        log = folder / f"{video.stem}.mcap"
        summaries = [job.import_video(video, forces, log, object_name=object_, region=region, align=align)]
    rows = [console.jsonable(summary) for summary in summaries]
    console.show({"logs": rows}, as_json, console.imports_table)


@import_app.command("database")
def import_database(
    database: Annotated[
        Path, typer.Argument(help="Folder that holds folders <object>_<degrees>_<illumination>.")
    ],
    folder: Annotated[Path, typer.Option("--out", help="Folder for the logs.")] = Path("data/shin2019"),
    rate_hz: Annotated[float, typer.Option(help="Frame rate, for the times of the images.")] = 149.0,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Import the published database of Shin et al. 2019, a log for every four touches. Damage is named.

    Goes on where it was broken off.
    """
    from gripper_force.database_import import find_environments, import_environment

    settings = load_settings(None, set_, {"camera.rate_hz": rate_hz})
    environments, ignored = find_environments(database)
    rows = []
    with console.bar("importing", len(environments)) as advance:
        for path in environments:
            rows.append(
                import_environment(
                    path, folder, rate_hz=settings.camera.rate_hz, region=settings.vision.region
                )
            )
            advance(path.name)
    console.show({"environments": rows, "ignored": ignored}, as_json, console.database_table)


@app.command("virtual-servo")
def virtual_servo(
    model: Annotated[str | None, typer.Option(help="Servo model.")] = None,
    ids: Annotated[list[int] | None, typer.Option("--id", help="Servo id. Repeatable.")] = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Serve virtual servos at a device path that any Dynamixel client can open, until Ctrl-C."""
    from gripper_force.backends import VIRTUAL_SERVO, load

    servo = load_settings(None, set_, {"servo.model": model}).servo
    who = ids or [servo.id]
    with load(VIRTUAL_SERVO)(servo.model, who) as server:
        console.show({"port": server.device_path, "model": servo.model, "ids": who}, as_json)
        sys.stdout.flush()
        console.err.print("serving until Ctrl-C")
        signal.pause()


@app.command()
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
    from gripper_force import doctor as job

    settings = load_settings(config, set_, {})
    if setup:
        console.show(
            job.setup(settings, lambda servo, changes: _agreed(servo, changes, yes)),
            as_json,
            console.setup_line,
        )
        return
    with console.err.status("looking"):
        checks = list(job.doctor(settings))
    ok = all(check.ok is not False for check in checks)
    console.show({"checks": checks, "ok": ok}, as_json, console.checks_table)
    if not ok:
        raise typer.Exit(1)


app.command()(bench.bench)
app.command()(stability.stability)


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _agreed(servo: str, changes: list[Any], yes: bool) -> bool:
    console.changes_table(servo, changes)
    try:
        return yes or typer.confirm(f"Write these to {servo}?", err=True)
    except typer.Abort as abort:
        if not isinstance(abort.__context__, EOFError):
            raise
        console.err.print()
        raise ConfigError(
            f"no answer came, so nothing was written to {servo}; say --yes where nobody can be asked"
        ) from abort
