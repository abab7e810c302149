import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import GripperConfig
from gripper_force.control.transmission import Transmission

signs = st.sampled_from([-1, 1])


@given(signs, st.floats(0, 0.1), st.floats(-5, 5))
def test_width_and_position_are_inverse(sign, width_m, open_rad):
    config = GripperConfig(closing_sign=sign, open_position_rad=open_rad)
    gripper = Transmission.from_config(config, 1.78)
    assert gripper.width_m(gripper.position_rad(width_m)) == pytest.approx(width_m, abs=1e-12)


@given(signs, st.floats(-20, 20))
def test_force_and_current_are_inverse(sign, force_n):
    gripper = Transmission.from_config(GripperConfig(closing_sign=sign), 1.78)
    assert gripper.force_n(gripper.current_a(force_n, 0.3), 0.3) == pytest.approx(force_n)


@pytest.mark.parametrize("sign", [-1, 1])
def test_signs_follow_the_closing_direction(sign):
    gripper = Transmission.from_config(GripperConfig(closing_sign=sign), 1.78)
    assert gripper.current_a(1.0, 0.0) * sign > 0
    assert (gripper.closed_position_rad - gripper.open_position_rad) * sign > 0
    assert gripper.closing_m_s(sign * 1.0, 0.0) == pytest.approx(GripperConfig().pinion_radius_m)
    assert gripper.width_m(gripper.open_position_rad) == gripper.open_width_m


def test_two_racks_share_the_torque():
    gripper = Transmission.from_config(GripperConfig(pinion_radius_m=0.01), 2.0)
    assert gripper.force_n(1.0, 0.0) == pytest.approx(2.0 / (2 * 0.01))


def test_configured_torque_constant_overrides_the_servos():
    assert Transmission.from_config(GripperConfig(nm_per_a=1.0), 2.0).n_per_a(0.0) == pytest.approx(25.0)


def test_uncertainty_grows_with_force():
    gripper = Transmission.from_config(GripperConfig(), 1.78)
    assert gripper.bias_std_n(8.0) > gripper.bias_std_n(0.0) == pytest.approx(0.25 * gripper.friction_n)


def test_calibration_reduces_uncertainty():
    gripper = Transmission.from_config(GripperConfig(friction_std=0.1, gain_std=0.02), 1.78)
    assert gripper.bias_std_n(0.0) == pytest.approx(0.1 * gripper.friction_n)
    assert gripper.bias_std_n(1e3) == pytest.approx(0.02 * 1e3, rel=1e-3)


@pytest.mark.parametrize("sign", [-1, 1])
def test_goals_go_from_the_open_jaws_to_10_mm_of_each_jaw_beyond_the_closed_ones(sign):
    gripper = Transmission.from_config(GripperConfig(closing_sign=sign), 1.78)
    assert gripper.goal_range_rad == tuple(sorted(gripper.goal_range_rad))
    widths_m = sorted(gripper.width_m(position_rad) for position_rad in gripper.goal_range_rad)
    assert widths_m == pytest.approx([-0.02, gripper.open_width_m])


@pytest.mark.parametrize(("radius_m", "speed_m_s"), [(0.02, 0.0036), (0.01, 0.0018)])
def test_the_speed_of_an_impact_grows_with_its_force(radius_m, speed_m_s):
    gripper = Transmission.from_config(GripperConfig(pinion_radius_m=radius_m), 1.78)
    assert gripper.impact_m_s(1.0) == pytest.approx(speed_m_s)
    assert gripper.impact_m_s(3.0) == pytest.approx(3 * speed_m_s)
