"""``sim.detail: auto``: the cheapest level of detail that keeps the budget, by a table that is shipped.

The table is `gripper-force bench scene`'s. It is not measured anew on each machine, as the same
configuration has to give the same log everywhere.
"""

from pathlib import Path
from typing import Final

import yaml

from gripper_force.config import BudgetConfig, Config
from gripper_force.errors import ConfigError

_TABLE: Final = Path(__file__).with_name("detail_level.yaml")
_HEAD: Final = "# Made by `gripper-force bench scene --write docs/simulation.md`. Not to be edited by hand.\n"

Levels = dict[str, dict[str, float]]
"""By level of detail: ``error_n`` and ``speed``, as measured by ``gripper-force bench scene``."""


def keep(table: dict[str, Levels]) -> None:
    """Writes the table, by object."""
    _TABLE.write_text(_HEAD + yaml.safe_dump(table, sort_keys=False), encoding="utf-8")


def resolve_detail(config: Config) -> tuple[Config, str]:
    """Puts a level in place of ``auto``, and says why.

    Returns:
        The configuration with a level that is named, and a sentence; empty where one was named before.

    Raises:
        ConfigError: Nothing was measured of the object, there is no budget, or no level keeps it.
    """
    if config.sim.detail != "auto":
        return config, ""
    table: dict[str, Levels] = yaml.safe_load(_TABLE.read_text(encoding="utf-8"))
    if config.object not in table:
        raise ConfigError(
            f"sim.detail=auto knows nothing of {config.object!r}, but of {', '.join(table)}; name a level"
        )
    detail, why = choose(table[config.object], config.budget, config.object)
    sim = config.sim.model_copy(update={"detail": detail})
    return config.model_copy(update={"sim": sim}), why


def choose(levels: Levels, budget: BudgetConfig, name: str) -> tuple[str, str]:
    """The fastest of an object's levels that keep the budget, and why.

    Raises:
        ConfigError: There is no budget, or none of them keeps it.
    """
    asked = {key: getattr(budget, key) for key in ("sim_error_n", "sim_speed")}
    asked = {key: value for key, value in asked.items() if value is not None}
    if not asked:
        raise ConfigError(
            "sim.detail=auto needs to know what for: set budget.sim_error_n or budget.sim_speed"
        )
    fits = [
        detail
        for detail, level in levels.items()
        if level["error_n"] <= asked.get("sim_error_n", level["error_n"])
        and level["speed"] >= asked.get("sim_speed", level["speed"])
    ]
    named = " and ".join(f"budget.{key}={value:g}" for key, value in asked.items())
    if not fits:
        there = ", ".join(f"{detail}: {_said(level)}" for detail, level in levels.items())
        raise ConfigError(f"no level of detail of a simulated {name} keeps {named}; there are {there}")
    taken = max(fits, key=lambda detail: levels[detail]["speed"])
    return taken, f"took sim.detail={taken} ({_said(levels[taken])}), the fastest that keeps {named}"


def _said(level: dict[str, float]) -> str:
    return f"{level['error_n']:g} N off the finest at {level['speed']:g} simulated s/s"
