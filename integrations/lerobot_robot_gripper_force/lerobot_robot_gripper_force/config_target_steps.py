"""Configuration of the teleoperator ``gripper_force_targets``."""

from dataclasses import dataclass, field

from lerobot.teleoperators import TeleoperatorConfig

from lerobot_robot_gripper_force.config_gripper_force import ACTION_KEYS


@TeleoperatorConfig.register_subclass("gripper_force_targets")
@dataclass(kw_only=True)
class TargetStepsConfig(TeleoperatorConfig):
    """Targets that follow each other: grasps without a person or a leader arm.

    Attributes:
        targets: Forces in newtons (0 opens the jaws), or widths in metres with ``action=width``.
        frames: Number of actions for which each target lasts; after the last target the first one follows.
        action: ``force`` or ``width``, as of the robot.
    """

    targets: list[float] = field(default_factory=lambda: [4.0, 0.0])
    frames: int = 120
    action: str = "force"

    def __post_init__(self) -> None:
        """Checks the values. Raises ``ValueError`` that names the key."""
        if self.action not in ACTION_KEYS:
            raise ValueError(f"action={self.action!r} is unknown; set it to {' or '.join(ACTION_KEYS)}")
        if not self.targets or self.frames < 1:
            raise ValueError("targets is empty or frames is below 1; give at least one target and one frame")
