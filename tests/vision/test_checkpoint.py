import hashlib
import json
from pathlib import Path

import pytest
import torch
from pydantic import ValidationError
from safetensors import safe_open
from safetensors.torch import save_file

from gripper_force.errors import CheckpointError
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.checkpoint_writer import replace_header, save_checkpoint
from gripper_force.vision.header import FORMAT, SHIPPED, Header, NetworkConfig, Residual
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess

SSAM = NetworkConfig(attention="ssam", size=16, width=0.25, hidden=6, head=7)
SCAM = SSAM.model_copy(update={"attention": "scam"})


def header(*members: NetworkConfig) -> Header:
    return Header(
        members=members,
        preprocess=Preprocess(size=16),
        residuals=(Residual(force_n=0.5, std_n=0.1), Residual(force_n=9.5, std_n=0.7)),
        data_digest="abc",
        metrics={"mae_n": 0.16},
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    path = tmp_path / "folder" / "two.safetensors"
    save_checkpoint(path, [ForceNetwork(SSAM), ForceNetwork(SCAM)], header(SSAM, SCAM))
    return path


def test_a_full_disk_keeps_the_checkpoint_that_is_replaced(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, write = file.read_bytes(), Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        write(path, data[:100])
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(CheckpointError, match="No space left on device; name another file"):
        replace_header(file, header(SSAM, SCAM))
    assert file.read_bytes() == before


def test_round_trip(file: Path) -> None:
    loaded = load_checkpoint(file)
    assert loaded.header == header(SSAM, SCAM)
    assert loaded.digest == hashlib.sha256(file.read_bytes()).hexdigest()
    torch.manual_seed(0)
    for network, config in zip(loaded.networks, (SSAM, SCAM), strict=True):
        original = ForceNetwork(config).eval()
        clip = torch.randn(1, 4, 1, 16, 16, generator=torch.Generator().manual_seed(1))
        assert not network.training
        assert all(parameter.dtype == torch.float32 for parameter in network.parameters())
        torch.testing.assert_close(network(clip), original(clip), rtol=5e-3, atol=5e-3)


def test_missing_header_keys_take_defaults(file: Path, tmp_path: Path) -> None:
    with safe_open(file, "pt") as opened:
        fields = json.loads(opened.metadata()[FORMAT])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - not a mapping
    for member in fields["members"]:
        assert (member.pop("backbone"), member.pop("pooling")) == ("vgg", "wap")
    save_file(tensors, tmp_path / "older.safetensors", {FORMAT: json.dumps(fields)})
    older, newer = load_checkpoint(tmp_path / "older.safetensors"), load_checkpoint(file)
    assert older.header == newer.header
    clip = torch.randn(1, 4, 1, 16, 16)
    for first, second in zip(older.networks, newer.networks, strict=True):
        assert torch.equal(first(clip), second(clip))


@pytest.mark.parametrize(
    "choices",
    [
        {"attention": "ssam", "pooling": "gap"},
        {"attention": "scam", "pooling": "gap", "backbone": "mobile"},
        {"attention": "se", "backbone": "resnet18"},
        {"attention": "cbam", "backbone": "mobile"},
    ],
)
@torch.inference_mode()
def test_every_network_shape_round_trips(choices: dict[str, str], tmp_path: Path) -> None:
    config = NetworkConfig.model_validate(SSAM.model_dump() | choices | {"size": 32})
    network = ForceNetwork(config).eval()
    whole = header(SSAM).model_copy(update={"members": (config,), "preprocess": Preprocess(size=32)})
    save_checkpoint(tmp_path / "one.safetensors", [network], whole)
    (loaded,) = load_checkpoint(tmp_path / "one.safetensors").force_networks
    clip = torch.randn(1, 4, 1, 32, 32)
    torch.testing.assert_close(loaded(clip), network(clip), rtol=5e-3, atol=5e-3)


def test_loading_is_bit_exact_after_the_first_rounding(file: Path, tmp_path: Path) -> None:
    loaded = load_checkpoint(file)
    again = tmp_path / "again.safetensors"
    save_checkpoint(again, loaded.networks, loaded.header)
    assert again.read_bytes() == file.read_bytes()


@pytest.mark.parametrize("factor", [1e-30, 1e-7, 1e7])
def test_values_beyond_half_precision_are_stored_as_float32(factor: float, tmp_path: Path) -> None:
    network = ForceNetwork(SSAM)
    with torch.no_grad():
        network.dense.weight *= factor
    save_checkpoint(tmp_path / "one.safetensors", [network], header(SSAM))
    (loaded,) = load_checkpoint(tmp_path / "one.safetensors").force_networks
    assert torch.equal(loaded.dense.weight, network.dense.weight)
    rounded, exact = (one.blstm.forward_lstm.get_parameter("weight_ih_l0") for one in (loaded, network))
    assert not torch.equal(rounded, exact)


def test_full_size_ensemble_fits_in_12_mb(tmp_path: Path) -> None:
    configs = [NetworkConfig(attention="ssam"), NetworkConfig(attention="scam")]
    path = tmp_path / "full.safetensors"
    full = header(SSAM).model_copy(update={"members": tuple(configs), "preprocess": Preprocess()})
    save_checkpoint(path, [ForceNetwork(config) for config in configs], full)
    assert path.stat().st_size < 12e6


def test_missing_file_error_names_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CheckpointError, match="train one"):
        load_checkpoint(tmp_path / "absent.safetensors")
    monkeypatch.setitem(SHIPPED, "default", tmp_path / "default.safetensors")
    with pytest.raises(CheckpointError, match=r"default\.safetensors"):
        load_checkpoint()


@pytest.mark.parametrize("keep", [0, 7, 100, -1])
def test_truncated_file_is_named(file: Path, keep: int) -> None:
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(file)


def test_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError):
        load_checkpoint(tmp_path)


