import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import ControlConfig, config_from
from gripper_force.control.safety import SafetyLatch, is_plausible
from gripper_force.errors import ConfigError
from gripper_force.types import ServoState

CONFIG = ControlConfig(voltage_limits_v=(10.0, 14.8))
WELL = ServoState(
    t_ns=0,
    position_rad=0.3,
    velocity_rad_s=0.0,
    current_a=0.1,
    temperature_c=35.0,
    voltage_v=12.0,
    hardware_error=0,
)
ILL = {
    "position": ({"position_rad": math.nan}, "not finite"),
    "velocity": ({"velocity_rad_s": math.inf}, "not finite"),
    "current": ({"current_a": -math.inf}, "not finite"),
    "current is absurd": ({"current_a": 1e300}, "not finite"),
    "temperature is nan": ({"temperature_c": math.nan}, "not finite"),
    "voltage is nan": ({"voltage_v": math.nan}, "not finite"),
    "overload": ({"hardware_error": 0x20}, "hardware error 0x20"),
    "hot": ({"temperature_c": 71.0}, "71 C"),
    "low": ({"voltage_v": 9.9}, "supply is at 9.9 V"),
    "high": ({"voltage_v": 15.0}, "supply is at 15.0 V"),
    "leap": ({"position_rad": 0.3 + 0.051}, "leapt"),
}


def check(safety, servo, dt_s=0.005, over_force=False, goal_current_a=0.1):
    return safety.check(servo, goal_current_a, dt_s, over_force=over_force)


def tripped_by(change):
    safety = SafetyLatch(CONFIG)
    assert not check(safety, WELL)
    assert check(safety, replace(WELL, **change))
    return safety


@pytest.mark.parametrize(("change", "reason"), ILL.values(), ids=ILL)
def test_bad_readings_trip_at_once(change, reason):
    assert reason in tripped_by(change).reason


@pytest.mark.parametrize(("change", "reason"), ILL.values(), ids=ILL)
def test_latch_clears_only_once_the_cause_is_gone(change, reason):
    safety = tripped_by(change)
    assert reason in safety.reset()
    assert reason in safety.reason
    healed = replace(WELL, position_rad=change.get("position_rad", WELL.position_rad))
    healed = healed if is_plausible(healed) else WELL
    assert not check(safety, healed)
    assert reason in safety.reason  # kept until a reset
    assert safety.reset() == ""
    assert safety.reason == ""


def test_first_reason_is_kept():
    safety = SafetyLatch(CONFIG)
    assert safety.trip("stop requested")
    assert not safety.trip("something else")
    assert not check(safety, replace(WELL, hardware_error=1))
    assert safety.reason == "stop requested"


def test_any_voltage_is_allowed_without_limits():
    assert not check(SafetyLatch(ControlConfig()), replace(WELL, voltage_v=3.0))


def test_fast_rotation_is_no_jump():
    safety = SafetyLatch(CONFIG)
    for i in range(20):
        moved = replace(WELL, t_ns=i * 5_000_000, position_rad=0.3 + i * 0.005 * 11)
        assert not check(safety, moved)


@pytest.mark.parametrize(("time_ms", "largest_rad"), [(-5, 0.05), (0, 0.05), (5, 0.15), (50, 1.05)])
def test_the_largest_plausible_rotation_grows_with_the_time(time_ms, largest_rad):
    for leap_rad, trips in ((0.99 * largest_rad, False), (1.01 * largest_rad, True)):
        safety = SafetyLatch(CONFIG)
        check(safety, replace(WELL, t_ns=10_000_000))
        moved = replace(WELL, t_ns=(10 + time_ms) * 1_000_000, position_rad=WELL.position_rad - leap_rad)
        assert check(safety, moved) == trips


def test_force_that_stays_over_its_limit_trips():
    safety = SafetyLatch(CONFIG)
    assert not any(check(safety, WELL, over_force=i % 40 != 0) for i in range(400))
    assert any(check(safety, WELL, over_force=True) for _ in range(60))
    assert "over its limit" in safety.reason


def test_motor_current_above_its_goal_trips():
    safety = SafetyLatch(CONFIG)
    assert not any(check(safety, replace(WELL, current_a=0.14)) for _ in range(100))
    assert not any(check(safety, replace(WELL, current_a=-0.3 if i % 4 else 0.1)) for i in range(100))
    assert any(check(safety, replace(WELL, current_a=-0.15)) for _ in range(6))
    assert "takes 0.150 A" in safety.reason


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("rad_s", [-0.03, 0.3])
def test_motor_that_is_back_driven_may_draw_more_than_its_goal(sign, rad_s):
    safety = SafetyLatch(CONFIG)
    pulled, not_pulled = (
        replace(WELL, current_a=sign * 0.3, velocity_rad_s=sign * each_rad_s) for each_rad_s in (-0.3, rad_s)
    )
    assert not any(check(safety, pulled) for _ in range(100))
    assert any(check(safety, not_pulled) for _ in range(6))


@given(st.integers(1, 5))
def test_pulling_at_a_motor_with_too_much_current_does_not_hide_it(pulled_cycles):
    safety = SafetyLatch(CONFIG)
    pulled = replace(WELL, current_a=0.3, velocity_rad_s=-0.3)
    for _ in range(3):
        check(safety, replace(WELL, current_a=0.3))
    assert not any(check(safety, pulled) for _ in range(pulled_cycles))
    assert any(check(safety, replace(WELL, current_a=0.3)) for _ in range(2))


@given(st.floats(-40, 120), st.floats(0, 20))
def test_a_hotter_servo_never_holds_more(temperature_c, hotter_c):
    safety = SafetyLatch(CONFIG)
    cooler, hotter = safety.derating(temperature_c), safety.derating(temperature_c + hotter_c)
    assert 0.6 <= hotter <= cooler <= 1.0
    assert cooler == 1.0 or temperature_c > CONFIG.warm_c


def test_half_way_to_its_temperature_limit_a_servo_holds_four_fifths():
    assert SafetyLatch(CONFIG).derating(65.0) == pytest.approx(0.8)


readings = st.builds(
    ServoState,
    t_ns=st.integers(0, 10**12),
    position_rad=st.floats(),
    velocity_rad_s=st.floats(),
    current_a=st.floats(),
    temperature_c=st.floats(),
    voltage_v=st.floats(),
    hardware_error=st.integers(0, 255),
)


@given(st.lists(st.tuples(readings, st.booleans(), st.booleans())))
def test_latch_is_tripped_in_every_cycle_with_a_cause(cycles):
    safety = SafetyLatch(CONFIG)
    for servo, over_force, asks in cycles:
        check(safety, servo, over_force=over_force)
        refused = safety.reset() if asks else ""
        assert not refused or safety.reason
        assert safety.reason or (is_plausible(servo) and not servo.hardware_error)


@pytest.mark.parametrize("control", [{"warm_c": 70.0}, {"voltage_limits_v": [14.8, 10.0]}])
def test_limits_out_of_order_are_refused(control):
    with pytest.raises(ConfigError, match="must be below"):
        config_from({"control": control}, "test")
