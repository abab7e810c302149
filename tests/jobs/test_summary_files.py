import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.jobs import summary_files


@pytest.fixture
def _parquet() -> None:
    pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'gripper-force[parquet]'")


@pytest.mark.usefixtures("_parquet")
def test_page_table_and_json_have_the_same_figures(tmp_path: Path) -> None:
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
@pytest.mark.parametrize("has_parquet", [True, False])
def test_commands_write_them(
    command: str,
    has_parquet: bool,
    few_logs: Path,
    fused_log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    if has_parquet:
        request.getfixturevalue("_parquet")
    else:
        monkeypatch.setitem(sys.modules, "pyarrow", None)
    call = {
        "evaluate": ["evaluate", str(few_logs), "--checkpoint", "small"],
        "replay": ["replay", str(fused_log)],
        "compare": ["replay", str(fused_log), "--compare", "log", "small"],
    }[command]
    out = tmp_path / "out"
    out.mkdir()
    (out / "frames.parquet").write_text("of an earlier summary")
    done = CliRunner().invoke(cli.app, [*call, "--jobs", "1", "--json", "--out", str(out)])
    assert done.exit_code == 0, done.stderr
    tree = json.loads((out / "summary.json").read_text())
    assert tree["logs"]
    assert bool(tree.get("differences")) == (command == "compare")
    assert all((out / f"summary.{suffix}").exists() for suffix in ("html", "csv"))
    assert (out / "frames.parquet").exists() == has_parquet
    problem = (
        "frames.parquet of --out needs pyarrow, which is not installed; pip install 'gripper-force[parquet]'; the other "
        "files are written without it"
    )
    assert done.stderr.startswith(problem) != has_parquet
