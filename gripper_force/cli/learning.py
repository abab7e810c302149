"""Commands for networks: `train`, `evaluate`, `export network` and `reproduce`."""

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import typer

from gripper_force.cli import console
from gripper_force.cli.options import CORES, AsJson, Jobs, Overrides, Ray, SummaryFolder, load_settings
from gripper_force.cli.output.paper import paper_tables
from gripper_force.cli.output.runs import errors_table
from gripper_force.errors import ConfigError
from gripper_force.plugins import require

if TYPE_CHECKING:
    from gripper_force.jobs.dataset import Clip
    from gripper_force.jobs.training.recipe import TrainConfig
    from gripper_force.vision.checkpoint import Checkpoint

ContactStarts = Annotated[
    bool,
    typer.Option(
        "--include-contact-starts",
        help="Also use logs that start in contact, whose first frames are no reference.",
    ),
]

_INCLUDE: Final = "; add --include-contact-starts to use them"


def train(
    data: Annotated[list[Path], typer.Argument(help="Folders with logs.")],
    checkpoint: Annotated[Path, typer.Option("--out", help="Checkpoint to write.")] = Path(
        "force.safetensors"
    ),
    recipe: Annotated[
        str,
        typer.Option(
            help="short_clips (this project's), shin2019 (the paper's), few (a Gaussian process), or touches (with "
            "--init, for a few touches of an object)."
        ),
    ] = "short_clips",
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Set one key of the recipe: key=value. Repeatable.")
    ] = None,
    hold_out: Annotated[
        list[str] | None, typer.Option(help="Object to exclude from training. Repeatable.")
    ] = None,
    validation: Annotated[
        Path | None,
        typer.Option(help="Logs to measure the checkpoint's error on. Default: sets held out of DATA."),
    ] = None,
    init: Annotated[
        str | None,
        typer.Option(help="Checkpoint to continue: its weights, and its keys where none are set."),
    ] = None,
    teacher: Annotated[
        str | None,
        typer.Option(help="Checkpoint whose estimates are learned beside the labels; see teacher_share."),
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option(
            help="Logs of an earlier training; they are mixed in, so that their objects are not forgotten."
        ),
    ] = None,
    resume: Annotated[bool, typer.Option(help="Continue an interrupted training.")] = False,
    include_contact_starts: ContactStarts = False,
    jobs: Jobs = CORES,
    as_json: AsJson = False,
) -> None:
    """Train the force network on logs; under `torchrun`, in several processes."""
    require("torch", "train")
    from gripper_force.jobs.training.recipe import continued
    from gripper_force.jobs.training.recipe import recipe as load_recipe
    from gripper_force.jobs.training.train import PROGRESS_STEPS, state_paths
    from gripper_force.jobs.training.train import train as job
    from gripper_force.runtime import process
    from gripper_force.vision.checkpoint import load_checkpoint
    from gripper_force.vision.checkpoint_writer import check_writable

    check_writable(checkpoint)
    settings = load_recipe(recipe, set_)
    initial = load_checkpoint(init) if init else None
    if initial is not None:
        settings = continued(settings, initial.header)
    states = state_paths(settings, checkpoint)
    old_states = _saved(states)
    if resume and not old_states:
        reason = f"there is no {states[0]}" if states else "a Gaussian process is fitted at once"
        raise ConfigError(
            f"no training was interrupted that --resume can continue: {reason}; leave out --resume"
        )
    quiet = os.environ.get("RANK", "0") != "0"  # only the first process of torchrun prints
    clips = _read_for_training(data, validation, replay, settings, jobs, quiet=quiet)
    clips = clips.without_objects(hold_out or [])
    left_out = 0
    if not include_contact_starts:
        count = clips.logs
        clips = clips.without_contact_starts(settings)
        left_out = count - clips.logs
        if not quiet:
            console.warn_of_contact_starts(left_out, count, _INCLUDE)
    warnings: list[str] = []
    try:
        with console.bar("training", PROGRESS_STEPS * max(1, len(states)), hidden=quiet) as progress:
            result = job(
                settings,
                clips.training,
                checkpoint,
                validation_clips=clips.validation if validation else None,
                init=initial,
                teacher=load_checkpoint(teacher) if teacher else None,
                replay_clips=clips.replayed,
                resume=resume,
                progress=progress,
                warn=warnings.append,
            )
    except BaseException as end:
        interrupted = isinstance(end, KeyboardInterrupt) or process.is_interrupted()
        if interrupted and not quiet and (resume or _saved(states) != old_states):
            console.err.print("the training was saved; add --resume to the same command to continue it")
        raise
    if not quiet:
        # A Gaussian process has no course of training.
        figure = checkpoint.with_suffix(".png") if states else None
        _show_trained(result, checkpoint, figure, left_out, warnings, as_json)


