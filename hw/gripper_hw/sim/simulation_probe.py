"""Can this machine draw a simulated scene?"""

from collections.abc import Iterator

from gripper_force.config import Config
from gripper_force.jobs.doctor import Check, time_ms
from gripper_force.runtime.backends import CAMERAS, RIG


def probe(config: Config) -> Iterator[Check]:
    """Draws a small picture of the configured scene, if a camera is to see it.

    Raises:
        ConfigError: There is no such object.
        SimulationError: EGL is missing.
    """
    if CAMERAS.get(config.camera.backend) != RIG:
        yield Check("simulation", "EGL", "not needed: no camera is simulated", None)
        return
    from gripper_hw.dynamixel.control_table import load_model
    from gripper_hw.dynamixel.firmware import VirtualServo
    from gripper_hw.sim.detail_level import resolve_detail
    from gripper_hw.sim.scene import draw_scene
    from gripper_hw.sim.world import World

    model = load_model("XM430-W350")
    config, _ = resolve_detail(config)
    scene = draw_scene(config.object, config.seed, config.sim)
    world = World(scene, config.gripper, VirtualServo(1, model), model.nm_per_a, config.seed)

    def step_and_draw() -> None:
        world.advance_to(world.t_ns + world.step_ns)  # a world that stands still is drawn but once
        world.render(16)

    try:
        world.render(16)  # the first one makes the drawing context, and raises where EGL is missing
        median_ms, _ = time_ms(step_and_draw, 5)
    finally:
        world.close()
    found = f"draws 16x16 pixels of {config.object!r}, with a step of its physics, in {median_ms:.1f} ms"
    yield Check("simulation", "EGL", found, True)
