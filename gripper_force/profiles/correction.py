"""Correction of the network's estimate by an object profile: force, interval, known frames.

*Corrected force*: ``curve(mean of the members) + head . features + offset``. The curve never falls. The head,
a correction of the last layer that is linear in its features, is zero if there were too few touches to fit
it.

*Known frames*: what the touches of the calibration have shown, for the out-of-distribution score
(`gripper_force.vision.ood`).
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load

from gripper_force.errors import ConfigError
from gripper_force.profiles.object_profile import ObjectProfile, OodLimit, weights_path

Floats = npt.NDArray[np.float64]
Features = npt.NDArray[np.float32]
"""Concatenated inputs of the members' last layers, (N, F); see `vision.batch_inference.features`."""

_NAMES = ("head", "offset")
_KNOWN_NAMES = ("mean", "axes", "floor")


class KnownFrames(NamedTuple):
    """Features of known frames, for the out-of-distribution score.

    Attributes:
        mean: Mean of the features without contact, (F,).
        axes: Basis of the subspace near which the features lie, (F, R).
        floor: Squared distance from the mean that is added to a frame's.
        limits: Limits, in order of rising force.
    """

    mean: npt.NDArray[np.floating]
    axes: npt.NDArray[np.floating]
    floor: float
    limits: tuple[OodLimit, ...]


@dataclass(frozen=True, eq=False)
class ProfileArrays:
    """The arrays of a profile, stored in the safetensors file beside its YAML file.

    Attributes:
        head: Correction of the last layers in newtons per unit of a feature, (F,); zeros for none.
        offset: Constant part of the correction in newtons, (1,).
        known: Known frames; None without limits in the profile.
    """

    head: Features
    offset: Features
    known: KnownFrames | None = None

    def head_n(self, features: Features) -> Floats:
        """Returns the correction by head and offset in newtons, (N,), for features (N, F)."""
        return features.astype(np.float64) @ self.head.astype(np.float64) + float(self.offset[0])


class Correction:
    """Applies an object profile to estimates.

    Attributes:
        profile: The profile.
        mismatches: Differences between the calibration's network and camera and the run's, as text.
        known: Frames of the calibration, for the out-of-distribution score; None if the network's limits count.
    """

    def __init__(self, profile: ObjectProfile, arrays: ProfileArrays, mismatches: Sequence[str] = ()) -> None:
        self.profile, self.mismatches = profile, tuple(mismatches)
        self._arrays, self.known = arrays, arrays.known
        self._z = NormalDist().inv_cdf(0.5 + profile.interval.coverage / 2)

    def force_n(self, estimate_n: npt.ArrayLike, features: Features) -> Floats:
        """Returns corrected forces, (N,), for the members' mean (N,) and their features (N, F)."""
        return self.profile.output.at(estimate_n) + self._arrays.head_n(features)

    def half_width_n(self, force_n: npt.ArrayLike) -> Floats:
        """Returns the half-width of the interval, (N,), for corrected forces (N,).

        Beyond the calibrated forces, 1 N per newton is added.
        """
        force = np.asarray(force_n, np.float64)
        min_n = -self.profile.interval.half_width_n(0.0)  # only noise gives negative forces
        known_n = np.clip(force, min_n, self.profile.force_n)
        beyond_n: Floats = np.abs(force - known_n)
        return self.profile.interval.half_width_n(force) + beyond_n

    def std_n(self, force_n: npt.ArrayLike) -> Floats:
        """Returns the standard deviation of a normal error with that interval, (N,)."""
        return self.half_width_n(force_n) / self._z


def load_correction(
    path: Path, profile: ObjectProfile, features: int, mismatches: Sequence[str] = ()
) -> Correction:
    """Reads the safetensors file beside a profile.

    Args:
        path: The profile's file.
        profile: Its content.
        features: F, the number of features of the network's members together.
        mismatches: As in `Correction`.

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
    names = _NAMES if profile.ood_limits is None else (*_NAMES, *_KNOWN_NAMES)
    try:
        tensors = load(data)
        arrays = {name: tensors[name].astype(np.float32) for name in names}
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{arrays_path} does not hold the arrays of an object profile: {error}; calibrate again"
        ) from error
    shapes = {name: array.shape for name, array in arrays.items()}
    expected = {"head": (features,), "offset": (1,), "mean": (features,), "floor": (1,)}
    wrong = [name for name, shape in expected.items() if shapes.get(name, shape) != shape]
    axes = shapes.get("axes", (features, 1))
    if wrong or len(axes) != 2 or axes[0] != features or axes[1] == 0:
        raise ConfigError(
            f"{arrays_path} is for another network: this one has {features} features, and the shapes are "
            f"{shapes}; calibrate again"
        )
    if not all(np.isfinite(array).all() for array in arrays.values()) or arrays.get("floor", [1.0])[0] <= 0:
        raise ConfigError(f"{arrays_path} holds values that are not finite, or a floor of 0; calibrate again")
    frames = None
    if profile.ood_limits is not None:
        frames = KnownFrames(arrays["mean"], arrays["axes"], float(arrays["floor"][0]), profile.ood_limits)
    return Correction(profile, ProfileArrays(arrays["head"], arrays["offset"], frames), mismatches)
