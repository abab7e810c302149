"""The command that measures."""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from gripper_force import console
from gripper_force.cli.options import CORES, AsJson, Jobs
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
    minutes: Annotated[float, typer.Option(min=0.01, help="With --training: for each way.")] = 30.0,
    folder: Annotated[
        Path, typer.Option("--out", help="With --training: where to keep what is measured.")
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
    """Measure what parts of a run cost on this machine, beside what others use."""
    from gripper_force.bench import bus as bus_job
    from gripper_force.bench import commands as commands_job

    if [bus, commands, startup, loop, training is not None].count(True) != 1:
        raise ConfigError(
            "bench measures one thing at a time: --bus, --commands, --startup, --loop or --training DATA"
        )
    if training is not None:
        console.show(_learning(training, minutes, set_ or [], folder, jobs), as_json, console.learning_table)
        return
    if loop:
        from gripper_force.bench.loop import loop as run

        with console.err.status(f"running for {2 * seconds:g} s"):
            costs_, log = run(seconds, set_ or [])
        told = {"loop": costs_, "log": log, "load": os.getloadavg()[0], "cores": CORES}
        console.show(told, as_json, console.loop_table)
        return
    if startup:
        console.show(_startup(), as_json, console.startup_table)
        return
    if commands:
        taken = []
        with console.bar("running", len(commands_job.COMMANDS)) as advance:
            for cost in commands_job.commands():
                taken.append(cost)
                advance(cost.command)
        console.show(
            {"commands": taken, "load": os.getloadavg()[0], "cores": CORES}, as_json, console.commands_table
        )
        return
    costs: list[Any] = []
    with console.bar("measuring", len(bus_job.BUS_SETTINGS)) as advance:
        for setting in bus_job.bus(cycles):
            costs += setting
            advance(f"{setting[0].baud_rate} baud, {setting[0].latency_ms:g} ms")
    console.show({"bus": costs, "load": os.getloadavg()[0], "cores": CORES}, as_json, console.bus_table)


def _startup() -> dict[str, Any]:
    from gripper_force.bench import startup as job

    rows = []
    with console.bar("starting", len(job.SCENES)) as advance:
        for row in job.startup(job.SCENES):
            rows.append(row)
            advance(row.scene)
    return {"startup": rows, "load": os.getloadavg()[0], "cores": CORES}


def _learning(data: Path, minutes: float, overrides: list[str], out_: Path, jobs: int) -> dict[str, Any]:
    from functools import partial

    from gripper_force.dataset import load_clips
    from gripper_force.training.learning import learn, reached

    points = []
    for point in learn(partial(load_clips, data, workers=jobs), minutes, overrides, out_):
        points.append(point)
        console.err.print(f"{point.way}, {point.minutes:.2f} min: {point.mae_n:.3f} N")
    return {"points": points, "as_good_as_paper_min": reached(points), "cores": CORES, "folder": out_}
