"""Kinds of simulated objects as records: `kinds.yaml` has the shipped ones, an object file holds one of a user.

Each family of kinds is a class, whose fields are the keys of a record and which builds the body.
"""

import math
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from gripper_force.errors import ConfigError
from gripper_force.schema import Positive, Section, Tree, tree_from, validated
from gripper_hw.sim.mesh_files import MAX_SIZE_M, MIN_SIZE_M, MeshFile, read_image, read_mesh
from gripper_hw.sim.meshes import (
    SHELL_CONTACT,
    SHELL_MESHES,
    SOFT_CONTACT,
    Detail,
    Indices,
    ObjectModel,
    Points,
    numbers,
    outward,
    shell,
    shell_of_revolution,
    solid_cube,
)

_SKIN_M = 0.001
_CORE = 0.62
"""Width of a solid's rigid core: a foam is compressed no further. Beyond this the elastic law would soften."""

_GHOST = 'contype="0" conaffinity="0"'
_RIGID = f'contype="0" conaffinity="1" condim="3" {SOFT_CONTACT}'

TEXTURES = ("stripes", "rings", "checks", "weave", "spots", "speckle", "marble", "label", "plain")
"""Patterns of `textures.PATTERNS`."""

_RING_N_M = (300.0, 30_000.0)
"""Stiffness E * wall^3 * length / radius^3 of a shell that the simulation can follow. A thinner wall is folded flat by
a few newtons and chatters; a thicker one moves less than the pads' own contact."""

_SOLID_N_M = 100_000.0
"""Stiffness E * area / width of a solid that the simulation can follow: 10 N press it by 0.1 mm."""

Length = Annotated[float, Field(ge=MIN_SIZE_M, le=MAX_SIZE_M)]
Size = tuple[Length, Length, Length]
Share = Annotated[float, Field(ge=0, le=1)]


class ObjectKind(Section):
    """A kind of object: what all families have.

    Attributes:
        family: ``solid``: elastic and filled; ``shell``: a thin wall of revolution; ``spring``: two rigid
            parts, pressed together against a spring.
        texture: Pattern of the surface, one of `TEXTURES`, whose colours are drawn; or the path of a PNG image.
        held_out: True if no network is trained on it.
        grip: Height of the jaws, as a share of the height.
    """

    family: str
    texture: str = "plain"
    held_out: bool = False
    grip: Annotated[float, Field(ge=0.1, le=0.9)] = 0.5

    @model_validator(mode="after")
    def _check_texture(self) -> Self:
        if self.texture not in TEXTURES and not self.texture.endswith(".png"):
            raise ValueError(
                f"texture {self.texture!r} is neither {', '.join(TEXTURES)} nor the path of a PNG image"
            )
        return self

    def build(self, detail: Detail, size: float, stiffness: float) -> ObjectModel:
        """Builds an object of this kind; the arguments are those of `objects.build_object`."""
        raise NotImplementedError

    def _model(self, body: str, contact: str, height_m: float, timestep_s: float) -> ObjectModel:
        texture, files = f"{self.texture}.png", {}
        if self.texture not in TEXTURES:
            texture = "image.png"
            files[texture] = read_image(Path(self.texture))
        return ObjectModel(body, contact, texture, self.grip * height_m, timestep_s, files)


