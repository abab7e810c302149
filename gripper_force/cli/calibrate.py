"""The commands that calibrate a rig and objects."""

import math
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gripper_force.cli import console
from gripper_force.cli.options import (
    CORES,
    AsJson,
    ConfigPath,
    Jobs,
    NoOverrides,
    Overrides,
    config_options,
    load_settings,
    load_settings_before_rig,
)
from gripper_force.cli.output import calibrate as output
from gripper_force.errors import ConfigError
from gripper_force.plugins import require
from gripper_force.runtime import process

if TYPE_CHECKING:
    from gripper_calibration.procedures.calibrate_camera import CameraResult
    from gripper_calibration.procedures.calibrate_load_cell import LoadCellResult
    from gripper_calibration.procedures.calibrate_object import ObjectCalibration
    from gripper_calibration.procedures.calibrate_servo import ServoResult
    from gripper_calibration.procedures.teach import Taught
    from gripper_force.config import Config
    from gripper_force.profiles.object_profile import ObjectProfile

app = typer.Typer(
    no_args_is_help=True,
    help="Calibrate the gripper (jaws, load cell, servo, weight, camera), an object, or a network's claimed errors.",
)

RigPath = Annotated[
    Path | None,
    typer.Option(
        "--rig",
        help="Rig profile to write; only the calibrated section is replaced. Default: calibration.rig, or "
        "rig_profile.yaml.",
    ),
]
Fresh = Annotated[
    bool,
    typer.Option("--fresh", help="Move existing touches to a folder beside, and record all of them again."),
]
Pause = Annotated[
    bool, typer.Option("--pause", help="Wait for Enter before each touch, to place the object again.")
]
PeakN = Annotated[
    float | None,
    typer.Option(help="Largest force of a touch in newtons. Default: 12 N, or what the force limit permits."),
]
TouchSeed = Annotated[int | None, typer.Option(help="Seed of the touches, and of a simulated scene.")]


@app.command("load-cell")
def load_cell(
    mass_kg: Annotated[float | None, typer.Option(help="Known mass to put on the load cell.")] = None,
    force_n: Annotated[float | None, typer.Option(help="Its weight in newtons, instead of the mass.")] = None,
    rig: RigPath = None,
    seconds: Annotated[
        float, typer.Option(min=1, max=3600, help="Duration of the readings of each load.")
    ] = 10.0,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for Enter: continue when the reading is at rest.")
    ] = False,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate a load cell's tare and scale with a known mass: empty, loaded, empty again."""
    from gripper_calibration.procedures import calibrate_load_cell as job
    from gripper_force.types import STANDARD_GRAVITY_M_S2

    if (mass_kg is None) == (force_n is None):
        raise ConfigError("pass the load that is put on the load cell: either --mass-kg or --force-n")
    weight_n = force_n if force_n is not None else (mass_kg or 0.0) * STANDARD_GRAVITY_M_S2
    settings, path = _rig_settings(config, set_, {}, rig)
    with console.err.status("reading") as status:
        result = job.calibrate_load_cell(
            settings,
            weight_n,
            path,
            prompt=console.prompt(yes, status),
            seconds=seconds,
            progress=console.status_text(status),
        )
    _show_rig(result, output.LOAD_CELL, as_json)
    _next_step(["calibrate", "servo", "--gauge-mm", "MM"], config, set_, path)


