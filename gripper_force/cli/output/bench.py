"""Tables of the `bench` commands."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Column, Table

from gripper_force.cli.console import number, out, pairs

if TYPE_CHECKING:
    from gripper_force.qualification.bench.bus_bench import BusCost
    from gripper_force.qualification.bench.command_bench import CommandCost
    from gripper_force.qualification.bench.estimator_bench import EstimatorCost, Ratios
    from gripper_force.qualification.bench.gain_bench import GainRow
    from gripper_force.qualification.bench.loop_bench import LogCost, LoopCost
    from gripper_force.qualification.bench.scene_bench import SceneCost
    from gripper_force.qualification.bench.startup_bench import Start
    from gripper_force.qualification.bench.training_bench import Point
    from gripper_force.qualification.recognition import Figures


def commands_table(costs: "Sequence[CommandCost]") -> None:
    """Prints the time and memory of commands."""
    table = Table("gripper-force", "time s", "CPU s", "memory MB", box=None)
    for c in costs:
        figures = (number(c.wall_s, digits=1), number(c.cpu_s, digits=1), number(c.memory_mb, digits=0))
        table.add_row(c.command, *figures)
    out.print(table)


def startup_table(starts: "Sequence[Start]") -> None:
    """Prints the start-up time and memory of scenes."""
    table = Table("scene", "time s", "memory MB", "libraries", "threads", box=None)
    for s in starts:
        figures = (number(s.time_s, digits=2), number(s.memory_mb, digits=0))
        libraries = ", ".join(name for name in s.loaded if "gripper_" not in name)
        table.add_row(s.scene, *figures, libraries, ", ".join(s.threads))
    out.print(table)


def scene_table(costs: "Sequence[SceneCost]") -> None:
    """Prints speed and error of the detail levels of simulated objects."""
    columns = ("object", "detail", "unknowns", "step ms", "iterations", "simulated s/s", "RMSE N", "worst N")
    table = Table(*columns, box=None)
    for s in costs:
        solver = (str(s.unknowns), f"{s.step_ms:g}", number(s.iterations, digits=1))
        figures = (number(s.speed, digits=1), number(s.error_n), number(s.worst_n))
        table.add_row(s.object, s.detail, *solver, *figures)
    out.print(table)


def gain_table(rows: "Sequence[GainRow]") -> None:
    """Prints the errors of vision without and with the object's gain, of each object and on average."""
    table = Table(
        "object", "true gain", "gain", "+- %", "grasps held", "MAE N", "with gain N", "best N", box=None
    )
    for r in rows:
        figures = (
            number(r.stiffness, digits=2),
            number(r.gain, digits=3),
            number(100 * r.gain_std, digits=1),
        )
        errors = (number(value) for value in (r.mae_n, r.learned_n, r.perfect_n))
        table.add_row(r.object, *figures, str(r.grasps), *errors)
    columns = ([r.mae_n for r in rows], [r.learned_n for r in rows], [r.perfect_n for r in rows])
    means = (number(sum(column) / len(rows)) for column in columns)
    table.add_row("all", "", "", "", str(sum(r.grasps for r in rows)), *means)
    out.print(table)


def loop_table(costs: "Sequence[LoopCost]", log: "LogCost") -> None:
    """Prints the timing of the real-time loop, and the cost of its log."""
    table = Table(
        "in parallel", "missed %", "late", "worst", "bus", "cycle", "estimate", "lost records", box=None
    )
    for c in costs:
        late, bus, cycle, estimate = (
            "/".join(number(ms, digits=2) for ms in pair)
            for pair in (
                (c.late_p50_ms, c.late_p99_ms),
                (c.bus_p50_ms, c.bus_p99_ms),
                (c.cycle_p50_ms, c.cycle_p99_ms),
                (c.estimator_p50_ms, c.estimator_p99_ms),
            )
        )
        missed, worst = number(100 * c.missed / c.cycles), number(c.late_max_ms, digits=2)
        table.add_row(c.beside, missed, late, worst, bus, cycle, estimate, str(c.lost_records))
    out.print(table)
    out.print(
        f"[dim]p50/p99 in ms of {costs[0].cycles} cycles; virtual servo over a pseudo-terminal, recorded "
        "camera, no physics[/]"
    )
    pairs(
        {
            "log of the run, MB/s": log.run_mb_s,
            "highest log rate, MB/s": log.write_mb_s,
            "us per record": log.record_us,
            "replay, times real time": log.replay_times,
        }
    )


