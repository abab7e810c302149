"""What an object profile makes of the network's estimate: corrected newtons, their interval, and a gate.

*The corrected force* is ``curve(mean of the members) + head . features + offset``: a curve that never falls,
and, where there were touches enough, a correction of the last layer, which is linear in its features.

*The gate.* The calibration's features lie near a plane of few dimensions. How much of a frame's deviation
from their mean lies off that plane, over the calibration's own mean deviation, is how unlike them it is: the
Q statistic of J. E. Jackson and G. S. Mudholkar, "Control procedures for residuals associated with principal
component analysis", Technometrics 21 (1979) 341-349, doi:10.1080/00401706.1979.10489779.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load, save

from gripper_force.errors import ConfigError
from gripper_force.profiles.object_profile import ObjectProfile, weights_path

Floats = npt.NDArray[np.float64]
Features = npt.NDArray[np.float32]
"""What the members' last layers make their forces from, side by side, (N, F); see `vision.dense.features`."""

_NAMES = ("head", "offset", "mean", "axes", "spread")


@dataclass(frozen=True, eq=False)
class ProfileArrays:
    """The part of a profile that is too long for a text.

    Attributes:
        head: Correction of the last layers, (F,), newtons for one unit of a feature; zeros: none.
        offset: Newtons to add to it, (1,).
        mean: Mean of the calibration's features, (F,).
        axes: Orthonormal directions in which they vary most, (F, R).
        spread: Mean square distance of the features from their mean, (1,).
    """

    head: Features
    offset: Features
    mean: Features
    axes: Features
    spread: Features

    def head_n(self, features: Features) -> Floats:
        """What the corrected last layer adds, (N,)."""
        return features.astype(np.float64) @ self.head.astype(np.float64) + float(self.offset[0])

    def ood_score(self, features: Features) -> Floats:
        """Share of the deviation that the calibration does not know, (N,)."""
        deviation = (features - self.mean).astype(np.float64)
        off = deviation - (deviation @ self.axes) @ self.axes.T
        share: Floats = np.square(off).sum(1) / float(self.spread[0])
        return share


class Correction:
    """A profile, ready to be applied to estimates.

    Attributes:
        profile: What the text of it says.
        differs: What of the run's network and camera it was not calibrated with, in words.
    """

    def __init__(self, profile: ObjectProfile, arrays: ProfileArrays, differs: Sequence[str] = ()) -> None:
        self.profile, self.differs = profile, tuple(differs)
        self._arrays = arrays
        self._estimate_n = np.array(profile.output.estimate_n)
        self._force_n = np.array(profile.output.force_n)
        self._z = NormalDist().inv_cdf(0.5 + profile.interval.coverage / 2)

    def force_n(self, estimate_n: npt.ArrayLike, features: Features) -> Floats:
        """Corrected forces, (N,), of the members' mean (N,) and their features (N, F)."""
        return curve_n(self._estimate_n, self._force_n, estimate_n) + self._arrays.head_n(features)

    def half_width_n(self, force_n: npt.ArrayLike) -> Floats:
        """Half-width of the interval about corrected forces, (N,); it grows beyond the forces calibrated."""
        force = np.asarray(force_n, np.float64)
        least_n = -self.profile.interval.half_width_n(0.0)  # nothing pulls: that is as far as noise takes it
        known_n = np.clip(force, least_n, self.profile.force_n)
        beyond_n: Floats = np.abs(force - known_n)
        return self.profile.interval.half_width_n(force) + beyond_n

    def std_n(self, force_n: npt.ArrayLike) -> Floats:
        """The standard deviation of an error that is normal with that interval, (N,)."""
        return self.half_width_n(force_n) / self._z

    def ood_score(self, features: Features) -> Floats:
        """How unlike the calibration's frames are, (N,); over 1 is too unlike."""
        return self._arrays.ood_score(features) / self.profile.ood_limit


def curve_n(estimate_n: Floats, force_n: Floats, at_n: npt.ArrayLike) -> Floats:
    """A curve through knots, straight in between and on beyond its ends."""
    at = np.asarray(at_n, np.float64)
    segment = np.clip(np.searchsorted(estimate_n, at) - 1, 0, len(estimate_n) - 2)
    slope = np.diff(force_n) / np.diff(estimate_n)
    value: Floats = force_n[segment] + slope[segment] * (at - estimate_n[segment])
    return value


def pack(arrays: ProfileArrays) -> bytes:
    """What goes into the file beside a profile, in half precision where it may be."""
    half = {"axes"}
    data: bytes = save(
        {n: getattr(arrays, n).astype(np.float16 if n in half else np.float32) for n in _NAMES}
    )
    return data


def load_correction(
    path: Path, profile: ObjectProfile, features: int, differs: Sequence[str] = ()
) -> Correction:
    """Reads the file beside a profile.

    Args:
        path: The profile.
        profile: What is in it.
        features: F, of all of the network's last layers together.
        differs: As in `Correction`.

    Raises:
        ConfigError: It is missing, damaged, of another profile, or of a network with other features.
    """
    beside = weights_path(path)
    try:
        data = beside.read_bytes()
    except OSError as error:
        raise ConfigError(f"the object profile {path} lacks its other half: {error}") from error
    if hashlib.sha256(data).hexdigest() != profile.weights:
        raise ConfigError(f"{beside} does not belong to {path}; calibrate again, or copy both together")
    try:
        tensors = load(data)
        arrays = ProfileArrays(**{name: tensors[name].astype(np.float32) for name in _NAMES})
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise ConfigError(f"{beside} is no half of an object profile: {error}") from error
    shapes = {name: getattr(arrays, name).shape for name in _NAMES}
    flat = {"head": (features,), "mean": (features,), "offset": (1,), "spread": (1,)}
    wrong = [name for name, shape in flat.items() if shapes[name] != shape]
    if wrong or len(shapes["axes"]) != 2 or shapes["axes"][0] != features:
        raise ConfigError(
            f"{beside} is for another network: this one has {features} features, and the shapes are {shapes}"
        )
    if not all(np.isfinite(getattr(arrays, name)).all() for name in _NAMES) or arrays.spread[0] <= 0:
        raise ConfigError(f"{beside} holds values that are not finite; calibrate again")
    return Correction(profile, arrays, differs)
