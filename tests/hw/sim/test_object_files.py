"""Objects and rigs of a user: the shipped examples, the examples of docs/simulation.md, and files that are refused."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from gripper_force.config import Config, GripperConfig, SimConfig, config_from, load_config
from gripper_force.errors import ConfigError
from gripper_hw.sim.kinds import Solid
from gripper_hw.sim.object_files import digest, read_object
from gripper_hw.sim.scene import draw_scene, scene_mjcf
from gripper_hw.sim.simulated_rig import SimulatedRig
from gripper_hw.sim.world import Motor, World

ROOT = Path(__file__).parents[3]
OBJECTS = sorted(path for path in (ROOT / "examples/objects").iterdir() if path.suffix in (".yaml", ".xml"))
RIGS = sorted((ROOT / "examples/rigs").glob("*.yaml"))
PAGE = (ROOT / "docs/simulation.md").read_text(encoding="utf-8")
GRIPPER = GripperConfig()
SOLID = "family: solid\nsize_m: [0.05, 0.05, 0.05]\nmodulus_pa: 30000\n"
CUBE = """v 0 0 0
v 40 0 0
v 0 50 0
v 40 50 0
v 0 0 60
v 40 0 60
v 0 50 60
v 40 50 60
f 1 3 2
f 2 3 4
f 5 6 7
f 6 8 7
f 1 2 5
f 2 6 5
f 3 7 4
f 4 7 8
f 1 5 3
f 3 5 7
f 2 4 6
f 4 8 6
"""


@pytest.fixture
def world(squeeze: Callable[[float], Motor]) -> Callable[..., World]:
    """Makes a world with an object's file."""

    def make(path: Path, seed: int = 0, **sim: object) -> World:
        config = config_from({"object": str(path), "sim": {"detail": "medium", **sim}}, "test")
        scene = draw_scene(config.object, seed, config.sim)
        scene = replace(scene, nm_per_a=1.0, servo_friction_nm=0.0, jaw_friction_n=0.0)
        return World(scene, GRIPPER, squeeze(8.0), 1.0, seed, textured=False)

    return make


def frame(config: Config) -> np.ndarray:
    rig = SimulatedRig(config)
    try:
        rig.camera.start()
        rig.clock.sleep_until_ns(60_000_000)
        taken = rig.camera.newest()
        assert taken is not None
        return taken.gray
    finally:
        rig.close()


def on_page(name: str) -> str:
    """The YAML block of the page after the name of its file."""
    found = re.search(rf"`{name}`.*?```yaml\n(.*?)```", PAGE, re.DOTALL)
    assert found is not None
    return found[1]


@pytest.mark.parametrize("path", OBJECTS, ids=lambda path: path.stem)
def test_a_squeeze_of_an_example_ends_at_its_force(path: Path, world: Callable[..., World]) -> None:
    squeezed = world(path, 3)
    squeezed.advance_to(1_200_000_000)
    assert squeezed.force_n == pytest.approx(8.0, abs=0.3)


@pytest.mark.parametrize("path", RIGS, ids=lambda path: path.stem)
def test_an_example_rig_shows_the_object(path: Path) -> None:
    cheap = ["seed=3", "sim.detail=coarse", "camera.rate_hz=30"]
    empty, full = (
        frame(load_config(path, [f"object={name}", "servo.port=virtual:shown", *cheap]))
        for name in ("none", OBJECTS[0])
    )
    changed = np.abs(full.astype(int) - empty) > 8
    assert 0.03 < changed.mean() < 0.7


def test_the_examples_of_the_page_are_complete(tmp_path: Path, world: Callable[..., World]) -> None:
    (tmp_path / "peach.yaml").write_text(on_page("peach.yaml"), encoding="utf-8")
    (tmp_path / "bench.yaml").write_text(on_page("bench.yaml"), encoding="utf-8")
    squeezed = world(tmp_path / "peach.yaml")
    squeezed.advance_to(1_200_000_000)
    assert squeezed.force_n == pytest.approx(8.0, abs=0.3)
    overrides = [f"object={tmp_path / 'peach.yaml'}", "servo.port=virtual:page"]
    taken = frame(load_config(tmp_path / "bench.yaml", overrides))
    assert 40 < taken.mean() < 200
    assert taken.std() > 15


