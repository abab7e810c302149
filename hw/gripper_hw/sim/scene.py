"""Scenes: parameters drawn from the seed, and the MJCF made of them."""

import base64
import re
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from string import Template
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config, GripperConfig, SimConfig
from gripper_force.errors import ConfigError
from gripper_hw.sim.meshes import ObjectModel, numbers
from gripper_hw.sim.objects import GAUGES, PADS_ONLY, build_object, object_file

LUX_LEVELS = (350.0, 550.0, 750.0)
"""The paper's three light levels."""

# MuJoCo's default friction is soft: under a constant force it creeps, and vanishes within three seconds. All
# friction acts at the horn, because on light jaws friction this hard makes the pads chatter.
_HARD_FRICTION = 'solreffriction=".005 1" solimpfriction=".997 .999 .001"'
_COUPLING = '<equality><joint joint1="left" joint2="right" solref=".004 1"/></equality>'
_PAD_HALF_THICKNESS_M = 0.004
_OPEN_SPARE_M = {"rack": 0.004, "other": 0.001}
"""Travel of a jaw beyond the open position. Other linkages than a rack are near their dead centre there."""
_ROD_RADIUS_M = 0.012
_RAIL_ABOVE_GRIP_M = 0.085
_FINGER_X_M = {"pads": 0.009, "discs": 0.009, "rods": 0.022}
"""Distance of the finger behind the centre of a pad, by tool."""

_SECOND_FINGER_SEEDS = 50_000_000
_FINGER_PARAMETERS = ("nm_per_a", "servo_friction_nm", "servo_damping_nm_s", "jaw_friction_n", "backlash_m")
"""Parameters that each finger with its own servo draws for itself; the first seed of the second finger."""

BACKGROUND_OBJECTS = 4
"""Number of objects that move behind the grasped object in a scene with a moving background."""

_MARKER_MATERIALS = "".join(
    f'<texture name="marker_{i}" type="2d" file="marker_{i}.png"/>'
    f'<material name="marker_{i}" texture="marker_{i}" specular="0" shininess="0"/>'
    for i in (0, 1)
)

# One gray pixel, in place of textures that are never rendered.
_BLANK_PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVQIHWNoAAAAggCB8KrjIgAAAABJRU5ErkJggg=="
)


@dataclass(frozen=True)
class Scene:
    """Parameters of one scene. The numbers may be drawn from the seed.

    Attributes:
        object: Name of the object.
        detail: Level of detail of its mesh.
        tool: Ends of the jaws, ``pads``, ``discs`` or ``rods``.
        object_file: File of a user's object; empty for a shipped one.
        size: Factor on the object's lengths.
        stiffness: Factor on the object's force at a given travel.
        offset_m: Position of the object relative to the gripper's centre, x and y.
        yaw_deg: Rotation of the object about the vertical.
        camera_from_grip_m: Position of the camera, relative to the point between the jaws.
        camera_aim_m: Point the camera is aimed at, likewise.
        camera_offset_m: Offset of the camera's position.
        camera_target_offset_m: Offset of the point the camera is aimed at.
        camera_fovy_deg: Vertical field of view.
        camera_roll_deg: Rotation of the camera about its optical axis.
        camera_blur_px: Standard deviation of the lens's blur, in pixels of a frame.
        lux: Illumination.
        light_direction: Direction of the key light.
        light_ambient: Ambient share of the light.
        texture_seed: Seed of the object's texture.
        table_seed: Seed of the table's texture, the light's variation and the background.
        shot_noise: Standard deviation of the photon noise at full scale, as a share of it.
        nm_per_a: True torque constant divided by the catalogue's.
        servo_friction_nm: Coulomb friction of motor and gears at the horn.
        servo_damping_nm_s: Viscous friction at the horn.
        jaw_friction_n: Coulomb friction of one rail; applied at the horn.
        backlash_m: Half of the gear play at the rack.
        rod_length_m: Length of a rod beyond its finger (tool ``rods`` only).
        pad_half_m: Half of the depth and height of a pad; a disc has the smaller one as its radius.
        finger_half_m: Half of the depth of a finger.
        pad_gray: Brightness of the pads, 0 to 1, if they had the default colour.
        finger_gray: Brightness of the fingers, likewise.
        pad_rgb: Colour of the pads.
        finger_rgb: Colour of the fingers.
        background: Factor on the brightness of table and wall.
        markers: True if each finger carries an ArUco marker.
        changing_light: True if the light varies over time.
        moving_background: True if objects move in the background.
    """

    object: str
    detail: str
    tool: str = "pads"
    object_file: str = ""
    size: float = 1.0
    stiffness: float = 1.0
    offset_m: tuple[float, float] = (0.0, 0.0)
    yaw_deg: float = 0.0
    camera_from_grip_m: tuple[float, float, float] = (0.10, -0.30, 0.125)
    camera_aim_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_target_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera_fovy_deg: float = 17.0
    camera_roll_deg: float = 0.0
    camera_blur_px: float = 0.0
    lux: float = 550.0
    light_direction: tuple[float, float, float] = (-0.40, 0.55, -0.75)
    light_ambient: float = 0.30
    texture_seed: int = 0
    table_seed: int = 0
    shot_noise: float = 0.020
    nm_per_a: float = 1.0
    servo_friction_nm: float = 0.030
    servo_damping_nm_s: float = 0.010
    jaw_friction_n: float = 0.20
    backlash_m: float = 0.0003
    rod_length_m: float = 0.020
    pad_half_m: tuple[float, float] = (0.012, 0.011)
    finger_half_m: float = 0.008
    pad_gray: float = 0.17
    finger_gray: float = 0.78
    pad_rgb: tuple[float, float, float] = (0.16, 0.17, 0.19)
    finger_rgb: tuple[float, float, float] = (0.78, 0.78, 0.80)
    background: float = 1.0
    markers: bool = False
    changing_light: bool = False
    moving_background: bool = False


