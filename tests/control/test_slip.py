import pytest

from gripper_force.config import ControlConfig
from gripper_force.control.slip import SlipMonitor

CONFIG = ControlConfig()
HOLD_M_S = 0.0125
FREE = {"width_m": 0.05, "closing_m_s": 0.01, "shortfall_n": 3.0, "reference_n": 4.0}


def cycles_until_lost(**changes):
    monitor = SlipMonitor(CONFIG, HOLD_M_S)
    for cycle in range(1, 41):
        if monitor.loss_reason(0.005, **{**FREE, **changes}):
            return cycle
    return None


@pytest.mark.parametrize(("shortfall_n", "reference_n"), [(3.0, 4.0), (0.5, 0.6)])
def test_closing_without_resistance_is_a_loss_within_50_ms(shortfall_n, reference_n):
    assert cycles_until_lost(shortfall_n=shortfall_n, reference_n=reference_n) <= 9


def test_jaws_that_the_speed_limit_brakes_in_every_second_cycle_are_a_loss():
    monitor = SlipMonitor(CONFIG, HOLD_M_S)
    cycles = [(0.02, 6.0), (-0.005, 13.0)] * 5
    found = [
        monitor.loss_reason(0.005, 0.05, speed_m_s, shortfall_n, 8.5) for speed_m_s, shortfall_n in cycles
    ]
    assert "without resistance" in found[9]


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


def test_jaws_that_a_small_force_limit_makes_slow_show_a_loss_too():
    slow = SlipMonitor(CONFIG, 0.003)
    assert any(slow.loss_reason(0.005, **{**FREE, "closing_m_s": 0.002}) for _ in range(10))
    assert not slow.recession_reason(0.05, 0.05, 0.0, 0.5)
    assert "without more motor force" in slow.recession_reason(0.0494, 0.05, 0.002, 0.5)


def test_signs_must_persist():
    monitor = SlipMonitor(CONFIG, HOLD_M_S)
    for _ in range(20):
        assert not monitor.loss_reason(0.005, **FREE)
        assert not monitor.loss_reason(0.005, **FREE)
        assert not monitor.loss_reason(0.005, **{**FREE, "shortfall_n": 0.0})


def test_closed_jaws_hold_nothing():
    assert cycles_until_lost(width_m=0.001, closing_m_s=0.0) == 1
    thin = SlipMonitor(ControlConfig(min_object_width_m=0.0001), HOLD_M_S)
    assert not thin.loss_reason(0.005, 0.0003, 0.0, 0.0, 4.0)


def receding(monitor, *, motor_force_n, speed_m_s=0.01, rest_m=0.05):
    """Jaws at rest, then closing by 1 mm of width in 50 ms, with a motor force that rises to ``motor_force_n``."""
    found = [monitor.recession_reason(rest_m, 0.05, 0.0, 0.5)] if rest_m else []
    for cycle in range(1, 11):
        width_m, share = (rest_m or 0.05) - 2 * speed_m_s * 0.005 * cycle, cycle / 10
        found.append(monitor.recession_reason(width_m, 0.05, speed_m_s, 0.5 + share * (motor_force_n - 0.5)))
    return [text for text in found if text]


def test_jaws_that_close_without_more_motor_force_hold_nothing():
    assert "without more motor force" in receding(SlipMonitor(CONFIG, HOLD_M_S), motor_force_n=0.48)[0]


@pytest.mark.parametrize("motor_force_n", [1.5, 0.0])
def test_jaws_that_close_with_another_motor_force_still_hold(motor_force_n):
    assert not receding(SlipMonitor(CONFIG, HOLD_M_S), motor_force_n=motor_force_n)


def test_a_recession_counts_from_the_last_rest():
    monitor = SlipMonitor(CONFIG, HOLD_M_S)
    assert not monitor.recession_reason(0.0493, 0.05, 0.0, 0.5)
    assert not monitor.recession_reason(0.0491, 0.05, 0.01, 0.5)
    assert monitor.recession_reason(0.0487, 0.05, 0.01, 0.5)


def test_jaws_that_have_not_been_at_rest_yet_still_close_on_the_object():
    assert not receding(SlipMonitor(CONFIG, HOLD_M_S), motor_force_n=0.5, rest_m=0.0)


def test_jaws_that_return_after_a_pull_still_hold():
    assert not receding(SlipMonitor(CONFIG, HOLD_M_S), motor_force_n=0.5, rest_m=0.051)


def test_creep_of_a_soft_object_is_no_loss():
    assert not receding(SlipMonitor(CONFIG, HOLD_M_S), motor_force_n=0.5, speed_m_s=0.004)


def test_collapsed_force_is_a_slip_after_its_time():
    monitor = SlipMonitor(CONFIG, HOLD_M_S)
    found = [monitor.slip_reason(0.005, 1.9, 4.0, 0.0, closing_m_s=0.0) for _ in range(25)]
    assert not any(found[:19])
    assert "fell to 1.90 N" in found[20]
    monitor.start()
    assert not monitor.slip_reason(0.005, 1.9, 4.0, 0.0, closing_m_s=0.0)
    assert not any(monitor.slip_reason(0.005, 2.1, 4.0, 0.0, closing_m_s=0.0) for _ in range(25))


def test_collapsed_force_of_closing_jaws_is_a_slip_after_half_the_time():
    monitor = SlipMonitor(CONFIG, HOLD_M_S)
    found = [monitor.slip_reason(0.005, 1.9, 4.0, 0.0, closing_m_s=0.01) for _ in range(15)]
    assert not any(found[:9])
    assert "fell to 1.90 N" in found[10]


def test_closing_while_held_is_a_slip():
    assert "closed by 5.0 mm" in SlipMonitor(CONFIG, HOLD_M_S).slip_reason(0.005, 4.0, 4.0, 0.005, 0.0)
    assert not SlipMonitor(CONFIG, HOLD_M_S).slip_reason(0.005, 4.0, 4.0, 0.003, 0.0)
