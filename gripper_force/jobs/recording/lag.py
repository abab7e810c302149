"""How late a camera's timestamps are against a load cell's, from touches that both have seen.

*Why not the picture against the force.* What gives way also flows: its force follows travel and speed,
F = k x + c dx/dt, which is as if force led travel by c/k. That is 9 to 28 ms for the simulated objects, with
perfect timestamps, and no correlation of picture and force, be it of values, derivatives or ranks, tells it
from a lag. So there are two steps, by way of the servo's encoder.

*Camera against servo.* A picture shows travel, whatever the material does. The lag is the shift at which the
pictures explain the encoder best.

*Load cell against servo.* Where jaws that were at rest let go, force and travel begin to change in the same
instant; what flows only shapes how they go on. The lag is the difference of the two beginnings.

Of a simulated set of four touches both steps together are within 5 ms of the truth, and of three sets within
4 ms, for all four objects. A load cell with less than some 50 samples/s is too slow for the second step.

*A recording without an encoder* has the picture and the force alone. Flow makes force lead; so a force that
trails what is seen, or leads it by longer than any flow, is late or early beyond doubt: see `force_lag_s`.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.types import Gray
from gripper_force.vision.preprocess import Normaliser, Preprocess

WIDEST_S: Final = 0.15
"""No larger lag is looked for."""

_STEP_S: Final = 0.001
_BEFORE_S: Final = 0.5
_AFTER_S: Final = 0.25
"""What of a touch is looked at, around its release."""

_COMPONENTS: Final = 20
_FRAMES_EACH: Final = 4
"""Principal components of the pictures that are used, at most, and least frames for each."""

_REST_S: Final = 0.12
"""What of the rest before a change is looked at."""

_FEWEST_SAMPLES: Final = 6
_ONSET_STEP_S: Final = 0.0005
_CLEAR: Final = 8.0
_CLEAR_SHARE: Final = 0.01
"""A change is clear once it is so many times the noise, and this share of all that follows."""

_HALFWAY: Final = 0.35
_AFTER_CLEAR: Final = 3
_TRAVEL: Final = (0.025, (2.0,))
_FORCE: Final = (0.020, (1.0, 1.25, 1.5, 1.75, 2.0))
"""How long a change is followed once it is clear, for so many samples at least, and the powers of time that
it may begin with. Jaws have mass; a force may fall at once, as speed has a part in it."""

_FLOW_S: Final = 0.06
"""By so much what flows, the object or a soft pad, may make force lead the picture."""

_LEAST_LAG_S: Final = 0.02
_FEWEST_FRAMES: Final = 30
_CLEAR_FALL: Final = 0.7
"""A lag is believed if what the curve leaves unexplained falls below this share of what it was without."""

_CURVE: Final = 3
"""Degree of the polynomial by which force follows how far the picture has changed."""

Floats = npt.NDArray[np.float64]


def force_lag_s(t_s: Floats, images: Gray, force_t_s: Floats, force_n: Floats) -> float:
    """Time by which forces trail pictures in a recording that has no encoder, where that is beyond doubt.

    That is the shift at which force follows best, as one curve, how far the picture has gone from the first
    ones, which must show no contact.

    Args:
        t_s: Times of the pictures, rising, (T,).
        images: The pictures, small, (T, S, S) uint8.
        force_t_s: Times of the forces, rising, (M,).
        force_n: The forces, (M,), finite, without spikes.

    Returns:
        Lag in s; positive where the load cell's timestamps are late; 0 where the pictures tell of none, or of
        one that the flow of what is grasped explains.
    """
    inside = (t_s >= t_s[0] + WIDEST_S) & (t_s <= t_s[-1] - WIDEST_S)
    if not np.any(force_n) or inside.sum() < _FEWEST_FRAMES:
        return 0.0
    look = Normaliser(Preprocess())
    change = np.array([np.sqrt(np.square(d).mean()) for image in images for d in look.push(image)])  # (T,)
    if not change.max() > 0:
        return 0.0
    basis = np.linalg.qr(np.vander(change[inside] / change.max(), _CURVE + 1))[0]  # (frames, 4)
    lags_s = np.arange(-WIDEST_S, WIDEST_S + _STEP_S / 2, _STEP_S)
    share = force_n / np.abs(force_n).max()
    unexplained = np.empty(len(lags_s))
    for i, lag_s in enumerate(lags_s):  # not all at once: a recording may be long
        forces = np.interp(t_s[inside] + lag_s, force_t_s, share)  # (frames,)
        unexplained[i] = np.linalg.norm(forces - basis @ (basis.T @ forces))
    lag_s = _least(lags_s, unexplained)
    believed = unexplained.min() < _CLEAR_FALL * unexplained[len(lags_s) // 2]
    return lag_s if believed and (lag_s > _LEAST_LAG_S or lag_s < -_FLOW_S) else 0.0


def camera_lags_s(
    t_s: Floats, images: Gray, servo_t_s: Floats, width_m: Floats, releases_s: Sequence[float]
) -> Floats:
    """Time by which pictures trail the servo's encoder, for each touch of a set.

    Args:
        t_s: Times of the pictures, rising, (T,).
        images: The pictures, small, (T, S, S) uint8.
        servo_t_s: Times of the encoder's readings, rising, (N,).
        width_m: Distance between the jaws, (N,).
        releases_s: When the jaws were told to let go, once for each touch.

    Returns:
        Lags in s, (touches,); positive where the pictures' timestamps are late; NaN where it can't be told.
    """
    near = [(t_s > at_s - _BEFORE_S) & (t_s < at_s + _AFTER_S) for at_s in releases_s]
    touches = np.concatenate([np.full(int(part.sum()), i) for i, part in enumerate(near)] or [np.zeros(0)])
    number = min(_COMPONENTS, len(touches) // _FRAMES_EACH)
    if number == 0:
        return np.full(len(releases_s), np.nan)
    flat = np.concatenate([images[part] for part in near]).reshape(len(touches), -1).astype(np.float64)
    components = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[0][:, :number]
    basis = np.linalg.qr(np.column_stack([np.ones(len(touches)), components]))[0]  # (frames, number + 1)
    lags_s = np.arange(-WIDEST_S, WIDEST_S + _STEP_S / 2, _STEP_S)
    frames_s = np.concatenate([t_s[part] for part in near])
    width = np.interp(frames_s - lags_s[:, None], servo_t_s, width_m)  # (lags, frames)
    unexplained = np.square(width - width @ basis @ basis.T)
    return np.array([_least(lags_s, unexplained[:, touches == i].sum(axis=1)) for i in range(len(near))])


def load_cell_lag_s(
    t_s: Floats, force_n: Floats, servo_t_s: Floats, width_m: Floats, release_s: float
) -> float:
    """Time by which the load cell trails the servo's encoder in one touch, which ends after a rest.

    Args:
        t_s: Times of the load cell's samples, rising, (M,).
        force_n: The samples, (M,).
        servo_t_s: Times of the encoder's readings, rising, (N,).
        width_m: Distance between the jaws, (N,).
        release_s: When the jaws were told to let go.

    Returns:
        Lag in s; positive where the load cell's timestamps are late; NaN where it can't be told.
    """
    return _onset_s(t_s, -force_n, release_s, *_FORCE) - _onset_s(servo_t_s, width_m, release_s, *_TRAVEL)


def _least(lags_s: Floats, cost: Floats) -> float:
    """Where a cost is least, between its samples; NaN where that is at an end."""
    best = int(cost.argmin())
    if not 0 < best < len(lags_s) - 1:
        return float("nan")
    before, at, after = cost[best - 1 : best + 2]
    bend = before - 2 * at + after
    return float(lags_s[best] + (_STEP_S * (before - after) / (2 * bend) if bend > 0 else 0.0))


def _onset_s(
    t_s: Floats, values: Floats, release_s: float, follow_s: float, powers: tuple[float, ...]
) -> float:
    """When a signal that was at rest begins to rise: where ``a (t - onset)^p`` joins a constant, fitted."""
    near = (t_s > release_s - WIDEST_S - _REST_S) & (t_s < release_s + WIDEST_S + _AFTER_S)
    t, y = t_s[near] - release_s, values[near]
    if len(t) < _FEWEST_SAMPLES:
        return float("nan")
    noise = float(np.median(np.abs(np.diff(y))))
    rise = float(np.ptp(y))
    clear = y.min() + 2 * noise + max(_CLEAR * noise, _CLEAR_SHARE * rise)
    halfway = int(np.argmax(y > y.min() + _HALFWAY * rise))
    at_rest = np.flatnonzero(y[:halfway] <= clear)
    if rise <= 2 * _CLEAR * noise or not len(at_rest):
        return float("nan")
    begin = int(at_rest[-1]) + 1
    end = max(begin + _AFTER_CLEAR, int(np.searchsorted(t, t[begin] + follow_s)))
    part = slice(int(np.searchsorted(t, t[begin] - _REST_S)), end)
    t, y = t[part], y[part]
    onsets = np.arange(t[0] + 0.2 * _REST_S, t[-1], _ONSET_STEP_S)
    if len(t) < _FEWEST_SAMPLES or not len(onsets):
        return float("nan")
    least, found = np.inf, float("nan")
    y = y - y.mean()
    for power in powers:
        shape = np.clip(t - onsets[:, None], 0, None) ** power  # (onsets, samples)
        shape -= shape.mean(axis=1, keepdims=True)
        left = y @ y - np.square(shape @ y) / np.maximum(np.square(shape).sum(axis=1), 1e-30)
        if left.min() < least:
            least, found = float(left.min()), float(onsets[left.argmin()])
    return found + release_s
