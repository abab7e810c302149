from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from gripper_force.errors import CheckpointError, ConfigError
from gripper_force.vision import export as job
from gripper_force.vision.checkpoint_writer import save_checkpoint
from gripper_force.vision.engines import Floats, StepOutput
from gripper_force.vision.engines.pytorch import TorchEngine
from gripper_force.vision.export import export
from gripper_force.vision.header import Model, NetworkConfig
from gripper_force.vision.model_files import cache_folder, read_model
from gripper_force.vision.network import ForceNetwork


@pytest.fixture
def model(tiny_checkpoint: Path) -> Model:
    return read_model(tiny_checkpoint)


@pytest.fixture
def plain(model: Model, tmp_path: Path) -> Model:
    """One network, which takes half the time to export."""
    config = NetworkConfig(attention="none", size=32, width=0.25, hidden=6, head=7)
    path = tmp_path / "plain.safetensors"
    save_checkpoint(
        path, [ForceNetwork(config).eval()], model.header.model_copy(update={"members": (config,)})
    )
    return read_model(path)


def needs(package: str) -> None:
    if find_spec(package) is None:
        pytest.skip(f"{package} is not installed: pip install 'gripper-force[engines]'")


@pytest.mark.parametrize(("name", "package"), [("force.xml", "openvino"), ("force.onnx", "onnxscript")])
def test_export_reports_its_error_and_keeps_the_header(
    plain: Model, tmp_path: Path, name: str, package: str
) -> None:
    needs(package)
    errors = export(plain, tmp_path / "new" / name)
    assert 0 <= errors["mean_n"] <= errors["rms_n"] <= errors["largest_n"] < 1e-4
    again = read_model(tmp_path / "new" / name)
    assert (again.header, again.digest) == (plain.header, plain.digest)
    left = {path.name for path in (tmp_path / "new").iterdir()}
    assert left == ({"force.xml", "force.bin"} if name.endswith("xml") else {"force.onnx"})


@pytest.mark.parametrize("name", ["forces_n", "features", "attention"])
def test_a_file_with_another_output_is_refused(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    class Wrong(TorchEngine):
        """Turns one output around. The mean force stays the same."""

        def _infer(self, frame: Floats) -> StepOutput:
            step = super()._infer(frame)
            return replace(step, **{name: np.flip(getattr(step, name))})

    monkeypatch.setattr(job, "openvino_network", lambda _: None)
    monkeypatch.setattr(job, "save_openvino", lambda _network, _model, path: path.write_text("wrong"))
    monkeypatch.setattr(job, "open_engine", lambda *_: Wrong(model))
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
        export(model, cache_folder() / "force.xml")
