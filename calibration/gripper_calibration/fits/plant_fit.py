"""The force loop's plant with an object: from the motor's push to the contact force, and to its estimate."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.signal import lfilter

from gripper_calibration.fits.touches import Floats
from gripper_force.control.tuning import Plant, phase_margin_deg, simc
from gripper_force.profiles.object_profile import LoopPlant

_STEP_S: Final = 0.005
_LONGEST_LAG_S: Final = 0.3
_LEAST_RISE_N: Final = 0.5
_FEWEST: Final = 20
_LEAST_DELAY_S: Final = 0.002
_GAINS: Final = (0.3, 3.0)
_LEAST_DENT_M: Final = 0.001
_CLEAR_DENT: Final = 4.0
_AFTERWARDS: Final = 2
"""A dent is this deep, and clear of how the object lies each time, in so many touches afterwards at least."""


@dataclass(frozen=True, eq=False)
class PressSeries:
    """One ramp and the hold after it: the force rises, so that friction keeps its sign, and then rests.

    Attributes:
        t_s: Times of the control cycles, (N,).
        motor_force_n: Push at each jaw by motor current, less the nominal friction, (N,).
        force_n: What the load cell felt, (N,).
    """

    t_s: Floats
    motor_force_n: Floats
    force_n: Floats


def fit_plant(presses: list[PressSeries], delay_s: float) -> LoopPlant | None:
    """Fits gain and lag to presses by least squares, and tunes the loop for them and a measured delay.

    Friction differs from press to press and from what is nominal, so each press has an offset of its own: the
    ramp tells gain and offset, and how the force goes on into the hold tells the lag.

    Args:
        presses: Ramps and holds.
        delay_s: From the contact force to an estimate that can be used.

    Returns:
        The plant with gains by SIMC, or None where no press tells it.
    """
    even = [e for e in map(_evenly, presses) if e is not None]
    if not even:
        return None
    lags_s = np.arange(0.0, _LONGEST_LAG_S + _STEP_S / 2, _STEP_S)
    fits = [_gain(even, lag_s) for lag_s in lags_s]
    best = int(np.argmin([left for left, _ in fits]))
    gain, lag_s = fits[best][1], max(float(lags_s[best]), _STEP_S)
    if best == len(lags_s) - 1 or not _GAINS[0] < gain < _GAINS[1]:
        return None
    plant = Plant(gain, lag_s, max(delay_s, _LEAST_DELAY_S))
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
    """Slope of force over travel, between a third and two thirds of the largest force, of each touch, (K,).

    Args:
        width_m: Distance between the jaws while the force rose, (N,) for each touch.
        force_n: What the load cell felt, (N,) for each touch.
    """
    peak_n = max((float(force.max()) for force in force_n if len(force)), default=0.0)
    slopes = []
    for width, force in zip(width_m, force_n, strict=True):
        part = (force > peak_n / 3) & (force < 2 * peak_n / 3)
        if part.sum() >= _FEWEST and np.ptp(force[part]) > _LEAST_RISE_N / 2:
            # Travel is the cleaner of the two, and the force is what its noise is in.
            slope = -float(np.polyfit(width[part] - width[part].mean(), force[part], 1)[0])
            if slope > 0:
                slopes.append(slope)
    return np.array(slopes)


def crushed_by(contact_m: Floats, peak_n: Floats) -> int | None:
    """The touch after which the object has stayed narrower, or None where it has sprung back from all.

    Args:
        contact_m: Distance between the jaws where each touch met it, in the order they were done, (K,).
        peak_n: Largest force of each, (K,).
    """
    found, most = None, 0.0
    for last in range(1, len(contact_m) - _AFTERWARDS):
        before, after = contact_m[: last + 1], contact_m[last + 1 :]
        scatter_m = max(float(np.median(np.abs(part - np.median(part)))) for part in (before, after))
        dent_m = float(np.median(before) - np.median(after))
        # The split that explains most of the spread is where it changed.
        explained = len(before) * len(after) * float(before.mean() - after.mean()) ** 2
        if dent_m > _LEAST_DENT_M + _CLEAR_DENT * scatter_m and explained > most:
            found, most = last, explained
    if found is None or peak_n[found] < peak_n[: found + 1].max():
        return None
    return found


def _evenly(press: PressSeries) -> tuple[Floats, Floats] | None:
    """Push and force at even times, or None where the press is too small to tell anything."""
    if len(press.t_s) < _FEWEST or np.ptp(press.force_n) < _LEAST_RISE_N:
        return None
    t_s = np.arange(press.t_s[0], press.t_s[-1], _STEP_S)
    if len(t_s) < _FEWEST:
        return None
    return np.interp(t_s, press.t_s, press.motor_force_n), np.interp(t_s, press.t_s, press.force_n)


def _gain(presses: list[tuple[Floats, Floats]], lag_s: float) -> tuple[float, float]:
    """What a lag leaves of the forces, as a sum of squares, and the gain that goes with it."""
    keep = float(np.exp(-_STEP_S / lag_s)) if lag_s > 0 else 0.0
    along = across = total = 0.0
    for motor_force_n, force_n in presses:
        late = lfilter([1 - keep], [1, -keep], motor_force_n, zi=[keep * motor_force_n[0]])[0]
        late, force = late - late.mean(), force_n - force_n.mean()
        along, across, total = along + late @ force, across + late @ late, total + force @ force
    gain = along / max(across, 1e-12)
    return total - gain * along, gain
