"""Correction of the network's estimate by an object profile: force, interval, out-of-distribution score.

*Corrected force*: ``curve(mean of the members) + head . features + offset``. The curve never falls. The head,
a correction of the last layer that is linear in its features, is zero if there were too few touches to fit
it.

*Out-of-distribution score*: the calibration's features lie near a linear subspace of few dimensions. The
score is the squared distance of a frame's features from that subspace, divided by the mean squared distance
of the calibration's features from their mean. This is the Q statistic of J. E. Jackson and G. S. Mudholkar,
"Control procedures for residuals associated with principal component analysis", Technometrics 21 (1979)
341-349, doi:10.1080/00401706.1979.10489779.
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
"""Concatenated inputs of the members' last layers, (N, F); see `vision.batch_inference.features`."""

_NAMES = ("head", "offset", "mean", "axes", "spread")


@dataclass(frozen=True, eq=False)
class ProfileArrays:
    """The arrays of a profile, stored in the safetensors file beside its YAML file.

    Attributes:
        head: Correction of the last layers in newtons per unit of a feature, (F,); zeros for none.
        offset: Constant part of the correction in newtons, (1,).
        mean: Mean of the calibration's features, (F,).
        axes: Orthonormal basis of the subspace in which the features vary most, (F, R).
        spread: Mean squared distance of the features from their mean, (1,).
    """

    head: Features
    offset: Features
    mean: Features
    axes: Features
    spread: Features

    def head_n(self, features: Features) -> Floats:
        """Returns the correction by head and offset in newtons, (N,), for features (N, F)."""
        return features.astype(np.float64) @ self.head.astype(np.float64) + float(self.offset[0])

    def ood_score(self, features: Features) -> Floats:
        """Returns the Q statistic over the calibration's spread, (N,), for features (N, F)."""
        deviation = (features - self.mean).astype(np.float64)
        residual = deviation - (deviation @ self.axes) @ self.axes.T
        score: Floats = np.square(residual).sum(1) / float(self.spread[0])
        return score


class Correction:
    """Applies an object profile to estimates.

    Attributes:
        profile: The profile.
        differs: Differences between the calibration's network and camera and the run's, as text.
    """

    def __init__(self, profile: ObjectProfile, arrays: ProfileArrays, differs: Sequence[str] = ()) -> None:
        self.profile, self.differs = profile, tuple(differs)
        self._arrays = arrays
        self._estimate_n = np.array(profile.output.estimate_n)
        self._force_n = np.array(profile.output.force_n)
        self._z = NormalDist().inv_cdf(0.5 + profile.interval.coverage / 2)

    def force_n(self, estimate_n: npt.ArrayLike, features: Features) -> Floats:
        """Returns corrected forces, (N,), for the members' mean (N,) and their features (N, F)."""
        return curve_n(self._estimate_n, self._force_n, estimate_n) + self._arrays.head_n(features)

    def half_width_n(self, force_n: npt.ArrayLike) -> Floats:
        """Returns the half-width of the interval, (N,), for corrected forces (N,).

        Beyond the calibrated forces, 1 N per newton is added.
        """
        force = np.asarray(force_n, np.float64)
        least_n = -self.profile.interval.half_width_n(0.0)  # only noise gives negative forces
        known_n = np.clip(force, least_n, self.profile.force_n)
        beyond_n: Floats = np.abs(force - known_n)
        return self.profile.interval.half_width_n(force) + beyond_n

    def std_n(self, force_n: npt.ArrayLike) -> Floats:
        """Returns the standard deviation of a normal error with that interval, (N,)."""
        return self.half_width_n(force_n) / self._z

    def ood_score(self, features: Features) -> Floats:
        """Returns the out-of-distribution score over the profile's limit, (N,); above 1 it is rejected."""
        return self._arrays.ood_score(features) / self.profile.ood_limit


def curve_n(estimate_n: Floats, force_n: Floats, at_n: npt.ArrayLike) -> Floats:
    """Evaluates a piecewise linear curve, extrapolated linearly beyond its ends.

    Args:
        estimate_n: Knots, rising, (K,).
        force_n: Values at the knots, (K,).
        at_n: Where to evaluate, (N,).
    """
    at = np.asarray(at_n, np.float64)
    segment = np.clip(np.searchsorted(estimate_n, at) - 1, 0, len(estimate_n) - 2)
    slope = np.diff(force_n) / np.diff(estimate_n)
    value: Floats = force_n[segment] + slope[segment] * (at - estimate_n[segment])
    return value


def pack(arrays: ProfileArrays) -> bytes:
    """Returns the content of the safetensors file beside a profile, with the axes in half precision."""
    data: bytes = save(
        {n: getattr(arrays, n).astype(np.float16 if n == "axes" else np.float32) for n in _NAMES}
    )
    return data


def load_correction(
    path: Path, profile: ObjectProfile, features: int, differs: Sequence[str] = ()
) -> Correction:
    """Reads the safetensors file beside a profile.

    Args:
        path: The profile's file.
        profile: Its content.
        features: F, the number of features of the network's members together.
        differs: As in `Correction`.

    Raises:
        ConfigError: The file is missing, damaged, of another profile, or of a network with other features.
    """
    arrays_path = weights_path(path)
    try:
        data = arrays_path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"can't read {arrays_path}, which belongs to the object profile {path}: {error}; copy both files"
        ) from error
    if hashlib.sha256(data).hexdigest() != profile.weights:
        raise ConfigError(f"{arrays_path} does not belong to {path}; copy both files, or calibrate again")
    try:
        tensors = load(data)
        arrays = ProfileArrays(**{name: tensors[name].astype(np.float32) for name in _NAMES})
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{arrays_path} does not hold the arrays of an object profile: {error}; calibrate again"
        ) from error
    shapes = {name: getattr(arrays, name).shape for name in _NAMES}
    flat = {"head": (features,), "mean": (features,), "offset": (1,), "spread": (1,)}
    wrong = [name for name, shape in flat.items() if shapes[name] != shape]
    if wrong or len(shapes["axes"]) != 2 or shapes["axes"][0] != features:
        raise ConfigError(
            f"{arrays_path} is for another network: this one has {features} features, and the shapes are "
            f"{shapes}; calibrate again"
        )
    if not all(np.isfinite(getattr(arrays, name)).all() for name in _NAMES) or arrays.spread[0] <= 0:
        raise ConfigError(
            f"{arrays_path} holds values that are not finite, or a spread of 0; calibrate again"
        )
    return Correction(profile, arrays, differs)
