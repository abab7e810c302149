"""Commands that make logs: `simulate`, `record`, `import video` and `import database`."""

from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from gripper_force.cli import console
from gripper_force.cli.options import CORES, AsJson, ConfigPath, Jobs, Overrides, Ray, load_settings
from gripper_force.cli.output.data import database_table, imports_table, sets_table
from gripper_force.errors import ConfigError, DataError

if TYPE_CHECKING:
    from gripper_force.jobs.simulate import Kind, SimulationPlan

import_app = typer.Typer(no_args_is_help=True, help="Convert other recordings to logs.")

_MANY_SETS: Final = 100
"""Number of recordings above which a network learns more than a Gaussian process (docs/training.md)."""


def simulate(
    folder: Annotated[Path, typer.Option("--out", help="Folder for the logs.")] = Path("data/sim"),
    presses: Annotated[
        int | None,
        typer.Option(min=0, help="Logs of presses: one to three random forces in turn. Default: 200."),
    ] = None,
    taps: Annotated[
        int | None,
        typer.Option(min=0, help="Logs of taps: one fast touch, for more scenes in less time. Default: 0."),
    ] = None,
    grasps: Annotated[int | None, typer.Option(min=0, help="Logs of grasps. Default: 20.")] = None,
    first_seed: Annotated[
        int | None,
        typer.Option(min=0, help="Seed of the first log. Training data starts at 100000. Default: 100000."),
    ] = None,
    object_: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            help="Simulate this object (a name, or the path of its file), or a group: training-kinds, "
            "held-out-kinds. Repeatable. Default: all four, in turn.",
        ),
    ] = None,
    protocol: Annotated[
        str | None, typer.Option(help="shin2019: the paper's sets instead, in OUT/train and OUT/test.")
    ] = None,
    scale: Annotated[
        str | None,
        typer.Option(
            help="With --protocol: full (720 logs) or small (80: 0 and 30 degrees, one light).  "
            "Default: full."
        ),
    ] = None,
    instances: Annotated[
        str | None,
        typer.Option(
            help="With --protocol: same (one instance of each object and one rig in all sets, as in the paper) "
            "or redrawn (for each set). Default: same."
        ),
    ] = None,
    jobs: Jobs = CORES,
    ray: Ray = None,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Simulate logs of random touches, for training and evaluation. Continues if it was interrupted."""
    from gripper_force.jobs import paper_protocol
    from gripper_force.jobs import simulate as job

    plans: list[job.Plan]
    conflicts = [text for text in set_ or () if text.partition("=")[0] in ("object", "seed", "target_n")]
    _refuse(
        {f"--set {text}": text for text in conflicts},
        "can't be used: simulate chooses object, seed and target of each log; use --object or --first-seed",
    )
    if protocol is None:
        _refuse(
            {"--scale": scale, "--instances": instances},
            "can only be used with --protocol; add --protocol shin2019, or leave this out",
        )
        settings = load_settings(config, set_, {})
        counts: dict[job.Kind, int] = {
            "press": 200 if presses is None else presses,
            "tap": taps or 0,
            "grasp": 20 if grasps is None else grasps,
        }
        plans = [*_plans(counts, 100_000 if first_seed is None else first_seed, object_)]
    elif protocol == "shin2019":
        options = {
            "--presses": presses,
            "--taps": taps,
            "--grasps": grasps,
            "--first-seed": first_seed,
            "--object": object_,
        }
        _refuse(options, "can't be combined with --protocol, whose sets are fixed; omit one of them")
        settings = load_settings(config, [f"camera.rate_hz={paper_protocol.RATE_HZ}", *(set_ or [])], {})
        plans = list(paper_protocol.plan_protocol(scale or "full", instances or "same"))
    else:
        raise ConfigError(f"no protocol {protocol!r}; use shin2019")
    names = [name for p in plans for name in p.names]
    if not names:
        raise ConfigError("there is nothing to simulate; give --presses, --taps or --grasps a number above 0")
    count = 0
    with console.bar("simulating", len(names)) as progress:
        progress("", sum((folder / name).exists() for name in names))
        with closing(job.simulate(plans, folder, settings, jobs, ray)) as paths:
            for path in paths:
                count += 1
                progress(path.name)
    console.show({"logs": len(names), "made": count, "folder": str(folder)}, as_json)
    if protocol is None:
        console.next_step("train", folder, "--out", "force.safetensors")
    else:
        console.next_step("reproduce", "3", "--data", folder)


def _refuse(options: Mapping[str, object], problem: str) -> None:
    """Raises `ConfigError` if one of the options is given."""
    if names := [option for option, value in options.items() if value is not None]:
        raise ConfigError(f"{' and '.join(names)} {problem}")


def _plans(counts: "Mapping[Kind, int]", seed: int, names: list[str] | None) -> "Iterator[SimulationPlan]":
    """Yields the logs of each kind in turn, with the given objects and groups, or the paper's objects."""
    from gripper_force.jobs.grasp import PAPER_OBJECTS
    from gripper_force.jobs.simulate import plan
    from gripper_hw.sim.kinds import held_out_kinds, training_kinds

    groups = {"training-kinds": training_kinds, "held-out-kinds": held_out_kinds}
    objects: list[str] = []
    for name in names or PAPER_OBJECTS:
        objects += groups[name]() if name in groups else (name,)
    for kind, count in counts.items():
        yield from plan(kind, count, seed, tuple(objects))
        seed += count


