"""Computing time of an estimate."""

import time
from collections.abc import Iterable

import numpy as np

from gripper_force.runtime.resolve import ResolvedConfig, make_estimator
from gripper_force.types import NS_PER_MS, Gray


def estimate_ms(resolved: ResolvedConfig, frames: Iterable[Gray]) -> float:
    """Time of one estimate: configured on the simulated clock, otherwise measured with frames; 0 without vision."""
    if resolved.config.clock == "lockstep" and resolved.model is not None:
        return resolved.config.vision.lockstep_compute_ms
    estimator = make_estimator(resolved)
    if estimator is None:
        return 0.0
    times_ms = []
    for frame in frames:
        begin_ns = time.perf_counter_ns()
        estimator.update(frame)
        times_ms.append((time.perf_counter_ns() - begin_ns) / NS_PER_MS)
    return float(np.median(times_ms))
