from pathlib import Path

import pytest

from gripper_force.config import load_config
from gripper_force.jobs.evaluate import evaluate
from gripper_force.jobs.simulate import plan, simulate


@pytest.mark.parametrize("moving", ["false", "true"])
def test_shipped_network_tolerates_a_moving_background(moving: str, tmp_path: Path) -> None:
    config = load_config(None, [f"sim.moving_background={moving}"])
    list(simulate(plan("tap", 4, 903_000), tmp_path, config, workers=1))
    result = evaluate(tmp_path)
    assert result.mae_n < 0.4
    assert max(errors.mae_n for errors in result.per_object.values()) < 0.7
