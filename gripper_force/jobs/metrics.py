"""Errors and lag of a predicted signal against a measured one, and other statistics."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Signal = npt.ArrayLike
"""A one-dimensional series of numbers, (N,)."""


MAX_SPAN_S: Final = 7200.0
"""Longest span that `lag_s` accepts. No run is longer, and a damaged time would need unlimited memory."""

MAX_LAG_S: Final = 1.0
"""Largest lag that `lag_s` believes. Estimates are 0.05 to 0.3 s late, and a force that hardly changes shows no lag."""

_STEP_S: Final = 0.001
"""Resolution of `lag_s`: both signals are interpolated to it over the span they share."""


@dataclass(frozen=True, slots=True)
class ForceBin:
    """Errors over the frames whose measured force is within ``from_n`` to ``to_n``.

    Attributes:
        from_n: Lower end of the bin, inclusive.
        to_n: Upper end, exclusive.
        frames: Number of frames.
        mae_n: Mean absolute error.
        bias_n: Mean error.
    """

    from_n: float
    to_n: float
    frames: int
    mae_n: float
    bias_n: float


def mean_interval(values: Signal) -> tuple[float, float | None, float | None]:
    """Returns the mean, and the ends of its 95 % interval (Student's t), which are None for one value."""
    from scipy.special import stdtrit  # imported here: a replay without a comparison needs no SciPy

    each = np.asarray(values, np.float64)
    mean = float(each.mean())
    if len(each) < 2:
        return mean, None, None
    half = float(stdtrit(len(each) - 1, 0.975)) * float(each.std(ddof=1)) / len(each) ** 0.5
    return mean, mean - half, mean + half


def percentile(values: Signal, q: float) -> float | None:
    """Returns a percentile, or None without values."""
    array = np.asarray(values, np.float64)
    return float(np.percentile(array, q)) if array.size else None


def mae(predicted: Signal, measured: Signal) -> float:
    """Mean absolute error."""
    return float(np.abs(_error(predicted, measured)).mean())


def rmse(predicted: Signal, measured: Signal) -> float:
    """Root mean squared error."""
    return float(np.sqrt(np.square(_error(predicted, measured)).mean()))


def bias(predicted: Signal, measured: Signal) -> float:
    """Mean error; positive if predictions are too high."""
    return float(_error(predicted, measured).mean())


def per_bin(predicted_n: Signal, measured_n: Signal) -> list[ForceBin]:
    """Errors by measured force, in bins of 1 N, by rising force and without empty bins."""
    error = _error(predicted_n, measured_n)
    index = np.floor(np.asarray(measured_n, np.float64))
    bins = []
    for i in np.unique(index):
        part = error[index == i]
        bins.append(
            ForceBin(
                from_n=float(i),
                to_n=float(i + 1),
                frames=len(part),
                mae_n=float(np.abs(part).mean()),
                bias_n=float(part.mean()),
            )
        )
    return bins


def lag_s(t_s: Signal, values: Signal, reference_t_s: Signal, reference: Signal) -> float:
    """Lag of a signal behind a reference: the peak of their cross-correlation, at steps of `_STEP_S`.

    Args:
        t_s: Sample times of the signal, rising, (N,).
        values: The signal, (N,).
        reference_t_s: Sample times of the reference, rising, (M,).
        reference: The reference, (M,).

    Returns:
        Lag in s, positive if the signal is later. NaN if either is constant, if the lag is longer than `MAX_LAG_S`,
        or if their shared span is shorter than two steps or longer than `MAX_SPAN_S`.
    """
    t, t_ref = np.asarray(t_s, np.float64), np.asarray(reference_t_s, np.float64)
    begin, end = max(t[0], t_ref[0]), min(t[-1], t_ref[-1])
    if not 2 * _STEP_S <= end - begin <= MAX_SPAN_S:
        return float("nan")
    grid = np.arange(begin, end, _STEP_S)
    a = np.interp(grid, t, np.asarray(values, np.float64))
    b = np.interp(grid, t_ref, np.asarray(reference, np.float64))
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    size = 1 << (2 * len(grid)).bit_length()  # zero padding for both, against circular wrap-around
    spectrum = np.fft.rfft(a - a.mean(), size) * np.fft.rfft(b - b.mean(), size).conj()
    shift = int(np.fft.irfft(spectrum, size).argmax())
    found_s = (shift if shift < size // 2 else shift - size) * _STEP_S
    return found_s if abs(found_s) <= MAX_LAG_S else float("nan")


def _error(predicted: Signal, measured: Signal) -> npt.NDArray[np.float64]:
    a, b = np.asarray(predicted, np.float64), np.asarray(measured, np.float64)
    if a.shape != b.shape or a.ndim != 1 or not len(a):
        raise ValueError(f"need two series of one length, at least one sample, got {a.shape} and {b.shape}")
    return a - b