@app.command("jaws")
def jaws(
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for Enter: the jaws are empty and open.")
    ] = False,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Find the ends, the closing direction and the friction of empty jaws, and propose the configuration."""
    from gripper_calibration.procedures.calibrate_jaws import calibrate_jaws as job

    settings, _ = load_settings_before_rig(config, set_, {})
    with console.err.status("moving") as status:
        result = job(settings, prompt=console.prompt(yes, status), progress=console.status_text(status))
    console.show(result, as_json, output.jaws_table)
    if settings.load_cell.backend == "none":
        words = ["grasp"]
    elif settings.load_cell.backend == "simulated":  # needs no calibration
        words = ["calibrate", "servo", "--gauge-mm", "30", "--set", "object=block"]
    else:
        words = ["calibrate", "load-cell", "--mass-kg", "KG"]
    _next_step(words, config, set_)


@app.command("servo")
def servo(
    gauge_mm: Annotated[
        list[float],
        typer.Option(
            help="Width of the load cell between the jaws. A second width also gives the pinion's radius."
        ),
    ],
    rig: RigPath = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for Enter: the load cell is in place.")
    ] = False,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate a servo's torque, friction and jaw geometry by pressing the load cell."""
    from gripper_calibration.procedures import calibrate_servo as job

    settings, path = _rig_settings(config, set_, {}, rig)
    with console.err.status("moving") as status:
        result = job.calibrate_servo(
            settings,
            [width / 1e3 for width in gauge_mm],
            path,
            prompt=console.prompt(yes, status),
            progress=console.status_text(status),
        )
    _show_rig(result, output.SERVO, as_json)
    if (text := result.width_remark) is not None:
        console.warn(text)
    words = (
        ["calibrate", "camera", "--object", "NAME"] if settings.uses_vision else ["grasp", "--object", "NAME"]
    )
    _next_step(words, config, set_, path)


@app.command("weight")
def weight(
    mass_kg: Annotated[float, typer.Option(help="Known mass to hang from one jaw.")],
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for Enter: only with a simulated gripper.")
    ] = False,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure a servo's torque constant without a load cell: the jaws balance a known mass."""
    from gripper_calibration.procedures import calibrate_weight as job

    settings, _ = load_settings_before_rig(config, set_, {})
    if yes and not job.is_servo_simulated(settings):
        raise ConfigError(
            "calibrate weight needs a person who turns the gripper and hangs up the mass; leave out --yes"
        )
    with console.err.status("moving") as status:
        result = job.calibrate_weight(
            settings, mass_kg, prompt=console.prompt(yes, status), progress=console.status_text(status)
        )
    console.show(
        console.jsonable(result) | {"settings": result.settings},
        as_json,
        lambda _: output.weight_table(result),
    )
    if abs(result.ratio - 1) > 0.1:
        console.warn(
            f"the torque constant is {100 * (result.ratio - 1):+.0f} % off the configured one, more than motors of one "
            "model differ; check the mass"
        )
    if result.friction_n is None:
        console.warn(
            f"gripper.friction_n contradicts the breakaway friction of {result.breakaway_n:.2f} N; measure it with "
            "`calibrate jaws`"
        )
    overrides = [f"gripper.{key}={value:.4g}" for key, value in result.settings.items()]
    _next_step(["grasp"], config, [*(set_ or []), *overrides])


