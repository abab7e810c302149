from gripper_force.config import load_config
from gripper_hw.dynamixel.servo_scan import scan


def test_virtual_servo_is_found_or_the_problem_of_its_port_told() -> None:
    found, unplugged = (
        scan(load_config(None, ["clock=lockstep", *faults]), ["virtual:rig"])[0]
        for faults in ([], ["faults=[{unit: bus, kind: off}]"])
    )
    assert [servo.id for servo in found.servos] == [1]
    assert found.problem == ""
    assert unplugged.servos == []
    assert unplugged.problem == "no virtual bus named 'rig' is registered in this process; " + (
        "simulate one first, or set servo.port to a device path"
    )