def draw_scene(object_name: str, seed: int, config: SimConfig) -> Scene:
    """Draws a scene. The same arguments give the same scene.

    Args:
        object_name: Name of the object.
        seed: Seed of the object's place, and of everything for which ``config`` has no seed.
        config: The sim section of the configuration: ``object_seed`` draws the object, ``rig_seed`` the
            gripper and its surroundings.
    """

    def draw(other_seed: int | None) -> Scene:
        return _draw(object_name, seed if other_seed is None else other_seed, config)

    file = object_file(object_name, config.object)
    placement, grasped, rig = draw(None), draw(config.object_seed), _of_rig(draw(config.rig_seed), config)
    if config.gain is not None:
        rig = replace(rig, nm_per_a=config.gain)
    if config.friction is not None:
        rig = replace(
            rig,
            servo_friction_nm=config.friction * Scene.servo_friction_nm,
            jaw_friction_n=config.friction * Scene.jaw_friction_n,
        )
    if config.stiffness is not None:
        grasped = replace(grasped, stiffness=config.stiffness)
    exact = object_name in GAUGES
    octaves = 0.0
    if config.randomise:
        # Keys that came later have random streams of their own, so that old scenes are drawn identically.
        rig = _draw_jaws(rig, seed if config.rig_seed is None else config.rig_seed, config.jaw_spread)
        own_seed = seed if config.object_seed is None else config.object_seed
        octaves = config.stiffness_octaves * float(np.random.default_rng([own_seed, 21]).uniform(-1, 1))
    return replace(
        rig,
        markers=config.markers,
        changing_light=config.changing_light,
        moving_background=config.moving_background,
        object_file="" if file is None else str(file),
        size=1.0 if exact or (file is not None and file.suffix == ".xml") else grasped.size,
        stiffness=1.0 if exact else grasped.stiffness * 2.0**octaves,
        texture_seed=grasped.texture_seed,
        offset_m=placement.offset_m,
        yaw_deg=placement.yaw_deg,
    )


