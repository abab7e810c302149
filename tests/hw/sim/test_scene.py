from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gripper_force.config import GripperConfig, SimConfig, load_config
from gripper_force.errors import ConfigError
from gripper_hw.sim.engine import mujoco
from gripper_hw.sim.scene import LUX_LEVELS, Scene, draw_scene, scene_mjcf


def test_scene_depends_on_seed_only() -> None:
    config = SimConfig()
    assert draw_scene("tube", 3, config) == draw_scene("tube", 3, config)
    first, second = asdict(draw_scene("tube", 3, config)), asdict(draw_scene("tube", 4, config))
    same = {name for name in first if first[name] == second[name]}
    assert same == {
        "object",
        "detail",
        "tool",
        "object_file",
        "camera_from_grip_m",
        "camera_aim_m",
        "camera_roll_deg",
        "camera_blur_px",
        "rod_length_m",
        "pad_half_m",
        "finger_half_m",
        "pad_gray",
        "finger_gray",
        "pad_rgb",
        "finger_rgb",
        "background",
        "markers",
        "changing_light",
        "moving_background",
    }


def test_configured_values_are_not_drawn() -> None:
    scene = draw_scene("cup", 3, SimConfig(randomise=False, lux=350, detail="fine", tool="rods"))
    assert scene == Scene("cup", "fine", "rods", lux=350.0)
    assert {draw_scene("cup", i, SimConfig(randomise=False)).lux for i in range(20)} == set(LUX_LEVELS)
    assert draw_scene("cup", 3, SimConfig(lux=350)).lux == pytest.approx(350, rel=0.051)


@pytest.mark.parametrize("randomise", [True, False])
def test_true_friction_and_torque_constant_change_nothing_else(randomise: bool) -> None:
    config = SimConfig(randomise=randomise)
    before = draw_scene("tube", 3, config)
    after = draw_scene("tube", 3, config.model_copy(update={"friction": 3.0, "gain": 1.4}))
    assert (after.servo_friction_nm, after.jaw_friction_n) == pytest.approx((0.09, 0.6))
    assert after.nm_per_a == 1.4
    drawn = {key: getattr(before, key) for key in ("servo_friction_nm", "jaw_friction_n", "nm_per_a")}
    assert replace(after, **drawn) == before


@pytest.mark.parametrize("randomise", [True, False])
def test_yaw_and_lux_change_nothing_else(randomise: bool) -> None:
    config = SimConfig(randomise=randomise, lux=550)
    asked = SimConfig(randomise=randomise, lux=350, yaw_deg=20)
    before, after = (draw_scene("tube", 3, c) for c in (config, asked))
    assert after.yaw_deg == before.yaw_deg + 20
    assert after.lux == pytest.approx(before.lux * 350 / 550)
    assert replace(after, yaw_deg=before.yaw_deg, lux=before.lux) == before


def test_scenes_of_old_logs_are_drawn_identically() -> None:
    scene = draw_scene("sponge", 100_000, SimConfig())
    assert (scene.yaw_deg, scene.lux, scene.texture_seed, scene.backlash_m) == (
        2.9191085508820542,
        363.61738826701986,
        270442807,
        0.00023587746804863647,
    )


def test_rod_length_is_drawn_and_changes_nothing_else() -> None:
    pads, rods = (draw_scene("tube", 3, SimConfig(tool=tool)) for tool in ("pads", "rods"))
    assert replace(rods, tool="pads", rod_length_m=pads.rod_length_m) == pads
    lengths_m = [draw_scene("tube", seed, SimConfig(tool="rods")).rod_length_m for seed in range(50)]
    assert 0.017 <= min(lengths_m) < 0.018 < 0.022 < max(lengths_m) <= 0.023


@given(st.integers(0, 2**32), st.integers(0, 2**32), st.integers(0, 2**32))
def test_seed_places_the_same_object_on_the_same_rig(own: int, seed: int, other: int) -> None:
    assume(seed != other)
    config = SimConfig(object_seed=own, rig_seed=own + 1, size_spread=0.15)
    first, again = (asdict(draw_scene("tube", s, config)) for s in (seed, other))
    assert {name for name in first if first[name] != again[name]} == {"offset_m", "yaw_deg"}
    itself = {"size", "stiffness", "texture_seed"}
    drawn = SimConfig(size_spread=0.15)
    of_object, of_rig = (asdict(draw_scene("tube", s, drawn)) for s in (own, own + 1))
    for name in first.keys() - {"offset_m", "yaw_deg"}:
        assert first[name] == (of_object if name in itself else of_rig)[name], name


