import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.jobs import summary_files

pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'gripper-force[parquet]'")


def test_the_files_agree(tmp_path: Path) -> None:
    tables = {"sources": [], "logs": [{"log": "<a>.mcap", "mae_n": 0.25, "lag_s": float("nan")}]}
    columns = {"log": np.array(["<a>.mcap"] * 3), "visual_n": np.array([1.0, 2.0, np.nan])}
    summary_files.write_summary(tmp_path, "Title", tables, [columns])
    assert json.loads((tmp_path / "summary.json").read_text())["logs"][0]["lag_s"] is None
    assert [row["mae_n"] for row in csv.DictReader((tmp_path / "summary.csv").read_text().splitlines())] == [
        "0.25"
    ]
    page = (tmp_path / "summary.html").read_text()
    assert "&lt;a&gt;.mcap" in page
    assert "<th>MAE [N]</th><th>lag [s]</th>" in page
    from pyarrow import parquet

    assert parquet.read_table(tmp_path / "frames.parquet").column("visual_n").to_pylist()[:2] == [1.0, 2.0]


@pytest.mark.parametrize("command", ["evaluate", "replay", "compare"])
def test_commands_write_them(command: str, few_logs: Path, fused_log: Path, tmp_path: Path) -> None:
    call = {
        "evaluate": ["evaluate", str(few_logs), "--checkpoint", "small"],
        "replay": ["replay", str(fused_log), str(fused_log)],
        "compare": ["replay", str(fused_log), "--compare", "log", "small"],
    }[command]
    done = CliRunner().invoke(cli.app, [*call, "--jobs", "1", "--json", "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.stderr
    tree = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert tree["logs"]
    assert bool(tree.get("differences")) == (command == "compare")
