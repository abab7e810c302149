"""MuJoCo with EGL, or one clear sentence. Import `mujoco` from here."""

import os

from gripper_force.errors import SimulationError

NO_EGL = (
    "MuJoCo can't draw on this machine because EGL is missing; "
    "on Debian or Ubuntu: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
)

os.environ.setdefault("MUJOCO_GL", "egl")
try:
    import mujoco
except (
    AttributeError,
    ImportError,
) as error:  # what MuJoCo raises where libEGL, or a driver for it, is absent
    raise SimulationError(NO_EGL) from error


def _quiet(_: str) -> None:
    """Takes the place of a MUJOCO_LOG.TXT in the working directory: `World` looks at every warning itself."""


mujoco.set_mju_user_warning(_quiet)
# Each scene draws textures of its own: a cache of them would grow with every grasp, and never be used again.
mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)

__all__ = ["NO_EGL", "mujoco"]
