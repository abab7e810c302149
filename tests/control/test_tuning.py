import cmath
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.control.tuning import Gains, Plant, phase_margin_deg, simc


def test_simc_of_first_order_plus_delay():
    # With tau_c = theta: Kc = tau / (2 k theta), tau_I = min(tau, 8 theta).
    gains = simc(Plant(gain=2.0, lag_s=0.3, delay_s=0.1))
    assert gains.proportional == pytest.approx(0.75)
    assert gains.integral_s == pytest.approx(0.75 / 0.3)


def test_simc_of_a_slow_plant_has_the_integral_time_of_the_rule():
    gains = simc(Plant(gain=1.0, lag_s=1.0, delay_s=0.1))
    assert gains.proportional / gains.integral_s == pytest.approx(0.8)


def test_a_plant_without_lag_gets_an_integral():
    assert simc(Plant(1.0, 0.0, 0.1)) == Gains(0.0, pytest.approx(5.0))  # type: ignore[arg-type]


@given(st.floats(0.1, 10), st.floats(0.0, 0.5), st.floats(0.005, 0.2))
def test_the_rules_own_margin(gain, lag_s, delay_s):
    # With tau_I = tau the loop is exp(-theta s) / (2 theta s): 90 degrees less half a radian.
    plant = Plant(gain, min(lag_s, 8 * delay_s), delay_s)
    assert phase_margin_deg(plant, simc(plant)) == pytest.approx(90 - math.degrees(0.5), abs=1e-3)


def test_margin_agrees_with_a_search_on_the_frequency_response():
    plant, gains = Plant(1.0, 0.4, 0.05), Gains(3.0, 4.0)
    omegas = np.geomspace(0.1, 30, 200_000)
    s = 1j * omegas
    response = plant.gain * np.exp(-plant.delay_s * s) / (plant.lag_s * s + 1)
    loop = response * np.array([gains.response(w) for w in omegas])
    crossing = loop[np.argmin(np.abs(np.abs(loop) - 1))]
    assert phase_margin_deg(plant, gains) == pytest.approx(
        180 + math.degrees(cmath.phase(crossing)), abs=0.01
    )
