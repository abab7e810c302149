"""The command that measures."""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from gripper_force.cli import console
from gripper_force.cli.options import CORES, AsJson, Jobs
from gripper_force.cli.output.bench import (
    bus_table,
    commands_table,
    estimator_table,
    learning_table,
    loop_table,
    scene_table,
    startup_table,
)
from gripper_force.errors import ConfigError


def bench(
    bus: Annotated[bool, typer.Option("--bus", help="A cycle of the servo's bus, by the driver.")] = False,
    cycles: Annotated[int, typer.Option(min=1, help="With --bus: how many of each.")] = 1000,
    commands: Annotated[bool, typer.Option("--commands", help="Time and memory of most commands.")] = False,
    training: Annotated[
        Path | None, typer.Option(help="Ways to train on this folder of logs: error against minutes.")
    ] = None,
    startup: Annotated[
        bool, typer.Option("--startup", help="What each kind of scene takes until its first cycle.")
    ] = False,
    loop: Annotated[
        bool, typer.Option("--loop", help="The control loop in real time, with inference beside it.")
    ] = False,
    seconds: Annotated[
        float, typer.Option(min=1.0, help="With --loop: how long with inference, and how long without.")
    ] = 30.0,
    scene: Annotated[
        bool, typer.Option("--scene", help="Speed against error of each level of sim.detail.")
    ] = False,
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="With --scene: only this object. Repeatable.")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Estimator: logs that training never saw. By default some are simulated, for int8 too."
        ),
    ] = None,
    scale_on: Annotated[
        Path | None, typer.Option(help="Estimator: other logs, to scale int8 on. Goes with --data.")
    ] = None,
    checkpoints: Annotated[
        list[str] | None,
        typer.Option("--checkpoint", help="Estimator: a path or name. Repeatable. Default: all shipped."),
    ] = None,
    threads: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Estimator: CPU threads. Repeatable. Default: one, and all cores."),
    ] = None,
    write: Annotated[
        Path | None, typer.Option(help="Estimator, --scene: page to put the table into.")
    ] = None,
    minutes: Annotated[float, typer.Option(min=0.01, help="With --training: for each way.")] = 30.0,
    folder: Annotated[
        Path, typer.Option("--out", help="Estimator, --training: where to keep what is measured.")
    ] = Path("runs/bench"),
    jobs: Jobs = CORES,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="With --training a key of all recipes, with --loop of the run. Repeatable."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure what parts of a run cost on this machine, beside what others use.

    Without another choice: the visual estimate's speed against its error, by network, engine, precision and
    threads.
    """
    asked = {
        "--bus": bus,
        "--commands": commands,
        "--startup": startup,
        "--loop": loop,
        "--scene": scene,
        "--training DATA": training is not None,
    }
    if list(asked.values()).count(True) > 1:
        raise ConfigError(f"bench measures one thing at a time: the estimator, or one of {', '.join(asked)}")
    result: dict[str, Any]
    if bus:
        result, table = _bus(cycles), bus_table
    elif commands:
        result, table = _commands(), commands_table
    elif startup:
        result, table = _startup(), startup_table
    elif loop:
        result, table = _loop(seconds, set_ or []), loop_table
    elif scene:
        result, table = _scene(objects or [], write), scene_table
    elif training is not None:
        result, table = _learning(training, minutes, set_ or [], folder, jobs), learning_table
    else:
        result = _estimator(checkpoints, threads, data, scale_on, folder, write, jobs)
        table = estimator_table
    console.show({**result, "load": os.getloadavg()[0], "cores": CORES}, as_json, table)


def _estimator(
    checkpoints: list[str] | None,
    threads: list[int] | None,
    data: Path | None,
    scale_on: Path | None,
    out_: Path,
    page: Path | None,
    jobs: int,
) -> dict[str, Any]:
    from tempfile import TemporaryDirectory

    from gripper_force.config import Config
    from gripper_force.jobs.dataset import load_clips
    from gripper_force.jobs.simulate import plan, simulate
    from gripper_force.qualification.bench import estimator_bench as job
    from gripper_force.qualification.markdown_blocks import write_between
    from gripper_force.vision.header import SHIPPED

    if (data is None) != (scale_on is None):
        raise ConfigError(
            "--data and --scale-on go together: int8 is scaled on other logs than it is judged by"
        )
    with TemporaryDirectory() as name, console.err.status("measuring") as status:
        if data is None or scale_on is None:
            data, scale_on = Path(name) / "data", Path(name) / "scale"
            for folder, plans in ((data, plan("press", 12, 900_000)), (scale_on, plan("press", 8, 100_000))):
                for made in simulate(plans, folder, Config(), jobs):
                    status.update(f"simulating {made.name}")
        status.update("measuring")
        rows = job.bench(
            checkpoints or list(SHIPPED),
            lambda model: load_clips(data, model.header.preprocess, workers=jobs, quiet=True),
            lambda model: load_clips(scale_on, model.header.preprocess, workers=jobs, quiet=True),
            threads or sorted({1, CORES}),
            lambda what: console.err.print(what),
        )
    plot = out_ / "estimator.png" if page is None else page.with_suffix(".png")
    job.write_json(out_ / "estimator.json", rows)
    job.draw(plot, rows)
    if page is not None:
        write_between(page, "estimator", job.markdown(rows))
    return {
        "estimator": rows,
        "ratios": job.ratios(rows),
        "plot": plot,
        "file": out_ / "estimator.json",
    }


def _bus(cycles: int) -> dict[str, Any]:
    from gripper_force.qualification.bench import bus_bench as job

    costs: list[Any] = []
    with console.bar("measuring", len(job.BUS_SETTINGS)) as advance:
        for setting in job.bus(cycles):
            costs += setting
            advance(f"{setting[0].baud_rate} baud, {setting[0].latency_ms:g} ms")
    return {"bus": costs}


def _commands() -> dict[str, Any]:
    from gripper_force.qualification.bench import command_bench as job

    taken = []
    with console.bar("running", len(job.COMMANDS)) as advance:
        for cost in job.commands():
            taken.append(cost)
            advance(cost.command)
    return {"commands": taken}


def _startup() -> dict[str, Any]:
    from gripper_force.qualification.bench import startup_bench as job

    rows = []
    with console.bar("starting", len(job.STARTUP_CASES)) as advance:
        for row in job.startup(job.STARTUP_CASES):
            rows.append(row)
            advance(row.scene)
    return {"startup": rows}


def _loop(seconds: float, overrides: list[str]) -> dict[str, Any]:
    from gripper_force.qualification.bench import loop_bench as job

    with console.err.status(f"running for {2 * seconds:g} s"):
        costs, log = job.loop(seconds, overrides)
    return {"loop": costs, "log": log}


def _scene(objects: list[str], page: Path | None) -> dict[str, Any]:
    from gripper_force.qualification.bench import scene_bench as job

    if page is not None and objects:
        raise ConfigError("--write needs all objects: leave out --object")
    rows = []
    with console.err.status("squeezing") as status:
        for row in job.scene_costs(objects, keep_table=page is not None):
            rows.append(row)
            status.update(f"squeezed {row.object}, {row.detail}")
    if page is not None:
        from gripper_force.qualification.markdown_blocks import write_between

        write_between(page, "detail", job.markdown(rows))
    return {"scene": rows}


def _learning(data: Path, minutes: float, overrides: list[str], out_: Path, jobs: int) -> dict[str, Any]:
    from functools import partial

    from gripper_force.jobs.dataset import load_clips
    from gripper_force.qualification.bench.training_bench import learn, reached

    points = []
    for point in learn(partial(load_clips, data, workers=jobs), minutes, overrides, out_):
        points.append(point)
        console.err.print(f"{point.way}, {point.minutes:.2f} min: {point.mae_n:.3f} N")
    return {"points": points, "as_good_as_paper_min": reached(points), "folder": out_}
