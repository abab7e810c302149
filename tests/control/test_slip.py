import pytest

from gripper_force.config import ControlConfig
from gripper_force.control.slip import SlipMonitor

CONFIG = ControlConfig()
FREE = {"width_m": 0.05, "closing_m_s": 0.01, "shortfall_n": 3.0, "reference_n": 4.0}


def cycles_until_lost(**changes):
    monitor = SlipMonitor(CONFIG)
    for cycle in range(1, 41):
        if monitor.is_lost(0.005, **{**FREE, **changes}):
            return cycle
    return None


def test_closing_without_resistance_is_a_loss_within_20_ms():
    assert cycles_until_lost() == 3


@pytest.mark.parametrize(
    "changes",
    [
        {"closing_m_s": 0.004},  # too slow
        {"closing_m_s": -0.02},  # opening
        {"shortfall_n": 1.9},  # the motor presses
        {"shortfall_n": 0.1, "reference_n": 0.1},  # noise of the current
    ],
)
def test_a_grip_is_no_loss(changes):
    assert cycles_until_lost(**changes) is None


def test_signs_must_persist():
    monitor = SlipMonitor(CONFIG)
    for _ in range(20):
        assert not monitor.is_lost(0.005, **FREE)
        assert not monitor.is_lost(0.005, **FREE)
        assert not monitor.is_lost(0.005, **{**FREE, "shortfall_n": 0.0})


def test_closed_jaws_hold_nothing():
    assert cycles_until_lost(width_m=0.001, closing_m_s=0.0) == 1
    thin = SlipMonitor(ControlConfig(min_object_width_m=0.0001))
    assert not thin.is_lost(0.005, 0.0003, 0.0, 0.0, 4.0)


def test_collapsed_force_is_a_slip_after_its_time():
    monitor = SlipMonitor(CONFIG)
    found = [monitor.has_slipped(0.005, 1.9, 4.0, 0.0) for _ in range(25)]
    assert not any(found[:19])
    assert "fell to 1.90 N" in found[20]
    monitor.start()
    assert not monitor.has_slipped(0.005, 1.9, 4.0, 0.0)


def test_closing_while_held_is_a_slip():
    assert "closed by 5.0 mm" in SlipMonitor(CONFIG).has_slipped(0.005, 4.0, 4.0, 0.005)
    assert not SlipMonitor(CONFIG).has_slipped(0.005, 4.0, 4.0, 0.003)
