"""Figures of merit for a predicted against a measured signal."""

from typing import Final, TypedDict

import numpy as np
import numpy.typing as npt

Signal = npt.ArrayLike
"""A one-dimensional series of numbers."""


LONGEST_S: Final = 7200.0
"""No run is longer; a damaged time would ask for any amount of memory."""


class Bin(TypedDict):
    """Error where the measured force lies in ``from_n`` to ``to_n``."""

    from_n: float
    to_n: float
    frames: int
    mae_n: float
    bias_n: float


def mae(predicted: Signal, measured: Signal) -> float:
    """Mean absolute error."""
    return float(np.abs(_error(predicted, measured)).mean())


def rmse(predicted: Signal, measured: Signal) -> float:
    """Root mean squared error."""
    return float(np.sqrt(np.square(_error(predicted, measured)).mean()))


def bias(predicted: Signal, measured: Signal) -> float:
    """Mean error; positive where too much is predicted."""
    return float(_error(predicted, measured).mean())


def per_bin(predicted_n: Signal, measured_n: Signal, width_n: float = 1.0) -> list[Bin]:
    """Errors by measured force, in bins of ``width_n`` that hold any frame, by rising force."""
    error = _error(predicted_n, measured_n)
    index = np.floor(np.asarray(measured_n, np.float64) / width_n).astype(int)
    bins = []
    for i in np.unique(index):
        part = error[index == i]
        bins.append(
            Bin(
                from_n=float(i * width_n),
                to_n=float((i + 1) * width_n),
                frames=len(part),
                mae_n=float(np.abs(part).mean()),
                bias_n=float(part.mean()),
            )
        )
    return bins


def lag_s(
    t_s: Signal, values: Signal, reference_t_s: Signal, reference: Signal, *, step_s: float = 0.001
) -> float:
    """Time by which a signal trails a reference, by the peak of their cross-correlation.

    Args:
        t_s: Sample times of the signal, rising.
        values: The signal.
        reference_t_s: Sample times of the reference, rising.
        reference: The reference.
        step_s: Resolution. Both are interpolated to it over the span they share.

    Returns:
        Lag in s; positive where the signal comes later; NaN where either does not move, or they share no span
        or one of more than `LONGEST_S`.
    """
    t, t_ref = np.asarray(t_s, np.float64), np.asarray(reference_t_s, np.float64)
    begin, end = max(t[0], t_ref[0]), min(t[-1], t_ref[-1])
    if not 2 * step_s <= end - begin <= LONGEST_S:
        return float("nan")
    grid = np.arange(begin, end, step_s)
    a = np.interp(grid, t, np.asarray(values, np.float64))
    b = np.interp(grid, t_ref, np.asarray(reference, np.float64))
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    size = 1 << (2 * len(grid)).bit_length()  # both fit in beside each other, so that nothing wraps round
    spectrum = np.fft.rfft(a - a.mean(), size) * np.fft.rfft(b - b.mean(), size).conj()
    shift = int(np.fft.irfft(spectrum, size).argmax())
    return float((shift if shift < size // 2 else shift - size) * step_s)


def _error(predicted: Signal, measured: Signal) -> npt.NDArray[np.float64]:
    a, b = np.asarray(predicted, np.float64), np.asarray(measured, np.float64)
    if a.shape != b.shape or a.ndim != 1 or not len(a):
        raise ValueError(f"need two series of one length, at least one sample, got {a.shape} and {b.shape}")
    return a - b
