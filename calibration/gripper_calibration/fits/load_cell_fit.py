"""Tare and scale of a load cell from three rests: empty, under a known force, and empty again."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from gripper_force.errors import DataError
from gripper_force.profiles.rig_profile import CalibratedValue
from gripper_force.spikes import find_spikes

BATCHES: Final = 10
"""Batches per rest. Consecutive readings are not independent, but the means of a few long batches nearly are,
and they give an interval without a noise model. More than 30 give no benefit: Schmeiser, "Batch size
effects in the analysis of simulation output", Operations Research 30 (1982) 556, doi:10.1287/opre.30.3.556."""

MIN_READINGS: Final = 4 * BATCHES
_MAX_REJECTED: Final = 0.2
_MAX_RANGE: Final = 0.02
_MAX_RETURN_ERROR: Final = 0.02
_MAX_HALF_WIDTH: Final = 0.05
"""Limits as shares: of the readings (rejected), of the change by the load (the others)."""
_CHANGE_TO_SPREAD: Final = 10
_MAX_RAW: Final = 1e9
_S_PER_MIN: Final = 60.0

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Rest:
    """Readings under a load at rest.

    Attributes:
        t_s: Times, (N,).
        raw: Readings in the sensor's unit, (N,).
        valid: True for readings that the sensor's driver marks as valid, (N,).
    """

    t_s: Floats
    raw: Floats
    valid: Bools


@dataclass(frozen=True, slots=True)
class RestStatistics:
    """Statistics of a rest.

    Attributes:
        raw: Mean reading.
        half_raw: Half of its 95 % confidence interval.
        range_raw: Peak-to-peak range of the batch means.
        noise_raw: Standard deviation of a reading about the drift.
        drift_raw_min: Drift per minute.
        drift_half_raw_min: Half of its 95 % confidence interval.
        kept: True for the readings that were used, (N,).
    """

    raw: float
    half_raw: float
    range_raw: float
    noise_raw: float
    drift_raw_min: float
    drift_half_raw_min: float
    kept: Bools


@dataclass(frozen=True, slots=True)
class LoadCellFit:
    """Tare and scale with the data they come from.

    Attributes:
        rests: The readings.
        tare_raw: Reading without load.
        n_per_raw: Newtons per unit of the reading.
        noise_n: Standard deviation of one reading.
        drift_n_min: Drift without load, per minute.
        return_n: Difference of the empty readings after and before the load.
        rejected: Number of rejected readings.
        statistics: Statistics of the three rests.
    """

    rests: tuple[Rest, Rest, Rest]
    tare_raw: CalibratedValue
    n_per_raw: CalibratedValue
    noise_n: float
    drift_n_min: CalibratedValue
    return_n: float
    rejected: int
    statistics: tuple[RestStatistics, RestStatistics, RestStatistics]


