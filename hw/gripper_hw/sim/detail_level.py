"""Resolves ``sim.detail: auto``: the fastest level of detail within the budget, by a shipped table.

`gripper-force bench scene` made the table. It is not measured again on each machine, so that a configuration
gives the same log everywhere.
"""

from pathlib import Path
from typing import Final

from gripper_force.config import BudgetConfig, Config
from gripper_force.errors import ConfigError
from gripper_force.schema import read_tree

TABLE: Final = Path(__file__).with_name("detail_level.yaml")
"""Levels by name of an object."""

Levels = dict[str, dict[str, float]]
"""Level of detail to its ``error_n`` (N) and ``speed`` (simulated s/s), as measured by `bench scene`."""


def resolve_detail(config: Config) -> tuple[Config, str]:
    """Replaces ``sim.detail: auto`` by a level.

    Returns:
        The configuration with a level, and the reason for the choice.

    Raises:
        ConfigError: The table lacks the object, no budget is set, or no level meets it.
    """
    table: dict[str, Levels] = read_tree(TABLE)
    if config.object not in table:
        raise ConfigError(
            f"sim.detail=auto has no data of {config.object!r}, only of {', '.join(table)}; "
            "set sim.detail to a level"
        )
    detail, reason = select_level(table[config.object], config.budget, config.object)
    return config.with_values(sim={"detail": detail}), reason


def select_level(levels: Levels, budget: BudgetConfig, name: str) -> tuple[str, str]:
    """Returns the fastest level of an object that meets the budget, and the reason for the choice.

    Raises:
        ConfigError: No budget is set, or no level meets it.
    """
    limits = {key: getattr(budget, key) for key in ("sim_error_n", "sim_speed")}
    limits = {key: value for key, value in limits.items() if value is not None}
    if not limits:
        raise ConfigError("sim.detail=auto needs a budget; set budget.sim_error_n or budget.sim_speed")
    candidates = [
        detail
        for detail, level in levels.items()
        if level["error_n"] <= limits.get("sim_error_n", level["error_n"])
        and level["speed"] >= limits.get("sim_speed", level["speed"])
    ]
    budget_text = " and ".join(f"budget.{key}={value:g}" for key, value in limits.items())
    if not candidates:
        available = ", ".join(f"{detail}: {_describe(level)}" for detail, level in levels.items())
        raise ConfigError(f"no sim.detail level for {name} meets {budget_text}; available: {available}")
    selected = max(candidates, key=lambda detail: levels[detail]["speed"])
    return (
        selected,
        f"chose sim.detail={selected} ({_describe(levels[selected])}), the fastest that meets {budget_text}",
    )


def _describe(level: dict[str, float]) -> str:
    return f"{level['error_n']:g} N error against the finest, {level['speed']:g} simulated s/s"
