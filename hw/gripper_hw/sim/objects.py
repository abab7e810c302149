"""Four objects of Shin et al. 2019 (fig. 4), a ball and a gauge as MuJoCo bodies, at three levels of detail.

A level of detail is a mesh and a time step. docs/simulation.md has a table of speed and error, measured
against the finest level.
"""

from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from gripper_force.errors import ConfigError
from gripper_hw.sim.kinds import load_kinds
from gripper_hw.sim.meshes import (
    SHELL_CONTACT,
    SHELL_MESHES,
    SOFT_CONTACT,
    Detail,
    ObjectModel,
    numbers,
    shell,
    shell_of_revolution,
    solid_ball,
)

BLOCK_WIDTH_M = 0.030
"""Width of the gauge ``block`` between the jaws."""

NO_OBJECT = "none"
"""Name of the scene without an object."""

GAUGES = frozenset({"block"})
"""Objects with exact dimensions: no size or stiffness is drawn for them."""

PADS_ONLY = frozenset({"ball"})
"""Objects that only pads may press: the tip of a rod would invert elements of their mesh."""


def build_object(
    name: str, detail: Detail, size: float, stiffness: float, file: Path | None = None
) -> ObjectModel:
    """Builds an object.

    Args:
        name: A key of `OBJECTS`, a kind of ``kinds.yaml``, or `NO_OBJECT`; with a file only a name.
        detail: Level of detail.
        size: Factor on all lengths. Material moduli are scaled inversely, so that the force at a given travel
            of the jaws does not change.
        stiffness: Factor on the force at a given travel of the jaws.
        file: File of a user's object.

    Raises:
        ConfigError: The object does not exist, or its file is wrong.
    """
    if file is not None:
        from gripper_hw.sim.object_files import read_object

        return read_object(file).build(detail, size, stiffness)
    if name == NO_OBJECT:
        return ObjectModel("", SOFT_CONTACT, None, 0.025, 0.0025)
    if name in OBJECTS:
        return OBJECTS[name](detail, size, stiffness)
    if name in (kinds := load_kinds()):
        return kinds[name].build(detail, size, stiffness)
    names = [*OBJECTS, *kinds, NO_OBJECT]
    hint = "".join(f"; did you mean {close!r}?" for close in get_close_matches(name.lower(), names, 1, 0.7))
    raise ConfigError(
        f"no simulated object {name!r}{hint}; there are {', '.join(names)}, or the path of a file of your own that "
        "ends in .yaml or .xml"
    )


def object_file(name: str, file: Path | None) -> Path | None:
    """Returns the file of a scene's object. Raises `ConfigError` if its name is another object's."""
    if file is None:
        return None
    if file.stem != name:
        raise ConfigError(
            f"the object is {name!r}, but sim.object is {file}; leave sim.object out, or set object={file}"
        )
    if name in {*OBJECTS, *load_kinds(), NO_OBJECT}:
        raise ConfigError(f"the simulated object {file} has the name of a shipped one; rename the file")
    return file


def _sponge(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    order, cells, dt, contact = {
        "coarse": ("trilinear", (4, 2, 2), 0.0025, SOFT_CONTACT),
        "medium": ("quadratic", (2, 1, 1), 0.0025, SOFT_CONTACT),
        "fine": ("quadratic", (3, 2, 2), 0.00125, SHELL_CONTACT),
    }[detail]
    lengths = np.array([0.06, 0.05, 0.05]) * size
    counts = (9, 8, 7)
    spacing = lengths / (np.array(counts) - 1)
    grid = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), -1).reshape(-1, 3) * spacing
    uv = np.c_[grid[:, 0] + 0.5 * grid[:, 1], grid[:, 2] + 0.5 * grid[:, 1]] / 0.1
    nodes = 1 if order == "trilinear" else 2
    young_pa = 1.5e4 * stiffness / size  # stiffness of a block is proportional to E * area / length
    body = f"""<flexcomp name="object" type="grid" dim="3" count="{numbers(counts)}" spacing="{numbers(spacing)}"
      dof="{order}" cellcount="{numbers(cells)}" pos="0 0 {lengths[2] / 2 + 0.001:.6g}" mass=".2" radius=".001"
      material="object" flatskin="true" texcoord="{numbers(uv)}">
      <contact selfcollide="none" condim="3" friction=".6" {contact}/>
      <elasticity young="{young_pa:.6g}" poisson=".2" damping=".01"/>
      <pin gridrange="0 0 0 {nodes * cells[0]} {nodes * cells[1]} 0"/></flexcomp>"""
    return ObjectModel(body, contact, "sponge.png", 0.030 * size, dt)


