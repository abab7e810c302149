"""Meshes of simulated objects, and what an object is to a scene."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Detail = Literal["coarse", "medium", "fine"]
Points = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

# Stiffer contacts chatter: at solref .002 there were dropouts to 0 N and spikes of 50 N.
SOFT_CONTACT = 'solref=".01 1" solimp=".9 .95 .001"'
SHELL_CONTACT = 'solref=".005 1" solimp=".95 .99 .001"'


SHELL_MESHES: dict[Detail, tuple[int, int, float]] = {
    "coarse": (12, 6, 0.0025),
    "medium": (16, 8, 0.0025),
    "fine": (32, 16, 0.00125),
}
"""Points of a shell around and along its axis, and time step in s."""


@dataclass(frozen=True)
class ObjectModel:
    """One object between the jaws.

    Attributes:
        body: MJCF inside the object's body; its origin is on the table at the gripper's centre.
        contact: MJCF contact attributes, shared by the object and the pads.
        texture: File name of the texture image, or None for a plain material.
        grip_height_m: Height of the jaws above the table.
        timestep_s: Physics step for this mesh.
        files: Further files of the object's own, by the name that its MJCF has.
        spec: A body from an MJCF file as a ``mujoco.MjSpec``, to be attached to ``body``; or None.
    """

    body: str
    contact: str
    texture: str | None
    grip_height_m: float
    timestep_s: float
    files: dict[str, bytes] = field(default_factory=dict)
    spec: Any = None


def solid_cube(cells: int) -> tuple[Points, Indices]:
    """Returns points (N, 3) of a cube from -1 to 1, and tetrahedra (M, 4), some with negative volume."""
    count = cells + 1
    cube = np.stack(np.meshgrid(*[np.linspace(-1, 1, count)] * 3, indexing="ij"), -1).reshape(-1, 3)
    number = np.arange(count**3).reshape(count, count, count)
    tetrahedra = []
    for i, j, k in np.ndindex(cells, cells, cells):
        # Neighbouring cells are mirrored, so that their diagonals meet.
        (a, b, c, d), (e, f, g, h) = (
            number[i + x, j : j + 2, k : k + 2].ravel() for x in ((0, 1) if (i + j + k) % 2 else (1, 0))
        )
        tetrahedra += [(a, b, c, e), (d, c, b, h), (f, e, h, b), (g, h, e, c), (b, c, e, h)]
    return cube, np.array(tetrahedra)


def solid_ball(cells: int) -> tuple[Points, Indices]:
    """Returns points (N, 3) of a unit ball and tetrahedra (M, 4): a cube of cells, mapped to a ball."""
    cube, corners = solid_cube(cells)
    u, v = np.roll(cube, -1, axis=1) ** 2, np.roll(cube, -2, axis=1) ** 2
    points = cube * np.sqrt(1 - u / 2 - v / 2 + u * v / 3)
    # At the cube's edges some have all corners on the ball: they are flat and would invert.
    outside = np.abs(cube).max(axis=1) == 1
    used, corners = np.unique(corners[~outside[corners].all(axis=1)], return_inverse=True)
    return points[used], outward(points[used], corners.reshape(-1, 4))


def outward(points: Points, tetrahedra: Indices) -> Indices:
    """Returns the tetrahedra with their corners ordered so that each volume is positive."""
    corners = points[tetrahedra]  # (M, 4, 3)
    negative = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    return np.where(negative[:, None], tetrahedra[:, [0, 1, 3, 2]], tetrahedra)


def shell_of_revolution(
    bottom_radius: float,
    top_radius: float,
    height: float,
    around: int,
    along: int,
    *,
    seam_rad: float,
    bottom: bool = False,
) -> tuple[Points, Points, Indices]:
    """Returns points (N, 3), texture coordinates (N, 2) and triangles (M, 3) of a wall along +z."""
    ring, level = np.arange(around), np.arange(along)
    angle = 2 * np.pi * ring / around + seam_rad
    share = level / (along - 1)
    radius = bottom_radius + (top_radius - bottom_radius) * share
    points = np.stack(
        [
            radius[:, None] * np.cos(angle),
            radius[:, None] * np.sin(angle),
            np.broadcast_to(height * share[:, None], (along, around)),
        ],
        -1,
    ).reshape(-1, 3)
    uv = np.stack(np.broadcast_arrays(ring / around, share[:, None]), -1).reshape(-1, 2)
    faces = []
    for j in range(along - 1):
        for i in range(around):
            a, b = i + around * j, (i + 1) % around + around * j
            d, c = a + around, b + around
            # Diagonals alternate; otherwise the shell would be stiffer one way round than the other.
            faces += [(a, b, c), (a, c, d)] if (i + j) % 2 else [(a, b, d), (b, c, d)]
    if bottom:
        inner = points[:around] * [0.5, 0.5, 1.0]
        first, centre = len(points), len(points) + around
        points = np.vstack([points, inner, [[0, 0, 0]]])
        uv = np.vstack([uv, np.full((around + 1, 2), 0.02)])
        for i in range(around):
            k = (i + 1) % around
            faces += [(i, first + i, k), (k, first + i, first + k), (first + i, centre, first + k)]
    return points, uv, np.array(faces)


def shell(
    points: Points,
    uv: Points,
    faces: Indices,
    pins: Indices,
    young_pa: float,
    *,
    thickness: float,
    damping: float,
    radius: float,
) -> str:
    """Returns the MJCF of a thin elastic shell."""
    return f"""<flexcomp name="object" type="direct" dim="2" mass=".2" radius="{radius}" material="object"
      point="{numbers(points)}" element="{numbers(faces)}" texcoord="{numbers(uv)}">
      <contact selfcollide="none" condim="3" friction=".6" {SHELL_CONTACT}/>
      <elasticity young="{young_pa:.6g}" poisson=".3" thickness="{thickness}" damping="{damping}"
                  elastic2d="both"/>
      <pin id="{numbers(pins)}"/></flexcomp>"""


def numbers(values: npt.ArrayLike) -> str:
    """Returns numbers as MJCF has them."""
    return " ".join(f"{value:.6g}" for value in np.asarray(values).ravel())
