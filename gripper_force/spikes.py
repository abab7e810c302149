"""Spikes in load-cell data: one rule for recordings and for live cells."""

from typing import Final

import numpy as np
import numpy.typing as npt

HAMPEL_HALF_WINDOW: Final = 3
HAMPEL_SIGMAS: Final = 4.0
HAMPEL_FLOOR_N: Final = 0.5
"""Deviation from the local median that is never a spike, as that median can rest on equal values."""

IMPOSSIBLE_N: Final = -0.3
"""A grip pushes: a force below this, after tare, can't be. Beyond the drift seen on a quiet cell (0.1 N)."""
FLANK_N: Final = -0.1
"""A dip that reaches `IMPOSSIBLE_N` is rejected from where it leaves the cell's drift."""

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


def find_spikes(force_n: Floats) -> Bools:
    """Samples that can't be a grip force.

    A Hampel filter (Hampel 1974; median absolute deviation over a short window) takes what sticks out of its
    neighbours. An HX711's smoothed spikes are wider than any such window, and are taken where they reach
    below zero, flanks included; a wide spike upwards looks like a grip and stays.

    Args:
        force_n: Forces after tare, (N,).

    Returns:
        True where rejected, (N,).
    """
    if not len(force_n):
        return np.zeros(0, np.bool_)
    # Mirrored through its ends, so that a ramp goes on beyond them.
    padded = np.pad(force_n, HAMPEL_HALF_WINDOW, mode="reflect", reflect_type="odd")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * HAMPEL_HALF_WINDOW + 1)  # (N, 7)
    median = np.median(windows, axis=1)
    sigma = 1.4826 * np.median(np.abs(windows - median[:, None]), axis=1)
    sticks_out = np.abs(force_n - median) > np.maximum(HAMPEL_SIGMAS * sigma, HAMPEL_FLOOR_N)
    dips = force_n < FLANK_N
    part = np.cumsum(np.diff(dips, prepend=False))  # numbers the dips, and what lies between them
    impossible = dips & np.isin(part, part[force_n < IMPOSSIBLE_N])
    return np.asarray(sticks_out | impossible, np.bool_)
