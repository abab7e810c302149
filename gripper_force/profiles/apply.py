"""What the rig profile and the object profile that a configuration names mean for its run."""

from typing import TYPE_CHECKING

from gripper_force.config import Config, ControlConfig
from gripper_force.errors import ConfigError
from gripper_force.profiles.object_profile import find_object, read_object
from gripper_force.profiles.rig_profile import read_rig

if TYPE_CHECKING:  # a run without vision loads none of it
    from gripper_force.profiles.correction import Correction
    from gripper_force.vision.checkpoint import Checkpoint
    from gripper_force.vision.header import Model


def check_target(config: Config) -> None:
    """Raises `ConfigError` where the target is more than a profile was calibrated with."""
    reaches = {}
    if config.calibration.rig is not None and (servo := read_rig(config.calibration.rig).servo) is not None:
        reaches[f"rig profile {config.calibration.rig}"] = servo.force_n[1]
    if config.profile is not None:
        path = find_object(config.profile)
        reaches[f"object profile {path}"] = read_object(path).force_n
    for name, most_n in reaches.items():
        if config.target_n > most_n:
            raise ConfigError(
                f"target_n {config.target_n:g} N is more than the {name} was calibrated with, "
                f"{most_n:.1f} N; ask for less, or calibrate up to more"
            )


def with_plant(config: Config, control: ControlConfig) -> ControlConfig:
    """Completes the force loop's plant with what the object's profile knows of it."""
    if config.profile is None or (plant := read_object(find_object(config.profile)).plant) is None:
        return control
    known = {"plant_gain": plant.gain, "plant_lag_ms": plant.lag_ms, "plant_delay_ms": plant.delay_ms}
    return control.model_copy(update={k: v for k, v in known.items() if getattr(control, k) is None})


def correction_of(config: Config, checkpoint: "Model | Checkpoint | None") -> "Correction | None":
    """What the object's profile makes of estimates, or None without a profile or without vision.

    Raises:
        ConfigError: The profile can't be read, or is of another network or camera, and that is refused.
    """
    if config.profile is None or checkpoint is None:
        return None
    path = find_object(config.profile)
    profile = read_object(path)
    differ = profile.mismatches(checkpoint.digest, config.camera_settings())
    if differ and config.calibration.on_mismatch == "refuse":
        raise ConfigError(
            f"the object profile {path} is of {'; '.join(differ)}; calibrate again, or set "
            "calibration.on_mismatch=warn"
        )
    from gripper_force.profiles.correction import load_correction

    features = sum(member.head for member in checkpoint.header.members)
    return load_correction(path, profile, features, differ)


def rig_mismatches(config: Config) -> list[str]:
    """What differs between the rig profile's devices and the run's, in words.

    Raises:
        ConfigError: The profile can't be read, or something differs, and that is refused.
    """
    path = config.calibration.rig
    if path is None:
        return []
    differ = read_rig(path).mismatches(
        config.servo.model, config.load_cell.sensor, config.camera.model_dump(mode="json")
    )
    if differ and config.calibration.on_mismatch == "refuse":
        raise ConfigError(
            f"the rig profile {path} is of {'; '.join(differ)}; calibrate again, or set "
            "calibration.on_mismatch=warn"
        )
    return differ
