import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_calibration.fits.camera_fit import (
    METHOD_ERROR_MS,
    CameraLag,
    ExposureCandidate,
    Markers,
    estimate_lag,
    find_markers,
    region_around,
    select_exposure,
)
from gripper_force.errors import DataError
from gripper_force.types import Gray

MODULE_PX = 3
SIDE_PX = 6 * MODULE_PX


def image(*places: tuple[int, int, int]) -> Gray:
    """A noisy image of 128x128 with markers: number, left and top of its black square."""
    gray = np.full((128 + 2 * SIDE_PX,) * 2, 110.0)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, left, top in places:
        marker = np.pad(
            cv2.aruco.generateImageMarker(dictionary, number, SIDE_PX), MODULE_PX, constant_values=255
        )
        y, x = top - MODULE_PX + SIDE_PX, left - MODULE_PX + SIDE_PX
        gray[y : y + len(marker), x : x + len(marker)] = 20 + 0.7 * marker
    gray += np.random.default_rng(0).normal(0, 3, gray.shape)
    return gray[SIDE_PX:-SIDE_PX, SIDE_PX:-SIDE_PX].clip(0, 255).astype(np.uint8)


def at(left: float, top: float, side: float = 12.0) -> np.ndarray:
    return np.array([[left, top], [left + side, top], [left + side, top + side], [left, top + side]])


def test_markers_are_found_at_their_positions() -> None:
    found = find_markers(image((0, 12, 50), (1, 90, 58)))
    for number, left, top in ((0, 12, 50), (1, 90, 58)):
        assert found[number] == pytest.approx(at(left - 0.5, top - 0.5, SIDE_PX), abs=1.0)


def test_region_is_the_square_around_both_markers() -> None:
    seen = [find_markers(image((0, 30, 50), (1, 80, 52))), find_markers(image((0, 34, 50), (1, 76, 52)))]
    left, top, width, height = region_around(seen, 128, 128)
    assert width == height == pytest.approx(80 + SIDE_PX - 30 + SIDE_PX, abs=2)
    assert (left, top) == pytest.approx((30 - SIDE_PX / 2, 60 - width / 2), abs=2)


@pytest.mark.parametrize(
    ("shown", "counts"),
    [
        ((), "marker 0 in 0 and marker 1 in 0"),
        (((0, 12, 50),), "marker 0 in 1 and marker 1 in 0"),
        (((0, -4, 50), (1, 90, 58)), "marker 0 in 0 and marker 1 in 1"),  # cut off
        (((5, 12, 50), (7, 90, 58)), "marker 0 in 0 and marker 1 in 0"),  # of something else
    ],
)
def test_missing_or_cut_off_marker_is_named(shown: tuple[tuple[int, int, int], ...], counts: str) -> None:
    with pytest.raises(DataError, match=rf"no image shows both markers completely: of 1 images, {counts}"):
        region_around([find_markers(image(*shown))], 128, 128)


def test_markers_of_very_different_size_are_not_a_pair() -> None:
    with pytest.raises(
        DataError,
        match="no image shows both markers completely: of 1 images, marker 0 in 1 and marker 1 in 1",
    ):
        region_around([{0: at(10, 10), 1: at(60, 60, 40.0)}], 128, 128)


@given(
    st.lists(
        st.tuples(*(st.floats(0, 100),) * 4).map(lambda p: {0: at(p[0], p[1]), 1: at(p[2], p[3])}), min_size=1
    ),
    st.integers(112, 160),
    st.integers(112, 160),
)
def test_region_is_a_square_within_the_image(seen: list[Markers], width: int, height: int) -> None:
    left, top, side, same = region_around(seen, width, height)
    assert side == same > 0
    assert 0 <= left <= left + side <= width
    assert 0 <= top <= top + side <= height
    corners = np.concatenate([c for markers in seen for c in markers.values()])
    if side < min(width, height):  # else there is no more to show
        assert (corners >= (left - 1, top - 1)).all()
        assert (corners <= (left + side + 1, top + side + 1)).all()


def test_best_exposure_without_clipping_is_selected() -> None:
    candidates = [
        ExposureCandidate(500, 35, 0.0),
        ExposureCandidate(1000, 50, 0.0),
        ExposureCandidate(2000, 71, 0.0),
        ExposureCandidate(4000, 95, 0.02),
    ]
    assert select_exposure(candidates).exposure_us == 2000


@pytest.mark.parametrize("gray", [250, 255, 0, 39])
def test_clipped_or_dark_images_are_refused(gray: int) -> None:
    candidate = ExposureCandidate.measure(4000, np.full((64, 64), gray, np.uint8))
    with pytest.raises(
        DataError,
        match=r"the image is dark or clipped at every exposure \([\d.]+ us: mean [\d.]+, [\d.]+ % clipped",
    ):
        select_exposure([candidate])


def touches(*lags_ms: float, force_n: float = 5.0) -> list[CameraLag]:
    return [CameraLag(force_n, lag_ms, lag_ms + 20) for lag_ms in lags_ms]


@given(st.lists(st.floats(-150, 150), min_size=3, max_size=30))
def test_lag_interval_is_at_least_the_error_of_the_method(lags_ms: list[float]) -> None:
    lag = estimate_lag(touches(*lags_ms))
    assert lag.value == pytest.approx(np.median(lags_ms))
    assert lag.half >= METHOD_ERROR_MS - 1e-9


def test_scattered_touches_widen_the_lag_interval() -> None:
    assert estimate_lag(touches(-60, -20, 20, 60)).half > 60
    assert estimate_lag(touches(18, 19, 20, 21)).half < 6


def test_the_lag_interval_covers_the_scatter_of_a_median() -> None:
    rng = np.random.default_rng(0)
    lags = [estimate_lag(touches(*rng.normal(0, 1000, 20))) for _ in range(2000)]
    assert np.mean([abs(lag.value) <= lag.half for lag in lags]) > 0.94


def test_weak_touches_are_not_used() -> None:
    assert estimate_lag([*touches(10, 11, 12), *touches(90, 95, 99, force_n=2.0)]).value == 11


def test_too_few_usable_touches_are_refused() -> None:
    nan = float("nan")
    with pytest.raises(DataError, match="only 2 of 4 touches determine the camera's lag, and 3 are needed"):
        estimate_lag(touches(10, 11, nan, nan))
    with pytest.raises(DataError, match="0 of 0 touches"):
        estimate_lag([])
