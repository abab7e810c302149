"""Tare and scale of a load cell from three rests: empty, under a known force, and empty again."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import stats

from gripper_force.errors import DataError
from gripper_force.profiles.rig_profile import CalibratedValue
from gripper_force.spikes import find_spikes

BATCHES: Final = 10
"""Readings of a converter are no independent draws. The means of so few long batches nearly are, and give an
interval without a model of the noise: Schmeiser, "Batch size effects in the analysis of simulation output",
Operations Research 30 (1982) 556, doi:10.1287/opre.30.3.556, finds no use in more than 30."""

LEAST_READINGS: Final = 4 * BATCHES
_MOST_REJECTED: Final = 0.2
_MOST_MOVED: Final = 0.02
_MOST_RETURN: Final = 0.02
_MOST_UNKNOWN: Final = 0.05
_CLEAR: Final = 10
_LARGEST: Final = 1e9
_S_PER_MIN: Final = 60.0

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Rest:
    """Readings under a load that rests.

    Attributes:
        t_s: Times, (N,).
        raw: Readings in the sensor's own unit, (N,).
        valid: Whether the sensor itself stands by them, (N,).
    """

    t_s: Floats
    raw: Floats
    valid: Bools


@dataclass(frozen=True, slots=True)
class Level:
    """What a rest says.

    Attributes:
        raw: Mean reading.
        half_raw: Half of its 95 % confidence interval.
        moved_raw: How far the reading went from its first to its last batch, and in between.
        noise_raw: Standard deviation of a reading about the drift.
        drift_raw_min: Drift a minute.
        drift_half_raw_min: Half of its 95 % confidence interval.
        kept: Readings that count, (N,).
    """

    raw: float
    half_raw: float
    moved_raw: float
    noise_raw: float
    drift_raw_min: float
    drift_half_raw_min: float
    kept: Bools


@dataclass(frozen=True, slots=True)
class Weighing:
    """Tare and scale, and what they rest on.

    Attributes:
        rests: What was read.
        tare_raw: Reading without load.
        n_per_raw: Newtons for one unit of the reading.
        noise_n: Standard deviation of one reading.
        drift_n_min: Drift without load, a minute.
        return_n: What is read after the load was taken off, against before.
        rejected: Readings left out.
        levels: Of the three rests.
    """

    rests: tuple[Rest, Rest, Rest]
    tare_raw: CalibratedValue
    n_per_raw: CalibratedValue
    noise_n: float
    drift_n_min: CalibratedValue
    return_n: float
    rejected: int
    levels: tuple[Level, Level, Level]


def level(rest: Rest, scale: float, name: str) -> Level:
    """Mean, noise and drift of a rest, without what sticks out.

    Args:
        rest: The readings.
        scale: Newtons for one unit of the reading as far as known, to tell a spike; 0 where it is not.
        name: What rests, for the error.

    Raises:
        DataError: There are too few readings, or too many that are rejected.
    """
    kept = rest.valid & (np.abs(rest.raw) < _LARGEST) & np.isfinite(rest.t_s)
    if scale and kept.any():
        force_n = (rest.raw[kept] - _trend(rest.raw[kept])) * scale
        # A resting load knows no side: what can't be a dip can't be a bump either.
        kept[kept] = ~(find_spikes(force_n) | find_spikes(-force_n))
    rejected = len(rest.raw) - int(kept.sum())
    if kept.sum() < LEAST_READINGS:
        raise DataError(
            f"{name}, {int(kept.sum())} of {len(rest.raw)} readings are of use, and {LEAST_READINGS} are "
            "needed; see what doctor says of the load cell, or record for longer"
        )
    if rejected > _MOST_REJECTED * len(rest.raw):
        raise DataError(
            f"{name}, {rejected} of {len(rest.raw)} readings were rejected (saturated, stuck, no number, or "
            "spikes); see to the load cell's range and wiring"
        )
    t_s, raw = rest.t_s[kept], rest.raw[kept]
    centre = float(np.median(raw))
    batches_t_s = np.array([part.mean() for part in np.array_split(t_s, BATCHES)])
    if not (np.diff(batches_t_s) > 0).all():
        raise DataError(f"{name}, the readings' times do not go forwards, so no drift can be told from them")
    batches = np.array([part.mean() - centre for part in np.array_split(raw, BATCHES)])
    rate, offset = np.polyfit(batches_t_s - batches_t_s.mean(), batches, 1)
    trend = offset + rate * (batches_t_s - batches_t_s.mean())
    spread = float(np.sqrt(np.sum((batches - trend) ** 2) / (BATCHES - 2)))
    quantile = float(stats.t.ppf(0.975, BATCHES - 2))
    span = float(np.sqrt(np.sum((batches_t_s - batches_t_s.mean()) ** 2)))
    noise = float(np.std(raw - centre - offset - rate * (t_s - batches_t_s.mean())))
    return Level(
        raw=centre + float(offset),
        half_raw=quantile * spread / np.sqrt(BATCHES) + _rounding(raw),
        moved_raw=float(np.ptp(batches)),
        noise_raw=noise,
        drift_raw_min=float(rate) * _S_PER_MIN,
        drift_half_raw_min=quantile * spread / span * _S_PER_MIN,
        kept=kept,
    )


def fit_load_cell(empty: Rest, loaded: Rest, again: Rest, force_n: float) -> Weighing:
    """Tare and scale by a known force.

    The tare lies between what is read before and after: what differs is taken as uncertain, not as drift.

    Args:
        empty: Readings without load.
        loaded: Readings under the force.
        again: Readings after it was taken off.
        force_n: The force, positive.

    Raises:
        DataError: The readings are too few, do not rest, hardly change with the load, or do not come back.
    """
    rough = _rough_scale(empty, loaded, force_n)
    first = level(empty, rough, "without load")
    under = level(loaded, rough, "under load")
    last = level(again, rough, "after the load was taken off")
    change = under.raw - (first.raw + last.raw) / 2
    unit = "of the reading's unit"
    largest = max(first.half_raw, under.half_raw, last.half_raw, force_n / _LARGEST)
    if not abs(change) > largest:
        raise DataError(
            f"the load changes the reading by {change:.4g}, and each is only known within {largest:.4g} "
            f"{unit}; check that the load hangs on the cell, or take a heavier one"
        )
    for name, one in (("without load", first), ("under load", under), ("after unloading", last)):
        if one.moved_raw > _MOST_MOVED * abs(change):
            raise DataError(
                f"the reading does not rest {name}: it moves by {100 * one.moved_raw / abs(change):.1f} % of "
                "the load; wait until nothing swings, keep draughts off, or take a heavier load"
            )
    came_back = last.raw - first.raw
    if abs(came_back) > _MOST_RETURN * abs(change):
        raise DataError(
            f"without load the cell reads {100 * abs(came_back / change):.1f} % of the load more or less "
            "than before it; see that nothing touches it or has slipped, and repeat"
        )
    tare_half = abs(came_back) / 2 + max(first.half_raw, last.half_raw)
    change_half = abs(came_back) / 2 + float(
        np.hypot(under.half_raw, np.hypot(first.half_raw, last.half_raw) / 2)
    )
    if change_half > _MOST_UNKNOWN * abs(change):
        raise DataError(
            f"the load changes the reading by {change:.4g}, and that is only known within {change_half:.4g} "
            f"{unit}; take a heavier load, or record for longer"
        )
    n_per_raw = force_n / change
    ends = sorted(force_n / (change + side * change_half) for side in (-1, 1))
    tare = (first.raw + last.raw) / 2
    drift = (first.drift_raw_min + last.drift_raw_min) / 2 * n_per_raw
    drift_half = float(np.hypot(first.drift_half_raw_min, last.drift_half_raw_min)) / 2 * abs(n_per_raw)
    levels = (first, under, last)
    return Weighing(
        rests=(empty, loaded, again),
        tare_raw=CalibratedValue(value=tare, low=tare - tare_half, high=tare + tare_half),
        n_per_raw=CalibratedValue(value=n_per_raw, low=ends[0], high=ends[1]),
        noise_n=max(one.noise_raw for one in levels) * abs(n_per_raw),
        drift_n_min=CalibratedValue(value=drift, low=drift - drift_half, high=drift + drift_half),
        return_n=came_back * n_per_raw,
        rejected=sum(int((~one.kept).sum()) for one in levels),
        levels=levels,
    )


def allan_deviation(rest: Rest, kept: Bools) -> tuple[Floats, Floats]:
    """Averaging times in s and the Allan deviation of the kept readings at each, in the reading's unit.

    Overlapping, at octaves: Riley, "Handbook of frequency stability analysis", NIST SP 1065 (2008), 5.2.4.
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
    """Newtons for a unit of the reading by the medians; 0 where noise alone could change them so."""
    medians, spreads = [], []
    for rest in (empty, loaded):
        usable = rest.raw[rest.valid & (np.abs(rest.raw) < _LARGEST)]
        medians.append(float(np.median(usable)) if len(usable) else 0.0)
        spreads.append(float(np.median(np.abs(usable - medians[-1]))) if len(usable) else 0.0)
    change = medians[1] - medians[0]
    return force_n / change if abs(change) > max(_CLEAR * max(spreads), force_n / _LARGEST) else 0.0


def _trend(raw: Floats) -> Floats:
    """A line through the medians of parts, which spikes leave as it is."""
    parts = [part for part in np.array_split(np.arange(len(raw)), BATCHES) if len(part)]
    middles = np.array([part.mean() for part in parts])
    medians = np.array([np.median(raw[part]) for part in parts])
    if len(parts) < BATCHES:
        return np.full(len(raw), medians.mean())
    return np.asarray(np.polyval(np.polyfit(middles, medians, 1), np.arange(len(raw))), np.float64)


def _rounding(raw: Floats) -> float:
    """Half of the last digit that is told, where noise does not blur it."""
    values = np.unique(raw)
    if len(values) > 2:
        return 0.0
    digits = max(len(repr(float(value)).partition(".")[2]) for value in values)
    return 0.5 * 10.0**-digits if len(values) == 1 else float(values[1] - values[0]) / 2
