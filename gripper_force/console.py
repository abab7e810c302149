"""What a person sees in a terminal, or a script on stdout: tables, progress, one JSON object."""

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column, Table

from gripper_force.errors import GripperError

err = Console(stderr=True, highlight=False)
out = Console(highlight=False)


@contextmanager
def bar(label: str, total: int) -> Iterator[Any]:
    """A progress bar on stderr; gives a function to call with a note, and with steps if not one."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, TextColumn("{task.fields[note]}"), console=err) as progress:
        task = progress.add_task(label, total=total, note="")
        yield lambda note, steps=1: progress.update(task, advance=steps, note=note)


def show(result: dict[str, Any], as_json: bool, render: Any = None) -> None:
    """Prints a result: as one JSON object, or for a person, by ``render`` or as names and values."""
    if as_json:
        sys.stdout.write(json.dumps(jsonable(result), allow_nan=False) + "\n")
    elif render is None:
        _pairs(result)
    else:
        render(result)


def jsonable(value: Any) -> Any:
    """NaN has no place in JSON; a figure without a meaning is null."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: jsonable(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def _number(value: Any, unit: str = "", digits: int = 3) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:.{digits}f}{unit}" if isinstance(value, float) else f"{value}{unit}"


def _pairs(pairs: dict[str, Any]) -> None:
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in pairs.items():
        table.add_row(f"[dim]{name}[/]", _number(value))
    out.print(table)


def phases() -> Callable[[Any], None]:
    """What prints a line for each phase of a grasp on stderr, with the time since the first."""
    begin_ns: list[int] = []

    def show_phase(status: Any) -> None:
        begin_ns.append(status.t_ns)
        after_s = (status.t_ns - begin_ns[0]) / 1e9
        note = f" [bold]{status.outcome}[/]" if status.outcome else ""
        err.print(f"[dim]{after_s:8.2f} s[/] {status.phase}{note} [dim]{escape(status.reason)}[/]")

    return show_phase


def grasp_table(r: dict[str, Any]) -> None:
    """How a grasp went."""
    share = ""
    if r["steady_error_n"] is not None:
        share = f" ({100 * r['steady_error_n'] / r['target_n']:+.1f} %)"
    _pairs(
        {
            "result": r["result"],
            "object": r["object"],
            "target": _number(r["target_n"], " N", 2),
            "load cell, mean": _number(r["load_cell_mean_n"], " N"),
            "steady error": _number(r["steady_error_n"], " N") + share,
            "overshoot": _number(r["overshoot_n"], " N"),
            "settling time": _number(r["settle_s"], " s", 2),
            "estimator p50, p99": f"{_number(r['estimator_p50_ms'], '', 1)}, "
            f"{_number(r['estimator_p99_ms'], '', 1)} ms",
            "control loop": _number(r["loop_hz"], " Hz", 1),
            "camera": _number(r["camera_hz"], " Hz", 1),
            "samples rejected": _number(r["samples_rejected"]),
            **{f"auto, {i}": text for i, text in enumerate(r["taken"], 1)},
            "log": r["log"],
            "report": r["report"] or "-",
        }
    )


def trials_table(r: dict[str, Any]) -> None:
    """How each of several grasps went, and what they come to."""
    table = Table(
        "object", "target N", "load cell N", "error %", "overshoot N", "settle s", "result", box=None
    )
    for t in r["trials"]:
        error = None if t["steady_error_n"] is None else 100 * t["steady_error_n"] / t["target_n"]
        table.add_row(
            t["object"],
            _number(t["target_n"], digits=2),
            _number(t["load_cell_mean_n"], digits=2),
            _number(error, digits=1),
            _number(t["overshoot_n"], digits=2),
            _number(t["settle_s"], digits=2),
            t["result"],
        )
    out.print(table)
    summary = dict(r["summary"])
    errors = summary.pop("estimate_mae_n")
    _pairs(summary)
    table = Table("MAE over the whole run, N", "vision", "current", "fused", "floor", box=None)
    for name, e in errors.items():
        table.add_row(name, *(_number(e[key]) for key in ("visual", "current", "fused", "floor")))
    out.print(table)


def errors_table(r: dict[str, Any]) -> None:
    """Errors of estimates: over all, by object and by force."""
    _pairs({key: r[key] for key in ("mae_n", "rmse_n", "bias_n", "floor_n", "frames")})
    table = Table("object", "MAE N", "RMSE N", "contact MAE N", "floor N", "frames", box=None)
    for name, o in r["per_object"].items():
        figures = (o["mae_n"], o["rmse_n"], o["contact_mae_n"], o["floor_n"])
        table.add_row(name, *(_number(value) for value in figures), str(o["frames"]))
    out.print(table)
    _bins_table(r["per_bin"])


