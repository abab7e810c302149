"""Files of simulated objects: a record of a kind as YAML, or a body as MJCF (docs/simulation.md)."""

import hashlib
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gripper_force.errors import ConfigError
from gripper_force.schema import read_tree
from gripper_hw.sim.engine import mujoco
from gripper_hw.sim.kinds import ObjectKind, kind_from
from gripper_hw.sim.mesh_files import read_bytes
from gripper_hw.sim.meshes import SOFT_CONTACT, Detail, ObjectModel

_PREFIX = "own_"
"""Of the names of a user's body, so that they differ from those of the gripper."""


@dataclass(frozen=True)
class MjcfBody:
    """A body from an MJCF file."""

    path: Path

    def build(self, detail: Detail, size: float, stiffness: float) -> ObjectModel:
        """Builds the object; the stiffness of its joints is multiplied by ``stiffness``, its size is exact."""
        spec = _read_spec(self.path)
        for joint in spec.joints:
            joint.stiffness = joint.stiffness * stiffness
        model = _compile(spec, self.path)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        holder = """<inertial mass=".01" pos="0 0 0" diaginertia="1e-5 1e-5 1e-5"/>
          <joint name="self_centre" type="slide" axis="1 0 0" stiffness="20" damping="8"/>"""
        timestep_s = {"coarse": 0.0025, "medium": 0.00125, "fine": 0.0005}[detail]
        height_m = float(data.site("grip").xpos[2])
        return ObjectModel(holder, SOFT_CONTACT, None, height_m, timestep_s, _mjcf_files(spec), spec)


def read_object(path: Path) -> ObjectKind | MjcfBody:
    """Reads an object's file. Raises `ConfigError` that names the file, and the key or what is missing."""
    if path.suffix == ".xml":
        _read_spec(path)
        return MjcfBody(path)
    tree = read_tree(path, "simulated object")
    if "format" in tree:
        raise ConfigError(
            f"{path} is a {tree['format']} file, not a simulated object; pass an object profile with --profile {path}"
        )
    for section, key in ((tree, "texture"), (tree.get("mesh"), "file")):
        if isinstance(section, dict) and Path(str(section.get(key))).suffix:
            section[key] = str(path.parent / str(section[key]))
    return kind_from(tree, str(path))


def digest(path: Path) -> str:
    """Returns the SHA-256 of an object's file and of the files that it names."""
    kind, contents = read_object(path), [path.read_bytes()]
    if isinstance(kind, MjcfBody):
        spec = _read_spec(path)
        if re.search(rb"<(include|model)\s", contents[0]):
            contents.append(spec.to_xml().encode())
        contents += [data for _, data in sorted(_mjcf_files(spec).items())]
    else:
        mesh = getattr(kind, "mesh", None)
        files = [kind.texture] if kind.texture.endswith(".png") else []
        files += [] if mesh is None else [mesh.file]
        contents += [read_bytes(Path(name), "file") for name in files]
    return hashlib.sha256(b"".join(contents)).hexdigest()


def attach(scene: str, model: ObjectModel, images: dict[str, bytes]) -> str:
    """Returns the MJCF of a scene, whose images are given, with a user's body in its body ``object``."""
    try:
        scene_spec, spec = mujoco.MjSpec.from_string(scene), model.spec
        scene_spec.assets = images | model.files
        with warnings.catch_warnings():  # of options of the file, which the scene replaces
            warnings.simplefilter("ignore", UserWarning)
            scene_spec.body("object").add_frame().attach_body(spec.body("object"), _PREFIX, "")
            return str(scene_spec.to_xml())
    except ValueError as error:
        raise ConfigError(
            f"MuJoCo can't put the simulated object into the scene: {' '.join(str(error).split())}; correct its file"
        ) from error


def _read_spec(path: Path) -> Any:
    read_bytes(path, "simulated object")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ConfigError(f"MuJoCo can't read {path}: {' '.join(str(error).split())}; correct it") from error
    bodies = [body.name for body in spec.worldbody.bodies]
    kinds = mujoco.mjtJoint
    wrong = {
        f"exactly one body in its worldbody, named object (it has {', '.join(bodies) or 'none'})": bodies
        != ["object"],
        "a site named grip in that body, at the height of the jaws": "grip"
        not in [s.name for s in spec.sites],
        "only hinge and slide joints: the object must not fly away": any(
            joint.type not in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE) for joint in spec.joints
        ),
        "no flex; describe an elastic object as YAML": bool(len(spec.flexes)),
        "no geom outside of that body, no light and no camera, which belong to the scene": bool(
            len(spec.worldbody.geoms) + len(spec.lights) + len(spec.cameras)
        ),
        "no mocap body, which nothing moves": any(body.mocap for body in spec.bodies),
        "meshes or 2d textures instead of height fields and cube textures from files": any(
            field.file for field in spec.hfields
        )
        or any(any(texture.cubefiles) for texture in spec.textures),
        "a geom with conaffinity, which the pads can touch": not any(
            geom.conaffinity & 1 or geom.contype & 1 for geom in spec.geoms
        ),
    }
    if needs := [text for text, is_wrong in wrong.items() if is_wrong]:
        raise ConfigError(f"the simulated object {path} needs {'; and '.join(needs)}")
    _compile(spec, path)
    return spec


def _compile(spec: Any, path: Path) -> Any:
    try:
        return spec.compile()
    except ValueError as error:
        raise ConfigError(f"MuJoCo refuses {path}: {' '.join(str(error).split())}; correct it") from error


def _mjcf_files(spec: Any) -> dict[str, bytes]:
    """Contents of a specification's meshes and textures, by new names, which no file of the scene has."""
    folder = Path(spec.modelfiledir)
    files = [(spec.meshdir, mesh) for mesh in spec.meshes] + [
        (spec.texturedir, item) for item in spec.textures
    ]
    contents = {}
    for number, (subfolder, item) in enumerate(files):
        if item.file:
            content = read_bytes(folder / (subfolder or "") / item.file, "file")
            item.file = f"own_{number}{Path(item.file).suffix}"
            contents[item.file] = content
    return contents