class _Clips(NamedTuple):
    """Recordings of a training."""

    training: "list[Clip]"
    validation: "list[Clip]"
    replayed: "list[Clip]"

    def without_objects(self, names: list[str]) -> "_Clips":
        """Returns the recordings without these objects, which stay in the validation."""
        objects = {clip.object for clip in (*self.training, *self.replayed)}
        if unknown := sorted(set(names) - objects):
            raise ConfigError(
                f"--hold-out: no log is of {', '.join(unknown)}; there are {', '.join(sorted(objects))}"
            )
        training, replayed = (
            [clip for clip in clips if clip.object not in names] for clips in (self.training, self.replayed)
        )
        return _Clips(training, self.validation, replayed)

    def without_contact_starts(self, settings: "TrainConfig") -> "_Clips":
        from gripper_force.jobs.dataset import without_contact_starts

        return _Clips(*(without_contact_starts(clips, settings.preprocess) for clips in self))

    @property
    def logs(self) -> int:
        return sum(map(len, self))


def _read_for_training(
    data: list[Path],
    validation: Path | None,
    replay: Path | None,
    settings: "TrainConfig",
    workers: int,
    *,
    quiet: bool,
) -> _Clips:
    """Reads the logs of a training. Raises `ConfigError` if it would be validated on what it learns."""
    from gripper_force.jobs.dataset import digest, find_logs, load_clips

    folders = [
        find_logs(paths) if paths else []
        for paths in (data, [validation] if validation else [], [replay] if replay else [])
    ]
    _refuse_learned([[path.resolve() for path in logs] for logs in folders], folders[1])
    with console.bar("reading logs", sum(map(len, folders)), hidden=quiet) as progress:
        clips = [
            load_clips(logs, settings.preprocess, workers=workers, progress=progress) if logs else []
            for logs in folders
        ]
    if validation is not None:  # a copy of a log has another path
        _refuse_learned([[digest([clip]) for clip in part] for part in clips], folders[1])
    return _Clips(*clips)


def _refuse_learned(keys: Sequence[Sequence[object]], validation: list[Path]) -> None:
    """Raises `ConfigError` if logs of the validation have keys of those to train on or to replay."""
    training, tested, replayed = keys
    learned = {*training, *replayed}
    if both := [path for key, path in zip(tested, validation, strict=True) if key in learned]:
        raise ConfigError(
            f"{len(both)} logs of --validation are among those to train on, such as {both[0]}; the error on them would "
            "say nothing: name other folders"
        )


def _show_trained(
    result: "Checkpoint",
    path: Path,
    figure: Path | None,
    left_out: int,
    warnings: list[str],
    as_json: bool,
) -> None:
    for text in warnings:
        console.warn(text)
    values = {"checkpoint": str(path), "digest": result.digest, **result.header.metrics}
    if figure is not None:
        values["figure"] = str(figure)
    console.show(
        {**values, "left_out": left_out, "warnings": warnings},
        as_json,
        lambda _: console.pairs({console.label(key): value for key, value in values.items()}),
    )
    console.next_step("evaluate", "FOLDER", "--checkpoint", path)


