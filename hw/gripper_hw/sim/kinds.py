"""Kinds of simulated objects as records: `kinds.yaml` has them, and one builder for each family makes a body."""

from functools import cache
from importlib import resources
from typing import Literal

import numpy as np

from gripper_force.schema import Section, tree_from, validated
from gripper_hw.sim.meshes import (
    SHELL_CONTACT,
    SOFT_CONTACT,
    Detail,
    ObjectModel,
    Points,
    outward,
    shell,
    shell_of_revolution,
    solid_cube,
    text,
)

_SKIN_M = 0.001
_CORE = 0.62
"""Width of a solid's rigid core: a foam is compressed no further. Beyond this the elastic law would soften."""

_GHOST = 'contype="0" conaffinity="0"'
_RIGID = f'contype="0" conaffinity="1" condim="3" {SOFT_CONTACT}'


class ObjectKind(Section):
    """A kind of object.

    Attributes:
        name: Name, as for ``object`` in the configuration.
        family: ``solid``: elastic and filled; ``shell``: a thin wall of revolution; ``spring``: two rigid
            parts, pressed together against a spring.
        size_m: Width between the jaws, depth and height.
        texture: Pattern of the surface, a key of `textures.PATTERNS`; colours are drawn.
        held_out: True if no network is trained on it.
        shape: Of a solid or of a spring's parts: ``box``, ``roll`` (lying cylinder), ``column`` (standing
            cylinder) or ``ball``.
        modulus_pa: Young's modulus of a solid or shell.
        rounding: Solid: 0 for sharp edges to 1 for fully rounded.
        taper: Solid: loss of width and depth from foot to top, as a share of the middle's.
        dent: Solid: loss of width at half height, as a share.
        edge: Solid: loss of width at front and back, as a share: the sides have an upright edge.
        radii: Shell: radii at equal distances along the axis, as shares of half the width.
        lying: Shell: True if the axis is horizontal, towards the camera.
        wall_m: Shell: thickness of the wall.
        n_per_mm: Spring: force per travel of one jaw.
        cubic_n_per_mm3: Spring: further force per cube of the travel.
        stop_m: Spring: travel of one part up to its stop.
        hinge: Spring: axis of its parts, ``back`` (upright) or ``foot`` (horizontal); None: they slide.
        grip: Height of the jaws, as a share of the height.
    """

    name: str
    family: Literal["solid", "shell", "spring"]
    size_m: tuple[float, float, float]
    texture: str
    held_out: bool = False
    shape: Literal["box", "roll", "column", "ball"] = "box"
    modulus_pa: float = 0.0
    rounding: float = 0.15
    taper: float = 0.0
    dent: float = 0.0
    edge: float = 0.0
    radii: tuple[float, ...] = ()
    lying: bool = False
    wall_m: float = 0.0
    n_per_mm: float = 0.0
    cubic_n_per_mm3: float = 0.0
    stop_m: float = 0.0
    hinge: Literal["back", "foot"] | None = None
    grip: float = 0.5


@cache
def load_kinds() -> dict[str, ObjectKind]:
    """Returns the shipped kinds by name."""
    text_ = resources.files(__package__).joinpath("kinds.yaml").read_text(encoding="utf-8")
    records = tree_from(text_, "kinds.yaml", "kinds of objects")
    return {
        name: validated(ObjectKind, {"name": name, **record}, f"kinds.yaml, {name}", "kind of object")
        for name, record in records.items()
    }


def training_kinds() -> tuple[str, ...]:
    """Returns the names of the kinds that networks are trained on."""
    return tuple(name for name, kind in load_kinds().items() if not kind.held_out)


def held_out_kinds() -> tuple[str, ...]:
    """Returns the names of the kinds that are kept for tests."""
    return tuple(name for name, kind in load_kinds().items() if kind.held_out)


def build_kind(kind: ObjectKind, detail: Detail, size: float, stiffness: float) -> ObjectModel:
    """Builds an object of a kind; the arguments are those of `objects.build_object`."""
    build = {"solid": _solid, "shell": _shell, "spring": _spring}[kind.family]
    return build(kind, detail, np.array(kind.size_m) * size, size, stiffness)


