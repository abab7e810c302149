"""Four objects of Shin et al. 2019 (fig. 4), a ball and a gauge as MuJoCo bodies, at three levels of detail.

A level of detail is a mesh and a time step. docs/simulation.md has a table of speed and error, measured
against the finest level.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from gripper_force.errors import ConfigError

Detail = Literal["coarse", "medium", "fine"]
Points = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

# Stiffer contacts chatter: at solref .002 there were dropouts to 0 N and spikes of 50 N.
_SOFT_CONTACT = 'solref=".01 1" solimp=".9 .95 .001"'
_SHELL_CONTACT = 'solref=".005 1" solimp=".95 .99 .001"'


BLOCK_WIDTH_M = 0.030
"""Width of the gauge ``block`` between the jaws."""

NO_OBJECT = "none"
"""Name of the scene without an object."""

GAUGES = frozenset({"block"})
"""Objects with exact dimensions: no size or stiffness is drawn for them."""

PADS_ONLY = frozenset({"ball"})
"""Objects that only pads may press: the tip of a rod would invert elements of their mesh."""


@dataclass(frozen=True)
class ObjectModel:
    """One object between the jaws.

    Attributes:
        body: MJCF inside the object's body; its origin is on the table at the gripper's centre.
        contact: MJCF contact attributes, shared by the object and the pads.
        texture: File name of the texture image, or None for a plain material.
        grip_height_m: Height of the jaws above the table.
        timestep_s: Physics step for this mesh.
    """

    body: str
    contact: str
    texture: str | None
    grip_height_m: float
    timestep_s: float


def build_object(name: str, detail: Detail, size: float, stiffness: float) -> ObjectModel:
    """Builds an object.

    Args:
        name: A key of `OBJECTS`, or `NO_OBJECT`.
        detail: Level of detail.
        size: Factor on all lengths. Material moduli are scaled inversely, so that the force at a given travel
            of the jaws does not change.
        stiffness: Factor on the force at a given travel of the jaws.

    Raises:
        ConfigError: The object does not exist.
    """
    if name == NO_OBJECT:
        return ObjectModel("", _SOFT_CONTACT, None, 0.025, 0.0025)
    try:
        builder = OBJECTS[name]
    except KeyError:
        raise ConfigError(
            f"no simulated object {name!r}; there are {', '.join([*OBJECTS, NO_OBJECT])}"
        ) from None
    return builder(detail, size, stiffness)


def _sponge(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    order, cells, dt, contact = {
        "coarse": ("trilinear", (4, 2, 2), 0.0025, _SOFT_CONTACT),
        "medium": ("quadratic", (2, 1, 1), 0.0025, _SOFT_CONTACT),
        "fine": ("quadratic", (3, 2, 2), 0.00125, _SHELL_CONTACT),
    }[detail]
    lengths = np.array([0.06, 0.05, 0.05]) * size
    counts = (9, 8, 7)
    spacing = lengths / (np.array(counts) - 1)
    grid = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), -1).reshape(-1, 3) * spacing
    uv = np.c_[grid[:, 0] + 0.5 * grid[:, 1], grid[:, 2] + 0.5 * grid[:, 1]] / 0.1
    nodes = 1 if order == "trilinear" else 2
    young = 1.5e4 * stiffness / size  # stiffness of a block is proportional to E * area / length
    body = f"""<flexcomp name="object" type="grid" dim="3" count="{_text(counts)}" spacing="{_text(spacing)}"
      dof="{order}" cellcount="{_text(cells)}" pos="0 0 {lengths[2] / 2 + 0.001:.6g}" mass=".2" radius=".001"
      material="object" flatskin="true" texcoord="{_text(uv)}">
      <contact selfcollide="none" condim="3" friction=".6" {contact}/>
      <elasticity young="{young:.6g}" poisson=".2" damping=".01"/>
      <pin gridrange="0 0 0 {nodes * cells[0]} {nodes * cells[1]} 0"/></flexcomp>"""
    return ObjectModel(body, contact, "sponge.png", 0.030 * size, dt)


def _tube(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    around, along, dt = {"coarse": (12, 5, 0.0025), "medium": (16, 7, 0.0025), "fine": (32, 15, 0.00125)}[
        detail
    ]
    radius, length = 0.022 * size, 0.05 * size
    points, uv, faces = _shell_of_revolution(radius, radius, length, around, along, seam_rad=-np.pi / 2)
    points = points[:, [0, 2, 1]] - [0, length / 2, 0]  # axis along y, so that the camera sees both ends
    points[:, 2] += radius + 0.0012
    # Pins a strip: a single pinned line would act as a hinge.
    pins = np.flatnonzero(points[:, 2] < 0.0012 + radius * (1 - np.cos(np.deg2rad(24))))
    young = (
        3.0e7 * stiffness * size**2
    )  # stiffness of a ring is proportional to E * thickness^3 * length / radius^3
    body = _shell(points, uv, faces, pins, young, thickness=0.0022, damping=0.004, radius=0.0012)
    return ObjectModel(body, _SHELL_CONTACT, "tube.png", 0.022 * size, dt)


def _cup(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    around, along, dt = {"coarse": (12, 6, 0.0025), "medium": (16, 8, 0.0025), "fine": (32, 16, 0.00125)}[
        detail
    ]
    points, uv, faces = _shell_of_revolution(
        0.026 * size, 0.037 * size, 0.085 * size, around, along, seam_rad=np.pi / 2, bottom=True
    )
    uv[:, 1] = 1 - uv[:, 1]
    points[:, 2] += 0.0008
    pins = np.flatnonzero(points[:, 2] < 0.001)
    young = 1.5e8 * stiffness * size**2
    body = _shell(points, uv, faces, pins, young, thickness=0.0011, damping=0.003, radius=0.0008)
    return ObjectModel(body, _SHELL_CONTACT, "cup.png", 0.060 * size, dt)


def _stapler(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    # Two rigid parts and a spring: only the step can be refined. The spring's moment acts on an arm
    # proportional to the size, hence the powers of the size.
    dt = {"coarse": 0.0025, "medium": 0.00125, "fine": 0.0005}[detail]
    linear, cubic = 3.2 * stiffness * size**2, 40.0 * stiffness * size**4
    preload_deg = np.rad2deg(0.15 / 3.2)
    s = size

    ghost = 'contype="0" conaffinity="0"'

    def box(half: str, pos: str, material: str, extra: str) -> str:
        lengths, centre = (_text(np.array(text.split(), float) * s) for text in (half, pos))
        return f'<geom type="box" size="{lengths}" pos="{centre}" material="{material}" {extra}/>'

    solid = f'contype="0" conaffinity="1" condim="3" {_SOFT_CONTACT}'
    tilt = 'euler="0 -7 0"'
    # It lies on its side, on a slide so that it centres itself: fixed to the world it would over-constrain
    # the jaws.
    body = f"""<body pos="{_text(np.array([-0.030, 0.045, 0.030]) * s)}" quat="-.5 .5 -.5 .5">
      <joint name="self_centre" type="slide" axis="0 0 1" stiffness="20" damping="8"/>
      <body pos="{-0.055 * s:.6g} 0 0">
        {box(".062 .017 .004", ".06 0 .004", "pad", solid)}
        {box(".052 .009 .006", ".062 0 .017", "steel", ghost)}
        {box(".008 .016 .014", ".006 0 .018", "pad", ghost)}
        <body pos="{_text(np.array([0.004, 0, 0.030]) * s)}">
          <joint name="arm" type="hinge" axis="0 1 0" range="-1 8" stiffness="{linear:.6g} 0 {cubic:.6g}"
                 springref="{-preload_deg:.6g}" damping=".05" armature="2e-5" solreflimit=".004 1"/>
          {box(".056 .012 .005", ".058 0 .010", "object", f'{tilt} mass=".05" {_SOFT_CONTACT}')}
          <geom type="capsule" size="{0.011 * s:.6g}" material="object" mass=".005" {_SOFT_CONTACT}
                fromto="{_text(np.array([0.10, -0.004, 0.018, 0.10, 0.004, 0.018]) * s)}"/>
          {box(".020 .0122 .0006", ".058 0 .0155", "finger", f'{tilt} mass="0" {ghost}')}
        </body>
      </body></body>"""
    return ObjectModel(body, _SOFT_CONTACT, None, 0.030 * s, dt)


def _block(detail: Detail, size: float, _stiffness: float) -> ObjectModel:
    # The body of a load cell: rigid, and free to centre and align itself.
    dt = {"coarse": 0.0025, "medium": 0.00125, "fine": 0.0005}[detail]
    half = np.array([BLOCK_WIDTH_M / 2, 0.012, 0.020]) * size
    body = f"""<body pos="0 0 {0.030 * size:.6g}">
      <joint name="self_centre" type="slide" axis="1 0 0" stiffness="20" damping="8"/>
      <joint name="self_align" type="hinge" axis="0 0 1" stiffness=".002" damping=".002"/>
      <geom type="box" size="{_text(half)}" material="steel" mass=".1" contype="0" conaffinity="1" condim="3"
            {_SOFT_CONTACT}/></body>"""
    return ObjectModel(body, _SOFT_CONTACT, None, 0.030 * size, dt)


def _ball(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    cells, dt = {"coarse": (4, 0.0025), "medium": (6, 0.0025), "fine": (8, 0.00125)}[detail]
    radius = 0.024 * size
    points, tetrahedra = _solid_ball(cells)
    # The angle from the front direction is the distance from the texture's centre.
    across = points[:, [0, 2]] / np.maximum(np.hypot(points[:, 0], points[:, 2]), 1e-9)[:, None]
    uv = 0.5 + across * (np.arccos(np.clip(-points[:, 1], -1, 1)) / (2 * np.pi))[:, None]
    points = points * radius + [0, 0, radius + 0.001]
    pins = np.flatnonzero(points[:, 2] < 0.001 + 0.15 * radius)
    young = (
        9.0e4 * stiffness / size**0.75
    )  # exponent between 1 (a block) and 1/2 (two spheres in point contact)
    body = f"""<flexcomp name="object" type="direct" dim="3" mass=".2" radius=".001" material="object"
      point="{_text(points)}" element="{_text(tetrahedra)}" texcoord="{_text(uv)}">
      <contact selfcollide="none" condim="3" friction=".6" {_SHELL_CONTACT}/>
      <elasticity young="{young:.6g}" poisson=".2" damping=".01"/>
      <pin id="{_text(pins)}"/></flexcomp>"""
    return ObjectModel(body, _SHELL_CONTACT, "ball.png", radius, dt)


OBJECTS: dict[str, Callable[[Detail, float, float], ObjectModel]] = {
    "sponge": _sponge,
    "paper_cup": _cup,
    "tube": _tube,
    "stapler": _stapler,
    "ball": _ball,
    "block": _block,
}


def _solid_ball(cells: int) -> tuple[Points, Indices]:
    """Returns points (N, 3) of a unit ball and tetrahedra (M, 4): a cube of cells, mapped to a ball."""
    count = cells + 1
    cube = np.stack(np.meshgrid(*[np.linspace(-1, 1, count)] * 3, indexing="ij"), -1).reshape(-1, 3)
    u, v = np.roll(cube, -1, axis=1) ** 2, np.roll(cube, -2, axis=1) ** 2
    points = cube * np.sqrt(1 - u / 2 - v / 2 + u * v / 3)
    number = np.arange(count**3).reshape(count, count, count)
    tetrahedra = []
    for i, j, k in np.ndindex(cells, cells, cells):
        # Neighbouring cells are mirrored, so that their diagonals meet.
        (a, b, c, d), (e, f, g, h) = (
            number[i + x, j : j + 2, k : k + 2].ravel() for x in ((0, 1) if (i + j + k) % 2 else (1, 0))
        )
        tetrahedra += [(a, b, c, e), (d, c, b, h), (f, e, h, b), (g, h, e, c), (b, c, e, h)]
    corners = np.array(tetrahedra)
    # At the cube's edges some have all corners on the ball: they are flat and would invert.
    outside = np.abs(cube).max(axis=1) == 1
    used, corners = np.unique(corners[~outside[corners].all(axis=1)], return_inverse=True)
    return points[used], _outward(points[used], corners.reshape(-1, 4))


def _outward(points: Points, tetrahedra: Indices) -> Indices:
    """Returns the tetrahedra with their corners ordered so that each volume is positive."""
    corners = points[tetrahedra]  # (M, 4, 3)
    negative = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    return np.where(negative[:, None], tetrahedra[:, [0, 1, 3, 2]], tetrahedra)


def _shell_of_revolution(
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


def _shell(
    points: Points,
    uv: Points,
    faces: Indices,
    pins: Indices,
    young: float,
    *,
    thickness: float,
    damping: float,
    radius: float,
) -> str:
    return f"""<flexcomp name="object" type="direct" dim="2" mass=".2" radius="{radius}" material="object"
      point="{_text(points)}" element="{_text(faces)}" texcoord="{_text(uv)}">
      <contact selfcollide="none" condim="3" friction=".6" {_SHELL_CONTACT}/>
      <elasticity young="{young:.6g}" poisson=".3" thickness="{thickness}" damping="{damping}"
                  elastic2d="both"/>
      <pin id="{_text(pins)}"/></flexcomp>"""


def _text(values: npt.ArrayLike) -> str:
    return " ".join(f"{value:.6g}" for value in np.asarray(values).ravel())
