from pathlib import Path

import pytest
import yaml

from gripper_force.errors import ConfigError
from gripper_hw.sim import detail
from gripper_hw.sim.cost import scene_costs


def test_levels_differ_in_cost_and_error_and_are_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(detail, "_TABLE", tmp_path / "detail.yaml")
    coarse, medium, fine = scene_costs(["stapler"], keep_table=True)
    assert [row.detail for row in (coarse, medium, fine)] == ["coarse", "medium", "fine"]
    assert coarse.step_ms > medium.step_ms > fine.step_ms > 0
    assert coarse.error_n > medium.error_n > fine.error_n == 0
    assert 0 < coarse.error_n < coarse.worst_n < 10
    assert all(row.unknowns > 0 < row.iterations for row in (coarse, medium, fine))
    kept = yaml.safe_load((tmp_path / "detail.yaml").read_text())
    assert list(kept["stapler"]) == ["coarse", "medium", "fine"]
    assert kept["stapler"]["coarse"]["error_n"] == round(coarse.error_n, 3)


def test_an_object_that_is_unknown_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="no simulated object 'brick'"):
        list(scene_costs(["brick"], keep_table=False))
