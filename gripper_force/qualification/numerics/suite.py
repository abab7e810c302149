"""Numerical stability: hard cases of each part, each with a figure and the bound that it must keep."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from gripper_force.config import Config
from gripper_force.errors import ConfigError
from gripper_force.runtime.backends import load

PARTS: Final = {
    "network": "gripper_force.qualification.numerics.network_cases:cases",
    "loop": "gripper_force.qualification.loop_margin.loop_cases:cases",
    "filter": "gripper_force.qualification.numerics.filter_cases:cases",
    "simulator": "gripper_force.qualification.numerics.simulator_cases:cases",
}
"""Parts of the suite, in the order of the page, and the `Part` of each."""


@dataclass(frozen=True, slots=True)
class NumericalCase:
    """One hard case.

    Attributes:
        case: What was done.
        detail: How, and what it is measured against.
        figure: What was found. NaN breaks any bound.
        bound: The most that the figure may be; infinite where it only informs.
        unit: Of both.
        ok: Whether the figure keeps its bound.
    """

    case: str
    detail: str
    figure: float
    bound: float
    unit: str = ""
    ok: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "ok", bool(self.figure <= self.bound))


Part = Callable[[Config, Path | None], Iterator[NumericalCase]]
"""Yields its rows, and draws its maps into a folder if it is given one."""


def run(
    config: Config,
    parts: Sequence[str],
    maps: Path | None = None,
    advance: Callable[[str, int], None] = lambda _note, _done: None,
) -> dict[str, Any]:
    """Runs parts of the suite.

    Args:
        config: What is tested: control and its limits, the gripper, the estimator's checkpoint.
        parts: Names of `PARTS`; none means all of them.
        maps: Folder for the maps, or None for no maps.
        advance: Told of each case, and how many more parts are done.

    Returns:
        ``parts`` (name to a list of `NumericalCase`), ``seconds`` of each, and ``ok``.

    Raises:
        ConfigError: There is no such part.
    """
    if unknown := [name for name in parts if name not in PARTS]:
        raise ConfigError(f"stability has no part {unknown[0]!r}; there are {', '.join(PARTS)}")
    rows: dict[str, list[NumericalCase]] = {}
    seconds: dict[str, float] = {}
    for name in [part for part in PARTS if part in parts or not parts]:
        cases: Part = load(PARTS[name])
        begin_s = time.monotonic()
        rows[name] = []
        for row in cases(config, maps):
            rows[name].append(row)
            advance(f"{name}: {row.case}", 0)
        seconds[name] = round(time.monotonic() - begin_s, 1)
        advance(name, 1)
    return {"parts": rows, "seconds": seconds, "ok": all(row.ok for part in rows.values() for row in part)}


def markdown(rows: Sequence[NumericalCase]) -> str:
    """The cases of a part as a table in Markdown."""
    head = "| case | how | found | bound | |\n|---|---|---|---|---|\n"
    return head + "".join(
        f"| {row.case} | {row.detail} | {said(row.figure, row.unit)} | {said(row.bound, row.unit)} "
        f"| {'ok' if row.ok else '**broken**'} |\n"
        for row in rows
    )


def said(number: float, unit: str) -> str:
    """A figure with its unit; a bound that is none is a dash."""
    return "-" if number == math.inf else f"{number:.3g} {unit}".rstrip()