class Solid(ObjectKind):
    """An elastic, filled object.

    Attributes:
        size_m: Width between the jaws, depth and height; None with a mesh, which has its own.
        modulus_pa: Young's modulus.
        shape: ``box``, ``roll`` (lying cylinder), ``column`` (standing cylinder) or ``ball``.
        mesh: Mesh of its surface instead of a shape.
        rounding: 0 for sharp edges to 1 for fully rounded.
        taper: Loss of width and depth from foot to top, as a share of the middle's.
        dent: Loss of width at half height, as a share.
        edge: Loss of width at front and back, as a share: the sides have an upright edge.
    """

    family: Literal["solid"]
    size_m: Size | None = None
    modulus_pa: Annotated[float, Field(ge=2e3, le=3e6)]
    shape: Literal["box", "roll", "column", "ball"] = "box"
    mesh: MeshFile | None = None
    rounding: Share = 0.15
    taper: Annotated[float, Field(ge=-0.6, le=0.6)] = 0.0
    dent: Annotated[float, Field(ge=0, le=0.6)] = 0.0
    edge: Annotated[float, Field(ge=0, le=0.6)] = 0.0

    @model_validator(mode="after")
    def _has_one_shape(self) -> Self:
        if (self.mesh is None) == (self.size_m is None):
            raise ValueError("a solid needs either size_m, or a mesh, whose size is that of its file")
        if self.mesh is not None and (
            shaped := self.model_fields_set & {"shape", "rounding", "taper", "dent", "edge"}
        ):
            raise ValueError(f"a mesh has its own shape; leave out {' and '.join(sorted(shaped))}")
        return self

    def build(self, detail: Detail, size: float, stiffness: float) -> ObjectModel:
        """Builds a solid."""
        order, cells, dt = {
            "coarse": ("trilinear", (4, 2, 2), 0.0025),
            "medium": ("quadratic", (2, 1, 1), 0.0025),
            "fine": ("quadratic", (3, 2, 2), 0.00125),
        }[detail]
        if self.mesh is None:
            (points, tetrahedra), lengths = self._shape(), np.array(self.size_m) * size
        else:
            points, tetrahedra, lengths = _mesh_shape(self.mesh, size)
        max_pa = _SOLID_N_M * lengths[0] / (lengths[1] * lengths[2])
        if self.modulus_pa > max_pa:
            raise ConfigError(
                f"modulus_pa {self.modulus_pa:g} of a simulated object of this size is too stiff to be simulated as "
                f"elastic; set at most {max_pa:.2g}, or describe a rigid object as MJCF"
            )
        points = points * lengths / 2 + [0, 0, lengths[2] / 2 + _SKIN_M]
        uv = np.c_[points[:, 0] + 0.5 * points[:, 1], points[:, 2] + 0.5 * points[:, 1]] / 0.1
        nodes = 1 if order == "trilinear" else 2
        core = _geom(
            "ball" if self.mesh is not None else self.shape,
            lengths * [_CORE, 0.6, 0.6] / 2,
            np.zeros(3),
            f'material="object" mass=".05" {_RIGID}',
        )
        body = f"""<flexcomp name="object" type="direct" dim="3" dof="{order}" cellcount="{numbers(cells)}" mass=".2"
          radius="{_SKIN_M}" material="object" point="{numbers(points)}" element="{numbers(tetrahedra)}"
          texcoord="{numbers(uv)}">
          <contact selfcollide="none" contype="0" conaffinity="1" condim="3" friction=".6" {SOFT_CONTACT}/>
          <elasticity young="{self.modulus_pa * stiffness / size:.6g}" poisson=".2" damping=".01"/>
          <pin gridrange="0 0 0 {nodes * cells[0]} {nodes * cells[1]} 0"/></flexcomp>
          <body pos="0 0 {lengths[2] * self.grip:.6g}">
          <joint name="self_centre" type="slide" axis="1 0 0" stiffness="20" damping="8"/>{core}</body>"""
        return self._model(body, SOFT_CONTACT, lengths[2], dt)

    def _shape(self) -> tuple[Points, Indices]:
        """Returns points (N, 3) from -1 to 1 and tetrahedra (M, 4)."""
        cube, tetrahedra = solid_cube(6)
        tetrahedra = outward(cube, tetrahedra)
        # A cube becomes a ball or a cylinder: an axis that shortens another one shares a circle with it.
        round_axes = {"box": "xyz", "ball": "xyz", "roll": "xz", "column": "xy"}[self.shape]
        squares = [
            cube[:, i] ** 2 if axis in round_axes else np.zeros(len(cube)) for i, axis in enumerate("xyz")
        ]
        curved = cube.copy()
        for i, axis in enumerate("xyz"):
            if axis in round_axes:
                u, v = squares[i - 1], squares[i - 2]
                curved[:, i] *= np.sqrt(1 - u / 2 - v / 2 + u * v / 3)
        points = cube + self.rounding * (curved - cube)
        _, y, z = points.T
        points = points * np.stack(
            [
                (1 - self.taper * z) * (1 - self.dent * np.exp(-5 * z**2)) * (1 - self.edge * np.abs(y)),
                1 - self.taper * z,
                np.ones_like(z),
            ],
            -1,
        )
        points /= np.abs(points).max(axis=0)
        corners = points[tetrahedra]
        volumes = np.linalg.det(corners[:, 1:] - corners[:, :1])
        # Rounding makes some tetrahedra at the cube's edges flat.
        used, kept = np.unique(tetrahedra[volumes > 0.05 * np.median(volumes)], return_inverse=True)
        return points[used], kept.reshape(-1, 4)


