"""Diagnostics of the simulator for `doctor`: renders the configured scene."""

from collections.abc import Iterator
from contextlib import closing

from gripper_force.config import Config
from gripper_force.jobs.checks import Check, time_ms
from gripper_force.plugins import require
from gripper_force.runtime.backends import resolve_simulation

_SIDE_PX = 16


def probe(config: Config) -> Iterator[Check]:
    """Renders a small image of the configured scene, if its camera is simulated.

    Raises:
        ConfigError: The object does not exist, or MuJoCo is not installed.
        SimulationError: EGL is missing.
    """
    if config.camera.backend != "simulated":
        yield Check("simulation", "EGL", "not needed: the camera is not simulated", None)
        return
    require("mujoco", "camera.backend=simulated")
    from gripper_hw.dynamixel.control_table import load_model
    from gripper_hw.dynamixel.firmware import VirtualServo
    from gripper_hw.sim.scene import draw_scene, true_gripper
    from gripper_hw.sim.world import World

    model = load_model("XM430-W350")
    config, _ = resolve_simulation(config)
    scene = draw_scene(config.object, config.seed, config.sim)
    world = World(scene, true_gripper(config), VirtualServo(1, model), model.nm_per_a, config.seed)

    def step_and_render() -> None:
        world.advance_to(world.t_ns + world.step_ns)  # without a step, `render` returns the last image
        world.render(_SIDE_PX)

    with closing(world):
        world.render(_SIDE_PX)  # makes the rendering context, and raises if EGL is missing
        median_ms, _ = time_ms(step_and_render, 5)
    size = f"{_SIDE_PX}x{_SIDE_PX} pixels of {config.object!r}"
    yield Check("simulation", "EGL", f"renders {size}, with one physics step, in {median_ms:.1f} ms", True)
