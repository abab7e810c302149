"""Import of MuJoCo. EGL is only loaded for the first rendering; if it is missing, a clear error is raised."""

import ctypes
import importlib
import os
import sys
from typing import Any, Final

from gripper_force.errors import SimulationError

NO_EGL = (
    "MuJoCo cannot render on this machine because EGL is missing; "
    "on Debian or Ubuntu: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0"
)

_LINUX: Final = sys.platform == "linux"
_GL: Final = os.environ.get("MUJOCO_GL", "egl" if _LINUX else "cgl")  # CGL is Apple's
os.environ["MUJOCO_GL"] = "disable"  # a scene without a camera needs no EGL
import mujoco  # noqa: E402

os.environ["MUJOCO_GL"] = _GL


def _ignore_warning(_: str) -> None:
    """Ignores a warning. MuJoCo would write it to MUJOCO_LOG.TXT; `World` checks the warning counters."""


mujoco.set_mju_user_warning(_ignore_warning)
# Every scene has new textures: the cache would grow with each grasp and never be hit.
mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 0)


def new_renderer(model: Any, side_px: int) -> Any:
    """Returns a MuJoCo renderer of square images of a model. Raises `SimulationError` if it can't render."""
    from mujoco.rendering.classic import gl_context

    try:
        if not hasattr(gl_context, "GLContext"):
            importlib.reload(gl_context)
        return mujoco.Renderer(model, side_px, side_px)
    # MuJoCo raises any of these if libEGL, libOpenGL, or a driver, is missing.
    except (AttributeError, ctypes.ArgumentError, ImportError, RuntimeError, mujoco.FatalError) as error:
        other = f"MuJoCo cannot render on this machine ({error}); set camera.backend=none"
        raise SimulationError(NO_EGL if _LINUX else other) from error


__all__ = ["NO_EGL", "mujoco", "new_renderer"]
