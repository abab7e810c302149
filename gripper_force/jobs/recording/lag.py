"""Lag between the timestamps of a camera and a load cell, from touches that both have recorded.

Correlating images with force is not enough. Compliant materials are viscoelastic: their force follows travel
and speed, F = k x + c dx/dt, as if force led travel by c/k. That is 9 to 28 ms for the simulated objects, with
perfect timestamps, and no correlation of image and force (values, derivatives or ranks) can distinguish it
from a lag. So the lag is measured in two steps, each against the servo's encoder.

*Camera against servo.* An image shows travel, whatever the material does. The lag is the shift at which the
images explain the encoder best.

*Load cell against servo.* When jaws at rest start to open, force and travel begin to change at the same
instant; viscosity only shapes what follows. The lag is the difference of the two onsets.

For one simulated set of four touches both steps together are within 5 ms of the truth, and for three sets
within 4 ms, for all four objects. A load cell with fewer than about 50 samples/s is too slow for the second
step.

*Without an encoder* only image and force are available. Viscosity makes force lead, so a force that trails
the image, or leads it by more than viscosity can explain, has a certain lag: see `force_lag_s`.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.types import Gray
from gripper_force.vision.preprocess import Normaliser, Preprocess

MAX_LAG_S: Final = 0.15
"""Largest lag that is searched for."""

_STEP_S: Final = 0.001
_BEFORE_S: Final = 0.5
_AFTER_S: Final = 0.15
"""Part of a touch that is used, before and after its release. Later, the jaws travel without the object."""

_COMPONENTS: Final = 20
_FRAMES_PER_COMPONENT: Final = 4
"""Principal components of the images, at most, and frames needed for each."""

_REST_S: Final = 0.12
_RISE_S: Final = 0.06
"""Parts of the rest before an onset, and of the change after the latest one, that are used. With more of the way to the
open jaws, the change of the width would be clear only later."""

_MIN_SAMPLES: Final = 6
_ONSET_STEP_S: Final = 0.0005
_CLEAR: Final = 8.0
_CLEAR_SHARE: Final = 0.01
"""A change is clear once it exceeds this many times the noise, and this share of the whole change."""

_HALFWAY: Final = 0.35
"""Share of the change after which no rest is searched for."""

_MIN_CLEAR_SAMPLES: Final = 3
"""Samples of the clear change that are fitted, at least."""

_TRAVEL: Final = (0.025, (2.0,))
_FORCE: Final = (0.020, (1.0, 1.25, 1.5, 1.75, 2.0))
"""Time after the change is clear that is fitted, in s, and the powers of time that it may start with. Travel
starts with a square, because jaws have mass; force may also fall at once, because it depends on speed."""

_VISCOUS_LEAD_S: Final = 0.06
"""Largest lead of force over the image that a viscous object or pad can cause."""

_MIN_LAG_S: Final = 0.02
"""Smallest lag that `force_lag_s` reports."""

_MIN_FRAMES: Final = 30
_ACCEPTED_RESIDUAL: Final = 0.7
"""A lag is accepted if it reduces the residual of the curve below this share of the one without lag."""

_DEGREE: Final = 3
"""Degree of the polynomial from the change of the image to force."""

Floats = npt.NDArray[np.float64]


def force_lag_s(t_s: Floats, images: Gray, force_t_s: Floats, force_n: Floats) -> float:
    """Lag of forces behind images in a recording without an encoder, if it is certain.

    The lag is the shift at which a polynomial from the image's change to force fits best. The change is
    measured from the first images, which must show no contact.

    Args:
        t_s: Times of the images, rising, (T,).
        images: Downscaled images, (T, S, S) uint8.
        force_t_s: Times of the forces, rising, (M,).
        force_n: Forces, (M,), finite, without spikes.

    Returns:
        Lag in s, positive if the load cell's timestamps are late; 0 if there is none, or if the object's
        viscosity explains it.
    """
    inside = (t_s >= t_s[0] + MAX_LAG_S) & (t_s <= t_s[-1] - MAX_LAG_S)
    if not np.any(force_n) or inside.sum() < _MIN_FRAMES:
        return 0.0
    normaliser = Normaliser(Preprocess())
    change = np.array(
        [np.sqrt(np.square(d).mean()) for image in images for d in normaliser.push(image)]
    )  # (T,)
    if not change.max() > 0:
        return 0.0
    basis = np.linalg.qr(np.vander(change[inside] / change.max(), _DEGREE + 1))[0]  # (frames, 4)
    lags_s = np.arange(-MAX_LAG_S, MAX_LAG_S + _STEP_S / 2, _STEP_S)
    share = force_n / np.abs(force_n).max()
    residual = np.empty(len(lags_s))
    for i, lag_s in enumerate(lags_s):  # one by one: memory, for long recordings
        forces = np.interp(t_s[inside] + lag_s, force_t_s, share)  # (frames,)
        residual[i] = np.linalg.norm(forces - basis @ (basis.T @ forces))
    lag_s = _minimum(lags_s, residual)
    accepted = residual.min() < _ACCEPTED_RESIDUAL * residual[len(lags_s) // 2]
    return lag_s if accepted and (lag_s > _MIN_LAG_S or lag_s < -_VISCOUS_LEAD_S) else 0.0


def camera_lags_s(
    t_s: Floats, images: Gray, servo_t_s: Floats, width_m: Floats, releases_s: Sequence[float]
) -> Floats:
    """Lag of images behind the servo's encoder, for each touch of a set.

    Args:
        t_s: Times of the images, rising, (T,).
        images: Downscaled images, (T, S, S) uint8.
        servo_t_s: Times of the encoder's readings, rising, (N,).
        width_m: Distance between the jaws, (N,).
        releases_s: Times of the release requests, one per touch.

    Returns:
        Lags in s, (touches,), positive if the images' timestamps are late; NaN if unknown.
    """
    near = [(t_s > at_s - _BEFORE_S) & (t_s < at_s + _AFTER_S) for at_s in releases_s]
    touches = np.concatenate([np.full(int(part.sum()), i) for i, part in enumerate(near)] or [np.zeros(0)])
    number = min(_COMPONENTS, len(touches) // _FRAMES_PER_COMPONENT)
    if number == 0:
        return np.full(len(releases_s), np.nan)
    flat = np.concatenate([images[part] for part in near]).reshape(len(touches), -1).astype(np.float64)
    components = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[0][:, :number]
    basis = np.linalg.qr(np.column_stack([np.ones(len(touches)), components]))[0]  # (frames, number + 1)
    lags_s = np.arange(-MAX_LAG_S, MAX_LAG_S + _STEP_S / 2, _STEP_S)
    frames_s = np.concatenate([t_s[part] for part in near])
    width = np.interp(frames_s - lags_s[:, None], servo_t_s, width_m)  # (lags, frames)
    residual = np.square(width - width @ basis @ basis.T)
    return np.array([_minimum(lags_s, residual[:, touches == i].sum(axis=1)) for i in range(len(near))])


def load_cell_lag_s(
    t_s: Floats, force_n: Floats, servo_t_s: Floats, width_m: Floats, release_s: float
) -> float:
    """Lag of the load cell behind the servo's encoder in one touch, which is held at rest before its release.

    Args:
        t_s: Times of the load cell's samples, rising, (M,).
        force_n: Samples, (M,).
        servo_t_s: Times of the encoder's readings, rising, (N,).
        width_m: Distance between the jaws, (N,).
        release_s: Time of the release request.

    Returns:
        Lag in s, positive if the load cell's timestamps are late; NaN if unknown.
    """
    return _onset_s(t_s, -force_n, release_s, *_FORCE) - _onset_s(servo_t_s, width_m, release_s, *_TRAVEL)


def _minimum(lags_s: Floats, cost: Floats) -> float:
    """Returns the lag of least cost, interpolated by a parabola; NaN at either end."""
    best = int(cost.argmin())
    if not 0 < best < len(lags_s) - 1:
        return float("nan")
    before, at, after = cost[best - 1 : best + 2]
    curvature = before - 2 * at + after
    return float(lags_s[best] + (_STEP_S * (before - after) / (2 * curvature) if curvature > 0 else 0.0))


def _onset_s(
    t_s: Floats, values: Floats, release_s: float, fitted_s: float, powers: tuple[float, ...]
) -> float:
    """Onset of a signal's rise from rest: the fit of a constant, followed by ``a (t - onset)^p``."""
    near = (t_s > release_s - MAX_LAG_S - _REST_S) & (t_s < release_s + MAX_LAG_S + _RISE_S)
    t, y = t_s[near] - release_s, values[near]
    if len(t) < _MIN_SAMPLES:
        return float("nan")
    noise = float(np.median(np.abs(np.diff(y))))
    rise = float(np.ptp(y))
    clear = y.min() + 2 * noise + max(_CLEAR * noise, _CLEAR_SHARE * rise)
    halfway = int(np.argmax(y > y.min() + _HALFWAY * rise))
    at_rest = np.flatnonzero(y[:halfway] <= clear)
    if rise <= 2 * _CLEAR * noise or not len(at_rest):
        return float("nan")
    begin = int(at_rest[-1]) + 1
    end = max(begin + _MIN_CLEAR_SAMPLES, int(np.searchsorted(t, t[begin] + fitted_s)))
    part = slice(int(np.searchsorted(t, t[begin] - _REST_S)), end)
    t, y = t[part], y[part]
    onsets = np.arange(t[0] + 0.2 * _REST_S, t[-1], _ONSET_STEP_S)
    if len(t) < _MIN_SAMPLES or not len(onsets):
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