def _bins_table(bins: list[dict[str, Any]]) -> None:
    table = Table("force N", "MAE N", "bias N", "frames", box=None)
    for b in bins:
        span = f"{b['from_n']:.0f}-{b['to_n']:.0f}"
        table.add_row(span, _number(b["mae_n"]), _number(b["bias_n"]), str(b["frames"]))
    out.print(table)


def replay_table(r: dict[str, Any]) -> None:
    """What a replay gave."""
    identical = {True: "yes, to the bit", False: "no", None: "nothing to compare"}[r["identical"]]
    if r["note"]:
        identical += f": {r['note']}"
    pairs = {"identical": identical}
    if r["changed"] and not r["identical"]:
        pairs["commands"] = f"at most {1e3 * r['changed']['goal_current_a']:.0f} mA off the run's"
        pairs["fused force"] = f"at most {r['changed']['fused_n']:.2f} N off the run's"
    _pairs({**pairs, "log": r["log"], **({"report": r["report"]} if "report" in r else {})})
    table = Table("source", "MAE N", "RMSE N", "bias N", "contact MAE N", "lag ms", "samples", box=None)
    for name, s in r["sources"].items():
        figures = (s["mae_n"], s["rmse_n"], s["bias_n"], s["contact_mae_n"])
        lag = _number(1e3 * s["lag_s"], digits=0)
        table.add_row(name, *(_number(value) for value in figures), lag, str(s["frames"]))
    out.print(table)
    _bins_table(r["per_bin"])


def paper_tables(r: dict[str, Any]) -> None:
    """The paper's tables, and where its figures are."""
    from gripper_force.reproduce.tables import show

    for made in r["tables"]:
        table = Table(*made.columns, title=made.title, title_justify="left", box=None)
        for row in made.rows:
            table.add_row(*map(show, row))
        out.print(table)
        out.print()
    for name, path in r["figures"].items():
        out.print(f"{name}: {path}", soft_wrap=True)


def sets_table(r: dict[str, Any]) -> None:
    """What is in recorded sets."""
    rate = f"Hz of {r['overall']['camera_hz_asked']:g}"
    names = ("set", "frames", rate, "lost", "cell Hz", "rejected", "peak N", "lag ms")
    columns = [Column(name, no_wrap=True) for name in names]
    table = Table(*columns, box=None, pad_edge=False, collapse_padding=True)
    for s in (*r["sets"], {**r["overall"], "set": "all"}):
        table.add_row(
            s["set"],
            str(s["frames"]),
            _number(s["camera_hz"], digits=1),
            str(s["frames_lost"]),
            _number(s["load_cell_hz"], digits=1),
            str(s["samples_rejected"]),
            _number(s["peak_n"], digits=1),
            _lag(s["lag_ms"], s["lag_spread_ms"]),
        )
    out.print(table)
    table = Table("force N", "frames", box=None)
    for n, count in r["overall"]["histogram"].items():
        table.add_row(f"{n}-{n + 1}", str(count))
    out.print(table)
    for warning in r["warnings"]:
        out.print(f"[yellow]{escape(warning)}[/]", soft_wrap=True)


def _lag(lag_ms: float | None, spread_ms: float | None) -> str:
    """Of one touch alone, nothing is known of the spread."""
    return _number(lag_ms, digits=1) + ("" if spread_ms is None else f" ± {spread_ms:.1f}")


def imports_table(r: dict[str, Any]) -> None:
    """What became of recordings."""
    table = Table("log", "frames", "without force", "spikes", "tare N", "lag ms", box=None)
    for row in r["logs"]:
        figures = (_number(row["tare_n"], digits=3), f"{1e3 * row['force_lag_s']:.0f}")
        counts = (str(row[name]) for name in ("frames", "frames_without_force", "spikes_rejected"))
        table.add_row(Path(row["log"]).name, *counts, *figures)
    out.print(table)
    for row in r["logs"]:
        if row["tare_note"]:
            note = f"no tare: {row['tare_note']}"
            out.print(f"[yellow]{escape(Path(row['log']).name)}[/] {escape(note)}", soft_wrap=True)


def database_table(r: dict[str, Any]) -> None:
    """What became of the database's folders, and what was wrong with them."""
    columns = ("object", "degrees", "lux", "logs", "kept", "touches", "frames", "spikes_rejected")
    table = Table("folder", *(name.removesuffix("_rejected") for name in columns), box=None)
    for row in r["environments"]:
        table.add_row(row.folder, *(str(getattr(row, name)) for name in columns))
    out.print(table)
    for row in r["environments"]:
        for problem in row.problems:
            out.print(f"[yellow]{escape(row.folder)}[/] {escape(problem)}", soft_wrap=True)
    if r["ignored"]:
        out.print(f"[yellow]not imported[/] {escape(', '.join(r['ignored']))}", soft_wrap=True)


