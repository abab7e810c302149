import pytest

from gripper_force.control.free_travel import FreeTravel


@pytest.mark.parametrize(("motor_force_n", "friction_n"), [(0.9, 0.742), (0.1, 0.0), (-0.5, 0.0)])
def test_enough_free_travel_proves_a_least_friction(motor_force_n, friction_n):
    travel = FreeTravel()
    for _ in range(9):
        travel.add(motor_force_n)
    assert travel.friction_n is None
    for _ in range(31):
        travel.add(motor_force_n)
    assert travel.friction_n == pytest.approx(friction_n, abs=0.001)
    travel.add(50.0)  # jaws that have met an object
    assert travel.friction_n == pytest.approx(friction_n, abs=0.001)
