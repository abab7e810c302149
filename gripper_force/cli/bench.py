"""The `bench` commands: speed, memory and error of parts of the product on this machine."""

import os
from collections.abc import Callable, Mapping
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
    Page,
    load_settings,
)
from gripper_force.cli.output.bench import (
    bus_table,
    checkpoints_table,
    commands_table,
    estimator_table,
    gain_table,
    loop_table,
    recognition_table,
    scene_table,
    startup_table,
    training_table,
)
from gripper_force.cli.viewing import ViewCommand
from gripper_force.errors import ConfigError

if TYPE_CHECKING:
    from gripper_force.config import Config
    from gripper_force.jobs.dataset import Clip
    from gripper_force.vision.preprocess import Preprocess

app = typer.Typer(no_args_is_help=True, help="Measure speed, memory and error on this machine.")

Folder = Annotated[Path, typer.Option("--out", help="Folder for the results.")]


@app.command("estimator")
def estimator(
    data: Annotated[
        Path | None,
        typer.Option(help="Held-out logs to measure the error on, with --scale-on. Default: simulated."),
    ] = None,
    scale_on: Annotated[
        Path | None, typer.Option(help="Other logs to calibrate int8 on, with --data. Default: simulated.")
    ] = None,
    checkpoints: Annotated[
        list[str] | None,
        typer.Option("--checkpoint", help="Checkpoint, by path or name. Repeatable. Default: all shipped."),
    ] = None,
    threads: Annotated[
        list[int] | None, typer.Option(min=1, help="CPU threads. Repeatable. Default: one, and all cores.")
    ] = None,
    write: Page = None,
    folder: Folder = Path("runs/bench"),
    jobs: Jobs = CORES,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure speed and error of the visual estimate by network, engine, precision and threads.

    The configuration applies to the logs that are simulated without --data.
    """
    from tempfile import TemporaryDirectory

    from gripper_force.qualification.bench import estimator_bench
    from gripper_force.qualification.markdown_blocks import write_between
    from gripper_force.vision.header import SHIPPED
    from gripper_force.vision.model_files import read_model

    if (data is None) != (scale_on is None):
        raise ConfigError(
            "--data and --scale-on go together, as int8 is calibrated on other logs than it is tested on; "
            "give both or neither"
        )
    if data is not None and (config is not None or set_):
        raise ConfigError("--config and --set apply to simulated logs only; leave them out with --data")
    settings = load_settings(config, set_, {})
    sources, counts = checkpoints or list(SHIPPED), threads or sorted({1, CORES})
    for source in sources:
        read_model(source)  # a wrong name ends the command before its simulation
    with TemporaryDirectory() as name:
        if data is None or scale_on is None:
            data, scale_on = _simulate_presses(Path(name), settings, jobs)
        with console.bar_or_lines("measuring", estimator_bench.count_steps(sources, counts)) as progress:
            rows = estimator_bench.bench(
                sources,
                lambda model: _load(data, jobs, model.header.preprocess),
                lambda model: _load(scale_on, jobs, model.header.preprocess),
                counts,
                progress,
            )
    plot = folder / "estimator.png" if write is None else write.with_suffix(".png")
    file = folder / "estimator.json"
    estimator_bench.write_json(file, rows)
    estimator_bench.draw(plot, rows)
    if write is not None:
        write_between(write, "estimator", estimator_bench.markdown(rows))
    ratios = estimator_bench.ratios(rows)
    result = {"estimator": rows, "ratios": ratios, "plot": plot, "file": file}
    _show(result, as_json, lambda: estimator_table(rows, ratios, plot, file))


def _load(data: Path, workers: int, preprocess: "Preprocess") -> "list[Clip]":
    """Loads the logs of a folder that do not start in contact, as `train` and `evaluate` do."""
    from gripper_force.jobs.dataset import load_clips, without_contact_starts

    return without_contact_starts(load_clips(data, preprocess, workers=workers), preprocess)


def _simulate_presses(folder: Path, settings: "Config", workers: int) -> tuple[Path, Path]:
    """Simulates the logs to measure the error on, and those to calibrate int8 on. Returns their folders."""
    from gripper_force.jobs.simulate import plan, simulate

    data, scale_on = folder / "data", folder / "scale"
    jobs = ((data, plan("press", 12, 900_000)), (scale_on, plan("press", 8, 100_000)))
    with console.bar("simulating", sum(len(plans) for _, plans in jobs)) as progress:
        for logs, plans in jobs:
            for path in simulate(plans, logs, settings, workers):
                progress(path.name)
    return data, scale_on


@app.command("gain")
def gain(
    objects: Annotated[
        list[str] | None,
        typer.Option("--object", help="Kind of object. Repeatable. Default: the four paper objects."),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Objects of each kind.")] = 1,
    grasps: Annotated[
        int, typer.Option(min=1, help="Grasps of each object, from which its gain is learned.")
    ] = 3,
    presses: Annotated[
        int, typer.Option(min=1, help="Presses of each object, on which the error is measured.")
    ] = 2,
    folder: Folder = Path("runs/gain"),
    config: ConfigPath = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the first object.")] = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure the error of vision on single simulated objects, without and with the object's gain from grasps."""
    from gripper_force.jobs.grasp import PAPER_OBJECTS
    from gripper_force.qualification.bench import gain_bench

    settings = load_settings(config, set_, {"seed": seed})
    kinds = objects or list(PAPER_OBJECTS)
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    with console.bar("grasping", rounds * len(kinds) * (grasps + presses)) as progress:
        running = gain_bench.bench(
            settings,
            kinds,
            rounds=rounds,
            grasps=grasps,
            presses=presses,
            folder=folder,
            progress=progress,
        )
        for row in running:
            rows.append(row)
            console.line(f"{row.object}: {row.mae_n:.3f} N, with the gain {row.learned_n:.3f} N")
    _show({"objects": rows}, as_json, lambda: gain_table(rows))


@app.command("teach")
def teach(
    rigs: Annotated[
        list[Path] | None,
        typer.Option("--rig", help="Configuration file of a rig. Repeatable. Default: six drawn rigs."),
    ] = None,
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="Object. Repeatable. Default: the held-out kinds.")
    ] = None,
    touches: Annotated[
        list[int] | None,
        typer.Option(min=4, help="Number of touches. Repeatable. Default: 4, 8, 16 and 32."),
    ] = None,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--method", help="shipped, calibrated, taught or from scratch. Repeatable. Default: all."
        ),
    ] = None,
    drawn: Annotated[int, typer.Option(min=1, help="Number of drawn rigs, without --rig.")] = 6,
    grasps: Annotated[int, typer.Option(min=0, help="Grasps of each cell with each feedback.")] = 6,
    recordings: Annotated[
        Path | None,
        typer.Option(help="Folder of real recordings instead: each object is left out, then taught."),
    ] = None,
    write: Page = None,
    folder: Folder = Path("runs/teach"),
    jobs: Jobs = CORES,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure what teaching gains on foreign rigs and unknown objects. Continues if interrupted."""
    from gripper_force.qualification.bench import teach_bench as job
    from gripper_force.qualification.markdown_blocks import write_between
    from gripper_hw.sim.kinds import held_out_kinds

    if unknown := sorted(set(methods or ()) - set(job.METHODS)):
        raise ConfigError(f"no method {unknown[0]!r}; use one of {', '.join(job.METHODS)}")
    rows: list[job.Cell] = []
    real: list[job.RecordingRow] = []
    if recordings is not None:
        with console.err.status("teaching") as status:
            for recording in job.bench_recordings(recordings, folder, console.status_text(status)):
                real.append(recording)
                console.line(f"{recording.object}, {recording.trials} trials: {recording.taught_n:.2f} N")
        text = job.recordings_markdown(real)
    else:
        settings = load_settings(None, set_, {})
        rig_list = job.read_rigs(rigs, set_) if rigs else job.foreign_rigs(settings, drawn)
        counts, method_list = touches or job.COUNTS, methods or job.METHODS
        cells = job.list_cells(rig_list, objects or held_out_kinds(), counts, method_list)
        with console.bar("teaching", len(cells)) as progress:
            running = job.bench(
                cells,
                grasps=grasps,
                folder=folder,
                workers=jobs,
                progress=lambda text, steps=1: progress(text, 0),
            )
            for cell in running:
                rows.append(cell)
                error = cell.problem or f"{cell.mae_n:.3f} N"
                console.line(f"{cell.rig}, {cell.object}, {cell.method}, {cell.touches} touches: {error}")
                progress("")
        text = job.markdown(rows)
    if write is not None:
        write_between(write, "teach" if recordings is None else "teach recordings", text)
    report = {"cells": rows} if recordings is None else {"recordings": [row._asdict() for row in real]}
    _show(report, as_json, lambda: console.out.print(text, soft_wrap=True))


@app.command("bus")
def bus(
    cycles: Annotated[int, typer.Option(min=1, help="Cycles of each client at each setting.")] = 1000,
    set_: NoOverrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure a cycle of the servo bus: the driver alone and beside an arm, a plain SDK loop, bare bytes."""
    from gripper_force.qualification.bench import bus_bench

    costs: list[bus_bench.BusCost] = []
    with console.bar("measuring", len(bus_bench.BUS_SETTINGS)) as progress:
        for setting in bus_bench.bus(cycles):
            costs += setting
            progress(f"{setting[0].baud_rate} baud, {setting[0].latency_ms:g} ms")
    _show({"bus": costs}, as_json, lambda: bus_table(costs))


