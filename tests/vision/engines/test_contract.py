"""Contract of the built-in engines: frame by frame the same forces as the whole window."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from gripper_force.errors import CheckpointError, ConfigError
from gripper_force.testing.engine_contract import EngineContract
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.checkpoint_writer import save_checkpoint
from gripper_force.vision.engines import ENGINES, Engine, Precision, open_engine
from gripper_force.vision.export import export
from gripper_force.vision.header import EXPORTED, Attention, Header, Model, NetworkConfig, Residual
from gripper_force.vision.model_files import cache_folder, exported_name, read_model
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess


def needs(engine: str) -> None:
    if find_spec(engine) is None:
        pytest.skip(f"{engine} is not installed: pip install 'gripper-force[engines]'")


def write(path: Path, *shapes: tuple[Attention, int, str]) -> Path:
    """Writes an untrained ensemble; shapes: attention, earlier frames and backbone of each member."""
    torch.manual_seed(0)
    configs = tuple(
        NetworkConfig.model_validate(
            {"attention": a, "earlier_frames": n, "backbone": b, "size": 32, "width": 0.25}
            | {"window": 5, "hidden": 6, "head": 7, "reduction": 4}
        )
        for a, n, b in shapes
    )
    header = Header(
        members=configs,
        preprocess=Preprocess(size=32),
        residuals=(Residual(force_n=0.0, std_n=1.0),),
        data_digest="",
        metrics={"mae_n": 0.5},
    )
    save_checkpoint(path, [ForceNetwork(config).eval() for config in configs], header)
    return path


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "engines-cache"))
        yield


@pytest.fixture(scope="session")
def ensemble(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("engines") / "both.safetensors"
    return write(path, ("ssam", 2, "vgg"), ("scam", 1, "mobile"))


@pytest.fixture(scope="session")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("engines") / "plain.safetensors", ("none", 0, "vgg"))


def in_cache(checkpoint: Path, suffix: str) -> Path:
    """An export in the cache, made in this process: the one that the first use starts takes seconds."""
    model = read_model(checkpoint)
    path = cache_folder() / exported_name(model, suffix)
    if not path.exists():
        export(model, path)
    return path


def opened(checkpoint: Path, name: str, precision: Precision = "float32", threads: int | None = 1) -> Engine:
    needs(name)
    for suffix, engine in EXPORTED.items():
        if engine == name:
            in_cache(checkpoint, suffix)
    return open_engine(read_model(checkpoint), name, precision, threads)


@pytest.fixture(scope="module", params=ENGINES)
def kept(request: pytest.FixtureRequest, ensemble: Path) -> Engine:
    return opened(ensemble, request.param)


@pytest.fixture
def engine(kept: Engine) -> Engine:
    kept.reset()
    return kept


class TestEngines(EngineContract):
    @pytest.fixture
    def engine(self, engine: Engine) -> Engine:
        return engine


def frames(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 32, 32)).astype(np.float32)


def windows(ensemble: Path, clip: np.ndarray) -> np.ndarray:
    """Each member's forces, (T, M), by the whole clip at once in float64."""
    inputs = torch.from_numpy(clip)[None, :, None].double()
    with torch.inference_mode():
        members = [network.double()(inputs)[0].numpy() for network in load_checkpoint(ensemble).networks]
    return np.stack(members, axis=1)


def test_streams_what_whole_windows_give(engine: Engine, ensemble: Path) -> None:
    clip = frames(17)
    streamed = np.stack([engine.step(frame).forces_n for frame in clip])
    np.testing.assert_allclose(streamed, windows(ensemble, clip), rtol=1e-5, atol=1e-5)


def test_features_and_attention_are_of_the_newest_frame(engine: Engine) -> None:
    first, second = (engine.step(frame) for frame in frames(2))
    assert first.attention is not None
    assert second.attention is not None
    assert first.attention.shape == (2, 2)
    assert not np.array_equal(first.attention, second.attention)
    assert not np.array_equal(first.features, second.features)


def test_bfloat16_is_close_to_float64(ensemble: Path) -> None:
    clip = frames(10)
    engine = opened(ensemble, "openvino", "bfloat16")
    streamed = np.stack([engine.step(frame).forces_n for frame in clip])
    np.testing.assert_allclose(streamed, windows(ensemble, clip), atol=20 * 2**-7)


@pytest.mark.parametrize("name", ENGINES)
def test_network_without_ssam_gives_no_attention_map(plain: Path, name: str) -> None:
    step = opened(plain, name).step(frames(1)[0])
    assert step.attention is None
    np.testing.assert_allclose(step.forces_n, windows(plain, frames(1))[0], rtol=1e-5, atol=1e-5)


