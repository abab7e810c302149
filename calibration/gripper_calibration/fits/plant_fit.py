"""Fit of the force loop's plant with an object: from motor force to contact force and to its estimate."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.signal import lfilter

from gripper_calibration.fits.touches import Floats
from gripper_force.control.tuning import Plant, phase_margin_deg, simc
from gripper_force.profiles.object_profile import LoopPlant

_STEP_S: Final = 0.005
_MAX_LAG_S: Final = 0.3
_MIN_RISE_N: Final = 0.5
_MIN_SAMPLES: Final = 20
_HELD_SHARE: Final = 0.1
"""Share of the rise of a press that is left out: until the ramp exceeds it, friction holds the force of the impact."""

_MIN_DELAY_S: Final = 0.002
_GAIN_RANGE: Final = (0.3, 3.0)
_MIN_DENT_M: Final = 0.001
_DENT_TO_SCATTER: Final = 4.0
_TOUCHES_AFTER: Final = 2
"""A dent is deeper than `_MIN_DENT_M` plus this many times the scatter of the object's position, and visible in
at least this many later touches."""


@dataclass(frozen=True, eq=False)
class PressSeries:
    """One ramp and the hold after it. The force never falls, so friction keeps its sign.

    Attributes:
        t_s: Times of the control cycles, (N,).
        motor_force_n: Force at each jaw from the motor current, less the nominal friction, (N,).
        force_n: Load-cell force, (N,).
    """

    t_s: Floats
    motor_force_n: Floats
    force_n: Floats


def fit_plant(presses: list[PressSeries], delay_s: float) -> LoopPlant | None:
    """Fits gain and lag to presses by least squares, and tunes the loop for them and a measured delay.

    Friction differs between presses and from its nominal value, so each press has its own offset. The ramp
    determines gain and offset, and the transition into the hold determines the lag. A press counts from where its
    force rises: the impact leaves a force that friction holds while the motor force is still below it.

    Args:
        presses: Ramps and holds.
        delay_s: Delay from the contact force to a usable estimate.

    Returns:
        The plant with its SIMC gains, or None if no press determines it.
    """
    resampled = [series for series in map(_resample, presses) if series is not None]
    if not resampled:
        return None
    lags_s = np.arange(0.0, _MAX_LAG_S + _STEP_S / 2, _STEP_S)
    fits = [_fit_gain(resampled, lag_s) for lag_s in lags_s]
    best = int(np.argmin([squares for squares, _ in fits]))
    gain, lag_s = fits[best][1], max(float(lags_s[best]), _STEP_S)
    if best == len(lags_s) - 1 or not _GAIN_RANGE[0] < gain < _GAIN_RANGE[1]:
        return None
    plant = Plant(gain, lag_s, max(delay_s, _MIN_DELAY_S))
    gains = simc(plant)
    return LoopPlant(
        gain=gain,
        lag_ms=1e3 * lag_s,
        delay_ms=1e3 * plant.delay_s,
        proportional=gains.proportional,
        integral_s=gains.integral_s,
        phase_margin_deg=phase_margin_deg(plant, gains),
    )


def stiffness_n_m(width_m: list[Floats], force_n: list[Floats]) -> Floats:
    """Returns the slope of force over travel between one and two thirds of the largest force, in N/m.

    Args:
        width_m: Distance between the jaws while the force rose, (N,) for each touch.
        force_n: Load-cell force, (N,) for each touch.

    Returns:
        One slope for each touch that determines it, (K,).
    """
    peak_n = max((float(force.max()) for force in force_n if len(force)), default=0.0)
    slopes = []
    for width, force in zip(width_m, force_n, strict=True):
        part = (force > peak_n / 3) & (force < 2 * peak_n / 3)
        if part.sum() >= _MIN_SAMPLES and np.ptp(force[part]) > _MIN_RISE_N / 2:
            # Regress force on travel: the noise is in the force.
            slope = -float(np.polyfit(width[part] - width[part].mean(), force[part], 1)[0])
            if slope > 0:
                slopes.append(slope)
    return np.array(slopes)


def crushing_touch(contact_width_m: Floats, peak_n: Floats) -> int | None:
    """Returns the index of the touch after which the object stayed narrower, or None if there is none.

    Args:
        contact_width_m: Distance between the jaws at the contact of each touch, in order of time, (K,).
        peak_n: Largest force of each touch, (K,).
    """
    crushing, largest = None, 0.0
    for last in range(1, len(contact_width_m) - _TOUCHES_AFTER):
        before, after = contact_width_m[: last + 1], contact_width_m[last + 1 :]
        scatter_m = max(float(np.median(np.abs(part - np.median(part)))) for part in (before, after))
        dent_m = float(np.median(before) - np.median(after))
        # The change is at the split that explains most of the variance.
        explained = len(before) * len(after) * float(before.mean() - after.mean()) ** 2
        if dent_m > _MIN_DENT_M + _DENT_TO_SCATTER * scatter_m and explained > largest:
            crushing, largest = last, explained
    if crushing is None or peak_n[crushing] < peak_n[: crushing + 1].max():
        return None
    return crushing


def _resample(press: PressSeries) -> tuple[Floats, Floats, int] | None:
    """Motor force and contact force at even times and the index where the force rises, or None.

    None means that the press is too short or too weak.
    """
    if len(press.t_s) < _MIN_SAMPLES or np.ptp(press.force_n) < _MIN_RISE_N:
        return None
    t_s = np.arange(press.t_s[0], press.t_s[-1], _STEP_S)
    if len(t_s) < _MIN_SAMPLES:
        return None
    force_n = np.interp(t_s, press.t_s, press.force_n)
    rise_n = force_n.max() - force_n[0]
    rising = int(np.argmax(force_n - force_n[0] >= _HELD_SHARE * rise_n))
    return np.interp(t_s, press.t_s, press.motor_force_n), force_n, rising


def _fit_gain(presses: list[tuple[Floats, Floats, int]], lag_s: float) -> tuple[float, float]:
    """Residual sum of squares with this lag, and the best gain."""
    keep = float(np.exp(-_STEP_S / lag_s)) if lag_s > 0 else 0.0
    product = square = total = 0.0
    for motor_force_n, force_n, rising in presses:
        lagged = lfilter([1 - keep], [1, -keep], motor_force_n, zi=[keep * motor_force_n[0]])[0][rising:]
        lagged, force = lagged - lagged.mean(), force_n[rising:] - force_n[rising:].mean()
        product, square, total = product + lagged @ force, square + lagged @ lagged, total + force @ force
    gain = product / max(square, 1e-12)
    return total - gain * product, gain
