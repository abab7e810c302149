"""The commands that make logs, or turn other recordings into them."""

from pathlib import Path
from typing import Annotated, Any

import typer

from gripper_force.cli import console
from gripper_force.cli.options import CORES, AsJson, ConfigPath, Jobs, Overrides, load_settings
from gripper_force.cli.output.data import database_table, imports_table, sets_table
from gripper_force.errors import ConfigError, DataError

import_app = typer.Typer(no_args_is_help=True, help="Turn other recordings into logs.")


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
    from gripper_force.jobs import paper_protocol
    from gripper_force.jobs import simulate as job

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
        settings = load_settings(config, [f"camera.rate_hz={paper_protocol.RATE_HZ}", *(set_ or [])], {})
        plans = list(paper_protocol.plan_protocol(scale or "full"))
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
    from gripper_force.jobs.recording import record as job
    from gripper_force.jobs.recording.summary import summarise

    options = {"object": object_, "seed": seed, "sim.yaw_deg": degrees, "sim.lux": lux}
    settings = load_settings(config, set_, options)
    plan = job.RecordingPlan(sets, touches, peak_n, degrees, lux)
    paths = plan.paths(settings, folder)
    with console.bar("recording", sets) as advance:
        if there := sum(path.exists() for path in paths):
            console.err.print(f"{there} of {sets} sets are there already, and are kept")

        def tell(number: int, touch: int, force_n: float) -> None:
            what = f"touch {touch} of {touches}" if touch else "at rest"
            advance(f"set {number}, {what}: {force_n:.1f} N", 0)

        for path in job.record(settings, plan, folder, tell):
            advance(path.name)
    console.show(summarise(paths), as_json, sets_table)


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
    from gripper_force.jobs.imports import video as job

    region = load_settings(None, set_, {}).vision.region

    if video.is_dir():
        summaries = job.import_folder(video, folder, region=region, align=align)
    elif forces is None:
        raise DataError(f"{video} needs its load-cell table: import video CLIP.avi FORCES.csv")
    else:
        log = folder / f"{video.stem}.mcap"
        summaries = [job.import_video(video, forces, log, object_name=object_, region=region, align=align)]
    rows = [console.jsonable(summary) for summary in summaries]
    console.show({"logs": rows}, as_json, imports_table)


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
    from gripper_force.jobs.imports.database import find_environments, import_environment

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
    console.show({"environments": rows, "ignored": ignored}, as_json, database_table)