def checks_table(r: dict[str, Any]) -> None:
    """What doctor found, and what to do."""
    marks = {True: "[green]ok[/]", False: "[bold red]problem[/]", None: "-"}
    table = Table(box=None, show_header=False, pad_edge=False)
    for check in r["checks"]:
        advice = f"\n[yellow]{escape(check.advice)}[/]" if check.advice else ""
        style = "dim" if check.ok is None else ""
        table.add_row(marks[check.ok], check.unit, check.name, escape(check.found) + advice, style=style)
    out.print(table)


def fuzz_table(r: dict[str, Any]) -> None:
    """What readers made of hostile input."""
    table = Table("target", "inputs", "results", "typed errors", "findings", box=None)
    for name, row in r["targets"].items():
        table.add_row(name, *(str(row[key]) for key in ("inputs", "results", "typed_errors", "findings")))
    out.print(table)
    for finding in r["findings"]:
        out.print(f"[bold red]{escape(f'{finding.target}:{finding.index}')}[/] {escape(finding.error)}")
        out.print(f"  kept as {finding.file}", soft_wrap=True)
    _pairs({"inputs": r["inputs"], "seed": r["seed"], "seconds": r["wall_s"]})


def commands_table(r: dict[str, Any]) -> None:
    """What commands take."""
    table = Table("gripper-force", "time s", "CPU s", "memory MB", box=None)
    for c in r["commands"]:
        figures = (_number(c.wall_s, digits=1), _number(c.cpu_s, digits=1), _number(c.memory_mb, digits=0))
        table.add_row(c.command, *figures)
    out.print(table)
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def startup_table(r: dict[str, Any]) -> None:
    """What scenes take to start."""
    table = Table("scene", "time s", "memory MB", "libraries", "threads", box=None)
    for s in r["startup"]:
        figures = (_number(s.time_s, digits=2), _number(s.memory_mb, digits=0))
        libraries = ", ".join(name for name in s.loaded if "gripper_" not in name)
        table.add_row(s.scene, *figures, libraries, ", ".join(s.threads))
    out.print(table)
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def scene_table(r: dict[str, Any]) -> None:
    """What the levels of detail of simulated objects cost."""
    columns = ("object", "detail", "unknowns", "step ms", "iterations", "simulated s/s", "RMSE N", "worst N")
    table = Table(*columns, box=None)
    for s in r["scene"]:
        solver = (str(s.unknowns), f"{s.step_ms:g}", _number(s.iterations, digits=1))
        figures = (_number(s.speed, digits=1), _number(s.error_n), _number(s.worst_n))
        table.add_row(s.object, s.detail, *solver, *figures)
    out.print(table)
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def loop_table(r: dict[str, Any]) -> None:
    """What a loop in real time did."""
    table = Table("beside", "missed %", "late", "worst", "bus", "cycle", "estimate", "lost", box=None)
    for c in r["loop"]:
        late, bus, cycle, estimate = (
            "/".join(_number(ms, digits=2) for ms in pair)
            for pair in (
                (c.late_p50_ms, c.late_p99_ms),
                (c.bus_p50_ms, c.bus_p99_ms),
                (c.cycle_p50_ms, c.cycle_p99_ms),
                (c.estimator_p50_ms, c.estimator_p99_ms),
            )
        )
        missed, worst = _number(100 * c.missed / c.cycles), _number(c.late_max_ms, digits=2)
        table.add_row(c.beside, missed, late, worst, bus, cycle, estimate, str(c.lost_records))
    out.print(table)
    out.print(
        f"[dim]p50/p99 in ms of {r['loop'][0].cycles} cycles; a servo behind a pseudo-terminal, a recorded "
        "camera, no physics[/]"
    )
    log = r["log"]
    _pairs(
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
        numbers = (_number(value) for value in figures)
        share = _number(100 * c.cpu_share, digits=1)
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
            *(_number(value, digits=2) for value in (e.p50_ms, e.p99_ms)),
            _number(share, digits=1),
            _number(e.mae_n),
            _number(e.worst_n, digits=2),
            _number(e.memory_mb, digits=0),
            "*" if e.front else "",
        )
    out.print(table)
    for checkpoint, told in r["ratios"].items():
        _pairs(
            {
                f"{Path(checkpoint).stem}: fastest that keeps the error": told["fastest"],
                "faster than the window in PyTorch": f"{told['times_faster_than_window']:.0f} times",
            }
        )
    _pairs({"*": "no other way is faster and more exact"})
    _pairs({"plot": str(r["plot"]), "kept in": str(r["file"])})
    out.print(f"[dim]load {r['load']:.1f} on {r['cores']} cores[/]")


