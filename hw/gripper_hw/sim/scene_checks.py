"""Checks of a simulated scene before a run: what the jaws can touch, and what the camera sees."""

from typing import Any

import numpy as np
import numpy.typing as npt

from gripper_force.errors import ConfigError
from gripper_hw.sim.engine import mujoco

_NEAR_M = 0.015
"""Distance at which rendering begins (``znear`` times ``extent`` of the scene)."""

_HIDDEN_M = 0.03
"""A point is hidden by what is nearer by more than this; half of a pad or of a small part is less."""

_REMEDY = "set sim.camera.position_m, aim_m or fov_deg"


def check_reach(model: Any, data: Any, name: str) -> None:
    """Raises `ConfigError` if the closing jaws would pass the object.

    Args:
        model: The scene's ``mujoco.MjModel``.
        data: Its ``mujoco.MjData``, computed forward.
        name: Name of the object.
    """
    low, high = _bounds(model, data, model.geom("pad_right").id)
    bounds = [
        _bounds(model, data, geom)
        for geom in range(model.ngeom)
        if _is_object(model, geom) and (model.geom_conaffinity[geom] | model.geom_contype[geom]) & 1
    ]
    soft = data.flexvert_xpos.reshape(-1, 3)
    if len(soft):
        bounds.append((soft.min(0), soft.max(0)))
    if not any((low < top)[1:].all() and (high > bottom)[1:].all() for bottom, top in bounds):
        raise ConfigError(
            f"the jaws would pass the simulated object {name!r} without touching it; move its grip to where it is wide"
        )


def check_view(model: Any, data: Any) -> None:
    """Raises `ConfigError` if the camera is inside something, or sees neither a pad nor the object.

    Args:
        model: The scene's ``mujoco.MjModel``.
        data: Its ``mujoco.MjData``, computed forward.
    """
    camera = data.camera("camera")
    eye, axes = camera.xpos, camera.xmat.reshape(3, 3)
    names = {geom: model.body(model.geom_bodyid[geom]).name or "object" for geom in range(model.ngeom)}
    for geom in np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE).tolist():
        centre, half = model.geom_aabb[geom].reshape(2, 3)
        inside = np.abs(data.geom_xmat[geom].reshape(3, 3).T @ (eye - data.geom_xpos[geom]) - centre) - half
        if (inside < _NEAR_M).all():
            part = {"world": "rail or a thing in the background"}.get(names[geom], names[geom])
            raise ConfigError(f"the simulated camera is inside the {part} or within 15 mm of it; {_REMEDY}")
    soft = data.flexvert_xpos.reshape(-1, 3)
    if len(soft) and (eye > soft.min(0) - _NEAR_M).all() and (eye < soft.max(0) + _NEAR_M).all():
        raise ConfigError(f"the simulated camera is inside the object or within 15 mm of it; {_REMEDY}")
    for plane, side in (("table", "below the table"), ("wall", "behind the wall")):
        normal = data.geom(plane).xmat.reshape(3, 3)[:, 2]
        if float(normal @ (eye - data.geom(plane).xpos)) < _NEAR_M:
            raise ConfigError(f"the simulated camera is {side}; {_REMEDY}")
    pads = [data.geom(name).xpos for name in ("pad_left", "pad_right")]
    solid = [data.geom_xpos[g] for g, name in names.items() if _is_object(model, g)]
    limit = np.tan(np.deg2rad(float(model.camera("camera").fovy[0])) / 2)
    if not any(_sees(model, data, eye, axes, limit, point) for point in [*pads, *solid, *soft]):
        raise ConfigError(f"the simulated camera sees neither a pad nor the object; {_REMEDY}")


def _bounds(model: Any, data: Any, geom: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Returns the lowest and highest coordinates of a geom's bounding box."""
    centre, half = model.geom_aabb[geom].reshape(2, 3)
    axes = data.geom_xmat[geom].reshape(3, 3)
    centre, half = data.geom_xpos[geom] + axes @ centre, np.abs(axes) @ half
    return centre - half, centre + half


def _is_object(model: Any, geom: int) -> bool:
    return int(model.body_rootid[model.geom_bodyid[geom]]) == int(model.body("object").id)


def _sees(
    model: Any,
    data: Any,
    eye: npt.NDArray[np.float64],
    axes: npt.NDArray[np.float64],
    limit: float,
    point: npt.NDArray[np.float64],
) -> bool:
    ray = point - eye
    x, y, z = axes.T @ ray
    if z > -_NEAR_M or max(abs(x), abs(y)) > -z * limit:
        return False
    distance_m = float(np.linalg.norm(ray))
    hit_m = mujoco.mj_ray(model, data, eye, ray / distance_m, None, True, -1, None)
    return bool(hit_m < 0 or hit_m > distance_m - _HIDDEN_M)
