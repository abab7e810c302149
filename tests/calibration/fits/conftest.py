"""Synthetic touches for the fits."""

from collections.abc import Callable

import numpy as np
import pytest

from gripper_calibration.fits.touches import Floats, Touches

FEATURES = 40


def _touched(
    count: int,
    *,
    gain: float = 1.0,
    offset_n: float = 0.0,
    bend: float = 0.0,
    scatter: float = 0.0,
    noise_n: float = 0.02,
    peak_n: float = 8.0,
    seed: int = 0,
) -> Touches:
    """Touches whose true force is a line through the network's estimate, or bent away from it."""
    rng = np.random.default_rng(seed)
    mix = np.random.default_rng(99).normal(size=(3, FEATURES))  # one network
    parts: list[tuple[Floats, Floats, Floats]] = []
    for _ in range(count):
        rise = np.sin(np.linspace(0, np.pi, 60)).clip(0) * rng.uniform(0.4, 1) * peak_n
        estimate_n = np.concatenate([np.zeros(15), rise, np.zeros(15)])
        own = gain * (1 + scatter * rng.normal())
        force_n = own * estimate_n + offset_n + bend * np.square(estimate_n) / peak_n
        hidden = np.column_stack([estimate_n, np.square(estimate_n) / peak_n, rng.normal(size=90)])
        features = np.tanh(0.1 * hidden @ mix) + 0.01 * rng.normal(size=(90, FEATURES))
        parts.append((features, estimate_n, force_n + noise_n * rng.normal(size=90)))
    features, estimate_n, force_n = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Touches(features.astype(np.float32), estimate_n, force_n, np.repeat(np.arange(count), 90))


@pytest.fixture(scope="session")
def touched() -> Callable[..., Touches]:
    """Makes touches; see `_touched`."""
    return _touched