def test_object_seed_draws_texture_and_rig_seed_draws_table() -> None:
    def textures(**seeds: int) -> dict[str, bytes]:
        return scene_mjcf(draw_scene("tube", 1, SimConfig.model_validate(seeds)), GripperConfig())[1]

    plain, other_object, other_rig = textures(), textures(object_seed=2), textures(rig_seed=2)
    assert plain["table.png"] == other_object["table.png"] != other_rig["table.png"]
    assert plain["tube.png"] == other_rig["tube.png"] != other_object["tube.png"]


@pytest.mark.parametrize(
    ("name", "spread"), [("size", 0.0), ("size", 0.15), ("stiffness", 0.0), ("stiffness", 0.3)]
)
def test_size_and_stiffness_fill_their_spread(name: str, spread: float) -> None:
    config = SimConfig.model_validate({f"{name}_spread": spread})
    off = [abs(getattr(draw_scene("tube", seed, config), name) - 1) for seed in range(50)]
    assert max(off) <= spread + 1e-12
    assert max(off) >= 0.8 * spread


@pytest.mark.parametrize(
    ("change", "drawn"),
    [
        ({"stiffness_octaves": 1.0}, {"stiffness"}),
        (
            {"view_spread": 10.0},
            {
                "camera_offset_m",
                "camera_target_offset_m",
                "camera_fovy_deg",
                "lux",
                "light_direction",
                "light_ambient",
            },
        ),
        ({"jaw_spread": 1.0}, {"pad_half_m", "finger_half_m", "pad_gray", "finger_gray"}),
    ],
)
def test_wider_spread_changes_nothing_else(change: dict[str, float], drawn: set[str]) -> None:
    before, after = (asdict(draw_scene("tube", 3, SimConfig.model_validate(keys))) for keys in ({}, change))
    assert {name for name in before if before[name] != after[name]} == drawn
    fixed = SimConfig.model_validate({"object_seed": 1, "rig_seed": 2, **change})
    first, again = (asdict(draw_scene("tube", seed, fixed)) for seed in (3, 4))
    assert {name for name in first if first[name] != again[name]} == {"offset_m", "yaw_deg"}


def test_stiffness_octaves_fill_half_to_double() -> None:
    config = SimConfig(stiffness_octaves=1.0, stiffness_spread=0.0)
    drawn = [draw_scene("tube", seed, config).stiffness for seed in range(200)]
    assert 0.5 <= min(drawn) < 0.53
    assert 1.9 < max(drawn) <= 2.0
    assert sum(value < 1 for value in drawn) == pytest.approx(100, abs=25)


def test_gauge_has_exact_size_and_stiffness() -> None:
    scene = draw_scene("block", 3, SimConfig(stiffness_spread=0.5))
    assert replace(draw_scene("tube", 3, SimConfig()), object="block", size=1.0, stiffness=1.0) == scene


def test_every_drawn_number_changes_the_model() -> None:
    gripper = GripperConfig()
    plain = Scene("sponge", "coarse", "rods")
    before = scene_mjcf(plain, gripper)
    drawn = asdict(
        draw_scene("sponge", 1, SimConfig(tool="rods", markers=True, moving_background=True, jaw_spread=1.0))
    )
    not_drawn = {"object", "object_file", "detail", "tool", "changing_light"}
    not_drawn |= {
        "camera_from_grip_m",
        "camera_aim_m",
        "camera_roll_deg",
        "pad_rgb",
        "finger_rgb",
        "background",
    }
    not_of_the_model = {"lux", "shot_noise", "camera_blur_px", "nm_per_a", "pad_half_m"}
    for name in drawn.keys() - not_drawn - not_of_the_model:
        after = scene_mjcf(replace(plain, **{name: drawn[name]}), gripper)
        if name not in ("texture_seed", "table_seed"):
            assert after[0] != before[0], name
        else:
            assert after[1] != before[1]


