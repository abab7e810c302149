from importlib.util import find_spec
from pathlib import Path

import pytest
from torch import Tensor

from gripper_force.errors import CheckpointError, ConfigError
from gripper_force.vision import export as job
from gripper_force.vision.ensemble_step import EnsembleStep
from gripper_force.vision.export import export
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import exported_file, read_model


@pytest.fixture
def model(tiny_checkpoint: Path) -> Model:
    return read_model(tiny_checkpoint)


def needs(package: str) -> None:
    if find_spec(package) is None:
        pytest.skip(f"{package} is not installed: pip install 'gripper-force[engines]'")


@pytest.mark.parametrize(("name", "package"), [("force.xml", "openvino"), ("force.onnx", "onnxscript")])
def test_export_reports_its_error_and_keeps_the_header(
    model: Model, tmp_path: Path, name: str, package: str
) -> None:
    needs(package)
    errors = export(model, tmp_path / "new" / name)
    assert (
        0 <= errors["mean_n"] <= errors["largest_n"] < 1e-2
    )  # the fixture's output weights are scaled by 1000
    again = read_model(tmp_path / "new" / name)
    assert (again.header, again.digest) == (model.header, model.digest)
    left = {path.name for path in (tmp_path / "new").iterdir()}
    assert left == ({"force.xml", "force.bin"} if name.endswith("xml") else {"force.onnx"})


@pytest.mark.parametrize(("output", "name"), [(0, "forces_n"), (1, "features"), (2, "attention")])
def test_a_file_with_another_output_is_refused(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: int, name: str
) -> None:
    class Wrong(EnsembleStep):
        """Turns one output around. The mean force stays the same."""

        def forward(self, frame: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            outputs = list(super().forward(frame, *state))
            outputs[output] = outputs[output].flip(0)
            return tuple(outputs)

    needs("openvino")
    monkeypatch.setattr(job, "EnsembleStep", Wrong)  # that which is exported, not that of the comparison
    with pytest.raises(CheckpointError, match=f"differs from PyTorch by .* in {name}"):
        export(model, tmp_path / "force.xml")
    assert not list(tmp_path.iterdir())


def test_impossible_exports_are_refused(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match=r"name a file that ends in \.xml or \.onnx"):
        export(model, tmp_path / "force.trt")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(CheckpointError, match=r"can't write .*; name another file"):
        export(model, tmp_path / "file" / "force.xml")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(CheckpointError, match=r"can't write .*; set XDG_CACHE_HOME to a folder"):
        exported_file(model, ".xml")