def _solid(kind: ObjectKind, detail: Detail, lengths: Points, size: float, stiffness: float) -> ObjectModel:
    order, cells, dt = {
        "coarse": ("trilinear", (4, 2, 2), 0.0025),
        "medium": ("quadratic", (2, 1, 1), 0.0025),
        "fine": ("quadratic", (3, 2, 2), 0.00125),
    }[detail]
    cube, tetrahedra = solid_cube(6)
    tetrahedra = outward(cube, tetrahedra)
    # A cube becomes a ball or a cylinder: an axis that shortens another one shares a circle with it.
    round_axes = {"box": "xyz", "ball": "xyz", "roll": "xz", "column": "xy"}[kind.shape]
    squares = [cube[:, i] ** 2 if axis in round_axes else np.zeros(len(cube)) for i, axis in enumerate("xyz")]
    curved = cube.copy()
    for i, axis in enumerate("xyz"):
        if axis in round_axes:
            u, v = squares[i - 1], squares[i - 2]
            curved[:, i] *= np.sqrt(1 - u / 2 - v / 2 + u * v / 3)
    points = cube + kind.rounding * (curved - cube)
    _, y, z = points.T
    points = points * np.stack(
        [
            (1 - kind.taper * z) * (1 - kind.dent * np.exp(-5 * z**2)) * (1 - kind.edge * np.abs(y)),
            1 - kind.taper * z,
            np.ones_like(z),
        ],
        -1,
    )
    points /= np.abs(points).max(axis=0)
    corners = points[tetrahedra]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1])
    # Rounding makes some tetrahedra at the cube's edges flat.
    used, kept = np.unique(tetrahedra[volumes > 0.05 * np.median(volumes)], return_inverse=True)
    points = points[used] * lengths / 2 + [0, 0, lengths[2] / 2 + _SKIN_M]
    uv = np.c_[points[:, 0] + 0.5 * points[:, 1], points[:, 2] + 0.5 * points[:, 1]] / 0.1
    nodes = 1 if order == "trilinear" else 2
    core = _geom(
        kind.shape, lengths * [_CORE, 0.6, 0.6] / 2, np.zeros(3), f'material="object" mass=".05" {_RIGID}'
    )
    body = f"""<flexcomp name="object" type="direct" dim="3" dof="{order}" cellcount="{text(cells)}" mass=".2"
      radius="{_SKIN_M}" material="object" point="{text(points)}" element="{text(kept.reshape(-1, 4))}"
      texcoord="{text(uv)}">
      <contact selfcollide="none" contype="0" conaffinity="1" condim="3" friction=".6" {SOFT_CONTACT}/>
      <elasticity young="{kind.modulus_pa * stiffness / size:.6g}" poisson=".2" damping=".01"/>
      <pin gridrange="0 0 0 {nodes * cells[0]} {nodes * cells[1]} 0"/></flexcomp>
      <body pos="0 0 {lengths[2] * kind.grip:.6g}">
      <joint name="self_centre" type="slide" axis="1 0 0" stiffness="20" damping="8"/>{core}</body>"""
    return ObjectModel(body, SOFT_CONTACT, f"{kind.texture}.png", kind.grip * lengths[2], dt)


