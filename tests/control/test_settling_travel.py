"""A grip is held only if the jaws stand still while its force settles."""

from dataclasses import replace

from gripper_force.config import load_config
from gripper_force.control.state_machine import GraspController
from gripper_force.qualification import safety_search
from gripper_force.qualification.loop_margin.analytic_plant import POSITION_LOOP, Gripper, transmission_of
from gripper_force.types import Request, RequestKind


def test_jaws_that_come_loose_while_the_force_settles_hold_nothing() -> None:
    # Friction feigns a contact, and the network takes the motion of the jaws for force.
    config = load_config(None, [])
    drawn = replace(
        safety_search.draw(config.control, transmission_of(config.gripper), 777, 152),
        feedback="fused",
    )
    truth = transmission_of(config.gripper)
    plant = Gripper(
        truth,
        gain=drawn.gain,
        friction_n=drawn.friction * truth.friction_n,
        damping_n_s_m=drawn.damping_n_s_m,
        play_m=drawn.play_m,
        mass_kg=drawn.mass_kg,
        stiffness_n_m=drawn.stiffness_n_m,
        contact_m=drawn.contact_m,
        stops_m=(0.0, 0.0455),
    )
    control = config.control.model_copy(
        update={"feedback": "fused", "on_slip": drawn.on_slip, "vision_rate_hz": drawn.camera_hz}
    )
    controller = GraspController(control, truth, config.servo.current_limit_a, POSITION_LOOP)
    run = safety_search._Run(plant, controller, drawn, 0.0, control)
    run.go(4.0, Request(0, RequestKind.GRASP, drawn.target_n))
    assert not run.statements.held_nothing
