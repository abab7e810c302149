"""Meshes of a user's objects: STL and OBJ files, read by MuJoCo and checked."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from gripper_force.errors import ConfigError
from gripper_force.schema import Positive, Section
from gripper_hw.sim.engine import mujoco
from gripper_hw.sim.meshes import Indices, Points

MAX_VERTICES = 1000
"""Each triangle is a candidate of a contact. With 300 vertices a mesh is about as fast as the shipped foams."""

_LONGEST_M = 0.02
"""Longest edge of a triangle; a pad is 22 mm high."""

MIN_SIZE_M, MAX_SIZE_M = 0.004, 0.2
"""Least and largest length of an object along an axis."""

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
_Angle = Annotated[float, Field(ge=-360, le=360)]


class MeshFile(Section):
    """A mesh and its place.

    Attributes:
        file: Path of a binary STL or an OBJ file.
        unit: Unit of its coordinates.
        scale: Factor on its size.
        turn_deg: Rotations about x, then y, then z, after which x is along the jaws' travel and z points up.
    """

    file: str
    unit: Literal["m", "cm", "mm", "inch"]
    scale: Positive = 1.0
    turn_deg: tuple[_Angle, _Angle, _Angle] = (0.0, 0.0, 0.0)


def read_bytes(path: Path, what: str) -> bytes:
    """Reads a file of an object. Raises `ConfigError` that names it."""
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a path with a null byte
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(
            f"can't read the {what} {path}: {reason}; its path is relative to the object's file"
        ) from error


def read_image(path: Path) -> bytes:
    """Reads a PNG image. Raises `ConfigError` that names it."""
    import cv2

    data = read_bytes(path, "texture")
    if (
        not data.startswith(b"\x89PNG")
        or cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is None
    ):
        raise ConfigError(f"the texture {path} is not a PNG image; save it as PNG")
    return data


def read_mesh(mesh: MeshFile) -> tuple[Points, Indices]:
    """Returns the points (N, 3) in metres and the triangles (M, 3) of a closed surface.

    The middle of its width and depth is at x = y = 0, and its lowest point at z = 0.

    Raises:
        ConfigError: The file can't be read, has too many vertices, or its surface is not closed.
    """
    path = Path(mesh.file)
    name = f"mesh{path.suffix.lower()}"
    scene = f"""<mujoco><asset><mesh name="mesh" file="{name}" inertia="shell"/></asset>
      <worldbody><geom type="mesh" mesh="mesh"/></worldbody></mujoco>"""
    try:
        model = mujoco.MjModel.from_xml_string(scene, {name: read_bytes(path, "mesh")})
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"can't read the mesh {path}: {reason}; save it as binary STL or OBJ with triangles"
        ) from error
    # MuJoCo moves a mesh to its principal axes.
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])
    points = model.mesh_vert.astype(np.float64) @ turn.reshape(3, 3).T + model.mesh_pos[0]
    extent = float(np.ptp(points, axis=0).max())
    _, first, number = np.unique(
        np.round(points / extent, 6), axis=0, return_index=True, return_inverse=True
    )  # an OBJ file can hold a corner several times, with other texture coordinates
    triangles = number.reshape(-1)[model.mesh_face]
    triangles = triangles[[len(set(corners)) == 3 for corners in triangles.tolist()]]
    if len(first) > MAX_VERTICES:
        raise ConfigError(
            f"the mesh {path} has {len(first)} vertices, and at most {MAX_VERTICES} can be simulated; reduce it, "
            "for example with Decimate in Blender, to about 300"
        )
    edges = {
        (a, b) for corners in triangles.tolist() for a, b in zip(corners, np.roll(corners, -1), strict=True)
    }
    if open_edges := sum((b, a) not in edges for a, b in edges) + 3 * len(triangles) - len(edges):
        raise ConfigError(
            f"the surface of the mesh {path} is not closed: {open_edges} edges do not join two triangles of equal "
            "orientation; repair it, for example with Make Manifold in Blender's 3D-Print Toolbox"
        )
    points = points[first] * _METRES[mesh.unit] * mesh.scale
    for plane, angle in zip(([1, 2], [2, 0], [0, 1]), np.deg2rad(mesh.turn_deg), strict=True):
        c, s = np.cos(angle), np.sin(angle)
        points[:, plane] = points[:, plane] @ [[c, s], [-s, c]]
    low, high = points.min(axis=0), points.max(axis=0)
    if (high - low).min() < MIN_SIZE_M or (high - low).max() > MAX_SIZE_M:
        size = " x ".join(f"{1e3 * length:.6g}" for length in high - low)
        raise ConfigError(
            f"the mesh {path} measures {size} mm, and from {1e3 * MIN_SIZE_M:g} to {1e3 * MAX_SIZE_M:g} mm can be "
            "simulated; correct mesh.unit or mesh.scale"
        )
    return _refined(points - [*(low + high)[:2] / 2, low[2]], triangles, path)


def _refined(points: Points, triangles: Indices, path: Path) -> tuple[Points, Indices]:
    """Divides each triangle into four until the edges are short: a pad moves the corners of a triangle only."""
    while True:
        corners = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], -1), axis=-1)  # (M, 3, 2)
        edges, number = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
        longest_m = float(np.linalg.norm(np.diff(points[edges], axis=1), axis=-1).max())
        if longest_m <= _LONGEST_M:
            return points, triangles
        if len(points) + len(edges) > MAX_VERTICES:
            raise ConfigError(
                f"the mesh {path} has an edge of {1e3 * longest_m:.0f} mm among short ones, which would make it too "
                "stiff; divide it evenly, for example with Remesh in Blender"
            )
        (a, b, c), (d, e, f) = triangles.T, number.reshape(-1, 3).T + len(points)
        points = np.vstack([points, points[edges].mean(axis=1)])
        triangles = np.vstack([np.stack(one, -1) for one in ((a, d, f), (d, b, e), (f, e, c), (d, e, f))])
