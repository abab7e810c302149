"""Tables of forces that belong to a video, and the tare that they show."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.errors import DataError

TARE_S: Final = 0.25
"""Start of a recording that the tare is estimated from."""

TARE_SPREAD_N: Final = 0.05
"""Largest range of the force in that time."""

TARE_RISE_N: Final = 1.0
"""Smallest later rise of the force, and largest later fall, that a tare needs."""

_MAX_T_S: Final = 4e9
"""Largest time, over 100 years: beyond it the unit is none of seconds, and from 9.2e9 s on a log can't hold it."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ForceTable:
    """Rows of a table of forces.

    Attributes:
        frame: Frame numbers, (N,), rising.
        t_s: Times, (N,), rising.
        force_n: Forces as measured, (N,).
    """

    frame: npt.NDArray[np.int64]
    t_s: Floats
    force_n: Floats


def read_forces(path: Path) -> ForceTable:
    """Reads a table with the columns ``frame``, ``t_s`` and ``force_n``.

    Raises:
        DataError: The table is missing or empty, lacks a column, or has a value that is not a finite number,
            a time of more than 100 years, a repeated frame, or rows out of order. The message names the line.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            columns = ("frame", "t_s", "force_n")
            missing = [column for column in columns if column not in (reader.fieldnames or [])]
            if missing:
                found = ",".join(reader.fieldnames or [])  # shows another separator, or other letters
                raise DataError(
                    f"{path} lacks the column {missing[0]!r}: its first line is {found[:80]!r}; name columns frame, "
                    "t_s and force_n, separated by commas"
                )
            rows = [
                [_number(path, reader.line_num, column, row[column]) for column in columns] for row in reader
            ]
    except OSError as error:
        raise DataError(f"can't read the table of forces {path}: {error.strerror}; check the path") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path} is not a CSV table ({error}); export it as CSV in UTF-8") from error
    if not rows:
        raise DataError(f"{path} holds no rows; it needs one per frame")
    values = np.array(rows)  # (N, 3)
    unordered = np.flatnonzero((np.diff(values[:, 0]) <= 0) | (np.diff(values[:, 1]) <= 0))
    if len(unordered):
        row = int(unordered[0])
        raise DataError(
            f"{path}: frame {values[row + 1, 0]:.0f} at {values[row + 1, 1]:.4f} s follows frame "
            f"{values[row, 0]:.0f} at {values[row, 1]:.4f} s; sort the rows by frame and time"
        )
    return ForceTable(values[:, 0].astype(np.int64), values[:, 1], values[:, 2])


def _number(path: Path, line: int, column: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    # From 2**53 on a float can't represent every frame number.
    whole = value.is_integer() and abs(value) < 2**53
    if not math.isfinite(value) or (column == "frame" and not whole):
        kind = "frame number" if column == "frame" else "finite number"
        raise DataError(f"{path}, line {line}: {column} is {text!r} and not a {kind}; correct the line")
    if column == "t_s" and abs(value) > _MAX_T_S:
        raise DataError(
            f"{path}, line {line}: t_s is {text!r}, more than 100 years; write the times in seconds"
        )
    return value


def estimate_tare(t_s: Floats, force_n: Floats) -> tuple[float, str]:
    """Estimates the load cell's offset from the start of a recording that starts without contact.

    Args:
        t_s: Times, (N,).
        force_n: Forces as measured, (N,).

    Returns:
        The offset in N and an empty text; or 0 and the reason why the start may not be unloaded.
    """
    start = force_n[t_s <= t_s[0] + TARE_S]
    offset = float(np.median(start))
    if len(start) < 3:
        return (
            0.0,
            f"the first {TARE_S} s hold {len(start)} forces, too few to distinguish an offset from a touch",
        )
    if np.ptp(start) > TARE_SPREAD_N:
        return (
            0.0,
            f"the force moves by {np.ptp(start):.2f} N in the first {TARE_S} s, so contact may be near",
        )
    if float(np.percentile(force_n, 25)) < offset - TARE_RISE_N:
        return 0.0, "the force starts above its later level, so the gripper may start loaded"
    if float(force_n.max()) < offset + TARE_RISE_N:
        return 0.0, f"the force never rises by {TARE_RISE_N} N, so the start may not be unloaded"
    return offset, ""
