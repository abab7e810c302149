"""Kinds of objects; ``python tests/hw/sim/test_kinds.py`` writes their table in docs/simulation.md."""

import hashlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from gripper_force.config import GripperConfig, SimConfig
from gripper_force.qualification.markdown_blocks import write_between
from gripper_hw.sim.engine import mujoco
from gripper_hw.sim.kinds import (
    FAMILIES,
    TEXTURES,
    Shell,
    Solid,
    Spring,
    held_out_kinds,
    load_kinds,
    training_kinds,
)
from gripper_hw.sim.objects import OBJECTS
from gripper_hw.sim.scene import Scene, draw_scene, scene_mjcf
from gripper_hw.sim.textures import PATTERNS
from gripper_hw.sim.world import Motor, World

PAGE = Path(__file__).parents[3] / "docs" / "simulation.md"
KINDS = load_kinds()
GRIPPER = GripperConfig()
WIDE = SimConfig(
    detail="coarse", size_spread=0.15, stiffness_octaves=1.0, view_spread=10.0, jaw_spread=1.0, markers=True
)

OLD_SCENES = {
    ("sponge", 3): "0831d9b6b76324e4",
    ("sponge", 100_000): "ae35aa67bb08c9ab",
    ("paper_cup", 3): "0a5be11ca49ae05a",
    ("paper_cup", 100_000): "54e9eaf95d59fcdd",
    ("tube", 3): "e9b4d2bef683ba6a",
    ("tube", 100_000): "b7673f60b97ff1fc",
    ("stapler", 3): "5b5be780516d5d17",
    ("stapler", 100_000): "9d0129d43377a0ba",
    ("ball", 3): "4c3e3b736a6d062f",
    ("ball", 100_000): "d283368598c8f1a5",
    ("block", 3): "05c294c624468954",
    ("block", 100_000): "67a96f705c1a3f39",
}
"""Digests of MJCF and textures of the objects that networks and profiles were made with, before there were kinds."""


def table() -> str:
    rows = [
        "| kind | family | shape | width x depth x height, mm | texture | for |",
        "|---|---|---|---|---|---|",
    ]
    for name, kind in KINDS.items():
        assert isinstance(kind, Solid | Shell | Spring)
        assert kind.size_m is not None
        shape = ("lying" if kind.lying else "standing") if isinstance(kind, Shell) else kind.shape
        size = " x ".join(f"{1e3 * length:.0f}" for length in kind.size_m)
        use = "tests" if kind.held_out else "training"
        rows.append(f"| `{name}` | {kind.family} | {shape} | {size} | {kind.texture} | {use} |")
    return "\n".join(rows)


@pytest.mark.parametrize(("name", "seed"), OLD_SCENES)
def test_scenes_of_old_objects_are_unchanged(name: str, seed: int) -> None:
    text, assets = scene_mjcf(draw_scene(name, seed, SimConfig()), GRIPPER)
    numbers = re.sub(r"-?\d*\.?\d+(e-?\d+)?", lambda m: repr(float(m[0])), text.split("-->", 1)[1])
    digest = hashlib.sha256(numbers.encode())
    for file in sorted(assets):
        digest.update(assets[file])
    assert digest.hexdigest()[:16] == OLD_SCENES[name, seed]


def test_training_and_held_out_kinds_are_many_and_cover_each_family() -> None:
    assert len(training_kinds()) >= 20
    assert len(held_out_kinds()) >= 4
    assert not set(training_kinds()) & set(held_out_kinds())
    assert not KINDS.keys() & OBJECTS.keys()
    for names in (training_kinds(), held_out_kinds()):
        assert {KINDS[name].family for name in names} == {"solid", "shell", "spring"}
    assert {kind.texture for kind in KINDS.values()} == PATTERNS.keys() - {"plain"}


@pytest.mark.parametrize("name", KINDS)
def test_each_kind_fits_between_the_jaws_at_any_size(name: str, squeeze: Callable[[float], Motor]) -> None:
    scene = draw_scene(name, 1, WIDE)
    assert scene == draw_scene(name, 1, WIDE)
    text, assets = scene_mjcf(scene, GRIPPER)
    assert (text, assets) == scene_mjcf(scene, GRIPPER)
    World(replace(scene, size=1.15), GRIPPER, squeeze(0), 1.0, 1, textured=False)
    mujoco.MjModel.from_xml_string(text, assets)


@pytest.mark.parametrize("stiffness", [0.5, 2.0])
@pytest.mark.parametrize("name", ["soft_box", "pear", "ridge", "can", "thin_ring", "peg", "knobs"])
def test_a_squeeze_reaches_its_force_and_ends(
    name: str, stiffness: float, squeeze: Callable[[float], Motor]
) -> None:
    scene = Scene(name, "coarse", stiffness=stiffness, yaw_deg=4, offset_m=(0.0015, 0.003), nm_per_a=1.0)
    scene = replace(scene, servo_friction_nm=0.0, jaw_friction_n=0.0)
    world = World(scene, GRIPPER, squeeze(12.5), 1.0, 0, textured=False)
    world.advance_to(1_200_000_000)
    assert world.force_n == pytest.approx(12.5, abs=1.0)


@pytest.mark.parametrize("name", ["orange", "bowl", "posts"])
def test_a_stiffer_object_gives_way_less(name: str) -> None:
    def closed_m(stiffness: float) -> float:
        text, assets = scene_mjcf(Scene(name, "coarse", stiffness=stiffness), GRIPPER, textured=False)
        model = mujoco.MjModel.from_xml_string(text, assets)
        data = mujoco.MjData(model)
        model.dof_frictionloss[:] = 0
        data.ctrl[0] = 2 * 5.0 * GRIPPER.pinion_radius_m
        model.dof_damping[model.joint("servo").dofadr] = 5.0 * GRIPPER.pinion_radius_m / 0.8
        while data.time < 1.5:
            mujoco.mj_step(model, data)
        return float(data.joint("right").qpos[0])

    soft_m, plain_m, stiff_m = (closed_m(stiffness) for stiffness in (0.5, 1.0, 2.0))
    assert soft_m - plain_m > 0.001
    assert plain_m - stiff_m > 0.0005


def test_every_attribute_of_a_kind_changes_its_body() -> None:
    common = {"size_m": (0.05, 0.03, 0.07), "grip": 0.4, "texture": "spots"}
    changes = {
        "solid": (
            "soft_box",
            {"modulus_pa": 5e4, "shape": "ball", "rounding": 0.5, "taper": 0.1, "dent": 0.1, "edge": 0.1},
        ),
        "shell": ("beaker", {"modulus_pa": 2e8, "radii": (0.6, 1.0), "lying": True, "wall_m": 0.003}),
        "spring": (
            "posts",
            {"shape": "ball", "n_per_mm": 9.0, "cubic_n_per_mm3": 9.0, "stop_m": 0.001, "hinge": "back"},
        ),
    }
    for family, (name, own) in changes.items():
        kind, values = KINDS[name], common | own
        assert values.keys() == FAMILIES[family].model_fields.keys() - {"family", "held_out", "mesh"}
        before = kind.build("coarse", 1.0, 1.0)
        for key, value in values.items():
            after = kind.model_copy(update={key: value}).build("coarse", 1.0, 1.0)
            assert after != before, (family, key)


def test_textures_are_the_patterns() -> None:
    assert set(TEXTURES) == PATTERNS.keys()


def test_page_has_the_table_of_kinds() -> None:
    assert table() in PAGE.read_text(encoding="utf-8"), "run: python tests/hw/sim/test_kinds.py"


if __name__ == "__main__":
    write_between(PAGE, "kinds", table())
