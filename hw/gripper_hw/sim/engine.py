"""MuJoCo. EGL comes with the first drawing; where it is missing, one clear sentence says so."""

import importlib
import os
from typing import Any, Final

from gripper_force.errors import SimulationError

NO_EGL = (
    "MuJoCo can't draw on this machine because EGL is missing; "
    "on Debian or Ubuntu: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
)

_GL: Final = os.environ.get("MUJOCO_GL", "egl")
os.environ["MUJOCO_GL"] = "disable"  # a scene without a camera needs no EGL
import mujoco  # noqa: E402

os.environ["MUJOCO_GL"] = _GL


def _quiet(_: str) -> None:
    """Takes the place of a MUJOCO_LOG.TXT in the working directory: `World` looks at every warning itself."""


mujoco.set_mju_user_warning(_quiet)
# Each scene draws textures of its own: a cache of them would grow with every grasp, and never be used again.
mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)


def new_renderer(model: Any, side: int) -> Any:
    """Something that draws square pictures of a model. Raises `SimulationError` without EGL."""
    from mujoco.rendering.classic import gl_context

    try:
        if not hasattr(gl_context, "GLContext"):
            importlib.reload(gl_context)
        return mujoco.Renderer(model, side, side)
    # What MuJoCo raises where libEGL, or a driver for it, is absent.
    except (AttributeError, ImportError, RuntimeError, mujoco.FatalError) as error:
        raise SimulationError(NO_EGL) from error


__all__ = ["NO_EGL", "mujoco", "new_renderer"]