def _draw(object_name: str, seed: int, config: SimConfig) -> Scene:
    rng = np.random.default_rng([seed, 0])
    lux = float(config.lux or rng.choice(LUX_LEVELS))
    if not config.randomise:
        return Scene(object_name, config.detail, config.tool, yaw_deg=config.yaw_deg, lux=lux)

    def offsets(*half_widths: float) -> tuple[float, ...]:
        return tuple(float(v) for v in rng.uniform(-1, 1, len(half_widths)) * half_widths)

    x, y = offsets(0.0015, 0.003)
    # The camera is mounted on the gripper: at a view_spread of 1 only the mounting's precision and the lens vary.
    view = config.view_spread
    ambient = min(view, 2.0)
    camera = offsets(*[0.003 * view] * 3)
    target = offsets(*[0.0015 * view] * 3)
    light = offsets(*[min(0.15 * view, 0.45)] * 3)
    return Scene(
        object_name,
        config.detail,
        config.tool,
        size=float(rng.uniform(1 - config.size_spread, 1 + config.size_spread)),
        stiffness=float(1 + rng.uniform(-1, 1) * config.stiffness_spread),
        offset_m=(x, y),
        yaw_deg=config.yaw_deg + float(rng.uniform(-4, 4)),
        camera_offset_m=(camera[0], camera[1], camera[2]),
        camera_target_offset_m=(target[0], target[1], target[2]),
        camera_fovy_deg=float(rng.uniform(17.0 - 0.2 * view, 17.0 + 0.2 * view)),
        lux=lux * float(rng.uniform(1 - min(0.05 * view, 0.4), 1 + min(0.05 * view, 0.4))),
        light_direction=(-0.40 + light[0], 0.55 + light[1], -0.75 + light[2]),
        light_ambient=float(rng.uniform(0.22 - 0.08 * (ambient - 1), 0.38 + 0.08 * (ambient - 1))),
        texture_seed=(texture_seed := int(rng.integers(2**31))),
        table_seed=texture_seed,
        shot_noise=float(rng.uniform(0.012, 0.024)),
        nm_per_a=float(rng.uniform(0.92, 1.08)),
        servo_friction_nm=float(rng.uniform(0.021, 0.039)),
        servo_damping_nm_s=float(rng.uniform(0.007, 0.013)),
        jaw_friction_n=float(rng.uniform(0.14, 0.26)),
        backlash_m=float(rng.uniform(0.0002, 0.0004)),
        # This varies more than the jaws' travel under force, so that travel alone does not give the force.
        rod_length_m=0.020 + (float(rng.uniform(-0.003, 0.003)) if config.tool == "rods" else 0.0),
    )


def _of_rig(scene: Scene, config: SimConfig) -> Scene:
    """Returns a scene with camera, jaws and light of a configuration; what was drawn is a deviation from them."""
    camera, jaws, light = config.camera, config.jaws, config.light
    shift = np.array(light.direction) - Scene.light_direction
    ambient = scene.light_ambient + (light.ambient - Scene.light_ambient)
    return replace(
        scene,
        camera_from_grip_m=camera.position_m,
        camera_aim_m=camera.aim_m,
        camera_fovy_deg=scene.camera_fovy_deg * (camera.fov_deg / Scene.camera_fovy_deg),
        camera_roll_deg=camera.roll_deg,
        camera_blur_px=camera.blur_px,
        shot_noise=scene.shot_noise if camera.noise is None else camera.noise,
        light_direction=tuple((np.array(scene.light_direction) + shift).tolist()),
        light_ambient=min(max(ambient, 0.0), 1.0),
        pad_half_m=(jaws.pad_m[0] / 2, jaws.pad_m[1] / 2),
        finger_half_m=jaws.finger_m / 2,
        pad_rgb=jaws.pad_rgb,
        finger_rgb=jaws.finger_rgb,
        background=light.background,
    )


def _draw_jaws(rig: Scene, seed: int, spread: float) -> Scene:
    rng = np.random.default_rng([seed, 20])
    depth, height, finger, pad_gray, finger_gray = spread * rng.uniform(-1, 1, 5)
    return replace(
        rig,
        pad_half_m=(
            rig.pad_half_m[0] * float(1 + 0.3 * depth),
            rig.pad_half_m[1] * float(1 + 0.3 * height),
        ),
        finger_half_m=rig.finger_half_m * float(1 + 0.4 * finger),
        pad_gray=Scene.pad_gray + float(pad_gray * 0.15 if pad_gray < 0 else pad_gray * 0.65),
        finger_gray=Scene.finger_gray + float(finger_gray * (0.6 if finger_gray < 0 else 0.2)),
    )


def true_gripper(config: Config) -> GripperConfig:
    """Returns the simulated gripper's geometry, which can differ from what the controller believes."""
    width_m = config.sim.open_width_m
    return config.gripper if width_m is None else config.gripper.model_copy(update={"open_width_m": width_m})


def draw_second_finger(scene: Scene, seed: int, config: SimConfig) -> Scene:
    """Returns a scene with motor, gears and rail of a second finger; ``seed`` and ``config`` as for `draw_scene`."""
    rig_seed = seed if config.rig_seed is None else config.rig_seed
    other = _draw(scene.object, rig_seed + _SECOND_FINGER_SEEDS, config)
    return replace(scene, **{name: getattr(other, name) for name in _FINGER_PARAMETERS})


def horn_dynamics(scene: Scene, pinion_radius_m: float, rails: int) -> tuple[float, float, float, float]:
    """Returns the rotor's inertia in kg m2, damping in Nm s and friction in Nm, and its rails' friction in Nm."""
    rail_friction_nm = rails * pinion_radius_m * scene.jaw_friction_n
    return 1e-3, scene.servo_damping_nm_s, scene.servo_friction_nm, rail_friction_nm


