import math
from dataclasses import replace

import pytest

from gripper_force.config import Config
from gripper_force.control.tuning import Gains
from gripper_force.qualification.loop_margin.analytic_plant import Gripper, transmission_of
from gripper_force.qualification.loop_margin.gain_margin import (
    FRAME_S,
    IdentifiedPlant,
    gains_of,
    identify,
    margin_by_lag,
    margin_by_rule,
    margin_with_inertia,
    observed_margin,
    oscillation_decays,
)

CONFIG = Config()
TRUTH = Gripper(transmission_of(CONFIG.gripper), contact_m=0.008)


@pytest.mark.parametrize("delay_s", [0.1, 0.2])
def test_margin_of_an_integral_follows_from_its_delay(delay_s: float) -> None:
    whole_s = delay_s + FRAME_S / 2 + 0.0025 + 0.002
    margin = margin_by_lag(Gains(0.0, 5.0), IdentifiedPlant(1.0, 1e-6), delay_s)
    assert margin == pytest.approx(math.pi / 2 / (5.0 * whole_s), rel=0.01)


def test_frame_period_alone_limits_the_proportional_gain() -> None:
    """Without a delay, the correction of a held error overshoots in the next frame."""
    margin = margin_by_lag(Gains(0.5, 0.001), IdentifiedPlant(1.0, 1e-6), -0.0025)
    assert margin == pytest.approx(2.0, rel=0.15)


def test_inertia_has_no_effect_on_a_stiff_object_without_friction() -> None:
    gains, plant = gains_of(CONFIG, "vision"), IdentifiedPlant(1.0, 1e-6)
    still = replace(TRUTH, stiffness_n_m=1e9, friction_n=0.0, damping_n_s_m=1e6)
    assert margin_with_inertia(gains, plant, still, 0.05) == pytest.approx(
        margin_by_lag(gains, IdentifiedPlant(1.0, 1e-3), 0.05), rel=0.01
    )


def test_margin_by_rule_is_pi_for_the_plant_of_the_tuning() -> None:
    gain, lag_s, delay_s = CONFIG.control.plant
    plant = IdentifiedPlant(gain, lag_s)
    assert margin_by_rule(gains_of(CONFIG, "fused"), plant, delay_s - FRAME_S / 2) == pytest.approx(math.pi)


def test_calibration_identifies_the_plant() -> None:
    found = identify(CONFIG, replace(TRUTH, stiffness_n_m=1000.0))
    assert found.gain == pytest.approx(1.0, abs=0.05)
    assert 0.005 < found.lag_s < 0.05


@pytest.mark.parametrize("feedback", ["vision", "fused"])
def test_oscillation_decays_or_grows_with_the_gain(feedback: str) -> None:
    assert oscillation_decays(CONFIG, TRUTH, feedback, 0.05, 0.8)
    assert not oscillation_decays(CONFIG, TRUTH, feedback, 0.05, 8.0)


@pytest.mark.parametrize("stiffness_n_m", [300.0, 30_000.0])
def test_prediction_agrees_with_observation(stiffness_n_m: float) -> None:
    truth = replace(TRUTH, stiffness_n_m=stiffness_n_m)
    predicted = margin_with_inertia(gains_of(CONFIG, "vision"), identify(CONFIG, truth), truth, 0.075)
    assert observed_margin(CONFIG, truth, "vision", 0.075) == pytest.approx(predicted, rel=0.2)