def test_every_key_of_an_object_is_on_the_page() -> None:
    from gripper_hw.sim.kinds import FAMILIES

    section = PAGE.split("## Your own object")[1].split("## Your own rig")[0]
    keys = {key for family in FAMILIES.values() for key in family.model_fields} - {"held_out"}
    assert {key for key in keys if f"`{key}`" not in section} == set()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("- 3", "must hold a mapping"),
        ("family: [solid]", "'family'.*set one of solid, shell, spring"),
        (SOLID + 'texture: "x\\0.png"', "can't read the texture"),
        ("size_m: [0.05, 0.05, 0.05]", "'family'.*set one of solid, shell, spring"),
        (SOLID + "modulos_pa: 3", "unknown simulated object key 'modulos_pa'"),
        ("family: solid\nsize_m: [0.05, 0.05, 0.05]", "'modulus_pa'.*required"),
        (SOLID.replace("30000", "100"), "'modulus_pa'.*greater than or equal to 2000"),
        (SOLID.replace("30000", "2500000"), "too stiff to be simulated as elastic; set at most 1.9e"),
        (SOLID.replace("[0.05,", "[0.15,"), "does not fit between jaws that open 92 mm"),
        (SOLID + "texture: zebra", "texture 'zebra' is neither stripes"),
        (SOLID + "texture: zebra.png", r"can't read the texture .*zebra\.png"),
        (SOLID + "texture: text.png", r"texture .*text\.png is not a PNG image"),
        (SOLID + "mesh: {file: cube.obj, unit: mm}", "either size_m, or a mesh"),
        ("family: solid\nmodulus_pa: 3e4\nshape: ball\nmesh: {file: cube.obj, unit: mm}", "leave out shape"),
        ("family: solid\nmodulus_pa: 30000\nmesh: {file: none.obj, unit: mm}", "can't read the mesh"),
        ("family: solid\nmodulus_pa: 30000\nmesh: {file: text.obj, unit: mm}", "can't read the mesh"),
        ("family: solid\nmodulus_pa: 30000\nmesh: {file: open.obj, unit: mm}", "not closed: 3 edges"),
        (
            "family: solid\nmodulus_pa: 30000\nmesh: {file: cube.obj, unit: m}",
            "measures 40000 x 50000 x 60000 mm",
        ),
        (
            "family: shell\nsize_m: [0.06, 0.06, 0.08]\nradii: [1, 1]\nwall_m: 0.0003\nmodulus_pa: 1000000",
            "the wall would fold flat; set modulus_pa from",
        ),
        (
            "family: shell\nsize_m: [0.06, 0.03, 0.08]\nradii: [1, 1]\nwall_m: 0.0006\nmodulus_pa: 20000000",
            "0.06 m wide and 0.03 m deep, but shells are round",
        ),
        (
            "family: spring\nsize_m: [0.05, 0.05, 0.05]\nn_per_mm: 2\nstop_m: 0.03",
            "more than 0.4 of the width",
        ),
        (
            "family: spring\nsize_m: [0.02, 0.05, 0.09]\nshape: roll\nn_per_mm: 2\nstop_m: 0.003\ngrip: 0.2",
            "jaws would pass",
        ),
        ("format: gripper-force-object/1", r"not a simulated object; pass an object profile with --profile"),
    ],
)
def test_an_object_that_cannot_be_simulated_is_refused(
    text: str, reason: str, tmp_path: Path, world: Callable[..., World]
) -> None:
    (tmp_path / "thing.yaml").write_text(text, encoding="utf-8")
    (tmp_path / "cube.obj").write_text(CUBE, encoding="utf-8")
    (tmp_path / "open.obj").write_text(CUBE.rsplit("f ", 1)[0], encoding="utf-8")
    for name in ("text.obj", "text.png"):
        (tmp_path / name).write_text("hello", encoding="utf-8")
    with pytest.raises(ConfigError, match=reason) as raised:
        world(tmp_path / "thing.yaml")
    assert "\n" not in str(raised.value)


