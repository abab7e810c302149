"""Application of the configured rig profile and object profile to a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gripper_force.config import Config, ControlConfig
from gripper_force.errors import ConfigError
from gripper_force.profiles.object_profile import (
    BUNDLED,
    ObjectProfile,
    find_object,
    read_object,
    user_folder,
)
from gripper_force.profiles.rig_profile import RigProfile, read_rig

if TYPE_CHECKING:  # a run without vision imports none of these
    from gripper_force.profiles.correction import Correction
    from gripper_force.schema import Tree
    from gripper_force.vision.checkpoint import Checkpoint
    from gripper_force.vision.header import Model


@dataclass(frozen=True, slots=True)
class Profiles:
    """The profiles of a run, each read once.

    Attributes:
        rig: Rig profile, or None.
        rig_path: Its file, or None.
        object: Object profile, or None.
        object_path: Its file, or None.
    """

    rig: RigProfile | None = None
    rig_path: Path | None = None
    object: ObjectProfile | None = None
    object_path: Path | None = None

    @property
    def target_limits_n(self) -> dict[str, float]:
        """Largest force that each profile was calibrated with, by the profile's description."""
        limits_n = {}
        if self.rig is not None and self.rig.servo is not None:
            limits_n[f"rig profile {self.rig_path}"] = self.rig.servo.force_n[1]
        if self.object is not None:
            limits_n[f"object profile {self.object_path}"] = self.object.force_n
        return limits_n


def read_profiles(config: Config) -> Profiles:
    """Reads the profiles that the configuration names. Raises `ConfigError` that names the file."""
    rig_path = config.calibration.rig
    object_path = None if config.profile is None else find_object(config.profile)
    rig = None if rig_path is None else read_rig(rig_path)
    profile = None if object_path is None else read_object(object_path)
    return Profiles(rig, rig_path, profile, object_path)


def with_bundle(config: Config) -> tuple[Config, str]:
    """Returns the configuration with a bundle's profile and network, unless it names a network, and a note about it."""
    name = config.profile
    if config.calibration.object is None and (user_folder() / config.object / BUNDLED).is_file():
        name = config.object
    if name is None or not config.uses_vision:
        return config, ""
    profile = read_object(path := find_object(name))
    file = config.sim.object and str(config.sim.object.resolve())
    if config.calibration.object is None and None not in (file, profile.file) and file != profile.file:
        return config, f"did not use the bundle {path.parent}, which is that of the object in {profile.file}"
    network = None if profile.network is None else str(path.with_name(profile.network))
    if network in (None, config.vision.checkpoint):
        return config, ""
    if config.vision.checkpoint != "default":
        reason = f"vision.checkpoint is {config.vision.checkpoint!r}; set it to default to use the bundle"
        return config, f"did not use the network of the bundle {path.parent}, because {reason}"
    config = config.with_values(calibration={"object": str(path)}, vision={"checkpoint": network})
    return config, f"used the bundle {path.parent}, made of {profile.touches} touches on {profile.date}"


def with_object(control: ControlConfig, profiles: Profiles) -> ControlConfig:
    """Fills in the plant and the object's ratio from the object profile, where the configuration leaves them open."""
    if profiles.object is None:
        return control
    values: dict[str, object] = {"object_ratio": profiles.object.ratio}
    if (plant := profiles.object.plant) is not None:
        values |= {"plant_gain": plant.gain, "plant_lag_ms": plant.lag_ms, "plant_delay_ms": plant.delay_ms}
    return control.filled(**values)


def read_correction(
    config: Config, profiles: Profiles, model: Model | Checkpoint | None, rig: Tree | None = None
) -> Correction | None:
    """Reads the object profile's correction of estimates; None without a profile or vision. ``rig``: run's settings.

    Raises:
        ConfigError: The profile's second file cannot be read, or the profile belongs to another network or
            camera and ``calibration.on_mismatch`` is ``refuse``.
    """
    if profiles.object is None or profiles.object_path is None or model is None:
        return None
    mismatches = profiles.object.mismatches(model.digest, config.rig_settings() if rig is None else rig)
    if profiles.object.checkpoint != model.digest:
        raise ConfigError(
            f"the object profile {profiles.object_path} was made with {mismatches[0]}, whose estimates it corrects; "
            f"calibrate the object again with {config.vision.checkpoint!r}, or leave the profile out with "
            "calibration.object=none"
        )
    _refuse(config, f"object profile {profiles.object_path}", mismatches)
    from gripper_force.profiles.correction import load_correction

    features = sum(member.head for member in model.header.members)
    return load_correction(profiles.object_path, profiles.object, features, mismatches)


def override_note(config: Config, profiles: Profiles) -> str:
    """Names the values of the rig profile that the configuration overrides with others; empty without any."""
    rig = {} if profiles.rig is None else profiles.rig.settings()
    run = config.model_dump(mode="json")
    keys = ", ".join(f"{a}.{b}" for a in rig for b, value in rig[a].items() if run[a][b] != value)
    return keys and f"the configuration overrides {keys} of the rig profile; delete them to use its values"


def rig_mismatches(config: Config, profiles: Profiles) -> list[str]:
    """Describes the differences between the rig profile's devices and the run's.

    Raises:
        ConfigError: There are some, and ``calibration.on_mismatch`` is ``refuse``.
    """
    if profiles.rig is None:
        return []
    servo = config.servo
    model = servo.model if len(servo.ids) == 1 else f"two {servo.model}"  # whose torque is another
    mismatches = profiles.rig.mismatches(
        model, config.load_cell.sensor, config.camera.model_dump(mode="json")
    )
    _refuse(config, f"rig profile {profiles.rig_path}", mismatches)
    return mismatches


def _refuse(config: Config, profile: str, mismatches: list[str]) -> None:
    if mismatches and config.calibration.on_mismatch == "refuse":
        raise ConfigError(
            f"the {profile} was made with {'; '.join(mismatches)}; teach or calibrate again, or set "
            "calibration.on_mismatch=warn"
        )
