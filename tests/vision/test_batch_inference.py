import weakref
from typing import Any

import numpy as np
import pytest
import torch

from gripper_force.vision import batch_inference
from gripper_force.vision.header import NetworkConfig
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess


@pytest.mark.parametrize(("batch", "chunk"), [(1, 40), (7, 9), (40, 1), (16, 256)])
def test_result_does_not_depend_on_the_size_of_batches(
    batch: int, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    tiny = NetworkConfig(size=16, width=0.25, hidden=6, head=7)
    networks = [
        ForceNetwork(tiny.model_copy(update={"attention": attention, "earlier_frames": n})).eval()
        for attention, n in (("ssam", 2), ("scam", 1), ("none", 0))
    ]
    frames = np.random.default_rng(0).integers(0, 256, (40, 16, 16), np.uint8)
    clip = torch.from_numpy(frames)[None]
    with torch.inference_mode():
        inputs = batch_inference.normalise(clip, clip[:, :4], Preprocess(size=16))
        whole = torch.cat([network(inputs) for network in networks])
    monkeypatch.setitem(batch_inference.BATCH, "cpu", batch)
    monkeypatch.setattr(batch_inference, "CHUNK", chunk)
    forces = batch_inference.predict(networks, Preprocess(size=16), frames)
    np.testing.assert_allclose(forces, whole, rtol=1e-5, atol=1e-5)


def test_last_layers_map_features_to_forces() -> None:
    torch.manual_seed(0)
    networks = [ForceNetwork(NetworkConfig(size=16, width=0.25, hidden=6, head=h)).eval() for h in (7, 5)]
    frames = np.random.default_rng(0).integers(0, 256, (12, 16, 16), np.uint8)
    forces, features = batch_inference.features(networks, Preprocess(size=16), frames)
    assert features.shape == (12, 7 + 5)
    with torch.inference_mode():
        parts = torch.from_numpy(features).split([7, 5], dim=1)
        again = torch.stack([network.force_n(part) for network, part in zip(networks, parts, strict=True)])
    np.testing.assert_allclose(forces, again, rtol=1e-6)


def test_no_batch_of_a_long_recording_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch's memory, which `tracemalloc` does not count."""
    made: list[weakref.ref[torch.Tensor]] = []

    def normalise(*arguments: Any) -> torch.Tensor:
        made.append(weakref.ref(batch := original(*arguments)))
        return batch

    original = batch_inference.normalise
    monkeypatch.setattr(batch_inference, "normalise", normalise)
    monkeypatch.setitem(batch_inference.BATCH, "cpu", 4)
    monkeypatch.setattr(batch_inference, "CHUNK", 8)
    network = ForceNetwork(NetworkConfig(size=16, width=0.25, hidden=6, head=7)).eval()
    frames = np.random.default_rng(0).integers(0, 256, (40, 16, 16), np.uint8)
    alive = [
        sum(batch() is not None for batch in made)
        for _ in batch_inference.stream_features([network], Preprocess(size=16), frames)
    ]
    assert len(made) == 10
    assert alive == [1] * 5  # the last one, which the loop still names