def bus_table(costs: "Sequence[BusCost]") -> None:
    """Prints the time of a bus cycle."""
    columns = ("Mbaud", "latency ms", "client", "line ms", "p50 ms", "p99 ms", "p50/line", "CPU % at 200 Hz")
    table = Table(*columns, box=None)
    for c in costs:
        figures = (c.line_ms, c.p50_ms, c.p99_ms, c.p50_ms / c.line_ms)
        numbers = (number(value) for value in figures)
        share = number(100 * c.cpu_share, digits=1)
        setting = (f"{c.baud_rate / 1e6:g}", f"{c.latency_ms:g}")
        table.add_row(*setting, c.client, *numbers, share)
    out.print(table)


def estimator_table(costs: "Sequence[EstimatorCost]", ratios: "Ratios", plot: Path, file: Path) -> None:
    """Prints speed and error of the visual estimate."""
    columns = ("p50 ms", "p99 ms", "/roofline", "MAE N", "worst N", "MB", "")
    table = Table("network", "px", Column("variant", no_wrap=True), *columns, box=None)
    short = {"float32": "f32", "bfloat16": "bf16"}
    for e in costs:
        over_roofline = None if e.least_ms is None else e.p50_ms / e.least_ms
        table.add_row(
            Path(e.checkpoint).stem,
            str(e.size),
            f"{e.engine} {short.get(e.precision, e.precision)} x{e.threads}",
            *(number(value, digits=2) for value in (e.p50_ms, e.p99_ms)),
            number(over_roofline, digits=1),
            number(e.mae_n),
            number(e.worst_n, digits=2),
            number(e.memory_mb, digits=0),
            "*" if e.front else "",
        )
    out.print(table)
    for checkpoint, ratio in ratios.items():
        pairs(
            {
                f"{Path(checkpoint).stem}: fastest with the error of float32": ratio["fastest"],
                "faster than our whole-window PyTorch": f"{ratio['times_faster_than_window']:.0f} times",
                "faster than plain whole-window PyTorch": (
                    f"{ratio['times_faster_than_plain_window']:.0f} times"
                ),
            }
        )
    pairs({"*": "Pareto front: no other variant is both faster and more accurate"})
    pairs({"plot": str(plot), "results": str(file)})


def recognition_table(rows: "Sequence[Figures]") -> None:
    """Prints what a network recognises as unfamiliar."""
    from gripper_force.qualification.recognition import HEADINGS, texts

    table = Table("group", "row", *HEADINGS.values(), box=None)
    for row in rows:
        table.add_row(row["group"], row["name"], *texts(row))
    out.print(table)


def checkpoints_table(errors_of: Mapping[str, Mapping[str, float]]) -> None:
    """Prints the errors of checkpoints on the same logs."""
    table = Table("checkpoint", "MAE N", "RMSE N", "bias N", box=None)
    for name, errors in errors_of.items():
        table.add_row(name, *(number(errors[key]) for key in ("mae_n", "rmse_n", "bias_n")))
    out.print(table)


def training_table(points: "Sequence[Point]", reached: Mapping[str, float | None], folder: Path) -> None:
    """Prints the validation error of training recipes over time."""
    table = Table("recipe", "minutes", "steps", "MAE N", "RMSE N", box=None)
    for p in points:
        table.add_row(p.way, number(p.minutes, digits=2), str(p.steps), number(p.mae_n), number(p.rmse_n))
    out.print(table)
    pairs({f"{recipe}: as good as the paper's, min": minutes for recipe, minutes in reached.items()})
    pairs({"results": str(folder)})
