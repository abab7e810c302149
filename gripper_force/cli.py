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
from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError, DataError, GripperError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
import_app = typer.Typer(no_args_is_help=True, help="Turn other recordings into logs.")
app.add_typer(import_app, name="import")
calibrate_app = typer.Typer(no_args_is_help=True, help="Find out what this rig and its objects are like.")
app.add_typer(calibrate_app, name="calibrate")

ConfigPath = Annotated[Path | None, typer.Option("--config", help="YAML file with configuration keys.")]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", help="Set one configuration key: key.path=value. Repeatable.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
RigPath = Annotated[
    Path, typer.Option("--rig", help="Rig profile to write; only what is calibrated is replaced in it.")
]
Jobs = Annotated[int, typer.Option(min=1, help="Processes to use.")]

_INTERRUPTED = 130
_CORES = os.cpu_count() or 1


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
    jobs: Jobs = _CORES,
) -> None:
    """Grasp with the wanted force, and report how well. Exit code 1 where nothing was held."""
    from gripper_force import grasp as job

    settings = _load(
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
    grasps: Annotated[int | None, typer.Option(min=0, help="Logs of grasps.  [default: 20]")] = None,
    first_seed: Annotated[
        int | None,
        typer.Option(min=0, help="Seed of the first log. Training data start at 100000.  [default: 100000]"),
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
    jobs: Jobs = _CORES,
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
        settings = _load(config, set_, {})
        count, seed = 200 if presses is None else presses, 100_000 if first_seed is None else first_seed
        plans = job.plan("press", count, seed)
        plans += job.plan("grasp", 20 if grasps is None else grasps, seed + count)
    elif protocol == "shin2019":
        given = {"--presses": presses, "--grasps": grasps, "--first-seed": first_seed}
        if idle := [name for name, value in given.items() if value is not None]:
            raise ConfigError(
                f"the sets of --protocol are fixed, so {' and '.join(idle)} can't be heeded: leave out one "
                "or the other"
            )
        settings = _load(config, [f"camera.rate_hz={job.PROTOCOL_RATE_HZ}", *(set_ or [])], {})
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
    settings = _load(config, set_, options)
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
    init: Annotated[str | None, typer.Option(help="Checkpoint to begin with.")] = None,
    resume: Annotated[bool, typer.Option(help="Go on from the states of a run that was broken off.")] = False,
    jobs: Jobs = _CORES,
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
    start = load_checkpoint(init) if init else None
    result = job(settings, clips, checkpoint, init=start, resume=resume)
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
    jobs: Jobs = _CORES,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Compare a checkpoint's estimates with the load cell, over all logs of a folder."""
    from gripper_force.dataset import load_clips
    from gripper_force.evaluate import evaluate as job
    from gripper_force.profiles import correction_of
    from gripper_force.vision.checkpoint import load_checkpoint

    settings = _load(None, set_, {"vision.checkpoint": checkpoint, "calibration.object": profile})
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
        Path | None, typer.Option(help="Markdown file to put tables and figures into, such as docs/paper.md.")
    ] = None,
    jobs: Jobs = _CORES,
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
    text = page.markdown(what, result, scale, settings, test, pictures.name)
    if write is not None:
        from gripper_force.report.markers import write_between

        write_between(write, scale, text)
    drawn = {name: str(pictures / f"{name}.png") for name in result.figures}
    console.show({"tables": result.tables, "figures": drawn}, as_json, console.paper_tables)


@import_app.command("video")
def import_video(
    video: Annotated[Path, typer.Argument(help="Clip, or a folder of recordings.")],
    forces: Annotated[Path | None, typer.Argument(help="Table with frame, t_s and force_n.")] = None,
    folder: Annotated[Path, typer.Option("--out", help="Folder for the logs.")] = Path("data/imported"),
    object_: Annotated[str | None, typer.Option("--object", help="What was grasped.")] = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Import a video and its load-cell table, or a folder of them. Spikes and tare are counted."""
    from gripper_force import video_import as job

    region = _load(None, set_, {}).vision.region

    if video.is_dir():
        summaries = job.import_folder(video, folder, region=region)
    elif forces is None:
        raise DataError(f"{video} needs its load-cell table: import video CLIP.avi FORCES.csv")
    else:
        log = folder / f"{video.stem}.mcap"
        summaries = [job.import_video(video, forces, log, object_name=object_, region=region)]
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

    settings = _load(None, set_, {"camera.rate_hz": rate_hz})
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


@calibrate_app.command("load-cell")
def calibrate_load_cell(
    mass_kg: Annotated[float | None, typer.Option(help="Known mass to put on the load cell.")] = None,
    force_n: Annotated[float | None, typer.Option(help="Its weight, instead.")] = None,
    rig: RigPath = Path("rig.yaml"),
    seconds: Annotated[float, typer.Option(min=1, help="How long to read each load.")] = 10.0,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for Enter: go on once the reading says so.")
    ] = False,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Find a load cell's tare and scale with a known mass: empty, loaded, empty again."""
    from gripper_calibration.procedures import load_cell as job

    if (mass_kg is None) == (force_n is None):
        raise ConfigError("say what is put on the load cell: --mass-kg or --force-n")
    weight_n = force_n if force_n is not None else (mass_kg or 0.0) * job.STANDARD_GRAVITY_M_S2
    settings = _load(config, set_, {})
    with console.err.status("reading") as status:
        result = job.calibrate(
            settings,
            weight_n,
            rig,
            ask=lambda what: _ask(what, yes, status),
            seconds=seconds,
            progress=lambda step, raw: status.update(f"{step}: {raw:.6g}"),
        )
    console.show(result, as_json, console.rig_table)


@calibrate_app.command("servo")
def calibrate_servo(
    gauge_mm: Annotated[
        list[float],
        typer.Option(
            help="Width of the load cell between the jaws. Another width tells the pinion's radius."
        ),
    ],
    rig: RigPath = Path("rig.yaml"),
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for Enter: the load cell is there.")
    ] = False,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Find a servo's torque, friction and jaw geometry with the load cell between the jaws."""
    from gripper_calibration.procedures import servo as job

    settings = _load(config, set_, {})
    with console.err.status("moving") as status:
        result = job.calibrate(
            settings,
            [width / 1e3 for width in gauge_mm],
            rig,
            ask=lambda what: _ask(what, yes, status),
            progress=lambda step, force_n: status.update(f"{step}: {force_n:.1f} N"),
        )
    console.show(result, as_json, console.rig_table)


@calibrate_app.command("camera")
def calibrate_camera(
    rig: RigPath = Path("rig.yaml"),
    region: Annotated[
        str | None,
        typer.Option(help="Region of interest of the frame: left,top,width,height. Default: by markers."),
    ] = None,
    exposure_us: Annotated[
        list[int] | None, typer.Option(min=1, help="An exposure to try. Repeatable. Default: a ladder.")
    ] = None,
    touches: Annotated[int, typer.Option(min=3, help="How often to touch the object.")] = 10,
    object_: Annotated[str | None, typer.Option("--object", help="What is between the jaws.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the touches, and of a simulated scene.")] = None,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Find a camera's region of interest, exposure and lag, by touching an object that gives way."""
    from gripper_calibration.procedures import camera as job

    settings = _load(config, set_, {"object": object_, "seed": seed})
    with console.err.status("looking") as status:
        result = job.calibrate(
            settings,
            rig,
            region=None if region is None else _region(region),
            exposures_us=exposure_us or job.EXPOSURES_US,
            touches=touches,
            progress=lambda step, force_n: status.update(f"{step}: {force_n:.1f} N"),
        )
    console.show(result, as_json, console.rig_table)


@calibrate_app.command("object")
def calibrate_object(
    name: Annotated[str, typer.Argument(help="The object; of a simulated rig one that it knows.")],
    touches: Annotated[int, typer.Option(min=1, help="How many touches there are to be.")] = 8,
    peak_n: Annotated[float | None, typer.Option(help="The most to press with.")] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option("--from", help="Calibrate on these logs, or folders of them, and touch nothing."),
    ] = None,
    folder: Annotated[
        Path | None, typer.Option(help="Where the touches are kept; those that are there are not done again.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Profile to write. Default: NAME.yaml in your own folder of profiles.")
    ] = None,
    pause: Annotated[
        bool, typer.Option("--pause", help="Wait for Enter before each touch, to put the object down anew.")
    ] = False,
    config: ConfigPath = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the touches, and of a simulated scene.")] = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Learn an object by touching it with the load cell in place. Ctrl-C calibrates on what there is."""
    from gripper_calibration.procedures import object as job
    from gripper_force.object_profile import user_folder

    settings = _load(config, set_, {"object": name, "seed": seed})
    if logs is None:
        paths = _touches(settings, touches, peak_n, folder or Path("data/touches") / name, pause)
    else:
        paths = [p for path in logs for p in (sorted(path.rglob("*.mcap")) if path.is_dir() else [path])]
    with console.bar("calibrating", len(paths) + 2) as advance:
        result = job.calibrate(settings, name, paths, out or user_folder() / f"{name}.yaml", advance)
    console.show(result, as_json, console.object_table)


def _touches(settings: Config, touches: int, peak_n: float | None, folder: Path, pause: bool) -> list[Path]:
    from gripper_calibration.procedures import object as job

    paths = []
    with console.err.status("touching") as status:

        def ask(number: int) -> None:
            _ask(f"Put the object down for touch {number}", False, status)

        try:
            for path in job.touch(
                settings,
                touches,
                peak_n,
                folder,
                ask=ask if pause else lambda _: None,
                progress=lambda number, _, force_n: status.update(
                    f"touch {number} of {touches}: {force_n:.1f} N"
                ),
            ):
                paths.append(path)
        except KeyboardInterrupt:
            if not paths:
                raise
            console.err.print(f"stopped after {len(paths)} of {touches} touches; calibrating on these")
    return paths


@app.command("virtual-servo")
def virtual_servo(
    model: Annotated[str | None, typer.Option(help="Servo model.")] = None,
    ids: Annotated[list[int] | None, typer.Option("--id", help="Servo id. Repeatable.")] = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Serve virtual servos at a device path that any Dynamixel client can open, until Ctrl-C."""
    from importlib import import_module

    servo = _load(None, set_, {"servo.model": model}).servo
    who = ids or [servo.id]
    serve = import_module("gripper_hw.dynamixel.serve").serve_virtual_servo
    with serve(servo.model, who) as server:
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

    settings = _load(config, set_, {})
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


@app.command()
def bench(
    bus: Annotated[bool, typer.Option("--bus", help="A cycle of the servo's bus, by the driver.")] = False,
    cycles: Annotated[int, typer.Option(min=1, help="With --bus: how many of each.")] = 1000,
    commands: Annotated[bool, typer.Option("--commands", help="Time and memory of most commands.")] = False,
    training: Annotated[
        Path | None, typer.Option(help="Ways to train on this folder of logs: error against minutes.")
    ] = None,
    minutes: Annotated[float, typer.Option(min=0.01, help="With --training: for each way.")] = 30.0,
    folder: Annotated[
        Path, typer.Option("--out", help="With --training: where to keep what is measured.")
    ] = Path("runs/bench"),
    jobs: Jobs = _CORES,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="With --training: a key for all recipes. Repeatable.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure what parts of a run cost on this machine, beside what others use."""
    from gripper_force import bench as job

    if [bus, commands, training is not None].count(True) != 1:
        raise ConfigError("bench measures one thing at a time: --bus, --commands or --training DATA")
    if training is not None:
        console.show(_learning(training, minutes, set_ or [], folder, jobs), as_json, console.learning_table)
        return
    if commands:
        taken = []
        with console.bar("running", len(job.COMMANDS)) as advance:
            for cost in job.commands():
                taken.append(cost)
                advance(cost.command)
        console.show(
            {"commands": taken, "load": os.getloadavg()[0], "cores": _CORES}, as_json, console.commands_table
        )
        return
    costs: list[Any] = []
    with console.bar("measuring", len(job.BUS_SETTINGS)) as advance:
        for setting in job.bus(cycles):
            costs += setting
            advance(f"{setting[0].baud_rate} baud, {setting[0].latency_ms:g} ms")
    console.show({"bus": costs, "load": os.getloadavg()[0], "cores": _CORES}, as_json, console.bus_table)


def _learning(data: Path, minutes: float, overrides: list[str], out_: Path, jobs: int) -> dict[str, Any]:
    from functools import partial

    from gripper_force.dataset import load_clips
    from gripper_force.training.learning import learn, reached

    points = []
    for point in learn(partial(load_clips, data, workers=jobs), minutes, overrides, out_):
        points.append(point)
        console.err.print(f"{point.way}, {point.minutes:.2f} min: {point.mae_n:.3f} N")
    return {"points": points, "as_good_as_paper_min": reached(points), "cores": _CORES, "folder": out_}


@app.command()
def stability(
    faults: Annotated[bool, typer.Option("--faults", help="Break each part in mid-grasp.")] = False,
    seeds: Annotated[int, typer.Option(min=1, help="With --faults: grasps of each row.")] = 20,
    live: Annotated[int, typer.Option(min=0, help="With --faults: of these, also in real time.")] = 2,
    write: Annotated[
        Path | None, typer.Option(help="With --faults: Markdown file to put the matrix into.")
    ] = None,
    resume: Annotated[
        bool, typer.Option(help="With --faults: go on where the last matrix was broken off.")
    ] = False,
    fuzz: Annotated[
        int | None, typer.Option(min=1, help="Feed so many random and damaged inputs to all readers.")
    ] = None,
    soak: Annotated[
        float | None,
        typer.Option(min=0, help="Grasp again and again for so many simulated seconds (coarse scenes)."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the inputs or of the first scene.")] = 0,
    only: Annotated[
        str | None, typer.Option(help="With --fuzz: one target, or one input as <target>:<number>.")
    ] = None,
    folder: Annotated[Path, typer.Option("--out", help="Folder for inputs that are findings.")] = Path(
        "runs/fuzz"
    ),
    jobs: Jobs = _CORES,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Show that faults, hostile input and long use are survived. Exit code 1 where they are not."""
    if [faults, fuzz is not None, soak is not None].count(True) != 1:
        raise ConfigError("stability does one thing at a time: --faults, --fuzz N or --soak SECONDS")
    if faults:
        result = _fault_matrix(_load(config, set_, {"seed": seed}), seeds, live, jobs, write, resume)
        console.show(result, as_json, console.faults_table)
    elif fuzz is not None:
        from gripper_force.stability.fuzz import fuzz as feed

        with console.bar("fuzzing", fuzz) as advance:
            result = feed(fuzz, seed, jobs, folder, advance, only=only)
        console.show(result, as_json, console.fuzz_table)
    else:
        from gripper_force.stability.soak import soak as grasp_on

        settings = _load(config, ["sim.detail=coarse", *(set_ or [])], {"seed": seed})
        with console.bar("soaking", round(soak or 0)) as advance:
            result = grasp_on(settings, soak or 0, advance)
        console.show(result, as_json, console.soak_table)
    if not result["ok"]:
        raise typer.Exit(1)


def _fault_matrix(
    settings: Config, seeds: int, live: int, jobs: int, page: Path | None, resume: bool
) -> dict[str, Any]:
    from gripper_force.report.markers import write_between
    from gripper_force.stability.faults import count_grasps, markdown, run_matrix

    with console.bar("breaking things", count_grasps(seeds, live)) as advance:
        keep = settings.log.directory / "faults.jsonl"
        rows = list(run_matrix(settings, seeds, live, jobs, keep, resume=resume, advance=advance))
    if page is not None:
        write_between(page, "matrix", markdown(rows))
    return {"rows": rows, "ok": all(row["ok"] == row["runs"] for row in rows)}


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _load(path: Path | None, overrides: list[str] | None, options: dict[str, Any]) -> Config:
    given = [f"{key}={json.dumps(value)}" for key, value in options.items() if value is not None]
    return load_config(path, [*(overrides or []), *given])


def _region(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--region needs left,top,width,height in pixels, got {text!r}") from None
    return left, top, width, height


def _ask(what: str, yes: bool, status: Any) -> None:
    """Says what a person is to do, and waits for Enter."""
    if yes:
        console.err.print(what, soft_wrap=True)
        return
    if not sys.stdin.isatty():
        raise ConfigError(
            f"nobody can be asked here to do this: {what}; run it in a terminal, or say --yes where it is "
            "done without being asked"
        )
    status.stop()
    console.err.print(f"{what}, then press Enter ", end="", soft_wrap=True)
    sys.stdin.readline()
    status.start()


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
