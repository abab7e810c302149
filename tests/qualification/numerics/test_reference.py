from pathlib import Path

import numpy as np
import pytest
import torch

from gripper_force.qualification.numerics.reference import ROUNDING, Rounding, Twin
from gripper_force.vision.batch_inference import predict
from gripper_force.vision.export import inputs_of
from gripper_force.vision.model_files import read_model


@pytest.fixture
def twin(tiny_checkpoint: Path, tmp_path: Path) -> Twin:
    torch.set_num_threads(1)
    return Twin(read_model(tiny_checkpoint), tmp_path)


@pytest.fixture
def inputs() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((25, 32, 32)).astype(np.float32)


def test_float64_agrees_with_float32_as_far_as_that_goes(twin: Twin) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (25, 32, 32), np.uint8)
    networks = [network.float() for network in twin.networks]
    expected = predict(networks, twin.model.header.preprocess, frames)
    again = Twin(twin.model, Path())
    found_n = again.forces_n(np.stack(list(inputs_of(twin.model, frames))))
    assert 0 < np.abs(found_n - expected).max() < 1e-3 * np.abs(expected).max()


def test_fewer_digits_allow_for_more(twin: Twin, inputs: np.ndarray) -> None:
    single, half, eight = (twin.bound_n(inputs, rounding).max() for rounding in ROUNDING.values())
    assert 0 < 100 * single < min(half, eight)


def test_nothing_lost_leaves_the_last_digit(twin: Twin, inputs: np.ndarray) -> None:
    bound_n = twin.bound_n(inputs, Rounding(sums=0.0))
    assert bound_n == pytest.approx(4 * 20 * 2.0**-24)
    assert (twin.bound_n(inputs, Rounding(sums=0.0), off=1e-3) > bound_n).all()


def test_a_steeper_network_is_allowed_more(twin: Twin, inputs: np.ndarray) -> None:
    before_n = twin.bound_n(inputs, ROUNDING["float32"])[0]
    twin.networks[0].out.weight.mul_(10)
    assert twin.bound_n(inputs, ROUNDING["float32"])[0] > 5 * before_n
