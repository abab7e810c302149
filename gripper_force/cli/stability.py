"""The command that shows what is survived."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gripper_force.cli import console
from gripper_force.cli.options import CORES, AsJson, ConfigPath, Jobs, Overrides, load_settings
from gripper_force.cli.output.stability import faults_table, fuzz_table, numerics_tables, soak_table
from gripper_force.errors import ConfigError

if TYPE_CHECKING:
    from gripper_force.config import Config


def stability(
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="Hard cases for the numbers of one part: network, loop, filter, simulator. Repeatable."
        ),
    ] = None,
    faults: Annotated[bool, typer.Option("--faults", help="Break each part in mid-grasp.")] = False,
    seeds: Annotated[int, typer.Option(min=1, help="With --faults: grasps of each row.")] = 20,
    live: Annotated[int, typer.Option(min=0, help="With --faults: of these, also in real time.")] = 2,
    write: Annotated[
        Path | None,
        typer.Option(help="Markdown file to put the tables into; maps go into a folder beside it."),
    ] = None,
    resume: Annotated[
        bool, typer.Option(help="With --faults: go on where the last matrix was broken off.")
    ] = False,
    fuzz: Annotated[
        int | None, typer.Option(min=1, help="Feed so many random and damaged inputs to all readers.")
    ] = None,
    soak: Annotated[
        float | None,
        typer.Option(min=0, help="Grasp again and again for so many simulated seconds (coarse scenes)."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the inputs or of the first scene.")] = 0,
    only: Annotated[
        str | None, typer.Option(help="With --fuzz: one target, or one input as <target>:<number>.")
    ] = None,
    folder: Annotated[Path, typer.Option("--out", help="Folder for inputs that are findings.")] = Path(
        "runs/fuzz"
    ),
    jobs: Jobs = CORES,
    config: ConfigPath = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Show that hard cases for the numbers, faults, hostile input and long use are survived.

    Without --faults, --fuzz or --soak: the numbers. Exit code 1 where a case breaks its bound.
    """
    modes = [faults, fuzz is not None, soak is not None].count(True)
    if modes > 1 or (modes == 1 and part):
        raise ConfigError("stability does one thing at a time: --part, --faults, --fuzz N or --soak SECONDS")
    if not modes:
        result = _numbers(load_settings(config, set_, {"seed": seed}), part or [], write)
        console.show(result, as_json, numerics_tables)
    elif faults:
        result = _fault_matrix(load_settings(config, set_, {"seed": seed}), seeds, live, jobs, write, resume)
        console.show(result, as_json, faults_table)
    elif fuzz is not None:
        from gripper_force.qualification.fuzz.fuzzer import fuzz as feed

        with console.bar("fuzzing", fuzz) as advance:
            result = feed(fuzz, seed, jobs, folder, advance, only=only)
        console.show(result, as_json, fuzz_table)
    else:
        from gripper_force.qualification.soak import soak as grasp_on

        settings = load_settings(config, ["sim.detail=coarse", *(set_ or [])], {"seed": seed})
        with console.bar("soaking", round(soak or 0)) as advance:
            result = grasp_on(settings, soak or 0, advance)
        console.show(result, as_json, soak_table)
    if not result["ok"]:
        raise typer.Exit(1)


def _numbers(settings: "Config", parts: list[str], page: Path | None) -> dict[str, Any]:
    from gripper_force.qualification.markdown_blocks import write_between
    from gripper_force.qualification.numerics.suite import PARTS, markdown, run

    with console.bar("hard cases", len(parts or PARTS)) as advance:
        result = run(settings, parts, page and page.with_suffix(""), advance)
    if page is not None:
        for name, rows in result["parts"].items():
            write_between(page, name, markdown(rows))
    return result


def _fault_matrix(
    settings: "Config", seeds: int, live: int, jobs: int, page: Path | None, resume: bool
) -> dict[str, Any]:
    from gripper_force.qualification.fault_matrix.matrix import count_grasps, markdown, run_matrix
    from gripper_force.qualification.markdown_blocks import write_between

    with console.bar("breaking things", count_grasps(seeds, live)) as advance:
        keep = settings.log.directory / "faults.jsonl"
        rows = list(run_matrix(settings, seeds, live, jobs, keep, resume=resume, advance=advance))
    if page is not None:
        write_between(page, "matrix", markdown(rows))
    return {"rows": rows, "ok": all(row["ok"] == row["runs"] for row in rows)}
