import gc
import math
import os
import subprocess
import sys
import textwrap
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from gripper_force.config import GripperConfig
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.types import NS_PER_MS
from gripper_hw.sim.engine import NO_EGL, mujoco
from gripper_hw.sim.scene import Scene
from gripper_hw.sim.world import World

NM_PER_A = 1.78
RADIUS_M = GripperConfig().pinion_radius_m


class Current:
    """A motor with a constant current, and a brake so that it closes slowly."""

    def __init__(self, current_a: float, brake_a_s: float = 0.0) -> None:
        self.current_a = current_a
        self.brake_a_s = brake_a_s
        self.calls: list[tuple[int, float]] = []

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        self.calls.append((t_ns, position_rad))
        return self.current_a - self.brake_a_s * velocity_rad_s


@pytest.fixture
def make_world() -> Iterator[Callable[..., World]]:
    worlds: list[World] = []

    def make(motor: Current, seed: int = 0, **scene: object) -> World:
        drawn = Scene(**{"object": "stapler", "detail": "coarse"} | scene)  # type: ignore[arg-type]
        worlds.append(World(drawn, GripperConfig(), motor, NM_PER_A, seed))
        return worlds[-1]

    yield make
    for world in worlds:
        world.close()


@pytest.mark.parametrize(
    ("name", "open_mm"), [("sponge", 40), ("stapler", 40), ("paper_cup", 36), ("block", 30)]
)
def test_object_wider_than_the_open_jaws_is_refused(name: str, open_mm: int) -> None:
    gripper = GripperConfig(open_width_m=1e-3 * open_mm)
    with pytest.raises(ConfigError, match=f"'{name}' does not fit between jaws that open {open_mm} mm"):
        World(Scene(name, "coarse"), gripper, Current(0.0), NM_PER_A, 0)


@pytest.mark.parametrize("gain", [0.9, 1.1])
def test_grip_is_motor_torque_over_pinion_radius_minus_friction(
    make_world: Callable[..., World], gain: float
) -> None:
    current_a = 0.13
    scene = Scene("stapler", "coarse")
    world = make_world(Current(current_a, brake_a_s=0.02), nm_per_a=gain)
    world.advance_to(2500 * NS_PER_MS)
    given_n = gain * NM_PER_A * current_a / RADIUS_M / 2
    friction_n = scene.servo_friction_nm / RADIUS_M / 2 + scene.jaw_friction_n
    assert given_n - friction_n < world.force_n < given_n - 0.1 * friction_n


def test_motor_is_called_at_each_physics_step(make_world: Callable[..., World]) -> None:
    motor = Current(0.1)
    world = make_world(motor)
    world.advance_to(101 * NS_PER_MS)
    assert [t_ns for t_ns, _ in motor.calls] == list(range(0, 100 * NS_PER_MS, 2_500_000))
    assert world.t_ns == 100 * NS_PER_MS
    assert motor.calls[0][1] == 0.0
    assert motor.calls[-1][1] > 0.1


def test_periodic_call_is_made_at_each_multiple_of_its_period(make_world: Callable[..., World]) -> None:
    world = make_world(Current(0.0))
    calls: list[int] = []
    world.call_every(16_666_667, calls.append)
    world.advance_to(1000 * NS_PER_MS)
    assert len(calls) == 59
    late_ns = np.array(calls) - 16_666_667 * np.arange(1, 60)
    assert (late_ns >= 0).all()
    assert (late_ns <= 2_500_000).all()


