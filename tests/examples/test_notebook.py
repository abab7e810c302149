"""The notebook: its cells run in order, and it is stored without outputs."""

import json
import os
import subprocess
import sys
from pathlib import Path

NOTEBOOK = json.loads((Path(__file__).parents[2] / "examples" / "first_grasp.ipynb").read_text())
CODE = ["".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
CHECKS = """
assert result.held
assert abs(measured_n[estimated_n > 3].mean() - 4) < 0.4
assert len(over_time.lines) == 4
assert image.images[0].get_array().shape == (128, 128)
"""


def test_the_cells_run_in_order_and_after_an_earlier_run(tmp_path: Path) -> None:
    (tmp_path / "grasp.mcap").write_text("of an earlier run of all cells")
    done = subprocess.run(
        [sys.executable, "-c", "\n".join([*CODE, CHECKS])],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("mean absolute error") == 2


def test_the_notebook_is_stored_without_outputs() -> None:
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in NOTEBOOK["cells"])