def scene_mjcf(
    scene: Scene, gripper: GripperConfig, *, textured: bool = True, second: Scene | None = None
) -> tuple[str, dict[str, bytes]]:
    """Returns the MJCF text of a scene, and its assets by file name.

    Args:
        scene: The scene.
        gripper: The gripper's geometry.
        textured: False for blank textures, if the scene is never rendered.
        second: Motor, gears and rail of the left finger (see `draw_second_finger`); None: one servo drives both.

    Raises:
        ConfigError: The object does not exist, or the tool is not suitable for it.
    """
    if scene.tool == "rods" and scene.object in PADS_ONLY:
        raise ConfigError(
            f"sim.tool=rods would dent the simulated {scene.object} beyond its model; set sim.tool=pads"
        )
    file = Path(scene.object_file) if scene.object_file else None
    model = build_object(scene.object, scene.detail, scene.size, scene.stiffness, file)  # type: ignore[arg-type]
    text = _filled_template(scene, gripper, model, second)
    if model.spec is not None:
        from gripper_hw.sim.object_files import attach

        text = attach(text, model, dict.fromkeys(re.findall(r'file="(.+?)"', text), _BLANK_PNG))
    if not textured:
        return text, dict.fromkeys(re.findall(r'file="(.+?)"', text), _BLANK_PNG) | model.files
    from gripper_hw.sim.textures import draw_markers, draw_textures

    pattern = None if model.texture in model.files else model.texture
    images = draw_textures(pattern, scene.texture_seed, scene.table_seed)
    return text, images | (draw_markers() if scene.markers else {}) | model.files


def _filled_template(scene: Scene, gripper: GripperConfig, model: ObjectModel, second: Scene | None) -> str:
    """Returns the MJCF text of a scene; an object with its own MJCF file is not yet in it."""
    grip_m = np.array([0.0, 0.0, model.grip_height_m])
    camera_m = grip_m + scene.camera_from_grip_m + scene.camera_offset_m
    aim_m = grip_m + scene.camera_aim_m + scene.camera_target_offset_m
    rail_height_m = model.grip_height_m + _RAIL_ABOVE_GRIP_M
    template = Template(resources.files(__package__).joinpath("assets/gripper.xml").read_text("utf-8"))
    radius_m, rails = gripper.pinion_radius_m, 2 if second is None else 1
    inertia_kg_m2, damping_nm_s, friction_nm, rail_friction_nm = horn_dynamics(scene, radius_m, rails)
    return template.substitute(
        object=escape(scene.object, {'"': "&quot;"}),
        timestep_s=model.timestep_s,
        object_material=_material(model),
        light_direction=numbers(scene.light_direction),
        light_diffuse=numbers([1.0 - scene.light_ambient] * 3),
        light_ambient=numbers([scene.light_ambient] * 3),
        camera_position=numbers(camera_m),
        camera_axes=numbers(_camera_axes(camera_m, aim_m, scene.camera_roll_deg)),
        camera_fovy=scene.camera_fovy_deg,
        object_position=numbers([*scene.offset_m, 0.0]),
        object_yaw=scene.yaw_deg,
        object_body=model.body,
        contact=model.contact,
        jaw_start=numbers([gripper.open_width_m / 2 + _PAD_HALF_THICKNESS_M]),
        open_spare=_OPEN_SPARE_M["rack" if gripper.linkage.kind == "rack" else "other"],
        jaw_travel=numbers([gripper.open_width_m / 2 - 0.001]),
        background=_background(scene),
        left_tool=_tool(scene, -1),
        right_tool=_tool(scene, 1),
        finger_half=numbers([scene.finger_half_m]),
        pad_rgb=numbers(np.array(scene.pad_rgb) * scene.pad_gray / Scene.pad_gray),
        finger_rgb=numbers(np.array(scene.finger_rgb) * scene.finger_gray / Scene.finger_gray),
        table_rgb="" if scene.background == 1.0 else f' rgba="{numbers([*3 * [scene.background], 1])}"',
        wall_rgb=numbers(np.array([0.33, 0.35, 0.38]) * scene.background),
        left_marker=_marker(scene, -1),
        right_marker=_marker(scene, 1),
        marker_materials=_MARKER_MATERIALS if scene.markers else "",
        finger_x=_FINGER_X_M[scene.tool],
        grip_height=numbers([model.grip_height_m]),
        rail_height=numbers([rail_height_m]),
        rotor_inertia=inertia_kg_m2,
        servo_damping=damping_nm_s,
        friction_nm=friction_nm + rail_friction_nm,
        hard_friction=_HARD_FRICTION,
        backlash_m=scene.backlash_m,
        pinion_radius_m=radius_m,
        **_finger_coupling(second, radius_m, rail_height_m),
    )


