"""Numerical test suite: hard cases of each part, each with a figure and a bound."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, TypedDict

from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.progress import Progress, no_progress
from gripper_force.qualification.numerics.numerical_case import NumericalCase

Part = Callable[[Config, Path | None], Iterator[NumericalCase]]
"""Yields the cases of a part, and draws its maps into a folder, if one is given."""


class NumericsReport(TypedDict):
    """Result of `run`.

    Attributes:
        parts: Cases by part.
        seconds: Duration of each part.
        ok: True if all cases are within their bounds.
    """

    parts: dict[str, list[NumericalCase]]
    seconds: dict[str, float]
    ok: bool


def _network(config: Config, maps: Path | None) -> Iterator[NumericalCase]:
    from gripper_force.qualification.numerics.network_cases import cases

    return cases(config, maps)


def _loop(config: Config, maps: Path | None) -> Iterator[NumericalCase]:
    from gripper_force.qualification.loop_margin.loop_cases import cases

    return cases(config, maps)


def _filter(config: Config, maps: Path | None) -> Iterator[NumericalCase]:
    from gripper_force.qualification.numerics.filter_cases import cases

    return cases(config, maps)


def _simulator(config: Config, maps: Path | None) -> Iterator[NumericalCase]:
    from gripper_force.qualification.numerics.simulator_cases import cases

    return cases(config, maps)


PARTS: Final[dict[str, Part]] = {
    "network": _network,
    "loop": _loop,
    "filter": _filter,
    "simulator": _simulator,
}
"""Parts of the suite, in the order of docs/stability.md. Each imports its libraries when it is called."""


def run(
    config: Config, parts: Sequence[str], maps: Path | None = None, progress: Progress = no_progress
) -> NumericsReport:
    """Runs parts of the suite.

    Args:
        config: Control and its limits, the gripper, and the estimator's checkpoint under test.
        parts: Names in `PARTS`; an empty sequence means all of them.
        maps: Folder for the maps, or None for no maps.
        progress: Called after each case with 0 steps, and after each part with 1.

    Raises:
        ConfigError: A part does not exist.
    """
    if unknown := [name for name in parts if name not in PARTS]:
        raise ConfigError(f"no part {unknown[0]!r}; choose from {', '.join(PARTS)}")
    rows: dict[str, list[NumericalCase]] = {}
    seconds: dict[str, float] = {}
    for name in [part for part in PARTS if part in parts or not parts]:
        begin_s = time.monotonic()
        rows[name] = []
        for row in PARTS[name](config, maps):
            rows[name].append(row)
            progress(f"{name}: {row.case}", 0)
        seconds[name] = round(time.monotonic() - begin_s, 1)
        progress(name, 1)
    return {"parts": rows, "seconds": seconds, "ok": all(row.ok for part in rows.values() for row in part)}


def markdown(rows: Sequence[NumericalCase]) -> str:
    """Markdown table of the cases of a part."""
    head = "| case | method | found | bound | |\n|---|---|---|---|---|\n"
    return head + "".join(
        f"| {row.case} | {row.detail} | {with_unit(row.figure, row.unit)} | {with_unit(row.bound, row.unit)} "
        f"| {'ok' if row.ok else '**exceeded**'} |\n"
        for row in rows
    )


def with_unit(figure: float, unit: str) -> str:
    """Figure with its unit; a dash for an infinite bound."""
    return "-" if figure == math.inf else f"{figure:.3g} {unit}".rstrip()