def _shell(kind: ObjectKind, detail: Detail, lengths: Points, size: float, stiffness: float) -> ObjectModel:
    around, along, dt = {"coarse": (12, 6, 0.0025), "medium": (16, 8, 0.0025), "fine": (32, 16, 0.00125)}[
        detail
    ]
    length = lengths[1] if kind.lying else lengths[2]
    points, uv, faces = shell_of_revolution(
        1.0, 1.0, length, around, along, seam_rad=np.pi / 2 * (-1 if kind.lying else 1), bottom=not kind.lying
    )
    stations = np.linspace(0, length, len(kind.radii))
    points[:, :2] *= lengths[0] / 2 * np.interp(points[:, 2], stations, kind.radii)[:, None]
    skin = 0.0012 if kind.lying else 0.0008
    if kind.lying:
        points = points[:, [0, 2, 1]] - [0, length / 2, 0]
        points[:, 2] += lengths[0] / 2 + skin
        radius = lengths[0] / 2
        pins = np.flatnonzero(points[:, 2] < skin + radius * (1 - np.cos(np.deg2rad(24)) * min(kind.radii)))
    else:
        uv[:, 1] = 1 - uv[:, 1]
        points[:, 2] += skin
        pins = np.flatnonzero(points[:, 2] < skin + 2e-4)
    # Stiffness of a ring is proportional to E * thickness^3 * length / radius^3.
    young = kind.modulus_pa * stiffness * size**2
    body = shell(points, uv, faces, pins, young, thickness=kind.wall_m, damping=0.004, radius=skin)
    height = lengths[0] if kind.lying else lengths[2]
    return ObjectModel(body, SHELL_CONTACT, f"{kind.texture}.png", kind.grip * height, dt)


def _spring(kind: ObjectKind, detail: Detail, lengths: Points, size: float, stiffness: float) -> ObjectModel:
    dt = {"coarse": 0.0025, "medium": 0.00125, "fine": 0.0005}[detail]
    width, depth, height = lengths
    linear, cubic = 1e3 * kind.n_per_mm * stiffness, 1e9 * kind.cubic_n_per_mm3 * stiffness
    gap = kind.stop_m * size
    half = np.array([(width / 2 - gap) / 2, depth / 2, height / 2])  # of one part
    # The part's hinge, relative to the grip; travels there become angles.
    arm = {None: 1.0, "back": depth / 2, "foot": height * kind.grip}[kind.hinge]
    parts = ""
    for side in (-1, 1):
        at = np.array([side * (width / 2 - half[0]), 0, height * (0.5 - kind.grip)])
        hinge = {None: [0, 0, 0], "back": [at[0], arm, 0], "foot": [at[0], 0, -arm]}[kind.hinge]
        axis = {None: [-side, 0, 0], "back": [0, 0, -side], "foot": [0, -side, 0]}[kind.hinge]
        joint = "slide" if kind.hinge is None else "hinge"
        travel = gap if kind.hinge is None else np.rad2deg(gap / arm)
        parts += f"""<body><joint type="{joint}" axis="{text(axis)}" pos="{text(hinge)}" range="-.001 {travel:.6g}"
          stiffness="{linear * arm**2:.6g} 0 {cubic * arm**4:.6g}" damping="{6 * arm**2:.6g}"
          armature="{0.03 * arm**2:.6g}" solreflimit=".006 1"/>
          {_geom(kind.shape, half, at, f'material="object" mass=".03" {_RIGID}')}</body>"""
    rod = _geom(
        "box",
        np.array([width / 2 - half[0], depth * 0.2, height * 0.2]),
        np.zeros(3),
        f'material="steel" {_GHOST}',
    )
    body = f"""<body pos="0 0 {height * kind.grip:.6g}">
      <joint name="self_centre" type="slide" axis="1 0 0" stiffness="20" damping="8"/>{rod}{parts}</body>"""
    return ObjectModel(body, SOFT_CONTACT, f"{kind.texture}.png", kind.grip * height, dt)


def _geom(shape: str, half: Points, at: Points, rest: str) -> str:
    """Returns a geom that fills a box, with half its lengths."""
    x, y, z = half
    if shape in ("box", "ball"):
        kind, size, turn = {"box": "box", "ball": "ellipsoid"}[shape], half, ""
    elif shape == "roll":
        kind, size, turn = "cylinder", np.array([min(x, z), y]), 'euler="90 0 0"'
    else:
        kind, size, turn = "cylinder", np.array([min(x, y), z]), ""
    return f'<geom type="{kind}" size="{text(size)}" pos="{text(at)}" {turn} {rest}/>'
