import pytest

from gripper_force.config import ControlConfig
from gripper_force.qualification.safety_statements import SafetyStatements
from gripper_force.types import Outcome, Phase

CONTROL = ControlConfig(force_limit_n=10.0, approach_speed_m_s=0.02)


def shown(
    phase: Phase = Phase.HOLD,
    outcome: Outcome = Outcome.HELD,
    *,
    steps: int = 1,
    sign: int = 1,
    force_n: float = 0.0,
    object_n: float = 0.0,
    closing_m_s: float = 0.0,
    has_torque: bool = True,
) -> SafetyStatements:
    statements = SafetyStatements(CONTROL, 4.0, sign)
    for _ in range(steps):
        statements.observe(
            0.01,
            phase,
            outcome,
            force_n=force_n,
            object_n=object_n,
            peak_n=force_n,
            closing_m_s=closing_m_s,
            has_torque=has_torque,
        )
    return statements


def test_force_counts_against_the_limit() -> None:
    assert shown(force_n=11.0, object_n=11.0).force_share == pytest.approx(1.1)


@pytest.mark.parametrize(
    ("phase", "closing_m_s", "sign", "share"),
    [
        (Phase.APPROACH, 0.03, 1, 1.5),
        (Phase.HOLD, 0.03, 1, 1.5),
        (Phase.APPROACH, -0.03, 1, 0.75),
        (Phase.RELEASE, -0.03, 1, 0.75),
        (Phase.MOVE, 0.03, 1, 0.75),
        (Phase.MOVE, -0.03, 1, 0.75),
        (Phase.APPROACH, -0.03, -1, 0.75),
        (Phase.RELEASE, 0.03, -1, 0.75),
    ],
)
def test_speed_counts_against_that_of_the_direction(
    phase: Phase, closing_m_s: float, sign: int, share: float
) -> None:
    assert shown(phase, closing_m_s=closing_m_s, sign=sign).speed_share == pytest.approx(share)


def test_jaws_that_keep_their_width_after_a_loss_may_not_close_faster_than_a_grasp() -> None:
    assert shown(Phase.MOVE, Outcome.SLIP, closing_m_s=0.03).speed_share == pytest.approx(1.5)


def test_speed_in_contact_does_not_count() -> None:
    assert shown(force_n=0.1, closing_m_s=1.0).speed_share == 0.0


@pytest.mark.parametrize("sign", [1, -1])
def test_jaws_without_torque_may_be_pushed_open_but_not_shut(sign: int) -> None:
    assert shown(Phase.FAULT, closing_m_s=-1.0, sign=sign, has_torque=False).speed_share == 0.0
    assert shown(Phase.FAULT, closing_m_s=1.0, sign=sign, has_torque=False).speed_share > 1.5
    assert shown(Phase.FAULT, closing_m_s=-1.0, sign=sign).speed_share > 1.5


def test_nothing_is_a_share_of_the_last_target() -> None:
    statements = SafetyStatements(CONTROL, 8.0)
    statements.change_target(2.0)
    for _ in range(20):
        statements.observe(
            0.01, Phase.HOLD, Outcome.HELD, force_n=0.2, object_n=0.2, peak_n=0.2, closing_m_s=0.01
        )
    assert not statements.held_nothing


@pytest.mark.parametrize(
    ("steps", "object_n", "closing_m_s", "outcome", "held_nothing"),
    [
        (12, 0.19, 0.01, Outcome.HELD, True),
        (12, 0.21, 0.01, Outcome.HELD, False),
        (9, 0.0, 0.01, Outcome.HELD, False),
        (12, 0.0, 0.01, Outcome.SLIP, False),
        (55, 0.0, 0.0, Outcome.HELD, True),  # only the camera shows that still jaws hold nothing
        (52, 0.0, 0.0, Outcome.HELD, False),
    ],
)
def test_held_without_force_on_an_object_counts_after_the_reaction_time(
    steps: int, object_n: float, closing_m_s: float, outcome: Outcome, held_nothing: bool
) -> None:
    found = shown(steps=steps, force_n=2.0, object_n=object_n, outcome=outcome, closing_m_s=closing_m_s)
    assert found.held_nothing == held_nothing
    assert not shown(Phase.RELEASE, outcome, steps=steps, object_n=object_n).held_nothing