RIG: dict[str, Any] = {
    "camera.position_m": (0.05, -0.25, 0.1),
    "camera.aim_m": (0.0, 0.01, 0.0),
    "camera.fov_deg": 30.0,
    "camera.roll_deg": 20.0,
    "camera.blur_px": 0.8,
    "camera.noise": 0.05,
    "jaws.pad_m": (0.03, 0.02),
    "jaws.finger_m": 0.01,
    "jaws.pad_rgb": (0.9, 0.1, 0.1),
    "jaws.finger_rgb": (0.1, 0.9, 0.1),
    "light.direction": (0.4, 0.5, -0.7),
    "light.ambient": 0.6,
    "light.background": 0.5,
}
IN_IMAGE = {"camera.blur_px": "camera_blur_px", "camera.noise": "shot_noise"}
"""Keys that change the frame after rendering, and their attribute of the scene."""


def test_the_table_of_rig_keys_is_complete() -> None:
    sections = {name: SimConfig.model_fields[name].annotation for name in ("camera", "jaws", "light")}
    known = {f"{name}.{key}" for name, section in sections.items() for key in section.model_fields}  # type: ignore[union-attr]
    assert RIG.keys() == known


@pytest.mark.parametrize("key", RIG)
def test_each_key_of_a_rig_changes_the_scene(key: str) -> None:
    config = load_config(None, {f"sim.{key}": RIG[key]}).sim
    before, after = draw_scene("tube", 3, SimConfig()), draw_scene("tube", 3, config)
    if key in IN_IMAGE:
        assert getattr(after, IN_IMAGE[key]) == RIG[key] != getattr(before, IN_IMAGE[key])
    else:
        assert scene_mjcf(after, GripperConfig()) != scene_mjcf(before, GripperConfig())


def test_draws_deviate_from_the_configured_rig_as_from_the_default_one() -> None:
    config = load_config(None, {f"sim.{key}": value for key, value in RIG.items()}).sim
    for seed in range(20):
        before, after = draw_scene("tube", seed, SimConfig()), draw_scene("tube", seed, config)
        assert after.camera_offset_m == before.camera_offset_m
        assert after.camera_fovy_deg / 30 == pytest.approx(before.camera_fovy_deg / 17)
        moved = np.subtract(after.light_direction, before.light_direction)
        assert moved == pytest.approx(np.subtract(RIG["light.direction"], Scene.light_direction))
        assert after.light_ambient == pytest.approx(before.light_ambient + 0.3)


def test_roll_turns_the_camera_about_its_axis() -> None:
    def camera(roll_deg: float) -> np.ndarray:
        text, assets = scene_mjcf(Scene("block", "coarse", camera_roll_deg=roll_deg), GripperConfig())
        model = mujoco.MjModel.from_xml_string(text, assets)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return np.array(data.camera("camera").xmat.reshape(3, 3))

    level, turned = camera(0), camera(90)
    assert turned[:, 2] == pytest.approx(level[:, 2], abs=1e-5)
    assert turned[:, 0] == pytest.approx(level[:, 1], abs=1e-5)


def test_a_camera_may_look_straight_down_but_not_at_itself() -> None:
    down = Scene("block", "coarse", camera_from_grip_m=(0.0, 0.0, 0.3))
    assert 'xyaxes="1 0 0 0 1 0"' in scene_mjcf(down, GripperConfig())[0]
    with pytest.raises(ConfigError, match=r"aimed at itself; set sim\.camera\.aim_m"):
        scene_mjcf(replace(down, camera_aim_m=(0.0, 0.0, 0.3)), GripperConfig())


def test_template_is_complete_and_textures_exist() -> None:
    for name, texture in [
        ("sponge", "sponge.png"),
        ("paper_cup", "cup.png"),
        ("tube", "tube.png"),
        ("stapler", None),
        ("ball", "ball.png"),
        ("block", None),
    ]:
        text, assets = scene_mjcf(Scene(name, "coarse"), GripperConfig())
        assert "$" not in text.split("-->", 1)[1]
        assert set(assets) == {"table.png"} | ({texture} if texture else set())
        assert all(data.startswith(b"\x89PNG") for data in assets.values())


def test_pads_and_rods_touch_an_object_at_the_same_width() -> None:
    pads, rods = (
        mujoco.MjModel.from_xml_string(*scene_mjcf(Scene("stapler", "coarse", tool), GripperConfig()))
        for tool in ("pads", "rods")
    )
    for side, sign in (("left", 1), ("right", -1)):
        pad, rod = pads.geom(f"pad_{side}"), rods.geom(f"pad_{side}")
        assert (pad.type[0], rod.type[0]) == (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE)
        assert rod.pos[0] + sign * (rod.size[0] + rod.size[1]) == pytest.approx(sign * pad.size[0])
