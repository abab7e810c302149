"""Rows with wrong configurations, in lockstep and on motor current alone where no camera is needed."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gripper_force.cli import app
from gripper_force.config import config_from, load_config
from gripper_force.control.slip import SlipMonitor
from gripper_force.control.speed_limit import SpeedLimit
from gripper_force.qualification.fault_matrix import wrong_configurations
from gripper_force.qualification.fault_matrix.wrong_configurations import (
    WRONG_CASES,
    WrongCase,
    WrongOutcome,
    count_grasps,
    draw,
    markdown,
    run_rows,
    run_wrong,
)
from gripper_force.schema import Tree

STAPLER = 3
"""Number of a grasp of the cheapest object."""

NO_CAMERA = ["camera.backend=none", "vision.checkpoint=none", "control.feedback=current"]
FAST_KEYS = ["sim.detail=coarse", "servo.bus_watchdog_ms=2540", *NO_CAMERA]
"""Without camera, and with a watchdog that a busy machine does not trip."""

FAST = load_config(None, FAST_KEYS)


def row(name: str, **keys: Any) -> WrongCase:
    """The row of that name, with these keys instead of drawn ones, where given."""
    found = next(row for row in WRONG_CASES if row.name.startswith(name))
    changed = {key.replace("__", "."): value for key, value in keys.items()}
    return replace(found, keys=lambda *_: changed) if keys else found


def outcome(case: WrongCase, index: int = STAPLER) -> WrongOutcome:
    return run_wrong(*draw(FAST, case, index), case.expected)


def leaving(at_s: float) -> WrongCase:
    fault = {"unit": "plant", "kind": "off", "at_s": at_s}
    return row("object leaves", faults=[fault], control__settle_s=0.2)


# Rows.


@pytest.mark.parametrize(("friction", "result"), [(0.3, "held"), (1.5, "held"), (5.0, "stuck")])
def test_wrong_friction_is_held_or_stuck(friction: float, result: str) -> None:
    found = outcome(row("friction", sim__friction=friction))
    assert found["failure"] == ""
    assert found["result"] == result
    assert (found["force_share"] > 0.5) == (result == "held")


@pytest.mark.parametrize(("open_position_rad", "result"), [(0.8, "refused"), (-0.8, "held")])
def test_wrong_start_is_refused_or_safe(open_position_rad: float, result: str) -> None:
    found = outcome(row("start", gripper__open_position_rad=open_position_rad))
    assert found["failure"] == ""
    assert found["result"] == result
    assert (found["speed_share"] > 0) == (result == "held")  # after a refusal nothing moves


@pytest.mark.parametrize("index", [8, STAPLER])  # a soft object, whose loss opens the jaws, and a regrip
def test_an_object_that_leaves_is_a_slip(index: int) -> None:
    found = outcome(leaving(2.4), index)
    assert found["failure"] == ""
    assert found["result"] == "slip"
    assert found["force_share"] > 0.2


def test_other_rows_without_camera_are_as_expected() -> None:
    for name in ("torque constant", "load cell", "open width: "):
        assert outcome(row(name))["failure"] == ""


def test_a_grasp_in_real_time_is_judged() -> None:
    tree, keys = draw(FAST, case := row("friction", sim__friction=5.0), STAPLER)
    found = run_wrong({**tree, "clock": "realtime"}, keys, case.expected)
    assert (found["result"], found["failure"]) == ("stuck", "")
    assert 0 < found["speed_share"] < 1.5


# A row can fail: each defect is planted, and the row must find it.


def test_a_missing_speed_limit_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SpeedLimit, "apply", lambda _self, command, *_: command)
    monkeypatch.setattr(SlipMonitor, "recession_reason", lambda *_: "")  # it reacts before the jaws are fast
    found = outcome(leaving(2.4))
    assert found["speed_share"] > 1.5
    assert "times as fast as configured" in found["failure"]


def test_a_torque_constant_beyond_the_configured_bound_is_found() -> None:
    assert "% over the limit" in outcome(row("torque constant", sim__gain=2.5))["failure"]


def test_an_end_stop_that_is_held_is_found() -> None:
    # On motor current alone, jaws that close on each other are taken for an object.
    keys = {"object": "none", "sim__open_width_m": 0.092, "gripper__open_width_m": 0.104}
    found = outcome(row("open width, no object", **keys))
    assert found["held_nothing"]
    assert "held on nothing; the result is held" in found["failure"]


# The table.


@pytest.mark.parametrize("case", WRONG_CASES, ids=lambda case: case.name)
def test_draws_cover_the_range_with_every_object(case: WrongCase) -> None:
    config = load_config()
    trees = [draw(config, case, index)[0] for index in range(20)]
    assert trees == [draw(config, case, index)[0] for index in range(20)]
    configs = [config_from(tree, "test") for tree in trees]
    assert len({c.target_n for c in configs}) == (3 if "light hold" in case.name else 20)
    assert {c.uses_vision for c in configs} == {"fused": {True}, "current": {False}}.get(
        case.feedback, {True, False}
    )
    if "friction" in case.name:
        assert {c.object for c in configs if c.sim.friction == 5.0} == {c.object for c in configs}
        assert min(c.sim.friction or 0 for c in configs) == 0.3


def run_without_grasp(tree: Tree, keys: dict[str, Any], expected: Sequence[str]) -> WrongOutcome:
    return {
        "seed": 1,
        "keys": keys,
        "result": f"stuck in {tree['clock']}",
        "force_share": 0.5,
        "speed_share": 0.25,
        "held_nothing": False,
        "failure": "",
    }


def test_a_table_runs_in_both_clocks_and_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread_pool: object
) -> None:
    monkeypatch.setattr(wrong_configurations, "process_pool", thread_pool)
    monkeypatch.setattr(wrong_configurations, "run_wrong", run_without_grasp)
    rows, kept = (row("friction"), row("closing")), tmp_path / "wrong.jsonl"
    names: list[str] = []

    def progress(text: str, steps: int = 1) -> None:
        names.append(text)

    friction, closing = run_rows(FAST, 2, 1, 1, kept, rows=rows, progress=progress)
    assert len(names) == count_grasps(2, 1, rows) == 6
    for summary in (friction, closing):
        assert (summary["runs"], summary["ok"], summary["results"]) == (2, 2, {"stuck in lockstep": 2})
        assert (summary["live_runs"], summary["live_ok"]) == (1, 1)
        assert summary["live_results"] == {"stuck in realtime": 1}
    cells = "held, stuck, timeout | 2 of 2, 1 of 1 | stuck in lockstep 2 | stuck in realtime 1 |"
    assert f"| friction: 0.3 to 5 times | {cells}" in markdown([friction, closing])
    *lines, _ = before = kept.read_text().splitlines()
    kept.write_text("\n".join(lines).replace("0.5", "0.75") + "\n")
    again = run_rows(FAST, 2, 1, 1, kept, resume=True, rows=rows)
    assert [(one["force_share"], one["live_force_share"]) for one in again] == [(0.75, 0.75), (0.75, 0.5)]
    assert len(kept.read_text().splitlines()) == len(before)


def test_the_command_reports_a_row_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread_pool: object
) -> None:
    monkeypatch.setattr(wrong_configurations, "process_pool", thread_pool)
    case = row("friction", object="stapler", sim__friction=5.0)
    summary = next(
        iter(run_rows(FAST, 1, 0, 1, tmp_path / "w.jsonl", rows=[replace(case, expected=("held",))]))
    )
    ((grasp, failure),) = summary["failures"].items()
    assert failure == "the result is stuck"
    repeated = load_config(None, [*FAST_KEYS, *grasp.split(", ")])
    assert repeated == config_from(draw(FAST, case, 0)[0], "test")
    monkeypatch.setattr(wrong_configurations, "run_rows", lambda *_, **__: [summary])
    page = tmp_path / "page.md"
    page.write_text("<!-- wrong -->\n<!-- end of wrong -->\n")
    call = [
        "stability",
        "faults",
        "--table",
        "wrong",
        "--set",
        f"log.directory={tmp_path}",
        "--write",
        str(page),
    ]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 1
    assert "sim.friction=5.0, clock=lockstep: the result is stuck" in done.stdout
    assert "| friction: 0.3 to 5 times |" in page.read_text()


def test_the_shipped_page_shows_every_row() -> None:
    page = Path(__file__).parents[3] / "docs" / "reliability.md"
    table = page.read_text(encoding="utf-8").split("<!-- wrong -->")[1].split("<!-- end of wrong -->")[0]
    assert all(f"| {row.name} |" in table for row in WRONG_CASES)
