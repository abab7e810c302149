from itertools import combinations

import numpy as np
import pytest

from gripper_calibration.procedures.teach_candidates import FOLDS, LeftOut, compare, make_candidates
from gripper_force.config import load_config
from gripper_force.runtime.resolve import resolve_vision


def test_a_fold_takes_no_part_in_the_choice_that_estimates_it() -> None:
    """The second candidate is the best of all, but only because of the first fold: the others choose the first one."""
    force_n = np.linspace(0, 4, 30)
    errors_n = {0: {0: 1.0, 1: 0.1, 2: 0.1}, 1: {0: 0.0, 1: 0.2, 2: 0.2}}  # by candidate and fold

    def left(candidate: int, log: int) -> LeftOut:
        error_n = errors_n[candidate][log % FOLDS]
        touch = np.full(30, log)
        return LeftOut(force_n, force_n + error_n, force_n, np.full(30, 1e-4), touch)

    outs = [frozenset(out) for n in (1, 2) for out in combinations(range(FOLDS), n)]
    results = [
        {out: {log: left(candidate, log) for log in range(6) if log % FOLDS in out} for out in outs}
        for candidate in range(2)
    ]
    found = compare(results, 6)
    assert found.best == 1
    error_n = found.estimate_n - found.measured.force_n
    np.testing.assert_allclose([error_n[found.measured.touch == log].mean() for log in (0, 3)], 1.0)
    assert not found.within[np.isin(found.measured.touch, (0, 3))].any()


@pytest.mark.parametrize("checkpoint", ["default", "small"])
def test_one_network_is_trained_and_never_the_default_one(checkpoint: str) -> None:
    config, model, _ = resolve_vision(load_config(None, [f"vision.checkpoint={checkpoint}"]))
    assert model is not None
    names = [candidate.name for candidate in make_candidates(config, model, logs=16)]
    assert [name for name in names if "trained" in name] == ["small, trained"]