@app.command("loop", cls=ViewCommand)
def loop(
    seconds: Annotated[
        float, typer.Option(min=1.0, max=1e9, help="Duration with inference, and again without it.")
    ] = 30.0,
    view: Annotated[
        str | None,
        typer.Option(help="Measure also with a viewer: rerun (also without a value) or foxglove."),
    ] = None,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure the control loop in real time, with and without inference in parallel."""
    from gripper_force.qualification.bench import loop_bench

    with console.err.status(f"running for {(2 if view is None else 3) * seconds:g} s"):
        costs, log = loop_bench.loop(seconds, set_ or [], config, view)
    _show({"loop": costs, "log": log}, as_json, lambda: loop_table(costs, log))


@app.command("replay")
def replay(
    logs: Annotated[Path | None, typer.Option(help="Folder with logs. Default: simulated presses.")] = None,
    presses: Annotated[int, typer.Option(min=1, help="Simulated presses, without --logs.")] = 24,
    checkpoints: Annotated[
        list[str] | None,
        typer.Option(
            "--checkpoint", help="Checkpoint, by path or name. Repeatable. Default: default and small."
        ),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds; each one measures every row once.")] = 2,
    jobs: Jobs = CORES,
    write: Page = None,
    set_: NoOverrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure how fast many logs are replayed and evaluated: in one process, in several, and on a Ray cluster."""
    from tempfile import TemporaryDirectory

    from gripper_force.config import load_config
    from gripper_force.jobs.dataset import find_logs
    from gripper_force.jobs.simulate import plan, simulate
    from gripper_force.qualification.bench import replay_bench
    from gripper_force.qualification.markdown_blocks import write_between

    load = os.getloadavg()[0]
    with TemporaryDirectory() as name:
        if logs is None:
            logs = Path(name) / "logs"
            with console.bar("simulating", presses) as progress:
                for path in simulate(plan("press", presses, 900_000), logs, load_config(None, None), jobs):
                    progress(path.name)
        count = len(find_logs(logs))
        rows = replay_bench.bench(logs, checkpoints or ["default", "small"], jobs, rounds, console.line)
    rounds_text = "one round" if rounds == 1 else f"median of {rounds} rounds"
    about = f"{count} logs, {rounds_text}, {CORES} cores, load {load:.1f} before the first command."
    text = replay_bench.markdown(rows, about)
    if write is not None:
        write_between(write, "rates", text)
    _show({"replay": rows}, as_json, lambda: console.out.print(text, soft_wrap=True))


@app.command("recognition")
def recognition(
    presses: Annotated[int, typer.Option(min=1, help="Simulated presses of each row.")] = 8,
    write: Page = None,
    folder: Folder = Path("runs/recognition"),
    jobs: Jobs = CORES,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure which unknown objects, views and disturbances a network recognises. Continues if interrupted."""
    from gripper_force.qualification import recognition as job
    from gripper_force.qualification.markdown_blocks import write_between

    settings = load_settings(config, set_, {})
    with console.bar("recognition", presses * len(job.ROWS)) as progress:
        rows = job.measure(settings, folder, presses, jobs, progress)
    if write is not None:
        write_between(write, "recognition", job.markdown(rows))
    console.show({"rows": rows}, as_json, lambda _: recognition_table(rows))


@app.command("startup")
def startup(set_: NoOverrides = None, as_json: AsJson = False) -> None:
    """Measure the time and memory of each kind of scene up to its first control cycle."""
    from gripper_force.qualification.bench import startup_bench

    rows: list[startup_bench.Start] = []
    with console.bar("starting", len(startup_bench.STARTUP_CASES)) as progress:
        for row in startup_bench.startup(startup_bench.STARTUP_CASES):
            rows.append(row)
            progress(row.scene)
    _show({"startup": rows}, as_json, lambda: startup_table(rows))


@app.command("scene")
def scene(
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="Only this object. Repeatable. Default: all.")
    ] = None,
    write: Page = None,
    set_: NoOverrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure speed and error of each sim.detail level; with --write also update the table of auto."""
    from gripper_force.qualification.bench import scene_bench
    from gripper_force.qualification.markdown_blocks import write_between

    if write is not None and objects:
        raise ConfigError("--write needs all objects; leave out --object")
    rows: list[scene_bench.SceneCost] = []
    with console.bar("squeezing", scene_bench.count_rows(objects or [])) as progress:
        for row in scene_bench.scene_costs(objects or [], keep_table=write is not None):
            rows.append(row)
            progress(f"{row.object}, {row.detail}")
    if write is not None:
        write_between(write, "detail", scene_bench.markdown(rows))
    _show({"scene": rows}, as_json, lambda: scene_table(rows))


@app.command("commands")
def commands(set_: NoOverrides = None, as_json: AsJson = False) -> None:
    """Measure the time and memory of most commands."""
    from gripper_force.qualification.bench import command_bench

    costs: list[command_bench.CommandCost] = []
    with console.bar("running", len(command_bench.COMMANDS)) as progress:
        for cost in command_bench.commands():
            costs.append(cost)
            progress(cost.command)
    _show({"commands": costs}, as_json, lambda: commands_table(costs))


@app.command("training")
def training(
    data: Annotated[Path, typer.Argument(help="Folder with logs to train on.")],
    minutes: Annotated[float, typer.Option(min=0.01, max=1e9, help="Training time of each recipe.")] = 30.0,
    folder: Folder = Path("runs/bench"),
    jobs: Jobs = CORES,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Set one key of all recipes: key=value. Repeatable."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the validation error of several training recipes against training time."""
    from functools import partial

    from gripper_force.qualification.bench import training_bench

    points: list[training_bench.Point] = []
    load = partial(_load, data, jobs)
    with console.bar("training", training_bench.TURNS) as progress:
        for point in training_bench.learn(load, minutes, set_ or [], folder, progress):
            points.append(point)
            console.err.print(f"{point.way}, {point.minutes:.2f} min: {point.mae_n:.3f} N")
    reached = training_bench.reached(points)
    result = {"points": points, "as_good_as_paper_min": reached, "folder": folder}
    _show(result, as_json, lambda: training_table(points, reached, folder))


@app.command("checkpoints")
def checkpoints(
    data: Annotated[list[Path], typer.Argument(help="Folders with logs that were not used for training.")],
    checkpoint: Annotated[
        list[str], typer.Option(help="Path of a checkpoint, or default or small. Repeatable.")
    ],
    write: Annotated[
        bool, typer.Option("--write", help="Write the errors into the checkpoints; their digests stay.")
    ] = False,
    jobs: Jobs = CORES,
    set_: NoOverrides = None,
    as_json: AsJson = False,
) -> None:
    """Measure the errors of checkpoints on the same logs, so that `vision.checkpoint=auto` can compare them."""
    from gripper_force.jobs.dataset import find_logs, load_clips, without_contact_starts
    from gripper_force.jobs.training.stated_errors import state_errors

    logs = find_logs(data)

    def read(preprocess: "Preprocess") -> "list[Clip]":
        with console.bar("reading logs", len(logs)) as progress:
            return without_contact_starts(
                load_clips(logs, preprocess, workers=jobs, progress=progress), preprocess
            )

    errors = state_errors(checkpoint, read, write=write)
    _show({"checkpoints": errors}, as_json, lambda: checkpoints_table(errors))


def _show(result: Mapping[str, object], as_json: bool, table: Callable[[], None]) -> None:
    """Prints a result with the load of this machine."""
    load = os.getloadavg()[0]

    def render(_: object) -> None:
        table()
        console.out.print(f"[dim]load {load:.1f} on {CORES} cores[/]")

    console.show({**result, "load": load, "cores": CORES}, as_json, render)
