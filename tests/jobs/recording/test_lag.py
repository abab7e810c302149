import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gripper_force.jobs.recording.lag import Floats, camera_lags_s, force_lag_s, load_cell_lag_s
from gripper_force.types import Gray

SERVO_S = np.arange(0, 8, 0.005)
RELEASES_S = [2.0, 4.5, 7.0]


def width_m(t_s: Floats) -> Floats:
    """Width over time: presses at rest that then open with increasing speed."""
    width = np.full(t_s.shape, 0.06)
    for i, release_s in enumerate(RELEASES_S):
        depth = 0.008 + 0.004 * i
        pressed = np.clip((t_s - release_s + 1.2) / 0.8, 0, 1) * depth
        opened = 2.0 * np.clip(t_s - release_s, 0, None) ** 2
        width -= np.where(t_s < release_s, pressed, np.clip(depth - opened, 0, None))
    return width


def pictures(t_s: Floats, rng: np.random.Generator) -> Gray:
    """Images of a bright jaw that moves over a dark background, (T, 24, 24)."""
    edge = (width_m(t_s) - 0.04) * 1000  # in pixels
    bright = np.clip(edge[:, None] - np.arange(24) + 0.5, 0, 1)
    rows = np.repeat(60 + 120 * bright[:, None, :], 24, axis=1)
    noisy: Gray = (rows + rng.normal(0, 2, rows.shape)).clip(0, 255).astype(np.uint8)
    return noisy


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 149.0])
@pytest.mark.parametrize("lag_s", [-0.04, 0.0, 0.0123, 0.1])
def test_camera_lag_against_encoder(lag_s: float, rate_hz: float) -> None:
    t_s = np.arange(0.003, 7.9, 1 / rate_hz)
    images = pictures(t_s, np.random.default_rng(1))
    found_s = camera_lags_s(t_s + lag_s, images, SERVO_S, width_m(SERVO_S), RELEASES_S)
    assert np.median(found_s) == pytest.approx(lag_s, abs=0.002)
    assert found_s == pytest.approx(np.full(3, lag_s), abs=0.005)


@pytest.mark.parametrize("viscous_s", [0.0, 0.01, 0.03])
@pytest.mark.parametrize("lag_s", [-0.04, 0.0, 0.0123, 0.1])
def test_viscosity_is_not_taken_for_load_cell_lag(lag_s: float, viscous_s: float) -> None:
    fine_s = np.arange(0, 8, 0.0005)
    depth_m = 0.06 - width_m(fine_s)
    force_n = np.clip(800 * (depth_m + viscous_s * np.gradient(depth_m, fine_s)), 0, None)
    cell_s = np.arange(0.001, 7.9, 0.005)
    noisy_n = np.interp(cell_s, fine_s, force_n) + np.random.default_rng(2).normal(0, 0.01, len(cell_s))
    found_s = [
        load_cell_lag_s(cell_s + lag_s, noisy_n, SERVO_S, width_m(SERVO_S), at_s) for at_s in RELEASES_S
    ]
    assert np.median(found_s) == pytest.approx(lag_s, abs=0.005)


def test_lag_without_movement_or_data_is_unknown() -> None:
    t_s = np.arange(0, 8, 1 / 60)
    images = np.full((len(t_s), 24, 24), 90, np.uint8)
    still = np.full(len(SERVO_S), 0.06)
    nothing = np.zeros(0)
    assert np.isnan(camera_lags_s(t_s, images, SERVO_S, still, RELEASES_S)).all()
    assert np.isnan(camera_lags_s(nothing, images[:0], SERVO_S, still, RELEASES_S)).all()
    assert not len(camera_lags_s(t_s, images, SERVO_S, still, []))
    assert np.isnan(load_cell_lag_s(t_s, np.zeros(len(t_s)), SERVO_S, width_m(SERVO_S), 2.0))
    assert np.isnan(load_cell_lag_s(nothing, nothing, SERVO_S, width_m(SERVO_S), 2.0))


def force_n(t_s: Floats, viscous_s: float) -> Floats:
    """Force of a material with a nonlinear spring and viscosity."""
    fine_s = np.arange(0, 8, 0.0005)
    depth_m = 0.06 - width_m(fine_s)
    force = 6e4 * np.clip(depth_m + viscous_s * np.gradient(depth_m, fine_s), 0, None) ** 2
    return np.interp(t_s, fine_s, force)


@pytest.mark.parametrize("viscous_s", [0.0, 0.03])
@pytest.mark.parametrize("lag_s", [-0.1, 0.06, 0.1])
def test_force_lag_without_encoder_is_found_up_to_viscosity(lag_s: float, viscous_s: float) -> None:
    t_s = np.arange(0.003, 7.9, 1 / 30)
    images = pictures(t_s, np.random.default_rng(3))
    found_s = force_lag_s(t_s, images, t_s + lag_s, force_n(t_s, viscous_s))
    assert found_s == pytest.approx(lag_s - viscous_s / 2, abs=0.008 + viscous_s / 2)


@pytest.mark.parametrize("viscous_s", [0.0, 0.02, 0.05])
def test_viscosity_is_not_taken_for_force_lag(viscous_s: float) -> None:
    t_s = np.arange(0.003, 7.9, 1 / 30)
    images = pictures(t_s, np.random.default_rng(4))
    assert force_lag_s(t_s, images, t_s, force_n(t_s, viscous_s)) == 0.0


def test_force_lag_without_information_is_zero() -> None:
    t_s = np.arange(0, 4, 1 / 30)
    images = pictures(t_s, np.random.default_rng(5))
    force = force_n(t_s, 0.0)
    assert force_lag_s(t_s, np.full_like(images, 90), t_s + 0.1, force) == 0.0
    assert force_lag_s(t_s, images, t_s, np.zeros(len(t_s))) == 0.0
    assert force_lag_s(t_s[:35], images[:35], t_s[:35] + 0.1, force[:35]) == 0.0
    assert force_lag_s(t_s, images, t_s[:0], force[:0]) == 0.0


@given(arrays(np.uint8, (45, 16, 16)), arrays(np.float64, 45, elements=st.floats(-1e308, 1e308)))
def test_force_lag_is_within_bounds(images: Gray, force: Floats) -> None:
    t_s = np.arange(45) / 30
    assert abs(force_lag_s(t_s, images, t_s, force)) < 0.15