@app.command("camera")
def camera(
    rig: RigPath = None,
    region: Annotated[
        str | None,
        typer.Option(help="Region of interest of the frame: left,top,width,height. Default: by markers."),
    ] = None,
    exposure_us: Annotated[
        list[int] | None,
        typer.Option(
            min=1,
            help="Candidate exposure. Repeatable. Default: 500 to 16000, or automatic with camera.exposure_us=null.",
        ),
    ] = None,
    touches: Annotated[int, typer.Option(min=3, help="Number of touches.")] = 10,
    object_: Annotated[str | None, typer.Option("--object", help="Object between the jaws.")] = None,
    seed: TouchSeed = None,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate a camera's region of interest, exposure and lag by touching a compliant object."""
    from gripper_calibration.procedures import calibrate_camera as job

    settings, path = _rig_settings(config, set_, {"object": object_, "seed": seed}, rig)
    with console.err.status("capturing") as status:
        result = job.calibrate_camera(
            settings,
            path,
            region=None if region is None else _region(region),
            exposures_us=exposure_us,
            touches=touches,
            progress=console.status_text(status),
        )
    for text in result.outdated:
        console.warn(
            f"the camera is now another one than that of {text}; teach or calibrate the object again"
        )
    _show_rig(result, output.CAMERA, as_json)
    seeds = [] if seed is None else ["--seed", str(seed)]
    _next_step(["calibrate", "object", "NAME", *seeds], config, set_, path)


@app.command("object")
def object_(
    name: Annotated[str, typer.Argument(help="Name of the object, or the file of a simulated one.")],
    touches: Annotated[int | None, typer.Option(min=1, help="Number of touches. Default: 8.")] = None,
    peak_n: PeakN = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option("--from", help="Calibrate with these logs, or folders of them, without the devices."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the touches' logs; existing ones are not repeated. Default: data/touches/NAME."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Profile to write. Default: NAME.yaml in your folder of profiles.")
    ] = None,
    fresh: Fresh = False,
    pause: Pause = False,
    config: ConfigPath = None,
    seed: TouchSeed = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate an object by touching it with the load cell in place. Ctrl-C uses the touches so far."""
    require("scipy", "calibrate object")
    from gripper_calibration.fits.interval_fit import MIN_TOUCHES
    from gripper_calibration.procedures import calibrate_object as job
    from gripper_force.jobs.dataset import find_logs
    from gripper_force.profiles.object_profile import find_object

    if logs is not None:
        _refuse_recording(touches=touches, peak_n=peak_n, folder=folder, fresh=fresh, pause=pause)
    touches = touches or job.TOUCHES
    settings = load_settings(config, set_, {"object": name, "seed": seed})
    argument, name = name, settings.object  # a path has become a name
    folder = folder or job.default_folder(name)
    prepared = job.prepare(settings, name, out)
    if logs is None:
        _tell_existing(settings, touches, folder, fresh)
        logs = _touches(settings, touches, peak_n, folder, pause=pause, may_stop=True)
    else:
        logs = find_logs(logs)
        _tell_other_objects(name, logs)
    with console.bar("calibrating", len(logs) + 2) as progress:
        result = job.fit_and_write(prepared, logs, progress)
    _tell_left_out(result)
    if result.mae_after_n is None:
        console.err.print(
            f"a test of the correction on touches outside its fit needs at least {MIN_TOUCHES} touches; "
            f"{job.TOUCHES} are recommended",
            soft_wrap=True,
        )
    if out is None and (path := find_object(name)) != result.profile_path:
        console.warn(
            f"runs use the bundle {path.parent} instead, which `teach` made; pass --profile {result.profile_path} to "
            "use this profile, or delete the bundle"
        )
    console.show(result.as_dict(), as_json, lambda _: output.object_table(result))
    profile = name if out is None and find_object(name) == result.profile_path else result.profile_path
    words = [
        "grasp",
        "--object",
        argument,
        "--profile",
        str(profile),
        *_safe_target(result.profile),
        *([] if seed is None else ["--seed", str(seed)]),
    ]
    _next_step(words, config, set_)


@app.command("network")
def network(
    data: Annotated[Path, typer.Argument(help="Folder with logs that were not used for training.")],
    out: Annotated[Path, typer.Option("--out", help="Checkpoint to write; it may be the same file.")],
    checkpoint: Annotated[str, typer.Option(help="Path of a checkpoint, or default or small.")] = "default",
    jobs: Jobs = CORES,
    set_: NoOverrides = None,
    as_json: AsJson = False,
) -> None:
    """Fit a network's out-of-distribution score, known views and claimed errors to logs of what it knows."""
    require("torch", "calibrate network")
    from gripper_force.jobs.dataset import find_logs
    from gripper_force.jobs.training.ood_fit import UNKNOWN_FACTOR, calibrate_network

    logs = find_logs(data)
    with console.bar("calibrating", 2 * len(logs)) as progress:
        model, views, left_out = calibrate_network(logs, out, checkpoint, workers=jobs, progress=progress)
    console.warn_of_contact_starts(left_out, len(logs))
    if (factor := math.hypot(model.std_base, model.std_growth)) > UNKNOWN_FACTOR:
        console.warn(
            f"the errors on these logs are up to {factor:.1f} times what the network claimed: it does not know what "
            f"they show, and {out} accepts it now; teach the object, or train with --init"
        )
    values = model.model_dump(mode="json", exclude={"mean", "axes"})
    limit = None if views is None else views.limit
    result = {"checkpoint": str(out), **values, "view_limit": limit, "left_out": left_out}
    console.show(result, as_json, lambda _: output.network_table(str(out), model, views))
    console.next_step("evaluate", data, "--checkpoint", out)


@app.command("gain")
def gain(
    name: Annotated[str, typer.Argument(help="Object profile to add the object's gain to, by name or path.")],
    logs: Annotated[
        list[Path],
        typer.Option("--from", help="Log of grasps of this object, or a folder of them. Repeatable."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Profile to write. Default: the profile in the bundle, otherwise NAME.yaml in your folder of profiles."
        ),
    ] = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Save an object's gain, as earlier grasps have shown it, into its object profile."""
    from gripper_force.jobs.dataset import find_logs
    from gripper_force.jobs.object_gain import save_gain
    from gripper_force.profiles.object_profile import find_object, read_object

    paths = find_logs(logs)
    _tell_other_objects(read_object(find_object(name)).object, paths)
    result = save_gain(name, paths, out, set_)
    console.show(result, as_json, output.gain_table)
    target = _safe_target(read_object(result.profile))
    console.next_step("grasp", "--object", result.object, "--profile", out or name, *target)


def teach(
    name: Annotated[
        str,
        typer.Argument(
            help="Name of the object; in simulation one of the known objects, or a file of your own."
        ),
    ],
    touches: Annotated[
        int | None, typer.Option(min=4, help="Number of touches, with those of earlier calls. Default: 16.")
    ] = None,
    peak_n: PeakN = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option("--from", help="Teach with these logs, or folders of them, without the devices."),
    ] = None,
    replay: Annotated[
        list[Path] | None,
        typer.Option(
            help="Logs of an earlier training; they are mixed in, so that their objects are not forgotten."
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the touches and of the work so far; nothing in it is repeated. Default: "
            "data/touches/NAME."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the bundle. Default: NAME in your folder of profiles.")
    ] = None,
    fresh: Fresh = False,
    pause: Pause = False,
    jobs: Jobs = CORES,
    config: ConfigPath = None,
    seed: TouchSeed = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Teach an object: touch it, train and calibrate the best estimator for it, and make `grasp` use it."""
    import time

    require("torch", "teach")
    from gripper_calibration.procedures import calibrate_object
    from gripper_calibration.procedures import teach as job
    from gripper_force.jobs.dataset import find_logs
    from gripper_force.profiles.object_profile import user_folder

    if logs is not None:
        _refuse_recording(touches=touches, peak_n=peak_n, fresh=fresh, pause=pause)
    touches = touches or job.TOUCHES
    settings = load_settings(config, set_, {"object": name, "seed": seed})
    argument, name = name, settings.object  # a path has become a name
    folder = folder or calibrate_object.default_folder(name)
    job.check_before_touches(settings, name, out or user_folder() / name)
    begin_s = time.monotonic()
    try:
        if logs is None:
            _tell_existing(settings, touches, folder, fresh)
            logs = _touches(settings, touches, peak_n, folder, pause=pause, may_stop=False)
        else:
            logs = find_logs(logs)
            _tell_other_objects(name, logs)
        with console.bar_or_lines("teaching", job.STEPS) as progress:
            result = job.teach(
                settings,
                name,
                logs=logs,
                folder=folder,
                out=out,
                replay=replay or (),
                workers=jobs,
                progress=progress,
            )
    except KeyboardInterrupt:
        console.tell_resumable(f"what was done until now is in {folder}", fresh=fresh)
        raise
    _tell_left_out(result)
    row = console.jsonable(result) | {"minutes": (time.monotonic() - begin_s) / 60}
    console.show(row, as_json, lambda _: output.taught_table(result, row["minutes"]))
    if result.more_touches_help:
        console.err.print(
            f"more touches would reduce the error further: --touches {2 * len(result.profile.logs)} adds to these",
            soft_wrap=True,
        )
    words = ["grasp", "--object", argument, *_safe_target(result.profile)]
    words += [] if out is None else ["--profile", str(out.absolute())]
    words += [] if seed is None else ["--seed", str(seed)]
    # With another network than the default one a grasp would not use the bundle's.
    overrides = [override for override in set_ or [] if not override.startswith("vision.checkpoint=")]
    if config is not None and load_settings(config, overrides, {}).vision.checkpoint != "default":
        overrides.append("vision.checkpoint=default")
    console.next_step(*words, *config_options(config, overrides))


def _refuse_recording(**options: object) -> None:
    """Raises `ConfigError` if one of the options of a recording of touches is given."""
    if names := [name for name, value in options.items() if value not in (None, False)]:
        name = names[0].replace("_", "-")
        raise ConfigError(f"--{name} is for recording touches and --from records none; leave out one of them")


def _safe_target(profile: "ObjectProfile") -> list[str]:
    """Returns the option with a target well within the forces of a profile: grasps refuse one beyond its largest."""
    return ["--target-n", f"{min(4.0, round(profile.force_n / 2, 1)):g}"]


def _tell_existing(settings: "Config", touches: int, folder: Path, fresh: bool) -> None:
    """Names the touches that are used again, or with ``fresh`` moves them away."""
    from gripper_calibration.procedures import calibrate_object as job

    if fresh:
        if (moved := job.move_away(settings, folder)) is not None:
            console.err.print(f"the earlier touches are now in {moved}", soft_wrap=True, markup=False)
        return
    paths = job.touch_paths(settings, touches, folder)
    if existing := [str(number) for number, path in enumerate(paths, 1) if path.exists()]:
        console.err.print(
            f"{len(existing)} of {touches} touches exist already in {folder} and are used: number "
            f"{', '.join(existing)}; --fresh records all of them again",
            soft_wrap=True,
            markup=False,
        )


def _tell_left_out(result: "ObjectCalibration | Taught") -> None:
    for reason, paths in (
        ("without contact", result.without_contact),
        ("starting in contact", result.contact_starts),
    ):
        if paths:
            console.warn(f"left out {len(paths)} logs {reason}: {', '.join(path.name for path in paths)}")


def _tell_other_objects(name: str, logs: Sequence[Path]) -> None:
    from gripper_force.config import config_from_text
    from gripper_force.runtime.log_reader import LogReader

    other_objects = {config_from_text(LogReader(path).config, str(path)).object for path in logs} - {name}
    if other_objects:
        console.warn(f"there are logs of {', '.join(sorted(other_objects))} among those for {name}")


def _touches(
    settings: "Config", touches: int, peak_n: float | None, folder: Path, *, pause: bool, may_stop: bool
) -> list[Path]:
    """Records touches and returns their logs; with ``may_stop`` Ctrl-C ends only them, and those so far are used."""
    from gripper_calibration.procedures import calibrate_object as job

    paths: list[Path] = []
    with console.bar("touching", touches) as progress:
        prompt = console.prompt(False, progress, "leave out --pause") if pause else None
        try:
            for path in job.record_touches(
                settings, touches, peak_n, folder, prompt=prompt, progress=progress
            ):
                paths.append(path)
                progress(path.name)
        except KeyboardInterrupt:
            if not (may_stop and paths) or process.interrupt_exit_code() != 128 + signal.SIGINT:
                raise  # SIGTERM and a lost terminal end the command, Ctrl-C only the touches
            console.err.print(f"stopped after {len(paths)} of {touches} touches; calibrating with these")
    return paths


def _rig_settings(
    config: Path | None, set_: list[str] | None, options: Mapping[str, object], rig: Path | None
) -> "tuple[Config, Path]":
    """Loads the configuration of a command that writes a rig profile, which need not exist yet.

    Returns:
        The configuration, and the rig profile to write.
    """
    from gripper_force.profiles.rig_profile import read_rig

    settings, new_rig = load_settings_before_rig(config, set_, options)
    if new_rig is not None and rig is not None and rig.resolve() != new_rig.resolve():
        read_rig(new_rig)  # raises: this command does not write it
    return settings, rig or new_rig or settings.calibration.rig or Path("rig_profile.yaml")


def _next_step(
    words: list[str], config: Path | None, set_: list[str] | None, rig: Path | None = None
) -> None:
    """Prints the step that follows, with the same configuration except the object, and the written rig profile."""
    omitted = ("object=", *([] if rig is None else ["calibration.rig="]))
    keys = [key for key in set_ or [] if not key.startswith(omitted)]
    if rig is not None:
        keys.append(f"calibration.rig={rig}")
    console.next_step(*words, *config_options(config, keys))


def _show_rig(
    result: "LoadCellResult | ServoResult | CameraResult", names: Mapping[str, str], as_json: bool
) -> None:
    """Shows the calibrated section of the rig profile and what else was measured, as one level of keys."""
    values = console.jsonable(result)
    row = values.pop("calibration") | values
    console.show(row, as_json, lambda _: output.rig_table(row, names))


def _region(text: str) -> tuple[int, int, int, int]:
    try:
        left, top, width, height = (int(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--region needs left,top,width,height in pixels, got {text!r}") from None
    return left, top, width, height
