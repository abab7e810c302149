"""The `stability` commands: hard numerical cases, faults, malformed input and long use."""

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypedDict, TypeVar

import typer

from gripper_force.cli import console
from gripper_force.cli.options import CORES, AsJson, ConfigPath, Jobs, Overrides, Page, load_settings
from gripper_force.cli.output.stability import (
    faults_tables,
    fuzz_table,
    numerics_tables,
    search_table,
    soak_table,
)

if TYPE_CHECKING:
    from gripper_force.cli.output.stability import FaultsReport

app = typer.Typer(
    no_args_is_help=True,
    help="Test with hard numerical cases, faults, malformed input and long use. Exit code 1 on a failure.",
)


class _Report(TypedDict):
    ok: bool


R = TypeVar("R", bound=_Report)

Seed = Annotated[int | None, typer.Option(min=0, help="Seed of all random draws. Default: the key seed.")]


@app.command("numerics")
def numerics(
    part: Annotated[
        list[str] | None,
        typer.Option(help="Only this part: network, loop, filter, simulator. Repeatable. Default: all."),
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option(
            help="Markdown page to write the tables into; maps go into a folder of the page's name."
        ),
    ] = None,
    seed: Seed = None,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Run hard numerical cases, each with an error bound. Exit code 1 if a bound is exceeded."""
    from gripper_force.qualification.markdown_blocks import write_between
    from gripper_force.qualification.numerics.suite import PARTS, markdown, run

    settings = load_settings(config, set_, {"seed": seed})
    with console.bar("hard cases", len(part or PARTS)) as progress:
        report = run(settings, part or [], write and write.with_suffix(""), progress)
    if write is not None:
        for name, rows in report["parts"].items():
            write_between(write, name, markdown(rows))
    _show(report, as_json, numerics_tables)


class Table(StrEnum):
    """Tables of `stability faults`."""

    FAULTS = "faults"
    WRONG = "wrong"


@app.command("faults")
def faults(
    table: Annotated[
        list[Table] | None,
        typer.Option(
            help="Only this table: faults (a part fails), wrong (the configuration is wrong). Repeatable. "
            "Default: both."
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Grasps of each row.")] = 20,
    live: Annotated[
        int | None,
        typer.Option(
            min=0, help="Grasps of each row repeated in real time. Default: 2 in table faults, all in wrong."
        ),
    ] = None,
    write: Page = None,
    resume: Annotated[bool, typer.Option(help="Continue an interrupted matrix.")] = False,
    seed: Seed = None,
    jobs: Jobs = CORES,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Break each part and each configuration during grasps. Exit code 1 if a reaction is not as expected."""
    from gripper_force.qualification.fault_matrix import matrix, wrong_configurations
    from gripper_force.qualification.markdown_blocks import write_between

    settings = load_settings(config, set_, {"seed": seed})
    report: FaultsReport = {"rows": [], "wrong": [], "ok": True}
    if Table.FAULTS in (table or Table):
        live_faults = 2 if live is None else live
        keep = settings.log.directory / "faults.jsonl"
        with console.bar("injecting faults", matrix.count_grasps(seeds, live_faults)) as progress:
            report["rows"] = list(
                matrix.run_matrix(settings, seeds, live_faults, jobs, keep, resume=resume, progress=progress)
            )
        if write is not None:
            write_between(write, "matrix", matrix.markdown(report["rows"]))
    if Table.WRONG in (table or Table):
        live_wrong = seeds if live is None else live
        keep = settings.log.directory / "wrong.jsonl"
        with console.bar(
            "wrong configurations", wrong_configurations.count_grasps(seeds, live_wrong)
        ) as progress:
            report["wrong"] = list(
                wrong_configurations.run_rows(
                    settings, seeds, live_wrong, jobs, keep, resume=resume, progress=progress
                )
            )
        if write is not None:
            write_between(write, "wrong", wrong_configurations.markdown(report["wrong"]))
    report["ok"] = all(
        row["ok"] == row["runs"] and row["live_ok"] == row["live_runs"]
        for row in (*report["rows"], *report["wrong"])
    )
    _show(report, as_json, faults_tables)


@app.command("search")
def search(
    cases: Annotated[int, typer.Option(min=1, help="Drawn plants and wrong configurations.")] = 10_000,
    resume: Annotated[bool, typer.Option(help="Continue an interrupted search.")] = False,
    seed: Seed = None,
    jobs: Jobs = CORES,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Search wrong configurations for unsafe grasps, on an analytic plant. Exit code 1 if one is found."""
    from gripper_force.qualification import safety_search

    settings = load_settings(config, set_, {"seed": seed})
    keep = settings.log.directory / "search.jsonl"
    with console.bar("searching", cases) as progress:
        report = safety_search.search(settings, cases, jobs, keep, resume=resume, progress=progress)
    _show(report, as_json, search_table)


@app.command("fuzz")
def fuzz(
    cases: Annotated[int, typer.Option(min=1, help="Random and damaged inputs over all readers.")] = 1000,
    only: Annotated[
        str | None, typer.Option(help="One target, or one input as <target>:<number>. Default: all targets.")
    ] = None,
    folder: Annotated[Path, typer.Option("--out", help="Folder for inputs that cause findings.")] = Path(
        "runs/fuzz"
    ),
    seed: Seed = None,
    jobs: Jobs = CORES,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Feed random and damaged input to all readers. Exit code 1 if there are findings."""
    from gripper_force.qualification.fuzz import fuzzer

    settings = load_settings(config, set_, {"seed": seed})
    with console.bar("fuzzing", cases) as progress:
        report = fuzzer.fuzz(cases, settings.seed, jobs, folder, progress, only=only)
    _show(report, as_json, fuzz_table)


@app.command("soak")
def soak(
    seconds: Annotated[float, typer.Option(min=0, max=1e9, help="Simulated seconds of grasps.")] = 600.0,
    seed: Seed = None,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Grasp repeatedly, in coarse scenes. Exit code 1 if memory, open files or threads grow."""
    from gripper_force.qualification import soak as soak_test

    settings = load_settings(config, ["sim.detail=coarse", *(set_ or [])], {"seed": seed})
    with console.bar("soaking", round(seconds)) as progress:
        report = soak_test.soak(settings, seconds, progress)
    _show(report, as_json, soak_table)


def _show(report: R, as_json: bool, table: Callable[[R], None]) -> None:
    """Prints a report. Exit code 1 if it is not ok."""
    console.show(report, as_json, table)
    if not report["ok"]:
        raise typer.Exit(1)
