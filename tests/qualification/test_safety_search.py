"""Random search for unsafe grasps."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gripper_force.cli import app
from gripper_force.config import Config, load_config
from gripper_force.control.limits import Limits
from gripper_force.control.speed_limit import SpeedLimit
from gripper_force.control.visual_check import VisualCheck
from gripper_force.errors import DataError
from gripper_force.qualification import safety_search
from gripper_force.qualification.loop_margin.analytic_plant import transmission_of
from gripper_force.qualification.safety_search import SearchReport, TimedRequest, draw, run_case, search
from gripper_force.types import RequestKind, ServoCommand

GRIPPERS = Path(__file__).parents[2] / "examples" / "grippers"
RACK = transmission_of(load_config(None).gripper)


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return load_config(None, [f"log.directory={tmp_path}"])


def linkage_of(name: str) -> Config:
    """A gripper whose limits trust its start position: larger targets, for which these cases were found."""
    return load_config(GRIPPERS / f"{name}.yaml", ["gripper.position_bound_rad=0"])


def results(config: Config, first: int, last: int) -> list[safety_search.CaseResult]:
    return [run_case(config, config.seed, index) for index in range(first, last)]


def test_the_first_cases_hold_all_three_statements(config: Config) -> None:
    found = results(config, 0, 12)
    assert all(result.ok for result in found)
    assert {"held", "refused", "no_object", "stuck"} <= {result.outcome for result in found}
    assert found[:2] == results(config, 0, 2)


def test_a_lost_object_of_a_small_force_does_not_stay_held(config: Config) -> None:
    assert draw(config.control, RACK, 0, 395).target_n < 0.65
    assert run_case(config, 0, 395).ok


@pytest.mark.parametrize("index", [869, 155], ids=["force", "speed"])
def test_a_crank_whose_start_is_wrong_keeps_force_and_speed(index: int) -> None:
    assert not run_case(linkage_of("viperx_aloha"), 0, index).ok
    assert run_case(load_config(GRIPPERS / "viperx_aloha.yaml"), 0, index).ok


def test_draws_cover_what_can_be_wrong(config: Config) -> None:
    drawn = [draw(config.control, RACK, 0, index) for index in range(300)]
    assert min(one.friction for one in drawn) < 0.4
    assert max(one.friction for one in drawn) > 4.0
    assert {one.sign for one in drawn} == {-1, 1}
    assert {one.feedback for one in drawn} == {"fused", "current", "vision"}
    assert any(one.width > 1.1 for one in drawn)
    assert min(one.force_limit_n for one in drawn) < 1.0
    assert any(one.start_m > 0.01 for one in drawn)
    assert any(one.leaves_s < 3 for one in drawn)
    assert any(one.leaves_s < 3 and one.away_s < 0.1 for one in drawn)
    assert {one.on_fault for one in drawn} == {"limp", "hold", "open"}
    assert {step.kind for one in drawn for step in one.requests} == {"grasp", "release", "move", "stop"}
    assert any(not one.requests for one in drawn)


def test_a_sequence_of_requests_can_be_searched(config: Config) -> None:
    cases = [i for i in range(32) if draw(config.control, RACK, 0, i).requests]
    assert len(cases) == 8
    found = [run_case(config, 0, i) for i in cases]
    assert all(result.ok for result in found)
    assert any(result.force_share > 0.3 for result in found)


def test_some_cases_begin_near_the_object_with_a_small_limit(config: Config) -> None:
    drawn = [draw(config.control, RACK, 0, index) for index in range(320)]
    near = [one for one in drawn if one.begins_m > 0]
    assert 40 <= len(near) <= 60
    with_object = [one.contact_m - one.begins_m for one in near if one.contact_m < 1.0]
    assert min(with_object) == 0.0
    assert 0.001 < max(with_object) <= 0.002
    assert all(one.force_limit_n <= 3.0 for one in near)
    assert any(one.requests for one in near)


@pytest.mark.parametrize("index", [357, 3370, 3485])
def test_jaws_that_begin_near_an_object_keep_a_small_limit(config: Config, index: int) -> None:
    # They pressed with 1.2 to 1.4 times it while the configured friction was credited.
    assert run_case(config, 0, index).ok


def test_a_stream_of_requests_is_safe(config: Config) -> None:
    requests = draw(config.control, RACK, 0, 1550).requests
    assert len(requests) > 300
    assert {one.kind for one in requests} == {"grasp", "release", "move"}
    # A release that was requested again and again let go of a springy object at once: 2.0 times too fast.
    assert run_case(config, 0, 1550).ok


def test_a_network_that_lags_behind_the_jaws_confirms_no_end_stop(config: Config) -> None:
    assert draw(config.control, RACK, 0, 9326).motion_n > 4.0
    assert run_case(config, 0, 9326).ok


@pytest.mark.parametrize("index", [2062, 3254, 6546, 8954])
def test_a_grasp_that_interrupts_another_motion_is_safe(config: Config, index: int) -> None:
    # 2062: a release, whose object still pushed the jaws open. The others: an approach, which began anew in contact.
    assert [step.kind for step in draw(config.control, RACK, 0, index).requests].count("grasp") > 3
    assert run_case(config, 0, index).ok


def test_a_soft_object_next_to_the_jaws_is_pressed_slowly(config: Config) -> None:
    # 1.14 times the limit: the jaws had not travelled far enough to show that friction is low.
    drawn = draw(config.control, RACK, 0, 7205)
    assert 0.0 < drawn.contact_m - drawn.begins_m < 0.0005
    assert run_case(config, 0, 7205).force_share < 1.0


def test_a_stiff_object_that_leaves_the_ramp_does_not_make_the_jaws_too_fast(config: Config) -> None:
    # 1.52 times the configured speed, for one cycle, as long as the ramp had all of it.
    assert draw(config.control, RACK, 0, 7302).stiffness_n_m > 2e4
    assert run_case(config, 0, 7302).ok


@pytest.mark.parametrize("index", [732, 5053, 9847])
def test_a_hold_with_a_small_limit_is_slow_when_its_object_leaves(config: Config, index: int) -> None:
    # 732, 9847: the object returned to jaws that closed with 15 mm/s: 1.9 and 1.4 times the limit. 5053: its loss was
    # found too late.
    drawn = draw(config.control, RACK, 0, index)
    assert (drawn.leaves_s < math.inf, drawn.force_limit_n < 1.5) == (True, True)
    assert run_case(config, 0, index).ok


# Each defect is planted into the controller, and the search must find it.


def test_a_current_beyond_its_limit_is_found(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    apply = Limits.apply

    def doubled(*arguments: Any, **options: Any) -> tuple[ServoCommand, bool]:
        command, over = apply(*arguments, **options)
        return replace(command, goal_current_a=2 * command.goal_current_a), over

    monkeypatch.setattr(Limits, "apply", doubled)
    assert any(run_case(config, 0, index).force_share > 1.05 for index in range(60))


def test_a_missing_speed_limit_is_found(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SpeedLimit, "apply", lambda _self, command, *_: command)
    assert any(run_case(config, 0, index).speed_share > 1.5 for index in range(40))


def test_a_grip_on_nothing_is_found(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(VisualCheck, "objection", lambda *_, **__: "")
    wrong = [
        i
        for i in range(1000)
        if (one := draw(config.control, RACK, 0, i)).width > 1.05 and one.contact_m == 1 and one.sign == 1
    ]
    nothing = stop = False
    for i in wrong:
        found = run_case(config, 0, i)
        nothing, stop = nothing or found.held_nothing, stop or found.held_stop
        if nothing and stop:
            break
    assert (nothing, stop) == (True, True)


def test_search_continues_where_it_was_interrupted(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread_pool: object
) -> None:
    monkeypatch.setattr(safety_search, "process_pool", thread_pool)
    keep = tmp_path / "search.jsonl"
    whole = search(config, 6, 1, keep)
    lines = keep.read_text().splitlines(keepends=True)
    keep.write_text("".join(lines[:4]) + lines[4][:20])  # the last line is cut
    counts: list[int] = []

    def progress(text: str, steps: int = 1) -> None:
        counts.append(steps)

    again: SearchReport = search(config, 6, 1, keep, resume=True, progress=progress)
    assert again == whole
    assert counts[0] == 3
    assert sum(counts) == 6
    other = config.with_values(seed=1)
    with pytest.raises(DataError, match="another configuration, seed or version"):
        search(other, 6, 1, keep, resume=True)
    monkeypatch.setattr(safety_search, "__version__", "0.0.1")
    with pytest.raises(DataError, match="another configuration, seed or version"):
        search(config, 6, 1, keep, resume=True)


@pytest.mark.parametrize(
    "name", ["viperx_aloha", "four_bar", "rotary_finger", "two_servos", "openmanipulator_x"]
)
def test_no_linkage_exceeds_the_force_limit(name: str) -> None:
    config = linkage_of(name)
    # Cases 89 and 101 press hard: with twice the goal current they exceed the limit by a third with each linkage.
    found = [run_case(config, config.seed, index) for index in (1, 3, 89, 101)]
    assert not any(result.force_share > 1.05 or result.held_nothing for result in found)
    assert min(result.force_share for result in found[2:]) > 0.6


def test_long_fingers_open_at_the_speed_of_a_release() -> None:
    config = linkage_of("four_bar")
    drawn = draw(config.control, transmission_of(config.gripper), 0, 240)
    assert (drawn.leaves_s, drawn.start_m) == (math.inf, 0.0)
    assert drawn.then_n > 7.0  # the motor force of the grip, with which the jaws would open twice as fast
    assert run_case(config, 0, 240).speed_share < 1.5


@pytest.mark.parametrize("index", [399, 740])
def test_jaws_that_have_lost_their_object_are_not_too_fast_again_after_the_brake(index: int) -> None:
    # Their speed was bounded in the first cycle, but they were 1.9 and 2.1 times too fast in every second one.
    config = linkage_of("four_bar")
    assert run_case(config, 0, index).speed_share < 1.5


def test_two_servos_have_the_torque_and_the_rotors_of_two() -> None:
    config = linkage_of("two_servos")
    one, two = (transmission_of(config.gripper, servos) for servos in (1, 2))
    assert two.nm_per_a == 2 * one.nm_per_a
    masses_kg = [draw(config.control, two, 0, 25, servos).mass_kg for servos in (1, 2)]
    assert masses_kg[1] == 2 * masses_kg[0]
    # With the torque constant of one servo, twice the current made this case 1.8 times too fast.
    assert run_case(config, 0, 25).speed_share < 1.1


def test_friction_is_measured_by_jaws_that_the_speed_limit_holds_back() -> None:
    # Otherwise an approach credits the configured friction, and presses with 1.5 times a limit of 0.8 N.
    config = linkage_of("four_bar")
    assert draw(config.control, transmission_of(config.gripper), 0, 369).force_limit_n < 1.0
    assert run_case(config, 0, 369).force_share < 1.05


def test_an_opening_in_the_wrong_direction_credits_the_friction_that_it_measures(config: Config) -> None:
    # The approach did not move far enough to measure it. With the configured one the release presses with 1.2 times
    # the limit.
    drawn = draw(config.control, RACK, 0, 4188)
    assert (drawn.sign, drawn.friction < 0.4, drawn.force_limit_n < 2.0) == (-1, True, True)
    assert 0.1 < run_case(config, 0, 4188).force_share < 1.0


def test_a_linkage_that_cannot_close_so_far_is_refused() -> None:
    config = linkage_of("viperx_aloha")
    truth = transmission_of(config.gripper)
    wide = next(i for i in range(1000) if draw(config.control, truth, 0, i).width > 1.18)
    assert run_case(config, 0, wide).outcome == "refused"


def test_command_reports_violations_with_exit_code_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*_: Any, **__: Any) -> SearchReport:
        return found

    config = load_config(None, [])
    bad = replace(run_case(config, 0, 3), force_share=1.2)
    found = safety_search._report(config, [run_case(config, 0, 2), bad])
    assert (found["ok"], found["violations"]["force"], found["worst"]["force"][0]["index"]) == (False, 1, 3)
    found["worst"]["force"][0]["drawn"]["requests"] = [TimedRequest(0.05, RequestKind.GRASP, 2.0)] * 100
    monkeypatch.setattr(safety_search, "search", run)
    call = ["stability", "search", "--cases", "2", "--set", f"log.directory={tmp_path}"]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 1
    assert "force: 1 of 2" in done.stdout
    assert "grasp 2 for 0.05 s; 100 in all" in done.stdout
    assert json.loads(CliRunner().invoke(app, [*call, "--json"]).stdout)["violations"]["force"] == 1
