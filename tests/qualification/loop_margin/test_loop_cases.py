import math
from dataclasses import replace
from pathlib import Path

import pytest

from gripper_force.config import Config
from gripper_force.qualification.loop_margin.analytic_plant import CURRENT_STEP_A, Gripper, transmission_of
from gripper_force.qualification.loop_margin.grid import Grid, Verdict
from gripper_force.qualification.loop_margin.loop_cases import _Bounds, cases, crushing_n_m, grasp

CONFIG = Config()
TRUTH = Gripper(transmission_of(CONFIG.gripper), contact_m=0.008)
SMALL = Grid(
    stiffness_n_m=(1e3, 1e6),
    delay_s=(0.05, 0.15),
    factors=(1.0,),
    margin_stiffness_n_m=(1e4,),
    margin_delay_s=(0.01, 0.075),
    tuned_delay_s=(0.075,),
    sweep={
        "stiffness_n_m": (1e3,),
        "delay_s": (0.035,),
        "gain": (0.9, 1.1),
        "friction_n": (1.0,),
        "play_m": (0.0,),
        "step_a": (CURRENT_STEP_A,),
    },
)


def verdict(truth: Gripper, delay_s: float = 0.035, **control: object) -> Verdict:
    changed = CONFIG.with_values(control=control)
    return grasp(changed, truth, delay_s, 0).verdict


def test_small_grid_keeps_its_bounds_and_draws_maps(tmp_path: Path) -> None:
    rows = list(cases(CONFIG, tmp_path / "maps", SMALL))
    assert [row.case for row in rows if not row.ok] == []
    assert len({row.case for row in rows}) == len(rows)
    assert sorted(path.name for path in (tmp_path / "maps").iterdir()) == [
        "loop-margins.png",
        "loop-verdicts.png",
    ]


def test_grasp_with_frames_that_are_too_old_holds_on_current() -> None:
    assert verdict(TRUTH) == Verdict.HOLDS
    assert verdict(TRUTH, 0.15) == Verdict.CURRENT


def test_eight_times_the_gain_rings_with_late_vision() -> None:
    assert verdict(replace(TRUTH, stiffness_n_m=100.0), 0.08, plant_gain=1 / 8) == Verdict.RINGS


@pytest.mark.parametrize("seed", [6, 7, 8])
def test_a_very_soft_object_is_not_taken_for_lost(seed: int) -> None:
    # With 0.95 of the approach speed in the ramp, the jaws fell behind it, and seed 6 ended as `slip`.
    soft = replace(TRUTH, stiffness_n_m=100.0)
    assert grasp(CONFIG, soft, 0.125, seed).verdict in (Verdict.HOLDS, Verdict.CURRENT)


def test_object_out_of_reach_is_not_held() -> None:
    assert verdict(replace(TRUTH, contact_m=0.2)) == Verdict.LOSES


@pytest.mark.parametrize(("share", "crushed"), [(0.7, False), (1.4, True)])
def test_first_contact_crushes_objects_that_are_too_stiff(share: float, crushed: bool) -> None:
    stiff = replace(TRUTH, stiffness_n_m=share * crushing_n_m(CONFIG.control, TRUTH))
    assert (verdict(stiff) == Verdict.CRUSHES) is crushed


@pytest.mark.parametrize(
    ("current_a", "position_rad"),
    [(-0.01, 0.1), (0.5, 0.1), (math.nan, 0.1), (0.1, math.inf), (0.1, -0.1), (0.1, 3.0)],
)
def test_commands_outside_limits_are_detected(current_a: float, position_rad: float) -> None:
    bounds = _Bounds(CONFIG, TRUTH)
    assert bounds.contains(0.1, 0.1)
    assert not bounds.contains(current_a, position_rad)