def _saved(states: list[Path]) -> list[tuple[Path, int]]:
    """Returns the existing states of a training, with their times."""
    return [(state, state.stat().st_mtime_ns) for state in states if state.exists()]


def evaluate(
    data: Annotated[Path, typer.Argument(help="Folder with logs that were not used for training.")],
    checkpoint: Annotated[str | None, typer.Option(help="Path of a checkpoint, or default or small.")] = None,
    profile: Annotated[
        str | None,
        typer.Option(help="Object profile, by name or path; own: the profile of each log's object."),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option("--object", help="Use only logs of this object. Repeatable.")
    ] = None,
    include_contact_starts: ContactStarts = False,
    plot: Annotated[
        Path | None, typer.Option(help="Figure to write: estimates and errors against the load cell.")
    ] = None,
    out: SummaryFolder = None,
    jobs: Jobs = CORES,
    ray: Ray = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Compare a checkpoint's estimates with the load cell, over all logs of a folder.

    Exit code 2 if a log could not be read; the others are evaluated.
    """
    from gripper_force.jobs.cpu import bfloat16_instructions
    from gripper_force.jobs.dataset import find_logs
    from gripper_force.jobs.evaluate import evaluate as job

    require("torch", "evaluate")
    settings = load_settings(None, set_, {"vision.checkpoint": checkpoint, "calibration.object": profile})
    logs = find_logs(data)
    console.tell_missing_parquet(out)
    if settings.vision.precision == "bfloat16" and not bfloat16_instructions():
        console.warn(
            "this CPU lists no instructions for bfloat16, so that it is slower than float32; leave vision.precision out"
        )
    with console.bar("evaluating", len(logs)) as progress:
        result = job(
            logs,
            settings.vision.checkpoint,
            objects=only or (),
            config=settings,
            include_contact_starts=include_contact_starts,
            workers=jobs,
            ray=ray,
            plot=plot,
            out=out,
            progress=progress,
        )
    console.warn_of_contact_starts(result.left_out, len(logs), _INCLUDE)
    console.warn_of_other_rig(result.other_rig)
    console.show(result, as_json, errors_table)
    if plot is not None:
        console.err.print(f"figure: {plot}", soft_wrap=True, markup=False)
    if out is not None:
        console.err.print(f"summary: {out / 'summary.html'}", soft_wrap=True, markup=False)
    if checkpoint is not None:
        console.next_step("grasp", "--set", f"vision.checkpoint={checkpoint}")
    console.end_with_failures(result.failed, len(logs))


def export_network(
    out: Annotated[Path, typer.Option("--out", help="File to write: .onnx, or .xml for OpenVINO.")],
    checkpoint: Annotated[
        str | None,
        typer.Argument(help="Path of a checkpoint, or default or small. Default: vision.checkpoint."),
    ] = None,
    int8: Annotated[
        Path | None,
        typer.Option(
            help="Quantise the convolutions to int8, calibrated on this folder of logs (.xml only)."
        ),
    ] = None,
    jobs: Jobs = CORES,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Export a network to ONNX or OpenVINO, and compare it with PyTorch."""
    from gripper_force.jobs.dataset import find_logs, load_clips
    from gripper_force.jobs.int8_export import check_int8_name, export_int8
    from gripper_force.vision.export import export as job
    from gripper_force.vision.header import EXPORTED
    from gripper_force.vision.model_files import read_model

    model = read_model(load_settings(None, set_, {"vision.checkpoint": checkpoint}).vision.checkpoint)
    frames = None
    if int8 is not None:
        check_int8_name(out)
        logs = find_logs(int8)
        with console.bar("reading logs", len(logs)) as progress:
            clips = load_clips(logs, model.header.preprocess, workers=jobs, progress=progress)
        frames = [clip.frames for clip in clips]
    with console.err.status("exporting"):
        errors = job(model, out) if frames is None else export_int8(model, out, frames)
    console.show(
        {"file": str(out), "digest": model.digest, "off_torch_n": errors},
        as_json,
        lambda _: console.pairs(
            {
                "file": str(out),
                "digest": model.digest,
                "difference from PyTorch": f"{errors['largest_n']:.2g} N at most, {errors['mean_n']:.2g} N on average",
            }
        ),
    )
    engine = EXPORTED[out.suffix]
    console.next_step("grasp", "--set", f"vision.checkpoint={out}", "--set", f"vision.engine={engine}")


def reproduce(
    what: Annotated[str, typer.Argument(help="3, 4, 5, 6, 7, 8, 9, fig6, fig7, fig8, fig9, claims or all.")],
    scale: Annotated[
        str, typer.Option(help="small (about five minutes per network on one core) or full (for a GPU).")
    ] = "small",
    instances: Annotated[
        str,
        typer.Option(
            help="same: one instance of each object and one rig in all sets, as in the paper; redrawn: others "
            "in each set."
        ),
    ] = "same",
    steps: Annotated[
        str | None,
        typer.Option(help="Steps of training; several lengths with commas. Default: 1100; 2000 at full."),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(help="Seeds with which each network is trained. Default: 3.")
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(help="Stop after this time, with the tables so far; run it again to continue.", min=0),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder with logs in train/ and test/. Default: simulated."),
    ] = None,
    folder: Annotated[
        Path,
        typer.Option("--out", help="Folder for the networks; existing ones are not trained again."),
    ] = Path("runs/paper"),
    write: Annotated[
        Path | None,
        typer.Option(help="Markdown page to write tables and figures into, such as docs/paper.md."),
    ] = None,
    jobs: Jobs = CORES,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Set one key of the scale: key=value. Repeatable.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Reproduce the paper's tables and figures, with its numbers. Continues an interrupted run."""
    import time

    require("torch", "reproduce")
    from gripper_force.jobs.training.recipe import section_from
    from gripper_force.qualification.markdown_blocks import write_between
    from gripper_force.qualification.paper import paper_page as page
    from gripper_force.qualification.paper.models import SCALES, Scale

    end_s = math.inf if minutes is None else time.monotonic() + 60 * minutes
    names = page.expand_name(what)
    if scale not in SCALES:
        raise ConfigError(f"no scale {scale!r}; choose from {', '.join(SCALES)}")
    options = [*(f"{k}={json.dumps(v)}" for k, v in SCALES[scale]), f"instances={instances}"]
    options += [] if seeds is None else [f"seeds={seeds}"]
    options += set_ or []
    lengths = [f"steps={text}" for text in steps.split(",")] if steps else []
    scales = [section_from(Scale, [*options, length]) for length in lengths] or [section_from(Scale, options)]
    pictures = _checked_pictures(folder, write)
    result = page.reproduce(names, scales, data, folder, jobs, console.bar_or_lines, end_s)
    figures = {}
    for name, figure in result.figures.items():
        if figure is not None:
            figures[name] = str(pictures / page.picture_name(scale, scales[0], name))
            figure.savefig(figures[name])
    if write is not None:
        for block, text in page.markdown(result, scale, scales[0], pictures.name).items():
            write_between(write, block, text)
    tables = [table for group in result.tables.values() for table in group]
    report = {
        "instances": scales[0].instances,
        "steps": [one.steps for one in scales],
        "seeds": scales[0].seeds,
        "tables": tables,
        "figures": figures,
        "missing": result.missing,
    }
    console.show(report, as_json, lambda _: paper_tables(tables, figures))
    if result.missing:
        console.warn(f"{result.missing}; run the same command again to continue")


def _checked_pictures(folder: Path, page: Path | None) -> Path:
    """Returns the folder of the figures. Raises `ConfigError` before the work if its results can't be written."""
    from gripper_force.jobs.summary_files import check_writable

    check_writable(folder)
    if page is None:
        return folder
    if not (page.is_file() and os.access(page, os.W_OK)):
        raise ConfigError(
            f"can't write the tables into {page}: it is no file that can be written; name a page that exists"
        )
    check_writable(pictures := page.with_suffix(""), "--write")
    return pictures
