from importlib.util import find_spec

import pytest

from gripper_force.qualification.bench import roofline
from gripper_force.qualification.bench.roofline import Roofline, cost, measure
from gripper_force.vision.header import NetworkConfig

SMALL = NetworkConfig(size=32, width=0.25)


def test_least_time_is_the_longer_of_arithmetic_and_reading() -> None:
    parameters, multiply_adds = cost(SMALL)
    assert Roofline("float32", 1, 1e9, 1e15).least_ms([SMALL]) == pytest.approx(2e-6 * multiply_adds)
    assert Roofline("float32", 1, 1e15, 1e9).least_ms([SMALL, SMALL]) == pytest.approx(8e-6 * parameters)
    assert Roofline("int8", 1, 1e15, 1e9).least_ms([SMALL]) == pytest.approx(1e-6 * parameters)


@pytest.mark.parametrize("precision", ["float32", "bfloat16", "int8"])
def test_rates_of_this_machine_are_measured(precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if find_spec("nncf") is None:
        pytest.skip("nncf is not installed: pip install 'gripper-force[engines]'")
    monkeypatch.setattr(roofline, "_PRODUCTS", 2)
    roof = measure(precision, 1)
    assert roof.flops > 1e8
    assert roof.bytes_s > 1e8
