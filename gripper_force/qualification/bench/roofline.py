"""Roofline of this machine: measured rate of matrix products, and of reading weights.

S. Williams, A. Waterman, D. Patterson, "Roofline: an insightful visual performance model for multicore
architectures", Communications of the ACM 52 (2009) 65-76, doi:10.1145/1498765.1498785.
"""

import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from typing import Any, Final

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from gripper_force.vision.header import NetworkConfig
from gripper_force.vision.network import ForceNetwork

_SIDE: Final = 1024
"""Side of the matrices for the arithmetic rate; products of this size are limited by arithmetic only."""

_BYTES: Final = {"float32": 4, "bfloat16": 2, "int8": 1}
"""Bytes per weight."""

_PRODUCTS: Final = 30
"""Repetitions; the fastest counts."""


@dataclass(frozen=True, slots=True)
class Roofline:
    """Highest rates of this machine.

    Attributes:
        precision: float32, bfloat16 or int8.
        threads: CPU threads.
        flops: Additions and multiplications per second of a matrix product.
        bytes_s: Bytes per second when reading a matrix as large as a network's weights.
    """

    precision: str
    threads: int
    flops: float
    bytes_s: float

    def least_ms(self, members: Sequence[NetworkConfig]) -> float:
        """Shortest possible time of an ensemble's step in ms: its arithmetic, or reading its weights, if longer."""
        costs = [cost(member) for member in members]
        arithmetic_s = 2 * sum(multiply_adds for _, multiply_adds in costs) / self.flops
        reading_s = _BYTES[self.precision] * sum(parameters for parameters, _ in costs) / self.bytes_s
        return 1e3 * max(arithmetic_s, reading_s)


def measure(precision: str, threads: int) -> Roofline:
    """Measures the rates with OpenVINO, which has the fastest matrix products.

    Args:
        precision: float32, bfloat16 or int8.
        threads: CPU threads.
    """
    square = 2 * _SIDE**3 / _least_s(precision, threads, _SIDE)
    read = _BYTES[precision] * _SIDE**2 * 2 / _least_s(precision, threads, 1, columns=2 * _SIDE)
    return Roofline(precision, threads, square, read)


def _least_s(precision: str, threads: int, rows: int, columns: int = _SIDE) -> float:
    """Shortest measured time of a product (rows, 1024) x (1024, columns), in s."""
    import openvino
    from openvino import opset13 as ops

    rng = np.random.default_rng(0)
    inputs = ops.parameter([rows, _SIDE], np.float32)
    weights = ops.constant(rng.normal(size=(_SIDE, columns)).astype(np.float32))
    model: Any = openvino.Model([ops.matmul(inputs, weights, False, False)], [inputs])
    data = rng.normal(size=(rows, _SIDE)).astype(np.float32)
    if precision == "int8":
        import nncf

        with redirect_stdout(StringIO()):  # NNCF prints its progress on stdout
            model = nncf.quantize(model, nncf.Dataset([data]), subset_size=1)
    hint = "bf16" if precision == "bfloat16" else "f32"
    settings = {"INFERENCE_PRECISION_HINT": hint, "INFERENCE_NUM_THREADS": threads, "NUM_STREAMS": 1}
    request = openvino.Core().compile_model(model, "CPU", settings).create_infer_request()
    request.set_input_tensor(openvino.Tensor(data, shared_memory=True))
    taken_s = []
    for _ in range(_PRODUCTS * (1 if rows > 1 else 20)):
        begin_s = time.perf_counter()
        request.infer()
        taken_s.append(time.perf_counter() - begin_s)
    return min(taken_s)


def cost(config: NetworkConfig) -> tuple[int, int]:
    """Computes the size and arithmetic of a network.

    Returns:
        The number of parameters, and of multiply-adds of one `ForceNetwork.step` in convolutions and matrix
        products. SCAM's weighted pooling, a few thousand, is not included.
    """
    network = ForceNetwork(config).eval()
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network.step(torch.zeros(1, 1, config.size, config.size), network.zero_state())
    parameters = sum(parameter.numel() for parameter in network.parameters())
    return parameters, counter.get_total_flops() // 2
