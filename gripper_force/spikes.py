"""Spike detection in load-cell data, the same for recordings and live data."""

from typing import Final

import numpy as np
import numpy.typing as npt

HAMPEL_HALF_WINDOW: Final = 3
HAMPEL_SIGMAS: Final = 4.0
HAMPEL_FLOOR_N: Final = 0.5
"""Deviation from the local median that is never a spike: the spread of equal values is zero."""

IMPOSSIBLE_N: Final = -0.3
"""A sample below this force, after tare, is no grip force. Beyond the drift of an unloaded cell (0.1 N)."""

FLANK_N: Final = -0.1
"""A dip that reaches `IMPOSSIBLE_N` is rejected from this force on, where it leaves the cell's drift."""

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


def find_spikes(force_n: Floats) -> Bools:
    """Finds samples that can't be a grip force.

    A Hampel filter (Hampel 1974; median absolute deviation over a short window) finds outliers. The smoothed
    spikes of an HX711 are wider than the window; they are found if they are negative, flanks included. A wide
    positive spike looks like a grip and is kept.

    Args:
        force_n: Forces after tare, (N,).

    Returns:
        True for each rejected sample, (N,).
    """
    if not len(force_n):
        return np.zeros(0, np.bool_)
    # Odd reflection at both ends continues a ramp.
    padded = np.pad(force_n, HAMPEL_HALF_WINDOW, mode="reflect", reflect_type="odd")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * HAMPEL_HALF_WINDOW + 1)  # (N, 7)
    median = np.median(windows, axis=1)
    sigma = 1.4826 * np.median(np.abs(windows - median[:, None]), axis=1)
    outliers = np.abs(force_n - median) > np.maximum(HAMPEL_SIGMAS * sigma, HAMPEL_FLOOR_N)
    dips = force_n < FLANK_N
    segment = np.cumsum(np.diff(dips, prepend=False))  # numbers the dips and the parts between them
    impossible = dips & np.isin(segment, segment[force_n < IMPOSSIBLE_N])
    return np.asarray(outliers | impossible, np.bool_)
