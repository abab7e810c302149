import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.control.trajectory import TrapezoidalProfile


@given(st.floats(-10, 10), st.floats(-10, 10), st.floats(0.5, 10), st.floats(0.001, 0.05))
def test_arrives_without_overshoot_within_rate(start, target, rate, dt_s):
    profile = TrapezoidalProfile(0.4)
    profile.start(start, rate)
    low, high = min(start, target), max(start, target)
    for _ in range(round((abs(target - start) / rate + 2.0) / dt_s) + 2):
        before = profile.value
        after = profile.step(target, dt_s)
        assert low <= after <= high
        assert abs(after - before) <= rate * dt_s * (1 + 1e-9)
        assert abs(target - after) <= abs(target - before)
        # It can still come to rest at its target.
        assert profile.speed**2 <= 2 * rate / 0.4 * abs(target - before) * (1 + 1e-9)
    assert profile.value == target


def test_starts_at_rest():
    profile = TrapezoidalProfile(0.4)
    profile.start(0.0, 8.0)
    first = profile.step(8.0, 0.005)
    assert first == pytest.approx(8.0 / 0.4 * 0.005 * 0.005)