BODY = '<body name="object" pos="0 0 .03"><site name="grip"/>{}</body>'


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("<geom", "MuJoCo can't read"),
        ('<geom size=".02"/>', r"exactly one body .*it has none\); and a site named grip"),
        (BODY.format('<geom size=".02"/>') + '<body name="more"/>', "it has object, more"),
        (BODY.format('<freejoint/><geom size=".02"/>'), "only hinge and slide joints"),
        (BODY.format('<geom size=".02" contype="0" conaffinity="0"/>'), "a geom with conaffinity"),
        (BODY.format('<geom size=".02"/>') + '<geom size=".01"/>', "no geom outside of that body"),
        (BODY.format('<light/><geom size=".02"/>'), "no light and no camera"),
        (BODY.format('<geom size=".06"/>'), "does not fit between jaws"),
        (BODY.format('<geom size=".004" pos="0 0 .05"/>'), "jaws would pass"),
        (BODY.format('<geom type="mesh" mesh="no"/>'), "MuJoCo can't read|MuJoCo refuses"),
        (BODY.format('<geom size=".02"/>').replace("pos", 'mocap="true" pos'), "no mocap body"),
    ],
)
def test_an_mjcf_body_that_cannot_be_gripped_is_refused(
    body: str, reason: str, tmp_path: Path, world: Callable[..., World]
) -> None:
    path = tmp_path / "thing.xml"
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>", encoding="utf-8")
    with pytest.raises(ConfigError, match=reason):
        world(path)


def test_a_file_with_a_quote_in_its_name_and_options_of_its_own_is_simulated(
    tmp_path: Path, world: Callable[..., World]
) -> None:
    path = tmp_path / 'a"b.yaml'
    path.write_text(SOLID, encoding="utf-8")
    assert world(path).unknowns > 0
    path = tmp_path / "own.xml"
    body = BODY.format('<geom size=".02"/>')
    text = f'<mujoco><option timestep="0.01"/><worldbody>{body}</worldbody></mujoco>'
    path.write_text(text, encoding="utf-8")
    assert world(path).unknowns > 0  # without a warning that the scene's options win


def test_files_of_an_mjcf_body_may_have_any_name(tmp_path: Path) -> None:
    textures = ("one/a.png", "two/a.png", "table.png")
    for name, shade in zip(textures, (40, 120, 250), strict=True):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.full((8, 8, 3), shade, np.uint8))
    assets = "".join(
        f'<texture name="t{i}" type="2d" file="{name}"/><material name="m{i}" texture="t{i}"/>'
        for i, name in enumerate(textures)
    )
    geoms = "".join(
        f'<geom type="box" size=".02 .015 .01" pos="0 0 {0.02 * i}" mass=".1" material="m{i}"/>'
        for i in range(3)
    )
    path = tmp_path / "thing.xml"
    path.write_text(
        f"<mujoco><asset>{assets}</asset><worldbody>{BODY.format(geoms)}</worldbody></mujoco>",
        encoding="utf-8",
    )
    text, files = scene_mjcf(draw_scene("thing", 3, SimConfig(object=path)), GRIPPER)
    images = {
        name: np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), 0)) for name, data in files.items()
    }
    assert {image[0, 0] for name, image in images.items() if name.startswith("own_")} == {40, 120, 250}
    assert "table.png" in text
    assert images["table.png"].std() > 0, "the scene keeps its own"


def test_an_mjcf_body_may_have_a_tendon_of_its_own(tmp_path: Path, world: Callable[..., World]) -> None:
    slide = 'type="slide" range="-.001 .02" limited="true" damping="5" armature=".02"'
    parts = "".join(
        f'<body pos="{side * 0.02} 0 0"><joint name="{name}" axis="{-side} 0 0" {slide}/>'
        '<geom type="box" size=".004 .02 .02"/></body>'
        for name, side in (("left_part", -1), ("right_part", 1))
    )
    path = tmp_path / "clip.xml"
    path.write_text(
        f"<mujoco><worldbody>{BODY.format(parts)}</worldbody><tendon><fixed name='spring' stiffness='400' "
        "springlength='0 0'><joint joint='left_part' coef='1'/><joint joint='right_part' coef='1'/></fixed></tendon>"
        "</mujoco>",
        encoding="utf-8",
    )
    squeezed = world(path)
    squeezed.advance_to(1_200_000_000)
    assert squeezed.force_n == pytest.approx(8.0, abs=0.3)