def _tube(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    around, along, dt = SHELL_MESHES[detail]
    radius, length = 0.022 * size, 0.05 * size
    points, uv, faces = shell_of_revolution(radius, radius, length, around, along - 1, seam_rad=-np.pi / 2)
    points = points[:, [0, 2, 1]] - [0, length / 2, 0]  # axis along y, so that the camera sees both ends
    points[:, 2] += radius + 0.0012
    # Pins a strip: a single pinned line would act as a hinge.
    pins = np.flatnonzero(points[:, 2] < 0.0012 + radius * (1 - np.cos(np.deg2rad(24))))
    # Stiffness of a ring is proportional to E * thickness^3 * length / radius^3.
    young_pa = 3.0e7 * stiffness * size**2
    body = shell(points, uv, faces, pins, young_pa, thickness=0.0022, damping=0.004, radius=0.0012)
    return ObjectModel(body, SHELL_CONTACT, "tube.png", 0.022 * size, dt)


def _cup(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    around, along, dt = SHELL_MESHES[detail]
    points, uv, faces = shell_of_revolution(
        0.026 * size, 0.037 * size, 0.085 * size, around, along, seam_rad=np.pi / 2, bottom=True
    )
    uv[:, 1] = 1 - uv[:, 1]
    points[:, 2] += 0.0008
    pins = np.flatnonzero(points[:, 2] < 0.001)
    young_pa = 1.5e8 * stiffness * size**2
    body = shell(points, uv, faces, pins, young_pa, thickness=0.0011, damping=0.003, radius=0.0008)
    return ObjectModel(body, SHELL_CONTACT, "cup.png", 0.060 * size, dt)


def _stapler(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    # Two rigid parts and a spring: only the step can be refined. The spring's moment acts on an arm
    # proportional to the size, hence the powers of the size.
    dt = {"coarse": 0.0025, "medium": 0.00125, "fine": 0.0005}[detail]
    linear, cubic = 3.2 * stiffness * size**2, 40.0 * stiffness * size**4
    preload_deg = np.rad2deg(0.15 / 3.2)
    s = size

    ghost = 'contype="0" conaffinity="0"'

    def box(half: str, pos: str, material: str, extra: str) -> str:
        lengths, centre = (numbers(np.array(part.split(), float) * s) for part in (half, pos))
        return f'<geom type="box" size="{lengths}" pos="{centre}" material="{material}" {extra}/>'

    solid = f'contype="0" conaffinity="1" condim="3" {SOFT_CONTACT}'
    tilt = 'euler="0 -7 0"'
    # It lies on its side, on a slide so that it centres itself: fixed to the world it would over-constrain
    # the jaws.
    body = f"""<body pos="{numbers(np.array([-0.030, 0.045, 0.030]) * s)}" quat="-.5 .5 -.5 .5">
      <joint name="self_centre" type="slide" axis="0 0 1" stiffness="20" damping="8"/>
      <body pos="{-0.055 * s:.6g} 0 0">
        {box(".062 .017 .004", ".06 0 .004", "pad", solid)}
        {box(".052 .009 .006", ".062 0 .017", "steel", ghost)}
        {box(".008 .016 .014", ".006 0 .018", "pad", ghost)}
        <body pos="{numbers(np.array([0.004, 0, 0.030]) * s)}">
          <joint name="arm" type="hinge" axis="0 1 0" range="-1 8" stiffness="{linear:.6g} 0 {cubic:.6g}"
                 springref="{-preload_deg:.6g}" damping=".05" armature="2e-5" solreflimit=".004 1"/>
          {box(".056 .012 .005", ".058 0 .010", "object", f'{tilt} mass=".05" {SOFT_CONTACT}')}
          <geom type="capsule" size="{0.011 * s:.6g}" material="object" mass=".005" {SOFT_CONTACT}
                fromto="{numbers(np.array([0.10, -0.004, 0.018, 0.10, 0.004, 0.018]) * s)}"/>
          {box(".020 .0122 .0006", ".058 0 .0155", "finger", f'{tilt} mass="0" {ghost}')}
        </body>
      </body></body>"""
    return ObjectModel(body, SOFT_CONTACT, None, 0.030 * s, dt)


def _block(detail: Detail, size: float, _stiffness: float) -> ObjectModel:
    # The body of a load cell: rigid, and free to centre and align itself.
    dt = {"coarse": 0.0025, "medium": 0.00125, "fine": 0.0005}[detail]
    half = np.array([BLOCK_WIDTH_M / 2, 0.012, 0.020]) * size
    body = f"""<body pos="0 0 {0.030 * size:.6g}">
      <joint name="self_centre" type="slide" axis="1 0 0" stiffness="20" damping="8"/>
      <joint name="self_align" type="hinge" axis="0 0 1" stiffness=".002" damping=".002"/>
      <geom type="box" size="{numbers(half)}" material="steel" mass=".1" contype="0" conaffinity="1" condim="3"
            {SOFT_CONTACT}/></body>"""
    return ObjectModel(body, SOFT_CONTACT, None, 0.030 * size, dt)


def _ball(detail: Detail, size: float, stiffness: float) -> ObjectModel:
    cells, dt = {"coarse": (4, 0.0025), "medium": (6, 0.0025), "fine": (8, 0.00125)}[detail]
    radius = 0.024 * size
    points, tetrahedra = solid_ball(cells)
    # The angle from the front direction is the distance from the texture's centre.
    direction = points[:, [0, 2]] / np.maximum(np.hypot(points[:, 0], points[:, 2]), 1e-9)[:, None]
    uv = 0.5 + direction * (np.arccos(np.clip(-points[:, 1], -1, 1)) / (2 * np.pi))[:, None]
    points = points * radius + [0, 0, radius + 0.001]
    pins = np.flatnonzero(points[:, 2] < 0.001 + 0.15 * radius)
    # The exponent is between 1 (a block) and 1/2 (two spheres in point contact).
    young_pa = 9.0e4 * stiffness / size**0.75
    body = f"""<flexcomp name="object" type="direct" dim="3" mass=".2" radius=".001" material="object"
      point="{numbers(points)}" element="{numbers(tetrahedra)}" texcoord="{numbers(uv)}">
      <contact selfcollide="none" condim="3" friction=".6" {SHELL_CONTACT}/>
      <elasticity young="{young_pa:.6g}" poisson=".2" damping=".01"/>
      <pin id="{numbers(pins)}"/></flexcomp>"""
    return ObjectModel(body, SHELL_CONTACT, "ball.png", radius, dt)


OBJECTS: dict[str, Callable[[Detail, float, float], ObjectModel]] = {
    "sponge": _sponge,
    "paper_cup": _cup,
    "tube": _tube,
    "stapler": _stapler,
    "ball": _ball,
    "block": _block,
}
