"""Configuration of the robot ``gripper_force``."""

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig

ACTION_KEYS = {"force": "gripper.force_n", "width": "gripper.width_m"}
"""Kinds of actions, and the key of each."""


@RobotConfig.register_subclass("gripper_force")
@dataclass(kw_only=True)
class GripperForceConfig(RobotConfig):
    """A gripper whose force is controlled by gripper-force.

    Attributes:
        config: Configuration file of gripper-force; None: its defaults, which are a simulated gripper.
        overrides: Configuration keys to change, as ``key.path=value``.
        log: MCAP log that gripper-force writes from `connect` to `disconnect`; it must not exist. None: no log.
        action: ``force``: an action is a grip force, in newtons. ``width``: it is a distance between the jaws, in
            metres.
        open_below_n: Force actions below this open the jaws, in newtons.
        lockstep_fps: Only with ``clock=lockstep``: each observation advances the simulated time by 1 / ``lockstep_fps``
            seconds. Set it to ``dataset.fps``.
        cameras: Further cameras. The gripper's own camera is not one of them: its frames are always observed.
    """

    config: Path | None = None
    overrides: list[str] = field(default_factory=list)
    log: Path | None = None
    action: str = "force"
    open_below_n: float = 0.2
    lockstep_fps: int = 30
    cameras: dict[str, CameraConfig] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Checks the values. Raises ``ValueError`` that names the key."""
        super().__post_init__()
        if self.action not in ACTION_KEYS:
            raise ValueError(f"action={self.action!r} is unknown; set it to {' or '.join(ACTION_KEYS)}")
        if not self.open_below_n > 0:
            raise ValueError(f"open_below_n={self.open_below_n} is not a positive force; set more than 0 N")
        if self.lockstep_fps < 1:
            raise ValueError(f"lockstep_fps={self.lockstep_fps} is no rate; set it to 1 or more")
