"""Tables of a grasp, of trials, of a replay, and of errors of estimates."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Column, Table

from gripper_force.cli.console import label, number, out, pairs

if TYPE_CHECKING:  # --help loads neither NumPy nor PyTorch
    from gripper_force.jobs.evaluate import Evaluation
    from gripper_force.jobs.grasp import GraspSummary
    from gripper_force.jobs.metrics import ForceBin
    from gripper_force.jobs.replay.comparison import PairedDifference, ReplayResult, ReplaySummary
    from gripper_force.jobs.trials import TrialsSummary


_REFUSED = (
    "The network does not know {} of {} frames. A run refuses them, so they have no part in the errors of vision; "
    "evaluate counts them."
)


def _table(*columns: str) -> Table:
    """Returns a table that continues a long cell in the next line: a narrow output must not lose digits or names."""
    return Table(*(Column(one, overflow="fold") for one in columns), box=None, pad_edge=False)


def grasp_table(r: "GraspSummary") -> None:
    """Prints the figures of a grasp."""
    share = ""
    if r["steady_error_n"] is not None:
        share = f" ({100 * r['steady_error_n'] / r['target_n']:+.1f} %)"
    pairs(
        {
            "result": r["result"] + (", fell back to motor current" if r["fell_back"] else ""),
            **({"reason": r["reason"]} if r["reason"] and r["result"] != "held" else {}),
            "object": r["object"],
            "target": number(r["target_n"], " N", 2),
            "load cell, mean": number(r["load_cell_mean_n"], " N"),
            "steady error": number(r["steady_error_n"], " N") + share,
            "overshoot": number(r["overshoot_n"], " N"),
            "settling time": number(r["settle_s"], " s", 2),
            **_vision(r),
            "estimator p50, p99": f"{number(r['estimator_p50_ms'], '', 1)}, "
            f"{number(r['estimator_p99_ms'], '', 1)} ms",
            "control loop": number(r["loop_hz"], " Hz", 1),
            "camera": number(r["camera_hz"], " Hz", 1),
            "samples rejected": number(r["samples_rejected"]),
            **{f"auto, {i}": text for i, text in enumerate(r["taken"], 1)},
            "log": r["log"],
            "report": r["report"] or "-",
        }
    )


def _vision(r: "GraspSummary") -> dict[str, str]:
    if r["vision_share"] is None:
        return {}
    losses = "\n".join(map(str, r["vision_losses"]))
    gain = {} if r["object_gain"] is None else {"object's gain": _gain(r)}
    return {
        "vision used": f"{100 * r['vision_share']:.0f} % of the hold",
        **({"vision lost": losses} if losses else {}),
        **gain,
    }


def _gain(r: "GraspSummary") -> str:
    if r["object_gain"] is None:
        return "-"
    true = "" if r["object_gain_true"] is None else f" (true: {r['object_gain_true']:.2f})"
    return f"{r['object_gain']:.2f} +- {100 * (r['object_gain_std'] or 0.0):.0f} %{true}"


def trials_table(
    trials: "Sequence[GraspSummary]", summary: "TrialsSummary", figure: str | None = None
) -> None:
    """Prints the figures of each trial and over all trials."""
    from gripper_force.jobs.trials import WITHIN_N, WITHIN_SHARE

    # 80 columns must do.
    units = ("target\nN", "load cell\nN", "error\n%", "overshoot\nN", "settle\ns", "vision\n%")
    table = _table("object", *units, "gain", "result")
    for t in trials:
        error = None if t["steady_error_n"] is None else 100 * t["steady_error_n"] / t["target_n"]
        table.add_row(
            escape(t["object"]),
            number(t["target_n"], digits=2),
            number(t["load_cell_mean_n"], digits=2),
            number(error, digits=1),
            number(t["overshoot_n"], digits=2),
            number(t["settle_s"], digits=2),
            number(None if t["vision_share"] is None else 100 * t["vision_share"], digits=0),
            number(t["object_gain"], digits=2),
            t["result"] + (", fell back" if t["fell_back"] else ""),
        )
    out.print(table)
    if summary["fell_back"]:
        left_out = any(t["fell_back"] and t["feedback"] == "vision" for t in trials)
        out.print(
            f"{summary['fell_back']} of {summary['trials']} trials fell back to motor current: less than half of "
            f"their hold used vision. They {'are left out of' if left_out else 'count in'} the errors."
        )
    names = {
        "good_percent": f"within {100 * WITHIN_SHARE:g} % or {WITHIN_N:g} N, %",
        "over_limit": "above the force limit",
    }
    rows = {names.get(key) or label(key): value for key, value in summary.items() if key != "estimate_mae_n"}
    if summary["peak_n"] is None:
        pairs({name: value for name, value in rows.items() if value is not None})
        out.print("No load cell: force errors, overshoot and peaks can't be measured.")
        return
    pairs(rows)
    table = _table("MAE over the run, N", "vision", "current", "fused", "floor")
    for name, e in summary["estimate_mae_n"].items():
        table.add_row(escape(name), *(number(e[key]) for key in ("visual", "current", "fused", "floor")))
    out.print(table)
    if figure is not None:
        pairs({"figure": figure})


def errors_table(r: "Evaluation") -> None:
    """Prints errors of estimates: over all frames, by object and by force."""
    pairs({label(key): getattr(r, key) for key in ("mae_n", "rmse_n", "bias_n", "floor_n", "frames")})
    table = _table("object", "MAE N", "RMSE N", "contact MAE N", "floor N", "frames")
    for name, o in r.per_object.items():
        figures = (o.mae_n, o.rmse_n, o.contact_mae_n, o.floor_n)
        table.add_row(escape(name), *(number(value) for value in figures), str(o.frames))
    out.print(table)
    _bins_table(r.per_bin, "visual")


def _bins_table(bins: "list[ForceBin]", source: str) -> None:
    table = _table("load cell N", f"{source}: MAE N", "bias N", "samples")
    for b in bins:
        span = f"{b.from_n:.0f} to {b.to_n:.0f}"
        table.add_row(span, number(b.mae_n), number(b.bias_n), str(b.frames))
    out.print(table)


def replay_table(r: "ReplayResult", report: str | None = None) -> None:
    """Prints the result of a replay."""
    identical = {True: "yes, bit for bit", False: "no", None: "nothing to compare"}[r.identical]
    if r.note:
        identical += f": {r.note}"
    values = {"identical": identical}
    if r.changed and not r.identical:
        values["commands"] = f"at most {1e3 * r.changed['goal_current_a']:.0f} mA from the run's"
        values["fused force"] = f"at most {r.changed['fused_n']:.2f} N from the run's"
    pairs({**values, "log": r.log, **({} if report is None else {"report": report})})
    _tell_lacking(r)
    if not r.sources:
        return
    table = _table("source", "MAE N", "RMSE N", "bias N", "contact MAE N", "lag ms", "samples")
    for name, s in r.sources.items():
        figures = (s.mae_n, s.rmse_n, s.bias_n, s.contact_mae_n)
        lag = number(None if s.lag_s is None else 1e3 * s.lag_s, digits=0)
        table.add_row(name, *(number(value) for value in figures), lag, str(s.frames))
    out.print(table)
    _bins_table(r.per_bin, "fused" if "fused" in r.sources else "visual")


def replays_table(
    results: "Sequence[ReplayResult]", summary: "ReplaySummary", reports: Sequence[str]
) -> None:
    """Prints the result of several replays: one row for each log, and the errors over all of them."""
    marks = {True: "yes", False: "no", None: "-"}
    table = _table("log", "object", "identical", "vision N", "current N", "fused N")
    for r in results:
        errors = (
            r.sources[name].mae_n if name in r.sources else None for name in ("visual", "current", "fused")
        )
        table.add_row(
            escape(Path(r.log).name),
            escape(", ".join(r.per_object)),
            marks[r.identical],
            *(number(value) for value in errors),
        )
    out.print(table)
    if notes := sorted({r.note for r in results if r.note}):
        out.print("\n".join(notes), soft_wrap=True)
    pairs({"logs": str(summary.logs), "identical": str(summary.identical)})
    _tell_lacking(summary)
    table = _table("object", "source", "MAE N", "RMSE N", "bias N", "samples")
    for name, sources in {"all": summary.sources, **summary.per_object}.items():
        for source, e in sources.items():
            table.add_row(
                escape(name), source, number(e.mae_n), number(e.rmse_n), number(e.bias_n), str(e.frames)
            )
    out.print(table)
    if reports:
        pairs({"reports": reports[0] + (f" and {len(reports) - 1} more" if len(reports) > 1 else "")})


def _tell_lacking(r: "ReplayResult | ReplaySummary") -> None:
    """Says which errors are lacking, and why."""
    if r.refused:
        out.print(_REFUSED.format(r.refused, r.seen), soft_wrap=True)
    if not (r.sources or 0 < r.refused == r.seen):
        out.print("No load cell: force errors can't be measured.")


def differences_table(first: str, second: str, differences: "dict[str, PairedDifference]") -> None:
    """Prints how the errors of two replays differ."""
    sides = (f"{escape(name)}: MAE N" for name in (first, second))
    table = _table("source", "logs", *sides, "difference N", "95 % interval")
    for name, d in differences.items():
        interval = "-" if d.low_n is None or d.high_n is None else f"{d.low_n:+.3f} to {d.high_n:+.3f}"
        row = (number(d.first_n), number(d.second_n), f"{d.difference_n:+.3f}", interval)
        table.add_row(name, str(d.logs), *row)
    out.print(table)