def learning_table(r: dict[str, Any]) -> None:
    """Ways to train."""
    table = Table("way", "minutes", "steps", "MAE N", "RMSE N", box=None)
    for p in r["points"]:
        table.add_row(p.way, _number(p.minutes, digits=2), str(p.steps), _number(p.mae_n), _number(p.rmse_n))
    out.print(table)
    _pairs({f"{way}: as good as the paper's, min": m for way, m in r["as_good_as_paper_min"].items()})
    _pairs({"kept in": str(r["folder"])})


def numerics_tables(r: dict[str, Any]) -> None:
    """Hard cases for the numbers, part by part."""
    from gripper_force.stability.numerics import said

    for name, rows in r["parts"].items():
        title = f"{name} ({r['seconds'][name]:.0f} s)"
        table = Table("case", "how", "found", "bound", title=title, title_justify="left", box=None)
        for row in rows:
            colour = "green" if row.ok else "bold red"
            found = f"[{colour}]{said(row.figure, row.unit)}[/]"
            table.add_row(escape(row.case), escape(row.detail), found, said(row.bound, row.unit))
        out.print(table)
        out.print()


def faults_table(r: dict[str, Any]) -> None:
    """The fault matrix."""
    table = Table(
        "fault", "expected", "as expected", "worst ms", "of", "live ms", "peak over limit", box=None
    )
    for row in r["rows"]:
        colour = "green" if row["ok"] == row["runs"] else "bold red"
        table.add_row(
            row["row"],
            row["expected"],
            f"[{colour}]{row['ok']} of {row['runs']}[/]",
            _number(row["worst_ms"], digits=1),
            _number(row["within_ms"], digits=0),
            _number(row["live_worst_ms"], digits=1),
            f"{100 * row['peak_over_limit']:+.1f} %",
        )
    out.print(table)
    for row in r["rows"]:
        for seed, why_not in row["failures"].items():
            out.print(f"[bold red]{row['row']}[/], seed {seed}: {plain(why_not)}", soft_wrap=True)


def soak_table(r: dict[str, Any]) -> None:
    """The process over many grasps."""
    table = Table("simulated s", "memory MB", "files", "threads", box=None)
    for s in r["samples"]:
        table.add_row(
            _number(s.simulated_s, digits=0), _number(s.memory_mb, digits=1), str(s.handles), str(s.threads)
        )
    out.print(table)
    summary = {key: value for key, value in r.items() if key not in ("samples", "outcomes")}
    _pairs({**summary, "outcomes": ", ".join(f"{n} {name}" for name, n in r["outcomes"].items())})


def rig_table(r: dict[str, Any]) -> None:
    """What a calibration of the rig found, each value with its 95 % interval."""
    _pairs({name: _found(value) for name, value in r.items()})


def _found(value: Any) -> Any:
    if isinstance(value, list):
        return ", ".join(f"{item:.5g}" for item in value)
    if not isinstance(value, dict):
        return value
    if value["low"] is None:
        return f"{value['value']:.6g} (given)"
    return f"{value['value']:.6g} ({value['low']:.6g} to {value['high']:.6g})"


def object_table(r: dict[str, Any]) -> None:
    """An object's profile."""
    after_n = r["after_n"]
    interval, plant = r["interval"], r["plant"]
    _pairs(
        {
            "object": r["object"],
            "touches": f"{r['touches']} with {r['frames']} frames, up to {r['force_n']:.1f} N",
            **(
                {}
                if (at := r["crushed_at_n"]) is None
                else {"crushed": f"it stayed narrower after {at:.1f} N"}
            ),
            "error before": _number(r["before_n"], "N"),
            "error after": "not known with so few touches" if after_n is None else _number(after_n, "N"),
            "correction": r["correction"],
            "interval": f"{100 * interval['coverage']:.0f} % within {interval['base_n']:.2f} N at no force, "
            f"{math.hypot(interval['base_n'], 5 * interval['share']):.2f} N at 5 N",
            "stiffness": _number(r["stiffness_n_m"], "N/m", 0),
            "loop": "not known: no servo in these logs"
            if plant is None
            else f"gain {plant['gain']:.2f}, lag {plant['lag_ms']:.0f} ms, delay {plant['delay_ms']:.0f} ms, "
            f"phase margin {plant['phase_margin_deg']:.0f} degrees",
            "profile": str(r["profile"]),
            "report": str(r["report"]),
        }
    )


def changes_table(servo: str, changes: list[Any]) -> None:
    """Registers that would change, on stderr."""
    table = Table(servo, "is", "becomes", box=None, pad_edge=False)
    for change in changes:
        table.add_row(change.register, change.old, change.new)
    err.print(table)


def setup_line(r: dict[str, Any]) -> None:
    """What became of a servo's set-up."""
    done = "set up, and read back" if r["applied"] else "left as it is"
    out.print(f"servo {r['servo']}: {done if r['changes'] else 'nothing to change'}")


def plain(error: GripperError) -> str:
    """An error's sentence, whose brackets are no markup."""
    return str(error).replace("[", r"\[")
