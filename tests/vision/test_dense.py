import numpy as np
import pytest
import torch

from gripper_force.vision import dense
from gripper_force.vision.network import ForceNetwork, NetworkConfig
from gripper_force.vision.preprocess import Preprocess


@pytest.mark.parametrize("chunk", [1, 7, 40])
def test_chunks_make_no_difference(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    tiny = NetworkConfig(size=16, width=0.25, hidden=6, head=7)
    networks = [
        ForceNetwork(tiny.model_copy(update={"attention": attention, "earlier_frames": n})).eval()
        for attention, n in (("ssam", 2), ("scam", 1), ("none", 0))
    ]
    frames = np.random.default_rng(0).integers(0, 256, (40, 16, 16), np.uint8)
    clip = torch.from_numpy(frames)[None]
    with torch.inference_mode():
        inputs = dense.normalise(clip, clip[:, :4])
        whole = torch.cat([network(inputs) for network in networks])
    monkeypatch.setattr(dense, "CHUNK", chunk)
    forces = dense.predict(networks, Preprocess(size=16), frames)
    np.testing.assert_allclose(forces, whole, rtol=1e-5, atol=1e-5)
