"""Contract of every linkage, and the errors of impossible geometry."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, get_args

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from gripper_force.config import ControlConfig, GripperConfig, LinkageConfig, load_config
from gripper_force.control.friction_allowance import FrictionAllowance
from gripper_force.control.limits import Limits
from gripper_force.control.linkage import RackAndPinion, make_linkage
from gripper_force.control.speed_limit import SpeedLimit
from gripper_force.control.transmission import Transmission, force_bound
from gripper_force.errors import ConfigError
from gripper_force.qualification.loop_margin.analytic_plant import POSITION_LOOP
from gripper_force.types import ServoCommand, ServoState

GRIPPERS = {
    path.stem: load_config(path).gripper
    for path in sorted((Path(__file__).parents[2] / "examples/grippers").glob("*.yaml"))
}
GRIPPERS["table"] = GripperConfig(
    linkage=LinkageConfig(
        kind="table", table=((0.0, 0.092), (0.5, 0.075), (1.0, 0.052), (1.5, 0.030), (2.0, 0.012))
    )
)
GRIPPERS["fingers"] = GripperConfig(
    linkage=LinkageConfig(kind="fingers", finger_m=0.06, open_finger_rad=0.6), open_width_m=0.065
)

grippers = st.sampled_from(sorted(GRIPPERS))


def transmission_of(name: str, **changes: Any) -> Transmission:
    return Transmission.from_config(GRIPPERS[name].model_copy(update=changes), 1.78)


@given(grippers, st.sampled_from([-1, 1]), st.floats(-0.2, 1.2), st.floats(-5, 5))
def test_width_and_position_are_inverse(name: str, sign: int, share: float, open_rad: float) -> None:
    one = transmission_of(name, closing_sign=sign, open_position_rad=open_rad)
    width_m = share * one.open_width_m
    assert one.width_m(one.position_rad(width_m)) == pytest.approx(width_m, abs=1e-9)


def test_two_fingers_close_twice_as_far_as_one() -> None:
    two = GRIPPERS["fingers"]
    one = two.model_copy(
        update={"linkage": two.linkage.model_copy(update={"kind": "finger"}), "open_width_m": 0.0325}
    )
    for closing_rad in (0.0, 0.2, 0.5):
        widths_m = [make_linkage(gripper).width_m(closing_rad) for gripper in (one, two)]
        assert widths_m[1] == pytest.approx(2 * widths_m[0], abs=1e-6)


@pytest.mark.parametrize("name", GRIPPERS)
def test_the_ends_are_open_and_closed(name: str) -> None:
    one = transmission_of(name)
    assert one.width_m(one.open_position_rad) == pytest.approx(one.open_width_m, abs=1e-9)
    assert one.width_m(one.closed_position_rad) == pytest.approx(0.0, abs=1e-6)


@given(grippers, st.sampled_from([-1, 1]), st.floats(0.02, 0.98), st.floats(0.01, 1.0))
def test_force_and_speed_follow_from_virtual_work(
    name: str, sign: int, share: float, current_a: float
) -> None:
    one = transmission_of(name, closing_sign=sign)
    at_rad = one.position_rad(share * one.open_width_m)
    step_rad = 1e-3
    closed_m = one.width_m(at_rad - sign * step_rad) - one.width_m(at_rad + sign * step_rad)
    force_n = one.force_n(sign * current_a, at_rad)
    assert force_n * closed_m == pytest.approx(1.78 * current_a * 2 * step_rad, rel=2e-3)
    assert one.closing_m_s(sign * 2.0, at_rad) == pytest.approx(2.0 * closed_m / (4 * step_rad), rel=2e-3)
    assert one.current_a(force_n, at_rad) == pytest.approx(sign * current_a)


@pytest.mark.parametrize("name", GRIPPERS)
def test_width_falls_throughout_and_beyond_the_ends(name: str) -> None:
    linkage = make_linkage(GRIPPERS[name])
    end_rad = linkage.closing_rad(0.0)
    widths_m = [linkage.width_m(end_rad * i / 100) for i in range(-10, 111)]
    assert all(after < before for before, after in pairwise(widths_m))


def test_crank_slider_follows_its_geometry() -> None:
    """Compared with the triangle of crank, rod and rail, at every tenth of a radian."""
    linkage = make_linkage(GRIPPERS["viperx_aloha"])

    def jaw_m(angle_rad: float) -> float:
        x_m, y_m = 0.022 * math.sin(angle_rad), 0.022 * math.cos(angle_rad)
        return x_m + math.sqrt(0.036**2 - y_m**2)

    for tenth in range(17):
        closing_rad = tenth / 10
        width_m = 0.072 - 2 * (jaw_m(1.10) - jaw_m(1.10 - closing_rad))
        assert linkage.width_m(closing_rad) == pytest.approx(width_m, abs=2e-7)


def test_parallelogram_turns_its_finger_as_its_crank() -> None:
    config = LinkageConfig(
        kind="four_bar", crank_m=0.02, rod_m=0.04, rocker_m=0.02, base_m=0.04, finger_m=0.06,
        open_crank_rad=1.9, open_finger_rad=0.6,
    )  # fmt: skip
    linkage = make_linkage(GripperConfig(linkage=config, open_width_m=0.06))
    for closing_rad in (0.1, 0.3, 0.5):
        width_m = 0.06 - 2 * 0.06 * (math.sin(0.6) - math.sin(0.6 - closing_rad))
        assert linkage.width_m(closing_rad) == pytest.approx(width_m, abs=1e-6)


def test_table_passes_through_its_rows() -> None:
    linkage = make_linkage(GRIPPERS["table"])
    for closing_rad, width_m in GRIPPERS["table"].linkage.table:
        assert linkage.width_m(closing_rad) == pytest.approx(width_m, abs=1e-5)


def test_default_is_a_rack_and_pinion() -> None:
    assert make_linkage(GripperConfig()) == RackAndPinion(0.02, 0.092)


Draw = Callable[[st.SearchStrategy[float]], float]


def drawn_finger(draw: Draw) -> tuple[dict[str, Any], float]:
    finger_m, open_rad = draw(st.floats(0.02, 0.2)), draw(st.floats(0.1, 1.5))
    keys = {"finger_m": finger_m, "open_finger_rad": open_rad}
    return keys, draw(st.floats(0.1, 1.1)) * finger_m * math.sin(open_rad)


def drawn_crank_slider(draw: Draw) -> tuple[dict[str, Any], float]:
    crank_m = draw(st.floats(0.005, 0.05))
    keys = {
        "crank_m": crank_m,
        "rod_m": draw(st.floats(0.8, 4.0)) * crank_m,
        "offset_m": draw(st.floats(-0.8, 0.8)) * crank_m,
        "open_crank_rad": draw(st.floats(-0.5, 1.6)),
    }
    return keys, draw(st.floats(0.1, 3.0)) * crank_m


def drawn_four_bar(draw: Draw) -> tuple[dict[str, Any], float]:
    keys = {key: draw(st.floats(0.01, 0.05)) for key in ("crank_m", "rod_m", "rocker_m", "base_m")}
    keys |= {"finger_m": draw(st.floats(0.02, 0.1)), "open_crank_rad": draw(st.floats(0.3, 2.8))}
    keys |= {"open_finger_rad": draw(st.floats(0.1, 1.2))}
    return keys, draw(st.floats(0.1, 1.5)) * keys["finger_m"]


def drawn_table(draw: Draw) -> tuple[dict[str, Any], float]:
    steps = [(draw(st.floats(0.1, 1.0)), draw(st.floats(0.005, 0.03))) for _ in range(5)]
    angles_rad = accumulate((step[0] for step in steps[:-1]), initial=0.0)
    closed_m = list(accumulate((step[1] for step in steps[:-1]), initial=0.0))
    open_width_m = closed_m[-1] + steps[-1][1]
    rows = tuple((a, open_width_m - b) for a, b in zip(angles_rad, closed_m, strict=True))
    return {"table": rows}, open_width_m


def drawn_rack(draw: Draw) -> tuple[dict[str, Any], float]:
    return {}, draw(st.floats(0.01, 0.2))


KINDS = {
    "rack": drawn_rack,
    "crank_slider": drawn_crank_slider,
    "four_bar": drawn_four_bar,
    "finger": drawn_finger,
    "fingers": drawn_finger,
    "table": drawn_table,
}


def test_every_kind_is_drawn() -> None:
    assert set(KINDS) == set(get_args(LinkageConfig.model_fields["kind"].annotation))


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=30)
@given(data=st.data())
def test_any_geometry_is_refused_or_has_all_properties_of_a_linkage(kind: str, data: st.DataObject) -> None:
    keys, open_width_m = KINDS[kind](data.draw)
    config = GripperConfig(
        linkage=LinkageConfig.model_validate({"kind": kind, **keys}), open_width_m=open_width_m
    )
    try:
        linkage = make_linkage(config)
    except ConfigError:
        assume(False)
    end_rad = linkage.closing_rad(0.0)
    assert (linkage.width_m(0.0), linkage.width_m(end_rad)) == pytest.approx((open_width_m, 0.0), abs=1e-6)
    for share in (-0.1, 0.03, 0.35, 0.5, 0.77, 0.97, 1.1):
        at_rad, step_rad = share * end_rad, 0.002 * end_rad
        assert linkage.closing_rad(linkage.width_m(at_rad)) == pytest.approx(at_rad, abs=1e-6 * end_rad)
        derivative = (linkage.width_m(at_rad - step_rad) - linkage.width_m(at_rad + step_rad)) / (
            2 * step_rad
        )
        assert 2 * linkage.jaw_m_per_rad(at_rad) == pytest.approx(derivative, rel=0.02)
        assert derivative > 0


wrong_starts = st.floats(-0.5, 0.5)
"""Errors of the open position in rad, up to `GripperConfig.position_bound_rad`."""


def with_true_start(believed: Transmission, error_rad: float) -> Transmission:
    return replace(believed, open_position_rad=believed.open_position_rad + error_rad)


@given(
    grippers,
    st.sampled_from([-1, 1]),
    st.floats(0, 1),
    st.floats(-1e3, 1e3),
    st.floats(0, 1e3),
    wrong_starts,
    st.floats(0, 1),
    st.floats(0, 2),
)
@example(
    "viperx_aloha", 1, 0.35, 9.0, 1e3, -0.5, 1.0, 0.95
)  # friction shown where the true travel is greatest
@example("viperx_aloha", 1, 0.35, 9.0, 1e3, 0.5, 1.0, 0.95)
def test_no_linkage_leaves_its_travel_or_the_force_limit(
    name: str,
    sign: int,
    share: float,
    goal_rad: float,
    goal_a: float,
    error_rad: float,
    earlier_share: float,
    true_friction_n: float,
) -> None:
    one, control = transmission_of(name, closing_sign=sign), ControlConfig(force_limit_n=5.0)
    truth = with_true_start(one, error_rad)
    at_rad, earlier_rad = (one.position_rad(s * one.open_width_m) for s in (share, earlier_share))
    allowance = FrictionAllowance(control, one)
    shows_a = truth.current_a(true_friction_n / one.torque_constant_bound, earlier_rad)
    allowance.learn(one.force_n(shows_a, earlier_rad), only_lower=False)
    friction_n = allowance.allowance_n(math.inf, opening=False, closing=True, gripping=True)
    wanted = ServoCommand(0, goal_rad, goal_a)
    command, _ = Limits(control, one, 1e3).apply(wanted, 0.0, friction_n, 0.0, at_rad, 60.0, may_rise=True)
    low_rad, high_rad = one.goal_range_rad
    assert low_rad <= command.goal_position_rad <= high_rad
    force_n = one.torque_constant_bound * truth.force_n(sign * command.goal_current_a, at_rad)
    assert force_n - true_friction_n <= 1.05 * control.force_limit_n


@given(grippers, st.floats(0, 1), wrong_starts)
def test_no_linkage_is_too_fast_with_a_wrong_start(name: str, share: float, error_rad: float) -> None:
    one, speed_m_s = transmission_of(name), 0.025
    at_rad, truth = one.position_rad(share * one.open_width_m), with_true_start(one, error_rad)
    limit = SpeedLimit(one, POSITION_LOOP)
    stands = ServoState(0, at_rad, 0.0, 0.0, 30.0, 12.0, 0)
    command = limit.apply(ServoCommand(0, at_rad + 1.0, 0.1), stands, speed_m_s)
    free_rad_s = POSITION_LOOP.gain_per_s * (command.goal_position_rad - at_rad)
    assert truth.closing_m_s(free_rad_s, at_rad) <= 1.31 * speed_m_s
    moves = replace(stands, velocity_rad_s=1.45 * speed_m_s / truth.jaw_m_per_rad(at_rad))
    assert limit.apply(ServoCommand(0, at_rad + 1.0, 0.1), moves, speed_m_s).goal_position_rad == at_rad


@pytest.mark.parametrize("name", GRIPPERS)
def test_the_force_bound_covers_torque_constant_and_linkage(name: str) -> None:
    one = transmission_of(name)
    exact = transmission_of(name, position_bound_rad=0.0)
    assert exact.force_bound == pytest.approx(1.4, rel=0.02)
    assert one.force_bound == force_bound(GRIPPERS[name])
    if GRIPPERS[name].linkage.kind == "rack":
        assert one.force_bound == 1.4
    else:
        assert one.force_bound > 1.05 * exact.force_bound


CRANK = {"kind": "crank_slider", "crank_m": 0.022, "rod_m": 0.036, "open_crank_rad": 1.1}

FOUR_BAR = {
    "kind": "four_bar", "crank_m": 0.02, "rod_m": 0.04, "rocker_m": 0.022, "base_m": 0.04, "finger_m": 0.06,
    "open_crank_rad": 1.9, "open_finger_rad": 0.6,
}  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "open_width_m", "message"),
    [
        ({"kind": "crank_slider", "rod_m": 0.036}, 0.05, r"needs gripper\.linkage\.crank_m"),
        (CRANK, 0.09, r"closes by 8\d\.\d mm at most, less than gripper\.open_width_m 90 mm"),
        (CRANK | {"open_crank_rad": 1.57}, 0.08, "near its dead centre"),
        (CRANK | {"rod_m": 0.01}, 0.05, "mm at most"),
        ({"kind": "finger", "finger_m": 0.03, "open_finger_rad": 0.5}, 0.09, "closes by"),
        ({"kind": "crank_slider", "crank_m": 0.022}, 0.05, r"needs gripper\.linkage\.rod_m"),
        ({"kind": "finger"}, 0.05, r"needs gripper\.linkage\.finger_m"),
        (FOUR_BAR | {"rocker_m": None}, 0.05, r"needs gripper\.linkage\.rocker_m"),
        (CRANK | {"open_crank_rad": 0.0, "rod_m": 0.01}, 0.05, "cannot be assembled"),
        (FOUR_BAR | {"rod_m": 0.2}, 0.05, "cannot be assembled"),
        (FOUR_BAR | {"base_m": 0.02, "open_crank_rad": 0.0}, 0.05, "cannot be assembled"),
        ({"kind": "table", "table": ((0, 0.05), (1, 0.049999), (2, 0.049998))}, 0.05, "mm at most"),
        ({"kind": "table", "table": ((0, 0.05), (1, 0.02))}, 0.05, "three or more rows"),
        ({"kind": "table", "table": ((0, 0.05), (1, 0.02), (2, 0.03))}, 0.05, "widths fall"),
        ({"kind": "table", "table": ((0, 0.05), (1, 0.02), (2, 0.01))}, 0.06, "open_width_m"),
    ],
)
def test_impossible_geometry_is_refused(keys: dict[str, Any], open_width_m: float, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_linkage(GripperConfig(linkage=LinkageConfig(**keys), open_width_m=open_width_m))
