"""The notebook: its cells run in order, and it is stored without outputs."""

import json
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

NOTEBOOK = json.loads((Path(__file__).parents[2] / "examples" / "first_grasp.ipynb").read_text())
CODE = ["".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
CHECKS = """
assert result.held
assert abs(measured_n[estimated_n > 3].mean() - 4) < 0.4
assert len(over_time.lines) == 4
assert image.images[0].get_array().shape == (128, 128)
"""


def test_the_cells_run_in_order_and_after_an_earlier_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "grasp.mcap").write_text("of an earlier run of all cells")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plt, "show", lambda: None)
    plt.switch_backend("agg")
    try:
        exec("\n".join([*CODE, CHECKS]), {})
    finally:
        plt.close("all")
    assert capsys.readouterr().out.count("mean absolute error") == 2


def test_the_notebook_is_stored_without_outputs() -> None:
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in NOTEBOOK["cells"])
