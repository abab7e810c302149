"""What was measured of speed, memory and error."""

from pathlib import Path
from typing import Any

from rich.table import Column, Table

from gripper_force.cli.console import number, out, pairs


def commands_table(r: dict[str, Any]) -> None:
    """What commands take."""
    table = Table("gripper-force", "time s", "CPU s", "memory MB", box=None)
    for c in r["commands"]:
        figures = (number(c.wall_s, digits=1), number(c.cpu_s, digits=1), number(c.memory_mb, digits=0))
        table.add_row(c.command, *figures)
    out.print(table)
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def startup_table(r: dict[str, Any]) -> None:
    """What scenes take to start."""
    table = Table("scene", "time s", "memory MB", "libraries", "threads", box=None)
    for s in r["startup"]:
        figures = (number(s.time_s, digits=2), number(s.memory_mb, digits=0))
        libraries = ", ".join(name for name in s.loaded if "gripper_" not in name)
        table.add_row(s.scene, *figures, libraries, ", ".join(s.threads))
    out.print(table)
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def scene_table(r: dict[str, Any]) -> None:
    """What the levels of detail of simulated objects cost."""
    columns = ("object", "detail", "unknowns", "step ms", "iterations", "simulated s/s", "RMSE N", "worst N")
    table = Table(*columns, box=None)
    for s in r["scene"]:
        solver = (str(s.unknowns), f"{s.step_ms:g}", number(s.iterations, digits=1))
        figures = (number(s.speed, digits=1), number(s.error_n), number(s.worst_n))
        table.add_row(s.object, s.detail, *solver, *figures)
    out.print(table)
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def loop_table(r: dict[str, Any]) -> None:
    """What a loop in real time did."""
    table = Table("beside", "missed %", "late", "worst", "bus", "cycle", "estimate", "lost", box=None)
    for c in r["loop"]:
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
        f"[dim]p50/p99 in ms of {r['loop'][0].cycles} cycles; a servo behind a pseudo-terminal, a recorded "
        "camera, no physics[/]"
    )
    log = r["log"]
    pairs(
        {
            "log of the run, MB/s": log.run_mb_s,
            "log at most, MB/s": log.write_mb_s,
            "us a record": log.record_us,
            "replay, times real time": log.replay_times,
        }
    )
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def bus_table(r: dict[str, Any]) -> None:
    """What a bus cycle takes."""
    columns = ("Mbaud", "latency ms", "client", "line ms", "p50 ms", "p99 ms", "p50/line", "CPU % at 200Hz")
    table = Table(*columns, box=None)
    for c in r["bus"]:
        figures = (c.line_ms, c.p50_ms, c.p99_ms, c.p50_ms / c.line_ms)
        numbers = (number(value) for value in figures)
        share = number(100 * c.cpu_share, digits=1)
        setting = (f"{c.baud_rate / 1e6:g}", f"{c.latency_ms:g}")
        table.add_row(*setting, c.client, *numbers, share)
    out.print(table)
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def estimator_table(r: dict[str, Any]) -> None:
    """Speed against error of the visual estimate."""
    columns = ("p50 ms", "p99 ms", "/roof", "MAE N", "worst", "MB", "")
    table = Table("network", "px", Column("way", no_wrap=True), *columns, box=None)
    short = {"float32": "f32", "bfloat16": "bf16"}
    for e in r["estimator"]:
        share = None if e.least_ms is None else e.p50_ms / e.least_ms
        table.add_row(
            Path(e.checkpoint).stem,
            str(e.size),
            f"{e.engine} {short.get(e.precision, e.precision)} x{e.threads}",
            *(number(value, digits=2) for value in (e.p50_ms, e.p99_ms)),
            number(share, digits=1),
            number(e.mae_n),
            number(e.worst_n, digits=2),
            number(e.memory_mb, digits=0),
            "*" if e.front else "",
        )
    out.print(table)
    for checkpoint, told in r["ratios"].items():
        pairs(
            {
                f"{Path(checkpoint).stem}: fastest that keeps the error": told["fastest"],
                "faster than the window in PyTorch": f"{told['times_faster_than_window']:.0f} times",
                "faster than the plain one": f"{told['times_faster_than_plain_window']:.0f} times",
            }
        )
    pairs({"*": "no other way is faster and more exact"})
    pairs({"plot": str(r["plot"]), "kept in": str(r["file"])})
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def learning_table(r: dict[str, Any]) -> None:
    """Ways to train."""
    table = Table("way", "minutes", "steps", "MAE N", "RMSE N", box=None)
    for p in r["points"]:
        table.add_row(p.way, number(p.minutes, digits=2), str(p.steps), number(p.mae_n), number(p.rmse_n))
    out.print(table)
    pairs({f"{way}: as good as the paper's, min": m for way, m in r["as_good_as_paper_min"].items()})
    pairs({"kept in": str(r["folder"])})
