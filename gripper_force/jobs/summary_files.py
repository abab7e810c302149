"""Files of a replay or an evaluation of many logs: a page, a table of the logs, JSON, and the estimates."""

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from html import escape
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gripper_force.errors import ConfigError
from gripper_force.plugins import importing, require

if TYPE_CHECKING:
    from gripper_force.jobs.evaluate import Evaluation
    from gripper_force.jobs.replay import Replays
    from gripper_force.jobs.replay.comparison import Columns, PairedDifference

Rows = list[dict[str, Any]]

_FRAMES: Final = "frames.parquet"

_PAGE: Final = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title><style>
:root {{ color-scheme: light dark; }}
body {{ font: 15px/1.45 system-ui, sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em; }}
section {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }}
th, td {{ text-align: left; padding: .25em .9em .25em 0; border-bottom: 1px solid #8884; white-space: nowrap; }}
td:nth-child(2):last-child {{ white-space: normal; min-width: 20em; }}
td.number {{ text-align: right; }}
</style></head><body><h1>{title}</h1>
{sections}
</body></html>
"""

_UNPRINTABLE: Final = "backslashreplace"
"""Treatment of bytes of a file's name that are not UTF-8."""

_NOTES: Final = {
    "sources": "Errors against the load cell over all estimates, without frames that a network does not know. The mean "
    "over logs counts each log once; low and high are the ends of its 95 % interval (Student's t).",
    "differences": "Second less first, of each log's mean absolute error: the mean over logs, and the ends of its 95 % "
    "interval, low and high (Student's t). If zero lies between them, the logs do not show which is better. Visual "
    "estimates are compared on the frames that both networks know.",
    "failed": "These logs failed. A log that failed with one of two settings is not part of the differences.",
}


def check_writable(folder: Path, option: str = "--out") -> None:
    """Makes the folder that an option of the command names, before the work begins.

    Raises:
        ConfigError: The folder can't be made, no file can be written there, or the package for intervals is missing.
    """
    require("scipy", option, f", or leave out {option}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigError(
            f"can't write in the folder {folder} of {option}: {error.strerror}; choose another"
        ) from error


def missing_parquet() -> str:
    """Returns a sentence if a package for the estimates' file is missing, so that there will be no such file."""
    try:
        with importing(f"{_FRAMES} of --out", "; the other files are written without it"):
            import pyarrow
            import pyarrow.parquet  # noqa: F401
    except (ConfigError, ImportError) as error:
        return str(error)
    return ""


def replay_tables(
    sides: "Mapping[str, Replays]", differences: "Mapping[str, PairedDifference] | None" = None
) -> dict[str, Rows]:
    """Returns the tables of one replay of logs, or of the two sides of a comparison, by the name of each side."""
    from gripper_force.jobs.metrics import mean_interval
    from gripper_force.jobs.replay.comparison import Comparison, summarise_replays

    tables: dict[str, Rows] = {name: [] for name in ("differences", "sources", "objects", "logs", "failed")}
    for side, replays in sides.items():
        head = {"setting": side} if len(sides) > 1 else {}
        over_all = summarise_replays(replays.results)
        for source, errors in over_all.sources.items():
            each_n = [r.sources[source].mae_n for r in replays.results if source in r.sources]
            mean_n, low_n, high_n = mean_interval(each_n)
            of_logs = {"logs": len(each_n), "mean_mae_n": mean_n, "low_n": low_n, "high_n": high_n}
            tables["sources"].append({**head, "source": source, **asdict(errors), **of_logs})
        for name, sources in over_all.per_object.items():
            for source, errors in sources.items():
                tables["objects"].append({**head, "object": name, "source": source, **asdict(errors)})
        for result in replays.results:
            # A log without a load cell has a row, too, without errors.
            comparisons: Mapping[str, Comparison | None] = result.sources or {"": None}
            for source, comparison in comparisons.items():
                figures = {
                    field.name: None if comparison is None else getattr(comparison, field.name)
                    for field in fields(Comparison)
                    if field.name != "per_bin"
                }
                about = {
                    "log": result.log,
                    "object": next(iter(result.per_object)),
                    "identical": result.identical,
                    "seen": result.seen,
                    "refused": result.refused,
                }
                tables["logs"].append({**head, **about, "source": source, **figures})
        tables["failed"] += [{**head, "log": log, "problem": str(e)} for log, e in replays.failed.items()]
    for source, difference in (differences or {}).items():
        tables["differences"].append({"source": source, **asdict(difference)})
    return tables


def evaluation_tables(result: "Evaluation") -> dict[str, Rows]:
    """Returns the tables of an evaluation."""
    from gripper_force.jobs.metrics import mean_interval

    over_all = {key: getattr(result, key) for key in ("mae_n", "rmse_n", "bias_n", "floor_n", "frames")}
    # A log with labels in its lead-in only has no error.
    each_n = [errors.mae_n for errors in result.per_log.values() if math.isfinite(errors.mae_n)]
    mean_n, low_n, high_n = mean_interval(each_n)
    of_logs = {"logs": len(each_n), "mean_mae_n": mean_n, "low_n": low_n, "high_n": high_n}
    return {
        "sources": [{"source": "visual", **over_all, **of_logs}],
        "objects": [{"object": name, **asdict(errors)} for name, errors in result.per_object.items()],
        "forces": [asdict(one) for one in result.per_bin],
        "logs": [{"log": log, **asdict(errors)} for log, errors in result.per_log.items()],
        "failed": [{"log": log, "problem": problem} for log, problem in result.failed.items()],
    }


def write_summary(
    folder: Path, title: str, tables: Mapping[str, Rows], columns: "Iterable[Columns]"
) -> list[Path]:
    """Writes ``summary.html``, ``summary.json``, ``summary.csv`` (the table of the logs) and ``frames.parquet``.

    The last one is left out if `missing_parquet`.

    Args:
        folder: An existing folder; see `check_writable`.
        title: Heading of the page.
        tables: Tables by name; ``logs`` among them.
        columns: Estimates of each log.

    Returns:
        The files.

    Raises:
        ConfigError: A file can't be written.
    """
    page, table, tree = (folder / name for name in ("summary.html", "summary.csv", "summary.json"))
    files, frames = [page, table, tree], folder / _FRAMES
    try:
        sections = [_section(name, rows) for name, rows in tables.items() if rows]
        page.write_text(
            _PAGE.format(title=escape(title), sections="\n".join(sections)),
            encoding="utf-8",
            errors=_UNPRINTABLE,
        )
        with table.open("w", newline="", encoding="utf-8", errors=_UNPRINTABLE) as file:
            writer = csv.DictWriter(file, list(tables["logs"][0]))
            writer.writeheader()
            writer.writerows({key: _known(value) for key, value in row.items()} for row in tables["logs"])
        clean = {
            name: [{k: _known(v) for k, v in row.items()} for row in rows] for name, rows in tables.items()
        }
        tree.write_text(json.dumps({"title": title, **clean}, indent=1, allow_nan=False), encoding="utf-8")
        if missing_parquet():
            frames.unlink(missing_ok=True)  # one of an earlier summary would not belong to this one
        else:
            _write_parquet(frames, list(columns))
            files.append(frames)
    except OSError as error:
        raise ConfigError(
            f"can't write the summary in {folder}: {error.strerror}; choose another --out"
        ) from error
    return files


def _write_parquet(path: Path, columns: "Sequence[Columns]") -> None:
    import pyarrow as pa
    from pyarrow import parquet

    names = columns[0].keys()
    joined = {name: np.concatenate([one[name] for one in columns]) for name in names}
    joined["log"] = np.array([str(log).encode(errors=_UNPRINTABLE).decode() for log in joined["log"]], object)
    parquet.write_table(pa.table(joined), path, compression="zstd")


def _section(name: str, rows: Rows) -> str:
    head = "".join(f"<th>{escape(_heading(key))}</th>" for key in rows[0])
    body = "".join(f"<tr>{''.join(_cell(value) for value in row.values())}</tr>" for row in rows)
    note = f"<p>{escape(_NOTES[name])}</p>" if name in _NOTES else ""
    return (
        f"<section><h2>{escape(name.capitalize())}</h2>{note}"
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></section>"
    )


def _heading(key: str) -> str:
    """Returns the name of a column, with its unit in brackets."""
    name, _, unit = key.replace("rmse", "RMSE").replace("mae", "MAE").rpartition("_")
    units = {"n": "N", "s": "s"}
    return f"{name.replace('_', ' ')} [{units[unit]}]" if unit in units else key


def _cell(value: object) -> str:
    value = _known(value)
    if isinstance(value, bool):
        value = "yes" if value else "no"
    if isinstance(value, float):
        return f'<td class="number">{value:.3f}</td>'
    if isinstance(value, int):
        return f'<td class="number">{value}</td>'
    return f"<td>{'-' if value is None else escape(str(value))}</td>"


def _known(value: Any) -> Any:
    """Returns None for NaN, which JSON does not have."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
