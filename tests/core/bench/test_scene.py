import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.bench import scene
from gripper_force.bench.scene import SceneCost

ROW = SceneCost("tube", "coarse", 168, 2.5, 30.3, 8.7, 0.443, 2.223)


def test_levels_of_detail_are_measured_and_shown() -> None:
    told = json.loads(CliRunner().invoke(cli.app, ["bench", "--scene", "--object", "block", "--json"]).stdout)
    assert [(row["object"], row["detail"]) for row in told["scene"]] == [
        ("block", detail) for detail in ("coarse", "medium", "fine")
    ]


def test_the_table_goes_into_a_page_and_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked = []

    def costs(names: list[str], keep_table: bool) -> list[SceneCost]:
        asked.append((names, keep_table))
        return [ROW]

    monkeypatch.setattr(scene, "load", lambda _: costs)
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- detail -->\nold\n<!-- end of detail -->\nafter\n")
    done = CliRunner().invoke(cli.app, ["bench", "--scene", "--write", str(page)])
    assert "0.443" in done.stdout
    assert "| tube | coarse | 168 | 2.5 | 30.3 | 8.7 | 0.44 | 2.22 |" in page.read_text()
    assert "old" not in page.read_text()
    assert asked == [([], True)]


def test_a_part_of_the_table_is_not_kept(tmp_path: Path) -> None:
    call = ["bench", "--scene", "--object", "tube", "--write", str(tmp_path / "page.md")]
    assert "--write needs all objects" in str(CliRunner().invoke(cli.app, call).exception)
