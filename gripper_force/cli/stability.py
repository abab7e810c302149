"""The `stability` commands: hard numerical cases, faults, malformed input and long use."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypedDict, TypeVar

import typer

from gripper_force.cli import console
from gripper_force.cli.options import CORES, AsJson, ConfigPath, Jobs, Overrides, Page, load_settings
from gripper_force.cli.output.stability import (
    faults_table,
    fuzz_table,
    numerics_tables,
    search_table,
    soak_table,
)

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


@app.command("faults")
def faults(
    seeds: Annotated[int, typer.Option(min=1, help="Grasps of each row.")] = 20,
    live: Annotated[int, typer.Option(min=0, help="Of these, grasps repeated in real time.")] = 2,
    write: Page = None,
    resume: Annotated[bool, typer.Option(help="Continue an interrupted matrix.")] = False,
    seed: Seed = None,
    jobs: Jobs = CORES,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Inject a fault into each part during a grasp. Exit code 1 if a reaction is not as expected."""
    from gripper_force.qualification.fault_matrix.matrix import (
        MatrixReport,
        count_grasps,
        markdown,
        run_matrix,
    )
    from gripper_force.qualification.markdown_blocks import write_between

    settings = load_settings(config, set_, {"seed": seed})
    keep = settings.log.directory / "faults.jsonl"
    with console.bar("injecting faults", count_grasps(seeds, live)) as progress:
        rows = list(run_matrix(settings, seeds, live, jobs, keep, resume=resume, progress=progress))
    if write is not None:
        write_between(write, "matrix", markdown(rows))
    report: MatrixReport = {"rows": rows, "ok": all(row["ok"] == row["runs"] for row in rows)}
    _show(report, as_json, faults_table)


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
    seconds: Annotated[float, typer.Option(min=0, help="Simulated seconds of grasps.")] = 600.0,
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