def test_damaged_file_is_named_in_error(ensemble: Path, tmp_path: Path) -> None:
    needs("openvino")
    for suffix in (".xml", ".bin"):
        shutil.copy(in_cache(ensemble, ".xml").with_suffix(suffix), (tmp_path / "cut").with_suffix(suffix))
    other = np.frombuffer((tmp_path / "cut.bin").read_bytes(), np.uint8) ^ 1
    for weights in (other.tobytes(), b""):
        (tmp_path / "cut.bin").write_bytes(weights)
        with pytest.raises(
            CheckpointError, match=r"cut\.xml: cut\.bin does not hold the weights .*export it"
        ):
            open_engine(read_model(tmp_path / "cut.xml"), "openvino")
    (tmp_path / "cut.bin").unlink()
    with pytest.raises(CheckpointError, match=r"cut\.xml"):
        open_engine(read_model(tmp_path / "cut.xml"), "openvino")
    (tmp_path / "cut.xml").write_text("<net", encoding="utf-8")
    with pytest.raises(CheckpointError, match="damaged or not an OpenVINO file"):
        read_model(tmp_path / "cut.xml")
    (tmp_path / "cut.xml").write_text("<net/>", encoding="utf-8")
    with pytest.raises(CheckpointError, match="not made by `gripper-force export network`"):
        read_model(tmp_path / "cut.xml")
    needs("onnxruntime")
    (tmp_path / "cut.onnx").write_bytes(b"no network")
    with pytest.raises(CheckpointError, match="damaged or not an ONNX file"):
        read_model(tmp_path / "cut.onnx")


@pytest.mark.parametrize(("suffix", "name"), [(".xml", "openvino"), (".onnx", "onnxruntime")])
def test_damaged_file_of_the_cache_is_to_be_deleted(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, name: str
) -> None:
    needs(name)
    name_in_cache = exported_name(read_model(plain), suffix)
    whole = in_cache(plain, suffix) if suffix == ".xml" else None
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = cache_folder() / name_in_cache
    path.parent.mkdir()
    if whole is not None:
        shutil.copy(whole, path)  # of its two files, that of the weights is damaged
    path.with_suffix(suffix if whole is None else ".bin").write_bytes(b"")
    with pytest.raises(CheckpointError, match=f"can't run {path}: .*; delete it") as raised:
        open_engine(read_model(plain), name)
    assert "\n" not in str(raised.value)
    if whole is not None:  # the damaged file is replaced
        path.unlink()
        assert opened(plain, name).step(frames(1)[0]).forces_n.shape == (1,)


def test_incompatible_engine_file_and_precision_are_refused(ensemble: Path) -> None:
    model = read_model(ensemble)
    with pytest.raises(
        ConfigError, match=r"unknown vision\.engine 'tensorrt'; use torch, openvino, onnxruntime"
    ):
        open_engine(model, "tensorrt")
    with pytest.raises(ConfigError, match=r"'openvno' \(did you mean 'openvino'\?\)"):
        open_engine(model, "openvno")
    with pytest.raises(ConfigError, match="bfloat16 needs openvino"):
        open_engine(model, "torch", "bfloat16")
    with pytest.raises(ConfigError, match=r"unknown vision\.precision 'int8'; use float32 or bfloat16"):
        open_engine(model, "torch", "int8")  # type: ignore[arg-type]
    for threads in (0, 1.5, "2"):
        with pytest.raises(
            ConfigError, match=rf"vision\.threads {threads!r} is not a whole number from 1 on"
        ):
            open_engine(model, "torch", threads=threads)  # type: ignore[arg-type]
    needs("openvino")
    file = read_model(in_cache(ensemble, ".xml"))
    for name in ("torch", "onnxruntime"):
        needs(name)
        with pytest.raises(ConfigError, match=r"set vision\.engine=openvino"):
            open_engine(file, name)


def test_only_a_number_of_threads_changes_pytorchs_setting(ensemble: Path) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        open_engine(read_model(ensemble), "torch", threads=None)
        assert torch.get_num_threads() == 3
        open_engine(read_model(ensemble), "torch", threads=2)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("name", ["openvino", "onnxruntime"])
def test_engine_runs_with_its_default_of_threads(ensemble: Path, name: str) -> None:
    engine = opened(ensemble, name, threads=None)
    np.testing.assert_allclose(
        engine.step(frames(1)[0]).forces_n, windows(ensemble, frames(1))[0], rtol=1e-5, atol=1e-5
    )


def test_engine_of_another_package_gets_model_precision_and_threads(
    ensemble: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "other_engines.py").write_text(
        "from gripper_force.vision.engines.pytorch import TorchEngine\n"
        "class OtherEngine(TorchEngine):\n"
        "    def __init__(self, model, precision, threads):\n"
        "        super().__init__(model)\n"
        "        self.arguments = model, precision, threads\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    model: Model = read_model(ensemble)
    precision: Precision = "bfloat16"
    engine = open_engine(model, "other_engines:OtherEngine", precision, 2)
    assert engine.arguments == (model, precision, 2)  # type: ignore[attr-defined]


def test_onnx_runtime_does_not_report_its_use(tmp_path: Path) -> None:
    keys = ("CI", "ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME")  # the first turns telemetry off, too
    environment = {name: value for name, value in os.environ.items() if name not in keys}
    code = "import gripper_force.vision.engines.onnxruntime"
    command = [sys.executable, "-c", code]
    subprocess.run(command, env=environment | {"HOME": str(tmp_path)}, check=True, timeout=60)
    assert not list(tmp_path.rglob("onnxruntime.db"))