def _finger_coupling(second: Scene | None, radius_m: float, rail_height_m: float) -> dict[str, str]:
    """Returns the parts of the template that couple the fingers, or drive the second one by its own servo."""
    if second is None:
        return {"coupling": _COUPLING, **dict.fromkeys(("second_horn", "second_rack", "second_motor"), "")}
    inertia_kg_m2, damping_nm_s, friction_nm, rail_friction_nm = horn_dynamics(second, radius_m, rails=1)
    horn = (
        f'<body name="second_horn" pos="-.03 0 {numbers([rail_height_m])}"><joint name="second_servo" type="hinge" '
        f'axis="0 -1 0" armature="{inertia_kg_m2}" damping="{damping_nm_s}" '
        f'frictionloss="{friction_nm + rail_friction_nm}" {_HARD_FRICTION}/><geom type="cylinder" '
        'size=".012 .006" euler="90 0 0" material="steel" contype="0" conaffinity="0" mass=".005"/></body>'
    )
    rack = (
        f'<fixed name="second_rack" range="-{second.backlash_m} {second.backlash_m}" solreflimit=".004 1">'
        f'<joint joint="left" coef="1"/><joint joint="second_servo" coef="-{radius_m}"/></fixed>'
    )
    motor = '<motor name="second_servo" joint="second_servo"/>'
    return {"coupling": "", "second_horn": horn, "second_rack": rack, "second_motor": motor}


def _tool(scene: Scene, side: int) -> str:
    if scene.tool == "pads":
        return f'type="box" size="{numbers([_PAD_HALF_THICKNESS_M, *scene.pad_half_m])}"'
    if scene.tool == "discs":
        return (
            f'type="cylinder" size="{numbers([min(scene.pad_half_m), _PAD_HALF_THICKNESS_M])}" euler="0 90 0"'
        )
    # The tip of a rod of 20 mm is at the position of a pad's face.
    root = _ROD_RADIUS_M - _PAD_HALF_THICKNESS_M + 0.020
    ends = numbers([side * (root - scene.rod_length_m), 0, 0, side * root, 0, 0])
    return f'type="capsule" size="{_ROD_RADIUS_M}" fromto="{ends}"'


def _marker(scene: Scene, side: int) -> str:
    """Plate on a jaw, at the position of a pad's finger: nearer to the object it would hide the contact."""
    if not scene.markers:
        return ""
    position = numbers([side * _FINGER_X_M["pads"], -0.0125, 0.0])
    return (
        f'<geom type="box" size=".008 .008 .0003" euler="90 0 0" pos="{position}" contype="0" conaffinity="0" '
        f'mass="0" material="marker_{(side + 1) // 2}"/>'
    )


def _background(scene: Scene) -> str:
    """Boxes and ellipsoids, from dark to bright; `World` moves them."""
    if not scene.moving_background:
        return ""
    sizes_m = np.random.default_rng(scene.table_seed).uniform(0.008, 0.025, (BACKGROUND_OBJECTS, 3))
    return "".join(
        f'<geom name="background_{i}" type="{"ellipsoid" if i % 2 else "box"}" size="{numbers(size_m)}" '
        f'rgba="{numbers([*(3 * [(i + 1) / BACKGROUND_OBJECTS]), 1])}" contype="0" conaffinity="0"/>'
        for i, size_m in enumerate(sizes_m)
    )


def _material(model: ObjectModel) -> str:
    if model.texture is None:
        return '<material name="object" rgba=".55 .16 .13 1" specular=".35" shininess=".4"/>'
    return (
        f'<texture name="object" type="2d" file="{model.texture}"/>'
        '<material name="object" texture="object" specular=".05" shininess=".1"/>'
    )


def _camera_axes(
    position: npt.NDArray[np.float64], target: npt.NDArray[np.float64], roll_deg: float
) -> npt.NDArray[np.float64]:
    """Returns the camera's axes to the right and up, (6,). A camera that looks straight down has +y on top."""
    backward = position - target
    if (distance_m := np.linalg.norm(backward)) < 1e-3:
        raise ConfigError("the simulated camera is aimed at itself; set sim.camera.aim_m to another point")
    backward = backward / distance_m
    right = np.cross([0.0, 0.0, 1.0], backward)
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    up = np.cross(backward, right)
    if roll_deg:
        c, s = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
        right, up = c * right + s * up, c * up - s * right
    return np.concatenate([right, up])
