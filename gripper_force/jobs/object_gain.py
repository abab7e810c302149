"""The gain of an object, from the logs of grasps, and its place in an object profile."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from gripper_force.config import Overrides, config_from_text
from gripper_force.control.object_gain import GATE, REPEAT_STD, GainEstimate, ObjectGain
from gripper_force.errors import ConfigError, DataError
from gripper_force.profiles.object_profile import BUNDLED, find_object, read_object, user_folder, weights_path
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import make_controller
from gripper_force.types import Request, ServoState, VisualForce


def learned_ratio(path: Path, overrides: Overrides | None = None) -> tuple[float, float] | None:
    """Runs the controller again on a log, and returns the ratio of its grasps; None if no grasp was held with vision.

    Args:
        path: Log of a run, which may hold several grasps. Its configuration may know a ratio of earlier grasps, which
            is then part of the result.
        overrides: Changes of the log's configuration, such as ``{"gripper.gain_std": 0.02}``.

    Raises:
        LogError: The log can't be read.
        ConfigError: The log holds no run of a controller.
    """
    reader = LogReader(path)
    controller = make_controller(config_from_text(reader.config, str(path), overrides))
    visual: VisualForce | None = None
    request: Request | None = None
    for record in reader.records(VisualForce, Request, ServoState):
        if isinstance(record, VisualForce):
            visual = record
        elif isinstance(record, Request):
            request = record
        else:
            controller.step(record.t_ns, record, visual, request)
            visual = request = None
    return controller.end_grasps()


@dataclass(frozen=True, slots=True)
class SavedGain:
    """Gain of an object that was saved to a profile.

    Attributes:
        object: Name of the object.
        object_gain: The gain: the object's stiffness over that of its kind.
        object_gain_std: Its relative standard deviation.
        ratio: Motor current over vision, the mean of the grasps.
        ratio_std: Its relative standard deviation without that of the torque constant.
        profile: The profile that was written.
    """

    object: str
    object_gain: float
    object_gain_std: float
    ratio: float
    ratio_std: float
    profile: Path


def save_gain(
    name: str, logs: Sequence[Path], out: Path | None = None, overrides: Overrides | None = None
) -> SavedGain:
    """Adds the gain that grasps have shown to an object profile.

    Args:
        name: Object profile, by name or path.
        logs: Logs of grasps of the object with the profile, in order of time. If a log began with what the one before
            had learned, pass only the last one of them.
        out: Profile to write; None: that of the bundle, or the one with this name in the user's folder of profiles.
        overrides: Changes of the logs' configuration; see `learned_ratio`.

    Raises:
        DataError: No log has a grasp that was held with vision, or the logs contradict each other.
        ConfigError: The profile or a file that belongs to it can't be read, or the new one can't be written.
        LogError: A log can't be read.
    """
    from gripper_force.jobs.profile_files import write_all, write_object

    source = find_object(name)
    profile = read_object(source)
    ratios = [ratio for path in logs if (ratio := learned_ratio(path, overrides)) is not None]
    if not ratios:
        raise DataError(
            "no log holds a grasp that was held for half a second with visual estimates; grasp the object with "
            "control.feedback=fused and control.learn_gain=true"
        )
    # The smallest and the largest ratio may be uncertain, and agree, where others do not.
    contradiction = max(combinations(sorted(ratios), 2), key=_contradiction, default=None)
    if contradiction is not None and _contradiction(contradiction) > GATE:
        (low, _), (high, _) = contradiction
        raise DataError(
            f"the logs contradict each other: motor current was {low:.2f} times the visual force in one, and "
            f"{high:.2f} times in another; pass logs of one object"
        )
    gain = ObjectGain(_torque_constant_std(logs[-1], overrides))
    for ratio in ratios:
        gain.add(*ratio)
    total, estimate = gain.ratio, gain.estimate()
    assert total is not None  # there was a ratio
    assert estimate is not None
    if gain.problem:
        raise DataError(f"the gain is not saved: {gain.problem}")
    target = out or (source if source.name == BUNDLED else user_folder() / f"{source.stem}.yaml")
    new_profile = profile.model_copy(update={"ratio": total})
    weights = _read_beside(source, weights_path(source))
    # The network of a bundle goes with its profile.
    if profile.network is not None and target.parent != source.parent:
        network = target.with_suffix(".network.safetensors")
        write_all({network: _read_beside(source, source.parent / profile.network)})
        new_profile = new_profile.model_copy(update={"network": network.name})
    write_object(target, new_profile, weights)
    return SavedGain(profile.object, estimate.gain, estimate.std, *total, target)


def _read_beside(profile: Path, file: Path) -> bytes:
    """Returns the content of a file that belongs to a profile."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"can't read {file}, which belongs to the object profile {profile}: {error.strerror}; copy all files of "
            "the profile"
        ) from error


def _contradiction(pair: tuple[tuple[float, float], tuple[float, float]]) -> float:
    """Returns the difference of two rising ratios, in standard deviations."""
    (low, low_std), (high, high_std) = pair
    return math.log(high / low) / math.hypot(low_std, high_std, math.sqrt(2) * REPEAT_STD)


def _torque_constant_std(path: Path, overrides: Overrides | None) -> float:
    return config_from_text(LogReader(path).config, str(path), overrides).gripper.gain_std


def gain_of(ratio: tuple[float, float] | None, torque_constant_std: float) -> GainEstimate | None:
    """Returns the gain that follows from a ratio; None without one."""
    return ObjectGain(torque_constant_std, ratio).estimate()
