import json
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import ConfigError
from gripper_force.qualification.bench import scene_bench as scene
from gripper_force.qualification.bench.scene_bench import SceneCost, scene_costs
from gripper_hw.sim import detail_level as detail

ROW = SceneCost("tube", "coarse", 168, 2.5, 30.3, 8.7, 0.443, 2.223)


def test_bench_scene_measures_each_detail_level() -> None:
    printed = json.loads(
        CliRunner().invoke(cli.app, ["bench", "scene", "--object", "block", "--json"]).stdout
    )
    assert [(row["object"], row["detail"]) for row in printed["scene"]] == [
        ("block", detail) for detail in ("coarse", "medium", "fine")
    ]


def test_write_updates_the_page_and_the_shipped_table(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls = []

    def costs(names: list[str], keep_table: bool) -> list[SceneCost]:
        calls.append((names, keep_table))
        return [ROW]

    monkeypatch.setattr(scene, "scene_costs", costs)
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- detail -->\nold\n<!-- end of detail -->\nafter\n")
    done = CliRunner().invoke(cli.app, ["bench", "scene", "--write", str(page)])
    assert "0.443" in done.stdout
    assert "| tube | coarse | 168 | 2.5 | 30.3 | 8.7 | 0.44 | 2.22 |" in page.read_text()
    assert "old" not in page.read_text()
    assert calls == [([], True)]


def test_write_needs_all_objects(tmp_path: Path) -> None:
    call = ["bench", "scene", "--object", "tube", "--write", str(tmp_path / "page.md")]
    assert "--write needs all objects" in str(CliRunner().invoke(cli.app, call).exception)


def test_finer_levels_cost_more_and_have_less_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(detail, "TABLE", tmp_path / "detail.yaml")
    coarse, medium, fine = scene_costs(["stapler"], keep_table=True)
    assert [row.detail for row in (coarse, medium, fine)] == ["coarse", "medium", "fine"]
    assert coarse.step_ms > medium.step_ms > fine.step_ms > 0
    assert coarse.error_n > medium.error_n > fine.error_n == 0
    assert 0 < coarse.error_n < coarse.worst_n < 10
    assert all(row.unknowns > 0 < row.iterations for row in (coarse, medium, fine))
    kept = yaml.safe_load((tmp_path / "detail.yaml").read_text())
    assert list(kept["stapler"]) == ["coarse", "medium", "fine"]
    assert kept["stapler"]["coarse"]["error_n"] == round(coarse.error_n, 3)


def test_unknown_object_raises() -> None:
    with pytest.raises(ConfigError, match="no simulated object 'brick'"):
        list(scene_costs(["brick"], keep_table=False))
