from pathlib import Path

import numpy as np
import pytest

from gripper_force.qualification.numerics.reference import ROUNDING, ReferenceEnsemble, Rounding
from gripper_force.vision.batch_inference import predict
from gripper_force.vision.model_files import read_model
from gripper_force.vision.stream_inference import prepared

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def reference(tiny_checkpoint: Path, tmp_path: Path) -> ReferenceEnsemble:
    return ReferenceEnsemble(read_model(tiny_checkpoint), tmp_path)


@pytest.fixture
def inputs() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((25, 32, 32)).astype(np.float32)


def test_float64_agrees_with_float32_up_to_rounding(reference: ReferenceEnsemble) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (25, 32, 32), np.uint8)
    networks = [network.float() for network in reference.networks]
    expected = predict(networks, reference.model.header.preprocess, frames)
    again = ReferenceEnsemble(reference.model, Path())
    found_n = again.forces_n(np.stack(list(prepared(frames, reference.model.header.preprocess))))
    assert 0 < np.abs(found_n - expected).max() < 1e-3 * np.abs(expected).max()


def test_lower_precision_has_a_larger_bound(reference: ReferenceEnsemble, inputs: np.ndarray) -> None:
    single, half, eight = (reference.bound_n(inputs, rounding).max() for rounding in ROUNDING.values())
    assert 0 < 100 * single < min(half, eight)


def test_bound_without_rounding_is_that_of_the_label_scale(
    reference: ReferenceEnsemble, inputs: np.ndarray
) -> None:
    bound_n = reference.bound_n(inputs, Rounding(sums=0.0))
    assert bound_n == pytest.approx(4 * 20 * 2.0**-24)
    assert (reference.bound_n(inputs, Rounding(sums=0.0), input_error=1e-3) > bound_n).all()


def test_a_steeper_network_has_a_larger_bound(reference: ReferenceEnsemble, inputs: np.ndarray) -> None:
    before_n = reference.bound_n(inputs, ROUNDING["float32"])[0]
    reference.networks[0].out.weight.mul_(10)
    assert reference.bound_n(inputs, ROUNDING["float32"])[0] > 5 * before_n
