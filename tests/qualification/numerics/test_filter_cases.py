import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from gripper_force.config import Config, ControlConfig, GripperConfig
from gripper_force.control import fusion
from gripper_force.qualification.loop_margin.analytic_plant import transmission_of
from gripper_force.qualification.numerics import filter_cases as suite
from gripper_force.qualification.numerics.filter_cases import Input, worst_n


@pytest.fixture
def inputs() -> Iterator[Input]:
    return suite._steady(np.random.default_rng(0), 2000)


def test_every_case_is_within_its_bound() -> None:
    rows = list(suite.cases(Config(), None, long_cycles=2000, short_cycles=400))
    assert [row.case for row in rows if not row.ok] == []
    assert len({row.case for row in rows}) == len(rows)


def test_an_error_in_the_ninth_digit_is_found(
    inputs: Iterator[Input], monkeypatch: pytest.MonkeyPatch
) -> None:
    original = fusion.Fusion._estimate
    monkeypatch.setattr(
        fusion.Fusion,
        "_estimate",
        lambda self, t_ns: replace(e := original(self, t_ns), force_n=e.force_n * (1 + 1e-8)),
    )
    assert worst_n(ControlConfig(), GripperConfig(), inputs) > 1e-9


def test_a_non_finite_estimate_exceeds_any_bound(
    inputs: Iterator[Input], monkeypatch: pytest.MonkeyPatch
) -> None:
    original = fusion.Fusion._estimate
    monkeypatch.setattr(
        fusion.Fusion, "_estimate", lambda self, t_ns: replace(original(self, t_ns), std_n=math.nan)
    )
    assert worst_n(ControlConfig(), GripperConfig(), inputs) == math.inf


def test_the_reference_uses_and_rejects_frames(inputs: Iterator[Input]) -> None:
    """Otherwise it would agree with a filter that ignores vision."""
    original = [(t_ns, motor_force_n, visual) for t_ns, motor_force_n, visual in inputs]
    no_vision = [(t_ns, motor_force_n, None) for t_ns, motor_force_n, _ in original]
    outliers = [
        (t_ns, motor_force_n, visual and replace(visual, force_n=visual.force_n + 3 * (number % 2)))
        for number, (t_ns, motor_force_n, visual) in enumerate(original)
    ]
    transmission = transmission_of(GripperConfig())
    ends = []
    for some in (original, no_vision, outliers):
        reference = suite._DecimalFusion(ControlConfig(), transmission)
        ends.append([float(reference.step(*one)[0]) for one in some][-1])
        assert worst_n(ControlConfig(), GripperConfig(), iter(some)) < 1e-9
    assert len(set(ends)) == 3