def rest_statistics(rest: Rest, scale: float, name: str, step_raw: float = math.inf) -> RestStatistics:
    """Returns mean, noise and drift of a rest, without spikes.

    Args:
        rest: The readings.
        scale: Approximate newtons per unit of the reading, to detect spikes; 0 if unknown.
        name: Name of the rest, for the error message.
        step_raw: Smallest difference of any two readings of the sensor; infinite if unknown. A display at rest does
            not show its resolution.

    Raises:
        DataError: There are too few readings, or too many rejected ones.
    """
    kept = rest.valid & (np.abs(rest.raw) < _MAX_RAW) & np.isfinite(rest.t_s)
    if scale and kept.any():
        force_n = (rest.raw[kept] - _trend(rest.raw[kept])) * scale
        # Spikes of a load at rest occur in both directions.
        kept[kept] = ~(find_spikes(force_n) | find_spikes(-force_n))
    rejected = len(rest.raw) - int(kept.sum())
    if kept.sum() < MIN_READINGS:
        raise DataError(
            f"{name}, only {int(kept.sum())} of {len(rest.raw)} readings are usable, and {MIN_READINGS} are "
            "needed; check the load cell with `gripper-force doctor`, or increase --seconds"
        )
    if rejected > _MAX_REJECTED * len(rest.raw):
        raise DataError(
            f"{name}, {rejected} of {len(rest.raw)} readings were rejected (saturated, stuck, not a number, "
            "or spikes); check the load cell's range and wiring"
        )
    t_s, raw = rest.t_s[kept], rest.raw[kept]
    centre = float(np.median(raw))
    batches_t_s = np.array([part.mean() for part in np.array_split(t_s, BATCHES)])
    if not (np.diff(batches_t_s) > 0).all():
        raise DataError(
            f"{name}, the times of the readings do not increase; check the load cell's clock or the log"
        )
    batches = np.array([part.mean() - centre for part in np.array_split(raw, BATCHES)])
    rate, offset = np.polyfit(batches_t_s - batches_t_s.mean(), batches, 1)
    trend = offset + rate * (batches_t_s - batches_t_s.mean())
    spread = float(np.sqrt(np.sum((batches - trend) ** 2) / (BATCHES - 2)))
    quantile = float(stdtrit(BATCHES - 2, 0.975))
    span = float(np.sqrt(np.sum((batches_t_s - batches_t_s.mean()) ** 2)))
    noise = float(np.std(raw - centre - offset - rate * (t_s - batches_t_s.mean())))
    return RestStatistics(
        raw=centre + float(offset),
        half_raw=quantile * spread / np.sqrt(BATCHES) + _rounding(raw, step_raw),
        range_raw=float(np.ptp(batches)),
        noise_raw=noise,
        drift_raw_min=float(rate) * _S_PER_MIN,
        drift_half_raw_min=quantile * spread / span * _S_PER_MIN,
        kept=kept,
    )


def fit_load_cell(
    empty: Rest, loaded: Rest, empty_again: Rest, force_n: float, step_raw: float = math.inf
) -> LoadCellFit:
    """Fits tare and scale to three rests.

    The tare lies between the empty readings before and after. Their difference counts as uncertainty, not as
    drift.

    Args:
        empty: Readings without load.
        loaded: Readings under the force.
        empty_again: Readings after the load was removed.
        force_n: The force, positive.
        step_raw: As for `rest_statistics`.

    Raises:
        DataError: There are too few readings, or they do not settle, hardly change with the load, or do not
            return to the empty value.
    """
    rough = _rough_scale(empty, loaded, force_n)
    first = rest_statistics(empty, rough, "without load", step_raw)
    under = rest_statistics(loaded, rough, "under load", step_raw)
    last = rest_statistics(empty_again, rough, "after unloading", step_raw)
    change = under.raw - (first.raw + last.raw) / 2
    unit = "units of the reading"
    largest = max(first.half_raw, under.half_raw, last.half_raw, force_n / _MAX_RAW)
    if not abs(change) > largest:
        raise DataError(
            f"the load changes the reading by {change:.4g} {unit}, and the readings are only known to within "
            f"{largest:.4g}; check that the load acts on the cell, or use a heavier load"
        )
    for name, one in (("without load", first), ("under load", under), ("after unloading", last)):
        if one.range_raw > _MAX_RANGE * abs(change):
            raise DataError(
                f"the reading does not settle {name}: it varies by {100 * one.range_raw / abs(change):.1f} % "
                "of the load; wait until nothing swings, avoid draughts, or use a heavier load"
            )
    return_raw = last.raw - first.raw
    if abs(return_raw) > _MAX_RETURN_ERROR * abs(change):
        raise DataError(
            f"the empty reading after the load differs from the one before it by "
            f"{100 * abs(return_raw / change):.1f} % of the load; check that nothing touches the cell or has "
            "slipped, and repeat"
        )
    tare_half = abs(return_raw) / 2 + max(first.half_raw, last.half_raw)
    change_half = abs(return_raw) / 2 + float(
        np.hypot(under.half_raw, np.hypot(first.half_raw, last.half_raw) / 2)
    )
    if change_half > _MAX_HALF_WIDTH * abs(change):
        raise DataError(
            f"the load changes the reading by {change:.4g} {unit}, and this is only known to within "
            f"{change_half:.4g}; use a heavier load, or increase --seconds"
        )
    n_per_raw = force_n / change
    ends = sorted(force_n / (change + side * change_half) for side in (-1, 1))
    tare = (first.raw + last.raw) / 2
    drift = (first.drift_raw_min + last.drift_raw_min) / 2 * n_per_raw
    drift_half = float(np.hypot(first.drift_half_raw_min, last.drift_half_raw_min)) / 2 * abs(n_per_raw)
    statistics = (first, under, last)
    return LoadCellFit(
        rests=(empty, loaded, empty_again),
        tare_raw=CalibratedValue(value=tare, low=tare - tare_half, high=tare + tare_half),
        n_per_raw=CalibratedValue(value=n_per_raw, low=ends[0], high=ends[1]),
        noise_n=max(one.noise_raw for one in statistics) * abs(n_per_raw),
        drift_n_min=CalibratedValue(value=drift, low=drift - drift_half, high=drift + drift_half),
        return_n=return_raw * n_per_raw,
        rejected=sum(int((~one.kept).sum()) for one in statistics),
        statistics=statistics,
    )