@pytest.mark.parametrize(
    ("current_a", "why"),
    [
        (math.nan, "BADCTRL"),
        (math.inf, "BADCTRL"),
        (1e7, "BADQACC"),
        (-1e7, "BADQACC"),
        (1e3, "slipped"),
        (10.0, "a contact is .* mm deep"),
    ],
)
def test_absurd_torque_raises(
    make_world: Callable[..., World],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    current_a: float,
    why: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    world = make_world(Current(current_a))
    with pytest.raises(SimulationError, match=rf"the simulation of 'stapler' \(coarse\) .*{why}") as caught:
        world.advance_to(300 * NS_PER_MS)
    assert "take a finer sim.detail or another seed" in str(caught.value)
    assert not list(tmp_path.iterdir())  # MuJoCo would leave a MUJOCO_LOG.TXT there
    assert capfd.readouterr().err == ""


def test_scene_that_mujoco_refuses_is_named(make_world: Callable[..., World]) -> None:
    with pytest.raises(SimulationError, match="MuJoCo refuses the scene of 'sponge'"):
        make_world(Current(0.0), object="sponge", size=-1.0)


def test_textures_of_past_worlds_are_not_cached(make_world: Callable[..., World]) -> None:
    for seed in range(3):
        make_world(Current(0.0), object="sponge", texture_seed=seed)
    assert mujoco.mj_getCacheSize(mujoco.mj_getCache()) == 0


def test_image_shows_motion_of_jaws(make_world: Callable[..., World]) -> None:
    world = make_world(Current(0.1))
    before = world.render(64)
    assert before.shape == (64, 64, 3)
    assert before.std() > 20
    assert (world.render(64) == before).all()
    world.advance_to(300 * NS_PER_MS)
    assert np.abs(world.render(64).astype(int) - before).max() > 40


def test_any_thread_renders_the_same_images_and_closes(make_world: Callable[..., World]) -> None:
    """`asyncio.to_thread` opens a gripper in one thread, grasps in others, and may close it in another still."""
    alone, shared = make_world(Current(0.1)), make_world(Current(0.1))
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(1) as another:
        for number, thread in enumerate((None, one, another, None), start=1):
            for world in (alone, shared):
                world.advance_to(10 * number * NS_PER_MS)
            image = shared.render(64) if thread is None else thread.submit(shared.render, 64).result()
            assert (image == alone.render(64)).all()
        another.submit(shared.close).result()


def test_world_that_was_rendered_is_freed_without_close() -> None:
    world = World(Scene("block", "coarse"), GripperConfig(), Current(0.0), NM_PER_A, 0)
    world.render(16)
    kept, threads = weakref.ref(world), [t for t in threading.enumerate() if t.name == "renderer"]
    del world
    gc.collect()  # the world refers to itself
    assert kept() is None
    threads[-1].join(10)
    assert not threads[-1].is_alive()


def test_world_whose_last_user_is_its_renderer_closes_itself() -> None:
    worlds = [World(Scene("block", "coarse"), GripperConfig(), Current(0.0), NM_PER_A, 0)]
    worlds[0].render(16)
    graphics = worlds[0]._graphics
    assert graphics is not None
    graphics.run(lambda: worlds.pop().close())
    graphics._thread.join(10)
    assert not graphics._thread.is_alive()


@pytest.mark.parametrize("tool", ["pads", "rods"])
def test_markers_are_detected_and_do_not_change_physics(make_world: Callable[..., World], tool: str) -> None:
    worlds = [make_world(Current(0.2, 0.1), tool=tool, markers=on) for on in (True, False)]
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    seen = []
    for world in worlds:
        world.advance_to(1500 * NS_PER_MS)
        _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(world.render(256))
        seen.append(set() if ids is None else set(ids.ravel().tolist()))
    assert seen == [{0, 1}, set()]
    assert worlds[0].force_n == worlds[1].force_n > 1.0


NO_LIBRARY = """
    import ctypes
    import ctypes.util

    load, find = ctypes.CDLL.__init__, ctypes.util.find_library

    def refuse(self, name, *args, **kwargs):
        if name and any(library in str(name) for library in MISSING):
            raise OSError(f"{name}: cannot open shared object file")
        load(self, name, *args, **kwargs)

    ctypes.CDLL.__init__ = refuse
    ctypes.util.find_library = lambda name: None if name in MISSING else find(name)
"""


RENDER = """
    from gripper_force.errors import SimulationError
    from gripper_hw.sim.engine import mujoco, new_renderer

    try:
        new_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16)
    except SimulationError as error:
        print(error)
"""


@pytest.mark.parametrize("missing", [("EGL",), ("OpenGL", "GL", "GLESv2", "GLESv1_CM")])
def test_a_missing_library_names_the_packages(missing: tuple[str, ...]) -> None:
    code = f"MISSING = {missing}\n" + textwrap.dedent(NO_LIBRARY) + textwrap.dedent(RENDER)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"{NO_EGL}\n"


def test_a_missing_driver_is_one_line_of_the_command(tmp_path: Path) -> None:
    env = dict(os.environ) | {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"}
    code = "from gripper_force.cli import main; main()"
    args = [
        "grasp",
        "--object",
        "stapler",
        "--set",
        "vision.checkpoint=none",
        "--set",
        f"log.directory={tmp_path}",
    ]
    done = subprocess.run(
        [sys.executable, "-c", code, *args], env=env, capture_output=True, text=True, check=False, timeout=120
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: {NO_EGL}\n"
    assert "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0" in NO_EGL


@pytest.mark.parametrize("name", ["sponge", "paper_cup", "stapler", "block"])
def test_an_object_that_leaves_presses_no_more(make_world: Callable[..., World], name: str) -> None:
    world = make_world(Current(0.13, brake_a_s=0.02), object=name)
    world.advance_to(2500 * NS_PER_MS)
    assert world.has_object
    assert world.force_n > 2.0
    world.remove_object()
    world.advance_to(world.t_ns + 2 * world.step_ns)
    assert world.force_n == 0.0
    assert not world.has_object
    assert world.closing_m_s > 0.0
    world.advance_to(world.t_ns + 500 * NS_PER_MS)  # the jaws meet
    assert world.force_n > 2.0


def test_a_scene_without_object_has_none(make_world: Callable[..., World]) -> None:
    assert not make_world(Current(0.0), object="none").has_object