def record(
    folder: Annotated[Path, typer.Option("--out", help="Folder for the logs.")] = Path("data/real"),
    object_: Annotated[str | None, typer.Option("--object", help="Object between the jaws.")] = None,
    sets: Annotated[int, typer.Option(min=1, help="Number of sets, including existing ones.")] = 15,
    touches: Annotated[int, typer.Option(min=1, help="Touches in each set.")] = 4,
    peak_n: Annotated[
        float | None,
        typer.Option(
            help="Peaks are random, from 1 N to this. Default: 12 N, or what the force limit permits."
        ),
    ] = None,
    degrees: Annotated[
        float | None,
        typer.Option(
            help="Angle of the press, noted in metadata and names; a simulated object is rotated by it."
        ),
    ] = None,
    lux: Annotated[
        float | None, typer.Option(help="Light level in lux, noted likewise; a simulated rig is lit with it.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the peaks, and of a simulated scene.")] = None,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Record sets of touches with servo, camera and load cell, for training and evaluation.

    The jaws open, rest, and press with random forces. Every fifth set goes into OUT/test, the others into
    OUT/train. At the end each set is summarised: frames, losses, forces, and the lag between camera and load
    cell. Existing sets are kept, so an interrupted recording continues.
    """
    from gripper_force.jobs.recording import record as job
    from gripper_force.jobs.recording.summary import summarise_recording

    options = {"object": object_, "seed": seed, "sim.yaw_deg": degrees, "sim.lux": lux}
    settings = load_settings(config, set_, options)
    plan = job.RecordingPlan(sets, touches, peak_n, degrees, lux)
    paths = plan.paths(settings, folder)
    with console.bar("recording", sets) as progress:
        if existing := sum(path.exists() for path in paths):
            console.err.print(f"{existing} of {sets} sets exist already and are kept")
        for path in job.record(settings, plan, folder, progress):
            progress(path.name)
    console.show(summarise_recording(paths), as_json, sets_table)
    recipe_options = () if sets > _MANY_SETS else ("--recipe", "few")
    console.next_step("train", folder / "train", *recipe_options, "--out", "force.safetensors")


@import_app.command("video")
def import_video(
    video: Annotated[Path, typer.Argument(help="Video, or a folder of recordings.")],
    forces: Annotated[
        Path | None, typer.Argument(help="CSV table with the columns frame, t_s and force_n.")
    ] = None,
    folder: Annotated[Path, typer.Option("--out", help="Folder for the logs.")] = Path("data/imported"),
    object_: Annotated[str | None, typer.Option("--object", help="Object in the recording.")] = None,
    align: Annotated[bool, typer.Option(help="Correct a certain lag between forces and images.")] = True,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Import a video and its load-cell table, or a folder of them. Reports spikes, tare and lag.

    Of a folder, existing logs are kept, so an interrupted import continues.
    """
    from gripper_force.jobs.imports import video as job

    region = load_settings(None, set_, {}).vision.region

    if video.is_dir():
        if forces is not None or object_ is not None:
            raise ConfigError(
                f"{video} is a folder, whose recordings have their own tables and names of objects; leave out "
                f"{'--object' if forces is None else forces}"
            )
        recordings = job.find_recordings(video)
        with console.bar("importing", len(recordings)) as progress:
            summaries = job.import_folder(video, folder, region=region, align=align, progress=progress)
        if kept := len(recordings) - len(summaries):
            console.err.print(f"{kept} of {len(recordings)} logs existed already and were kept")
    elif forces is None:
        if not video.exists():
            raise DataError(f"there is no {video}; name a video, or a folder of recordings")
        raise DataError(f"{video} needs its load-cell table; add it: import video CLIP.avi FORCES.csv")
    else:
        log = folder / f"{video.stem}.mcap"
        summaries = [job.import_video(video, forces, log, object_name=object_, region=region, align=align)]
    console.show({"logs": summaries}, as_json, lambda _: imports_table(summaries))
    console.next_step("evaluate", folder)


@import_app.command("database")
def import_database(
    database: Annotated[
        Path, typer.Argument(help="Folder with the folders <object>_<degrees>_<illumination>.")
    ],
    folder: Annotated[Path, typer.Option("--out", help="Folder for the logs.")] = Path("data/shin2019"),
    rate_hz: Annotated[
        float, typer.Option(help="Frame rate, from which the images' times are computed.")
    ] = 149.0,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Import the published database of Shin et al. 2019, one log per four touches. Reports damaged data.

    Continues if it was interrupted.
    """
    from gripper_force.jobs.imports.database import find_environments, import_environment

    settings = load_settings(None, set_, {"camera.rate_hz": rate_hz})
    environments, ignored = find_environments(database)
    rows = []
    with console.bar("importing", len(environments)) as progress:
        for path in environments:
            rows.append(
                import_environment(
                    path, folder, rate_hz=settings.camera.rate_hz, region=settings.vision.region
                )
            )
            progress(path.name)
    result = {"environments": rows, "ignored": ignored}
    console.show(result, as_json, lambda _: database_table(rows, ignored))
    console.next_step("evaluate", folder)
