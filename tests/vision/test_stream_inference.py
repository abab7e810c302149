from pathlib import Path

import numpy as np
import pytest

from gripper_force.vision import batch_inference, stream_inference
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines.pytorch import TorchEngine
from gripper_force.vision.model_files import read_model


def test_a_stream_equals_a_batch(tiny_checkpoint: Path) -> None:
    frames = np.random.default_rng(1).integers(0, 256, (30, 32, 32), np.uint8)
    checkpoint = load_checkpoint(tiny_checkpoint)
    expected = batch_inference.features(checkpoint.networks, checkpoint.header.preprocess, frames)
    engine = TorchEngine(read_model(tiny_checkpoint))
    for _ in range(2):  # each recording is a new stream
        for found, right in zip(stream_inference.features(engine, frames), expected, strict=True):
            assert found == pytest.approx(right, abs=1e-3)
