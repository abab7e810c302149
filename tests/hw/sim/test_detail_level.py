from contextlib import closing
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import BudgetConfig, load_config
from gripper_force.errors import ConfigError
from gripper_force.runtime.backends import resolve_simulation
from gripper_hw.sim import detail_level as detail
from gripper_hw.sim.detail_level import resolve_detail, select_level
from gripper_hw.sim.meshes import Detail
from gripper_hw.sim.objects import OBJECTS
from gripper_hw.sim.simulated_rig import SimulatedRig

figures = st.floats(0.001, 1000)
tables = st.dictionaries(
    st.sampled_from(get_args(Detail)),
    st.fixed_dictionaries({"error_n": figures, "speed": figures}),
    min_size=1,
)


@given(tables, st.none() | figures, st.none() | figures)
def test_fastest_level_within_budget_is_selected(
    levels: detail.Levels, error_n: float | None, speed: float | None
) -> None:
    fits = [
        level["speed"]
        for level in levels.values()
        if (error_n is None or level["error_n"] <= error_n) and (speed is None or level["speed"] >= speed)
    ]
    budget = BudgetConfig(sim_error_n=error_n, sim_speed=speed)
    if fits and (error_n, speed) != (None, None):
        taken, why = select_level(levels, budget, "tube")
        assert levels[taken]["speed"] == max(fits)
        assert why.startswith(f"chose sim.detail={taken} ")
    else:
        with pytest.raises(ConfigError):
            select_level(levels, budget, "tube")


@pytest.mark.parametrize("name", OBJECTS)
def test_shipped_table_has_every_object(name: str) -> None:
    strict, loose = (
        resolve_detail(
            load_config(None, [f"object={name}", "sim.detail=auto", f"budget.sim_error_n={error_n}"])
        )
        for error_n in (1e-6, 10)
    )
    assert strict[0].sim.detail == "fine"
    assert loose[0].sim.detail in ("coarse", "medium")


def test_configured_level_is_kept() -> None:
    config = load_config(None, ["budget.sim_speed=1e6"])
    assert resolve_simulation(config) == (config, "")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([], "needs a budget; set budget.sim_error_n or budget.sim_speed"),
        (["object=brick", "budget.sim_speed=1"], "has no data of 'brick', only of sponge, paper_cup"),
        (
            ["object=tube", "budget.sim_error_n=0.1", "budget.sim_speed=4"],
            r"no sim.detail level for tube meets budget.sim_error_n=0.1 and budget.sim_speed=4; "
            r"available: coarse: .* N error against the finest, .* simulated s/s, medium: ",
        ),
    ],
)
def test_unresolvable_level_is_refused(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        resolve_detail(load_config(None, ["sim.detail=auto", *overrides]))


def test_rig_simulates_selected_level_and_gives_the_reason(quick: list[str]) -> None:
    overrides = [*quick, "sim.detail=auto", "budget.sim_error_n=0.05"]
    config, reason = SimulatedRig.resolve(load_config(None, overrides))
    with closing(SimulatedRig(config)) as rig:
        assert rig.scene.detail == "medium"
    assert "chose sim.detail=medium" in reason
    assert "budget.sim_error_n=0.05" in reason


def test_rig_refuses_unresolved_level(quick: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"sim\.detail is still auto; "):
        SimulatedRig(load_config(None, [*quick, "sim.detail=auto"]))
