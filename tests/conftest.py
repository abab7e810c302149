"""Shared fixtures."""

from pathlib import Path

import pytest
from hypothesis import settings

# A machine may be busy: how long an example takes says nothing about what it tests.
settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")


@pytest.fixture(scope="session")
def real_grasps() -> Path:
    """The folder of real recordings, which is no part of the project."""
    folder = Path(__file__).parents[2] / "shared" / "real_grasps"
    if not folder.is_dir():
        pytest.skip(f"needs the real recordings, and {folder} is absent")
    return folder


@pytest.fixture(scope="session")
def quick() -> list[str]:
    """Overrides for the cheapest simulated grasp: motor current alone, and nothing to look at."""
    return [
        "object=stapler",
        "target_n=3",
        "sim.detail=coarse",
        "camera.backend=none",
        "vision.checkpoint=none",
        "vision.threads=1",
        "control.feedback=current",
        "control.settle_s=0.3",
        "control.hold_s=0.3",
    ]


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small networks that have learnt nothing, claim little, and say 0 N of a scene without contact."""
    import torch

    from gripper_force.vision.checkpoint import save_checkpoint
    from gripper_force.vision.header import Header, NetworkConfig, Residual
    from gripper_force.vision.network import ForceNetwork
    from gripper_force.vision.preprocess import Preprocess

    torch.manual_seed(0)
    members = tuple(
        NetworkConfig(attention=attention, size=32, width=0.25, hidden=6, head=7)
        for attention in ("ssam", "scam")
    )
    header = Header(
        members=members,
        preprocess=Preprocess(size=32),
        residuals=(Residual(force_n=-99.0, std_n=1.0), Residual(force_n=99.0, std_n=1.0)),
        data_digest="",
        metrics={},
    )
    networks = [ForceNetwork(member).eval() for member in members]
    with torch.no_grad():
        for network in networks:
            network.out.weight *= 1000  # what a frame changes would else be lost in the noise
            for _ in range(2):
                seen, _ = network.step(torch.zeros(1, 1, 32, 32), None)
                network.out.bias -= seen.force_n.mean() / 20
    path = tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors"
    save_checkpoint(path, networks, header)
    return path


@pytest.fixture(scope="session")
def quick_vision(quick: list[str], tiny_checkpoint: Path) -> list[str]:
    """As `quick`, with a camera and a network that take part."""
    eyes = ["camera.backend=simulated", f"vision.checkpoint={tiny_checkpoint}"]
    return [*quick, *eyes, "control.feedback=fused", "control.timeout_s=2.5"]


@pytest.fixture(scope="session")
def fused_log(quick_vision: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole lockstep grasp with vision. Not to be written to."""
    from gripper_force.config import load_config
    from gripper_force.session import run_grasp

    path = tmp_path_factory.mktemp("fused") / "grasp.mcap"
    run_grasp(load_config(None, quick_vision), path)
    return path
