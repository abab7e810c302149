"""The commands that calibrate."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gripper_force.cli import console
from gripper_force.cli.options import AsJson, ConfigPath, Overrides, load_settings
from gripper_force.cli.output.calibrate import object_table, rig_table
from gripper_force.errors import ConfigError

if TYPE_CHECKING:
    from gripper_force.config import Config

app = typer.Typer(no_args_is_help=True, help="Find out what this rig and its objects are like.")

RigPath = Annotated[
    Path, typer.Option("--rig", help="Rig profile to write; only what is calibrated is replaced in it.")
]


@app.command("load-cell")
def load_cell(
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
    from gripper_calibration.procedures import calibrate_load_cell as job

    if (mass_kg is None) == (force_n is None):
        raise ConfigError("say what is put on the load cell: --mass-kg or --force-n")
    weight_n = force_n if force_n is not None else (mass_kg or 0.0) * job.STANDARD_GRAVITY_M_S2
    settings = load_settings(config, set_, {})
    with console.err.status("reading") as status:
        result = job.calibrate(
            settings,
            weight_n,
            rig,
            ask=lambda what: _ask(what, yes, status),
            seconds=seconds,
            progress=lambda step, raw: status.update(f"{step}: {raw:.6g}"),
        )
    console.show(result, as_json, rig_table)


@app.command("servo")
def servo(
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
    from gripper_calibration.procedures import calibrate_servo as job

    settings = load_settings(config, set_, {})
    with console.err.status("moving") as status:
        result = job.calibrate(
            settings,
            [width / 1e3 for width in gauge_mm],
            rig,
            ask=lambda what: _ask(what, yes, status),
            progress=lambda step, force_n: status.update(f"{step}: {force_n:.1f} N"),
        )
    console.show(result, as_json, rig_table)


@app.command("camera")
def camera(
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
    from gripper_calibration.procedures import calibrate_camera as job

    settings = load_settings(config, set_, {"object": object_, "seed": seed})
    with console.err.status("looking") as status:
        result = job.calibrate(
            settings,
            rig,
            region=None if region is None else _region(region),
            exposures_us=exposure_us or job.EXPOSURES_US,
            touches=touches,
            progress=lambda step, force_n: status.update(f"{step}: {force_n:.1f} N"),
        )
    console.show(result, as_json, rig_table)


@app.command("object")
def object_(
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
    from gripper_calibration.procedures import calibrate_object as job
    from gripper_force.profiles.object_profile import user_folder

    settings = load_settings(config, set_, {"object": name, "seed": seed})
    if logs is None:
        paths = _touches(settings, touches, peak_n, folder or Path("data/touches") / name, pause)
    else:
        paths = [p for path in logs for p in (sorted(path.rglob("*.mcap")) if path.is_dir() else [path])]
    with console.bar("calibrating", len(paths) + 2) as advance:
        result = job.calibrate(settings, name, paths, out or user_folder() / f"{name}.yaml", advance)
    console.show(result, as_json, object_table)


def _touches(settings: "Config", touches: int, peak_n: float | None, folder: Path, pause: bool) -> list[Path]:
    from gripper_calibration.procedures import calibrate_object as job

    paths = []
    done: set[int] = set()
    with console.err.status("touching") as status:

        def ask(number: int) -> None:
            _ask(f"Put the object down for touch {number}", False, status)

        def tell(number: int, _touch: int, force_n: float) -> None:
            done.add(number)
            status.update(f"touch {number} of {touches}: {force_n:.1f} N")

        try:
            for path in job.touch(
                settings,
                touches,
                peak_n,
                folder,
                ask=ask if pause else lambda _: None,
                progress=tell,
            ):
                paths.append(path)
        except KeyboardInterrupt:
            if not paths:
                raise
            console.err.print(f"stopped after {len(paths)} of {touches} touches; calibrating on these")
    if kept := len(set(range(1, len(paths) + 1)) - done):
        console.err.print(f"{kept} of {touches} touches were there already, in {folder}")
    return paths


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
    if not sys.stdin.readline():  # the terminal was closed, or Ctrl-D
        raise ConfigError(f"no answer came to this: {what}; run it again, where Enter can be pressed")
    status.start()
