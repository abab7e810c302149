"""Computing time of an estimate."""

import time
from collections.abc import Iterable

import numpy as np

from gripper_force.runtime.resolve import ResolvedConfig, make_estimator
from gripper_force.types import NS_PER_MS, Gray
from gripper_force.vision.engines import Engine
from gripper_force.vision.estimator import ForceEstimator


def estimate_ms(resolved: ResolvedConfig, frames: Iterable[Gray], engine: Engine | None = None) -> float:
    """Time of one estimate: configured on the simulated clock, otherwise measured with frames; 0 without vision.

    Args:
        resolved: Configuration and network.
        frames: Frames without contact.
        engine: The network's engine, if it is open: a second one would take as much memory again.
    """
    vision = resolved.config.vision
    if resolved.config.clock == "lockstep" and resolved.model is not None:
        return vision.lockstep_compute_ms
    if engine is None:
        estimator = make_estimator(resolved)
    else:
        estimator = ForceEstimator(engine, vision.region, resolved.correction, vision.max_covered)
    if estimator is None:
        return 0.0
    times_ms = []
    for frame in frames:
        begin_ns = time.perf_counter_ns()
        estimator.update(frame)
        times_ms.append((time.perf_counter_ns() - begin_ns) / NS_PER_MS)
    return float(np.median(times_ms))