class Shell(ObjectKind):
    """A thin wall of revolution.

    Attributes:
        size_m: Width between the jaws, depth and height. One that lies is as high as wide, one that stands as deep.
        modulus_pa: Young's modulus.
        radii: Radii at equal distances along the axis, as shares of half the width.
        lying: True if the axis is horizontal, towards the camera.
        wall_m: Thickness of the wall.
    """

    family: Literal["shell"]
    size_m: Size
    modulus_pa: Positive
    radii: Annotated[tuple[Annotated[float, Field(ge=0.2, le=1)], ...], Field(min_length=2)]
    lying: bool = False
    wall_m: Annotated[float, Field(ge=2e-4, le=5e-3)]

    @model_validator(mode="after")
    def _is_stiff_enough(self) -> Self:
        length, radius = self.size_m[1 if self.lying else 2], self.size_m[0] / 2
        if not math.isclose(across := self.size_m[2 if self.lying else 1], self.size_m[0]):
            raise ValueError(
                f"size_m {list(self.size_m)} says that a shell is {self.size_m[0]:g} m wide and {across:g} m "
                f"{'high' if self.lying else 'deep'}, but shells are round; set both to the same"
            )
        per_modulus = self.wall_m**3 * length / radius**3
        low, high = (bound / per_modulus for bound in _RING_N_M)
        if not low <= self.modulus_pa <= high:
            raise ValueError(
                f"modulus_pa {self.modulus_pa:g} with this size and wall_m can't be simulated: the wall would "
                f"{'fold flat' if self.modulus_pa < low else 'not move visibly'}; set modulus_pa from {low:.2g} to "
                f"{high:.2g}, or another wall_m"
            )
        return self

    def build(self, detail: Detail, size: float, stiffness: float) -> ObjectModel:
        """Builds a shell."""
        lengths = np.array(self.size_m) * size
        around, along, dt = SHELL_MESHES[detail]
        length = lengths[1] if self.lying else lengths[2]
        points, uv, faces = shell_of_revolution(
            1.0,
            1.0,
            length,
            around,
            along,
            seam_rad=np.pi / 2 * (-1 if self.lying else 1),
            bottom=not self.lying,
        )
        stations = np.linspace(0, length, len(self.radii))
        points[:, :2] *= lengths[0] / 2 * np.interp(points[:, 2], stations, self.radii)[:, None]
        skin = 0.0012 if self.lying else 0.0008
        if self.lying:
            points = points[:, [0, 2, 1]] - [0, length / 2, 0]
            points[:, 2] += lengths[0] / 2 + skin
            radius = lengths[0] / 2
            pins = np.flatnonzero(
                points[:, 2] < skin + radius * (1 - np.cos(np.deg2rad(24)) * min(self.radii))
            )
        else:
            uv[:, 1] = 1 - uv[:, 1]
            points[:, 2] += skin
            pins = np.flatnonzero(points[:, 2] < skin + 2e-4)
        # Stiffness of a ring is proportional to E * thickness^3 * length / radius^3.
        young_pa = self.modulus_pa * stiffness * size**2
        body = shell(points, uv, faces, pins, young_pa, thickness=self.wall_m, damping=0.004, radius=skin)
        height = lengths[0] if self.lying else lengths[2]
        return self._model(body, SHELL_CONTACT, height, dt)