def test_parts_of_an_mjcf_body_may_touch_each_other(tmp_path: Path, world: Callable[..., World]) -> None:
    parts = "".join(
        f'<body pos="{side * 0.01} 0 0"><joint type="slide" axis="1 0 0" stiffness="1000" damping="5"/>'
        '<geom type="box" size=".0101 .015 .02" mass=".05"/></body>'
        for side in (-1, 1)
    )
    path = tmp_path / "pair.xml"
    path.write_text(f"<mujoco><worldbody>{BODY.format(parts)}</worldbody></mujoco>", encoding="utf-8")
    squeezed = world(path)
    squeezed.advance_to(1_200_000_000)
    assert squeezed.force_n == pytest.approx(8.0, abs=0.3)


def test_stiffness_multiplies_that_of_the_joints(world: Callable[..., World]) -> None:
    def width_m(stiffness: float) -> float:
        pressed = world(ROOT / "examples/objects/spring_clamp.xml", stiffness=stiffness)
        pressed.advance_to(1_200_000_000)
        return float(pressed._data.joint("right").qpos[0])

    soft, plain, stiff = (width_m(factor) for factor in (0.8, 1.0, 2.0))
    # 8 N press each spring of 2 N/mm by 4 mm.
    assert plain - stiff == pytest.approx(0.002, abs=2e-4)
    assert soft - plain == pytest.approx(0.001, abs=2e-4)


def test_a_mesh_is_a_box_if_it_has_the_corners_of_one(tmp_path: Path, world: Callable[..., World]) -> None:
    (tmp_path / "cube.obj").write_text(CUBE, encoding="utf-8")
    text = "family: solid\nmodulus_pa: 30000\nmesh: {file: cube.obj, unit: mm, turn_deg: [0, 0, 90]}"
    (tmp_path / "crate.yaml").write_text(text, encoding="utf-8")
    box = SOLID.replace("[0.05, 0.05, 0.05]", "[0.05, 0.04, 0.06]") + "rounding: 0"
    (tmp_path / "box.yaml").write_text(box, encoding="utf-8")
    crate, plain = (world(tmp_path / f"{name}.yaml", randomise=False) for name in ("crate", "box"))
    for one in (crate, plain):
        one.advance_to(1_200_000_000)
    travel_m = [float(one._data.joint("right").qpos[0]) for one in (crate, plain)]
    assert travel_m[0] == pytest.approx(travel_m[1], abs=0.001)


def test_the_digest_covers_every_file(tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE, encoding="utf-8")
    path = tmp_path / "crate.yaml"
    path.write_text("family: solid\nmodulus_pa: 30000\nmesh: {file: cube.obj, unit: mm}", encoding="utf-8")
    before = digest(path)
    assert before == digest(path)
    (tmp_path / "cube.obj").write_text(CUBE.replace("60", "61"), encoding="utf-8")
    after = digest(path)
    path.write_text(path.read_text(encoding="utf-8").replace("30000", "30001"), encoding="utf-8")
    assert len({before, after, digest(path)}) == 3
    assert digest(ROOT / "examples/objects/spring_clamp.xml") != before


@pytest.mark.parametrize(
    "body",
    [
        ('<include file="part.xml"/>', ""),
        ('<frame><attach model="m" body="part" prefix="p"/></frame>', '<model name="m" file="part.xml"/>'),
    ],
    ids=["include", "model"],
)
def test_the_digest_of_an_mjcf_body_covers_what_it_includes(body: tuple[str, str], tmp_path: Path) -> None:
    path = tmp_path / "whole.xml"
    inner, asset = body
    path.write_text(
        f"<mujoco><asset>{asset}</asset><worldbody>{BODY.format(inner)}</worldbody></mujoco>",
        encoding="utf-8",
    )
    digests = set()
    for size in (0.02, 0.03):
        part = f'<body name="part"><geom type="sphere" size="{size}"/></body>'
        part = f"<worldbody>{part}</worldbody>" if asset else part
        (tmp_path / "part.xml").write_text(f"<mujoco>{part}</mujoco>", encoding="utf-8")
        assert digest(path) == digest(path)
        digests.add(digest(path))
    assert len(digests) == 2


