"""A lower target, on the simulated rig with the friction that is configured."""

from gripper_force.config import load_config
from gripper_force.interfaces import WorldState
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import open_session
from gripper_force.types import Outcome, RequestKind


def test_a_sponge_is_within_5_percent_of_a_lower_target_after_half_a_second() -> None:
    keys = ["object=sponge", "sim.randomise=false", "camera.backend=none", "control.feedback=current"]
    run = resolve(load_config(None, keys))
    world: list[WorldState] = []
    with open_devices(run.config) as devices:
        assert devices.observe_world is not None
        devices.observe_world(world.append)
        with open_session(run, devices, None) as session:
            session.cycle(RequestKind.GRASP, 5.0)
            while session.cycle().status.outcome != Outcome.HELD:
                pass
            session.cycle(RequestKind.GRASP, 2.0)
            for _ in range(100):
                session.cycle()
            assert abs(world[-1].force_n - 2.0) < 0.05 * 2.0
