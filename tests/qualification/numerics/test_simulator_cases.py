import math

import pytest

from gripper_force.config import Config, GripperConfig
from gripper_force.errors import SimulationError
from gripper_force.qualification.numerics import simulator_cases as steps
from gripper_force.qualification.numerics.simulator_cases import cases
from gripper_hw.sim.scene import Scene
from gripper_hw.sim.world import World

OBJECTS = ("stapler", "block")


def test_every_case_of_fast_objects_is_within_its_bound() -> None:
    rows = list(cases(Config(), None, OBJECTS, (0.0005, 0.002, 0.004)))
    assert [row.case for row in rows if not row.ok] == []
    errors_n = {row.case: row.figure for row in rows if row.unit == "N"}
    assert errors_n["stapler, step 2 ms"] < errors_n["stapler, step 4 ms"]
    assert len(errors_n) == 4
    assert "MuJoCo's warning 2" in next(row.detail for row in rows if row.case == "motor current NaN")


def test_an_unstable_simulation_reports_its_error_and_exceeds_any_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(steps, "_squeeze", lambda t_s, _: 3.0 if t_s > 0.5 else 0.1)
    rows = list(cases(Config(), None, ("stapler",), (0.002, 0.004)))
    assert math.isnan(rows[0].figure)
    assert not rows[0].ok
    assert "broke at 0.5" in rows[0].detail


def test_undetected_cases_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steps, "_UNSTABLE", {"a gentle motor": lambda _t, _v: 0.05})
    gentle = list(cases(Config(), None, ("stapler",), (0.002,)))[-1]
    assert (gentle.figure, gentle.ok) == (1.0, False)


@pytest.mark.parametrize("step_s", [0.008, 0.0, math.nan])
def test_an_invalid_time_step_raises(step_s: float) -> None:
    with pytest.raises(SimulationError, match="gives wrong forces for 'stapler'"):
        World(
            Scene("stapler", "coarse"),
            GripperConfig(),
            steps._Motor(steps._squeeze),
            1.78,
            0,
            textured=False,
            step_s=step_s,
        )