def test_paths_in_an_object_file_are_relative_to_it() -> None:
    kind = read_object(ROOT / "examples/objects/figurine.yaml")
    assert isinstance(kind, Solid)
    assert kind.mesh is not None
    assert Path(kind.mesh.file) == ROOT / "examples/objects/figurine.stl"


@pytest.mark.parametrize("name", ["sponge", "soft_box", "none"])
def test_a_file_with_the_name_of_a_shipped_object_is_refused(
    name: str, tmp_path: Path, world: Callable[..., World]
) -> None:
    path = tmp_path / f"{name}.yaml"
    path.write_text(SOLID, encoding="utf-8")
    with pytest.raises(ConfigError, match="has the name of a shipped one; rename the file"):
        world(path)


def test_another_object_than_that_of_the_file_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"the object is 'tube', but sim\.object is peach\.yaml"):
        draw_scene("tube", 0, SimConfig(object=Path("peach.yaml")))


@pytest.mark.parametrize("fov_deg", [2, 4, 17])
def test_a_camera_that_sees_a_part_of_the_object_is_accepted(
    fov_deg: float, squeeze: Callable[[float], Motor]
) -> None:
    config = config_from({"sim": {"camera": {"fov_deg": fov_deg}, "randomise": False}}, "test")
    World(draw_scene("sponge", 0, config.sim), GRIPPER, squeeze(0), 1.0, 0).close()


@pytest.mark.parametrize(
    ("camera", "reason"),
    [
        ({"position_m": [0, -0.3, -0.2]}, "below the table"),
        ({"position_m": [0, 0.5, 0.1], "aim_m": [0, 0, 0]}, "behind the wall"),
        ({"position_m": [0.054, 0, 0.03]}, "inside the right or within 15 mm"),
        ({"position_m": [0.001, 0, 0]}, "inside the object or within 15 mm"),
        ({"aim_m": [0.9, -0.3, 0.1]}, "sees neither a pad nor the object"),
        ({"position_m": [0, -0.3, 0], "aim_m": [0, -0.3, 0]}, "aimed at itself"),
    ],
)
def test_a_camera_that_sees_nothing_is_refused(
    camera: dict[str, object], reason: str, squeeze: Callable[[float], Motor]
) -> None:
    config = config_from({"sim": {"camera": camera, "randomise": False}}, "test")
    scene = draw_scene("sponge", 0, config.sim)
    with pytest.raises(ConfigError, match=rf"{reason}.*sim\.camera|sim\.camera.*{reason}"):
        World(scene, GRIPPER, squeeze(0), 1.0, 0)


def test_the_log_names_the_file_and_its_digest() -> None:
    path = ROOT / "examples/objects/avocado.yaml"
    rig = SimulatedRig(
        load_config(None, [f"object={path}", "camera.backend=none", "servo.port=virtual:noted"])
    )
    try:
        notes = rig.notes()
    finally:
        rig.close()
    assert notes["object file"] == str(path)
    assert notes["object file sha256"] == digest(path)


def test_shipped_kinds_are_records_of_the_same_form(tmp_path: Path) -> None:
    """A shipped kind, copied to a file, is the same object but for its nodes' masses."""
    records = yaml.safe_load((ROOT / "hw/gripper_hw/sim/kinds.yaml").read_text(encoding="utf-8"))
    for name in ("pear", "can", "knobs"):
        path = tmp_path / f"my_{name}.yaml"
        path.write_text(yaml.safe_dump(records[name]), encoding="utf-8")
        own = config_from({"object": str(path)}, "test")
        shipped = scene_mjcf(draw_scene(name, 3, SimConfig()), GRIPPER)
        copied = scene_mjcf(draw_scene(own.object, 3, own.sim), GRIPPER)
        assert copied[0].replace(f"my_{name}", name) == shipped[0]
        assert copied[1] == shipped[1]