def allan_deviation(rest: Rest, kept: Bools) -> tuple[Floats, Floats]:
    """Returns averaging times in s and the Allan deviation at each, in the reading's unit, (K,) each.

    Overlapping estimator, at octaves: Riley, "Handbook of frequency stability analysis", NIST SP 1065 (2008),
    5.2.4.
    """
    raw = rest.raw[kept]
    period_s = float(np.median(np.diff(rest.t_s[kept])))
    sums = np.concatenate([[0.0], np.cumsum(raw - raw.mean())])
    sizes = [2**i for i in range(len(raw).bit_length()) if 3 * 2**i <= len(raw)]
    deviations = []
    for size in sizes:
        means = (sums[size:] - sums[:-size]) / size
        deviations.append(float(np.sqrt(np.mean((means[size:] - means[:-size]) ** 2) / 2)))
    return np.array(sizes) * period_s, np.array(deviations)


def _rough_scale(empty: Rest, loaded: Rest, force_n: float) -> float:
    """Newtons per unit of the reading from the medians; 0 if noise could explain their difference."""
    medians, spreads = [], []
    for rest in (empty, loaded):
        usable = rest.raw[rest.valid & (np.abs(rest.raw) < _MAX_RAW)]
        medians.append(float(np.median(usable)) if len(usable) else 0.0)
        spreads.append(float(np.median(np.abs(usable - medians[-1]))) if len(usable) else 0.0)
    change = medians[1] - medians[0]
    return (
        force_n / change if abs(change) > max(_CHANGE_TO_SPREAD * max(spreads), force_n / _MAX_RAW) else 0.0
    )


def _trend(raw: Floats) -> Floats:
    """Line through the medians of parts of the readings, robust against spikes, (N,)."""
    parts = [part for part in np.array_split(np.arange(len(raw)), BATCHES) if len(part)]
    middles = np.array([part.mean() for part in parts])
    medians = np.array([np.median(raw[part]) for part in parts])
    if len(parts) < BATCHES:
        return np.full(len(raw), medians.mean())
    return np.asarray(np.polyval(np.polyfit(middles, medians, 1), np.arange(len(raw))), np.float64)


def _rounding(raw: Floats, step_raw: float) -> float:
    """Half of the reading's resolution if noise is smaller than that, else 0."""
    values = np.unique(raw)
    if len(values) > 2:
        return 0.0
    digits = max(len(repr(float(value)).partition(".")[2]) for value in values)
    return 0.5 * min(10.0**-digits, step_raw) if len(values) == 1 else float(values[1] - values[0]) / 2
