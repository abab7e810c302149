"""Computing time of an estimate."""

import time
from contextlib import suppress
from typing import Final

import numpy as np

from gripper_force.errors import UnfamiliarFrameError
from gripper_force.runtime.resolve import ResolvedConfig, make_estimator
from gripper_force.types import NS_PER_MS, Gray
from gripper_force.vision.engines import Engine
from gripper_force.vision.estimator import ForceEstimator

_TIMED_FRAMES: Final = 30


def estimate_ms(resolved: ResolvedConfig, frame: Gray, engine: Engine | None = None) -> float:
    """Time of one estimate: configured on the simulated clock, otherwise measured with a frame; 0 without vision.

    Args:
        resolved: Configuration and network.
        frame: Frame without contact.
        engine: The network's engine, if it is open: a second one would take as much memory again.
    """
    vision, model = resolved.config.vision, resolved.model
    if model is None:
        return 0.0
    if resolved.config.clock == "lockstep":
        return vision.lockstep_compute_ms
    if engine is None:
        estimator = make_estimator(resolved)
        assert estimator is not None
    else:
        estimator = ForceEstimator(engine, vision.region, resolved.correction, vision.max_covered)
    times_ms = []
    for _ in range(model.header.preprocess.lead_in + 1 + _TIMED_FRAMES):
        begin_ns = time.perf_counter_ns()
        with suppress(UnfamiliarFrameError):  # it takes as long
            estimator.update(frame)
        times_ms.append((time.perf_counter_ns() - begin_ns) / NS_PER_MS)
    return float(np.median(times_ms[-_TIMED_FRAMES:]))