def test_other_safetensors_files_are_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.safetensors"
    save_file({"x": torch.zeros(1)}, other)
    with pytest.raises(CheckpointError, match="not a gripper-force-network"):
        load_checkpoint(other)
    save_file({"x": torch.zeros(1)}, other, metadata={FORMAT: "{}"})
    with pytest.raises(CheckpointError, match="header"):
        load_checkpoint(other)
    text = header(SCAM).model_dump_json()
    save_file({"0.x": torch.zeros(1)}, other, metadata={FORMAT: text})
    with pytest.raises(CheckpointError, match="member 0"):
        load_checkpoint(other)


def test_header_of_a_huge_network_allocates_nothing(file: Path) -> None:
    giant = header(SSAM.model_copy(update={"hidden": 100_000, "head": 100_000}))  # 80 GB
    save_checkpoint(file, [ForceNetwork(SSAM)], giant)
    with pytest.raises(CheckpointError, match="member 0 do not fit"):
        load_checkpoint(file)


def test_loaded_network_outlives_its_file(file: Path) -> None:
    weight = load_checkpoint(file).force_networks[0].out.bias
    before = weight.clone()
    with file.open("r+b") as opened:
        opened.write(bytes(file.stat().st_size))
    assert torch.equal(weight, before)


def test_non_finite_weights_are_refused(tmp_path: Path) -> None:
    network = ForceNetwork(SSAM)
    network.out.bias.data.fill_(torch.nan)
    save_checkpoint(tmp_path / "nan.safetensors", [network], header(SSAM))
    with pytest.raises(CheckpointError, match="NaN"):
        load_checkpoint(tmp_path / "nan.safetensors")


def test_inconsistent_header_is_refused() -> None:
    with pytest.raises(ValidationError, match="at least one"):
        header()
    with pytest.raises(ValidationError, match="must be equal"):
        header(SSAM.model_copy(update={"size": 32}))


def test_unwritable_path_is_named(tmp_path: Path) -> None:
    (tmp_path / "occupied").write_text("")
    with pytest.raises(CheckpointError, match="can't write"):
        save_checkpoint(tmp_path / "occupied" / "x.safetensors", [ForceNetwork(SSAM)], header(SSAM))