class Spring(ObjectKind):
    """Two rigid parts, pressed together against a spring.

    Attributes:
        size_m: Width between the jaws, depth and height.
        shape: Of its parts, as for `Solid`.
        n_per_mm: Force per travel of one jaw; with a hinge, of one that touches the part in its middle.
        cubic_n_per_mm3: Further force per cube of the travel.
        stop_m: Travel of one part up to its stop.
        hinge: Axis of its parts, ``back`` (upright) or ``foot`` (horizontal); None: they slide.
    """

    family: Literal["spring"]
    size_m: Size
    shape: Literal["box", "roll", "column", "ball"] = "box"
    n_per_mm: Annotated[float, Field(ge=0.05, le=100)]
    cubic_n_per_mm3: Annotated[float, Field(ge=0, le=100)] = 0.0
    stop_m: Annotated[float, Field(ge=5e-4, le=0.05)]
    hinge: Literal["back", "foot"] | None = None

    @model_validator(mode="after")
    def _has_room_to_move(self) -> Self:
        if self.stop_m > 0.4 * self.size_m[0]:
            raise ValueError(
                f"stop_m {self.stop_m:g} is more than 0.4 of the width size_m[0] {self.size_m[0]:g}"
            )
        return self

    def build(self, detail: Detail, size: float, stiffness: float) -> ObjectModel:
        """Builds a pair of parts on springs."""
        lengths = np.array(self.size_m) * size
        dt = {"coarse": 0.0025, "medium": 0.00125, "fine": 0.0005}[detail]
        width, depth, height = lengths
        linear, cubic = 1e3 * self.n_per_mm * stiffness, 1e9 * self.cubic_n_per_mm3 * stiffness
        gap = self.stop_m * size
        half = np.array([(width / 2 - gap) / 2, depth / 2, height / 2])  # of one part
        # The part's hinge, relative to the grip; travels there become angles.
        arm = {None: 1.0, "back": depth / 2, "foot": height * self.grip}[self.hinge]
        parts = ""
        for side in (-1, 1):
            centre = np.array([side * (width / 2 - half[0]), 0, height * (0.5 - self.grip)])
            hinge = {None: [0, 0, 0], "back": [centre[0], arm, 0], "foot": [centre[0], 0, -arm]}[self.hinge]
            axis = {None: [-side, 0, 0], "back": [0, 0, -side], "foot": [0, -side, 0]}[self.hinge]
            joint = "slide" if self.hinge is None else "hinge"
            travel = gap if self.hinge is None else np.rad2deg(gap / arm)
            pivot = numbers(hinge)
            parts += f"""<body><joint type="{joint}" axis="{numbers(axis)}" pos="{pivot}" range="-.001 {travel:.6g}"
              stiffness="{linear * arm**2:.6g} 0 {cubic * arm**4:.6g}" damping="{6 * arm**2:.6g}"
              armature="{0.03 * arm**2:.6g}" solreflimit=".006 1"/>
              {_geom(self.shape, half, centre, f'material="object" mass=".03" {_RIGID}')}</body>"""
        rod = _geom(
            "box",
            np.array([width / 2 - half[0], depth * 0.2, height * 0.2]),
            np.zeros(3),
            f'material="steel" {_GHOST}',
        )
        body = f"""<body pos="0 0 {height * self.grip:.6g}">
          <joint name="self_centre" type="slide" axis="1 0 0" stiffness="20" damping="8"/>{rod}{parts}</body>"""
        return self._model(body, SOFT_CONTACT, height, dt)


FAMILIES: dict[str, type[ObjectKind]] = {"solid": Solid, "shell": Shell, "spring": Spring}


def kind_from(record: Tree, where: str) -> ObjectKind:
    """Builds a kind from its record. Raises `ConfigError` that names ``where`` and the key."""
    family = record.get("family")
    if not isinstance(family, str) or family not in FAMILIES:
        raise ConfigError(
            f"simulated object key 'family' (from {where}): got {family!r}; set one of {', '.join(FAMILIES)}"
        )
    return validated(FAMILIES[family], record, where, "simulated object")


@cache
def load_kinds() -> dict[str, ObjectKind]:
    """Returns the shipped kinds by name."""
    text = resources.files(__package__).joinpath("kinds.yaml").read_text(encoding="utf-8")
    records = tree_from(text, "kinds.yaml", "kinds of objects")
    return {name: kind_from(record, f"kinds.yaml, {name}") for name, record in records.items()}


def training_kinds() -> tuple[str, ...]:
    """Returns the names of the kinds that networks are trained on."""
    return tuple(name for name, kind in load_kinds().items() if not kind.held_out)


def held_out_kinds() -> tuple[str, ...]:
    """Returns the names of the kinds that are kept for tests."""
    return tuple(name for name, kind in load_kinds().items() if kind.held_out)


def _mesh_shape(mesh: MeshFile, size: float) -> tuple[Points, Indices, Points]:
    """Returns points from -1 to 1, tetrahedra and lengths: each triangle and the middle form a tetrahedron.

    The cage around them is elastic, not they. So a hollow may be divided into overlapping tetrahedra.
    """
    surface, triangles = read_mesh(mesh)
    size_m = np.ptp(surface, axis=0)
    points = np.vstack([(surface - [0, 0, size_m[2] / 2]) * 2 / size_m, np.zeros(3)])
    tetrahedra = np.c_[triangles, np.full(len(triangles), len(surface))]
    corners = points[tetrahedra]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    return points, outward(points, tetrahedra[volumes > 1e-9]), size_m * size


def _geom(shape: str, half: Points, centre: Points, attributes: str) -> str:
    """Returns a geom that fills a box, with half its lengths."""
    x, y, z = half
    if shape in ("box", "ball"):
        kind, size, turn = {"box": "box", "ball": "ellipsoid"}[shape], half, ""
    elif shape == "roll":
        kind, size, turn = "cylinder", np.array([min(x, z), y]), 'euler="90 0 0"'
    else:
        kind, size, turn = "cylinder", np.array([min(x, y), z]), ""
    return f'<geom type="{kind}" size="{numbers(size)}" pos="{numbers(centre)}" {turn} {attributes}/>'
