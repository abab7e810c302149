import math

import pytest

from gripper_force.config import ControlConfig
from gripper_force.control.visual_check import VisualCheck
from gripper_force.types import NS_PER_MS, VisualForce

CONFIG = ControlConfig()
FRAME_NS = 16 * NS_PER_MS


def visual(t_ns, force_n=4.0, std_n=0.1):
    return VisualForce(t_ns, t_ns, 0, force_n, std_n, 1.0)


def seen(force_n, before_n=0.0, std_n=0.1, config=CONFIG):
    """Returns a check that has seen half a second of each force, the second in a grip, and the present time."""
    check = VisualCheck(config)
    for cycle in range(1, 61):
        gripping = cycle > 30
        if cycle == 31:
            check.start()
        estimate = visual(cycle * FRAME_NS, force_n if gripping else before_n, std_n)
        check.add(cycle * FRAME_NS, estimate, gripping=gripping)
    return check, 60 * FRAME_NS


@pytest.mark.parametrize("std_n", [0.1, math.inf], ids=["familiar", "unfamiliar"])
def test_a_force_that_rises_confirms_a_grip(std_n):
    check, _ = seen(4.0, std_n=std_n)
    assert not check.objection(4.0, 0.0)


@pytest.mark.parametrize("std_n", [0.1, math.inf], ids=["familiar", "unfamiliar"])
@pytest.mark.parametrize("before_n", [0.0, 3.0])
def test_a_force_that_does_not_rise_is_an_objection(before_n, std_n):
    check, _ = seen(before_n + 0.1, before_n=before_n, std_n=std_n)
    assert f"saw {before_n:.1f} N before the contact" in check.objection(4.0, 4.0)


@pytest.mark.parametrize(
    ("before_n", "rise_n", "target_n", "std_n", "objects"),
    [
        (3.0, 0.3, 1.0, 0.2, True),
        (3.0, 0.4, 1.0, 0.2, False),
        (3.0, 0.2, 0.4, 0.4, False),  # a small target may be within the noise
        (3.0, 0.3, 1.0, math.inf, False),  # the noise of unfamiliar frames is not known
        (0.7, 0.3, 1.0, 0.2, False),  # an impact may have given this force
    ],
)
def test_forces_above_the_target_before_the_contact_make_noise_count_until_the_grip_is_held(
    before_n, rise_n, target_n, std_n, objects
):
    check, _ = seen(before_n + rise_n, before_n, std_n)
    assert bool(check.objection(target_n, 4.0)) == objects
    assert not check.objection(target_n, 4.0, is_held=True)


def test_far_more_than_the_target_is_an_objection_unless_the_motor_current_proves_a_grip():
    check, _ = seen(9.0)
    assert "sees 8.9 N" in check.objection(4.0, 1.9)
    assert not check.objection(4.0, 2.0)


@pytest.mark.parametrize(("force_n", "objects"), [(2.0, False), (2.8, True)])
def test_for_a_small_target_it_takes_more_than_the_target_to_be_far_more(force_n, objects):
    check, _ = seen(force_n)
    assert bool(check.objection(0.8, 0.0)) == objects


def test_uncertain_estimates_alone_are_an_objection():
    check, _ = seen(4.0, std_n=2 * CONFIG.vision_std_n)
    assert check.objection(4.0, 4.0) == "the camera is uncertain"


@pytest.mark.parametrize("strange", [{"force_n": math.nan}, {"force_n": math.inf}, {"std_n": math.nan}])
def test_estimates_that_are_not_finite_do_not_count(strange):
    check, t_ns = seen(4.0)
    check.add(t_ns + 1, visual(t_ns + 1, **strange), gripping=True)
    assert not check.objection(4.0, 1.9)


def test_a_frame_from_the_future_does_not_count():
    check, t_ns = seen(0.0)
    check.add(t_ns + 1, visual(t_ns + 3600 * 1000 * NS_PER_MS, 9.0), gripping=True)
    assert check.objection(4.0, 4.0)
    for cycle in range(1, 31):
        check.add(t_ns + cycle * FRAME_NS, visual(t_ns + cycle * FRAME_NS, 4.0), gripping=True)
    assert not check.objection(4.0, 0.0)


def test_a_camera_that_has_stopped_objects_to_nothing():
    check, t_ns = seen(0.0)
    assert check.objection(4.0, 4.0)
    check.add(t_ns + 1, visual(t_ns + 1, std_n=2 * CONFIG.vision_std_n), gripping=True)
    check.add(t_ns + 1000 * NS_PER_MS, None, gripping=True)
    assert not check.objection(4.0, 4.0)


def covered(check, t_ns, cycles=3):
    """Adds covered frames in the grip, and returns the present time."""
    for _ in range(cycles):
        t_ns += FRAME_NS
        check.add(t_ns, visual(t_ns, math.nan, math.inf), gripping=True)
    return t_ns


def test_once_the_view_is_covered_the_motor_current_has_to_prove_the_grip():
    check, t_ns = seen(4.0)
    t_ns = covered(check, t_ns, 1)
    check.add(t_ns + 5 * NS_PER_MS, None, gripping=True)  # a cycle without a new frame
    assert check.objection(4.0, 1.9) == "the object is gone, or the view is covered or blurred"
    assert not check.objection(4.0, 2.0)
    covered(check, t_ns, 100)  # longer than an estimate is valid
    assert "covered" in check.objection(4.0, 1.9)
    assert not check.objection(4.0, 2.0)


def test_a_view_that_is_clear_again_counts_again():
    check, t_ns = seen(4.0)
    t_ns = covered(check, t_ns) + FRAME_NS
    check.add(t_ns, visual(t_ns, 4.0), gripping=True)
    assert not check.objection(4.0, 1.9)


def test_a_camera_that_stops_after_a_covered_frame_objects_to_nothing():
    check, t_ns = seen(4.0)
    check.add(t_ns + 1, visual(t_ns + 1, math.nan, math.inf), gripping=True)
    assert check.objection(4.0, 1.9)
    check.add(t_ns + 1000 * NS_PER_MS, None, gripping=True)
    assert not check.objection(4.0, 1.9)


def test_a_clear_view_with_an_uncertain_estimate_is_not_covered():
    check, t_ns = seen(4.0)
    t_ns = covered(check, t_ns) + FRAME_NS
    check.add(t_ns, visual(t_ns, 4.0, 2 * CONFIG.vision_std_n), gripping=True)
    assert not check.objection(4.0, 1.9)


@pytest.mark.parametrize("before", ["covered before", "covered in the grip before"])
def test_a_view_that_was_covered_before_the_grip_objects_to_nothing(before):
    check = VisualCheck(CONFIG)
    t_ns = 0
    if before == "covered in the grip before":
        check, t_ns = seen(4.0)
    t_ns = covered(check, t_ns)
    check.start()
    assert "covered" not in check.objection(4.0, 1.9)
    covered(check, t_ns, 100)
    assert not check.objection(4.0, 1.9)


def test_by_motor_current_alone_a_covered_view_is_no_objection():
    check, t_ns = seen(4.0, config=CONFIG.model_copy(update={"feedback": "current"}))
    covered(check, t_ns)
    assert not check.objection(4.0, 0.0)


def test_by_motor_current_alone_the_camera_has_no_say():
    check, _ = seen(0.0, config=CONFIG.model_copy(update={"feedback": "current"}))
    assert not check.objection(4.0, 4.0)


@pytest.mark.parametrize(("friction_n", "objects"), [(0.2, True), (1.0, False)])
def test_a_rise_before_the_ramp_counts_only_as_far_as_friction_may_hold_it(friction_n, objects):
    check = VisualCheck(CONFIG)
    for cycle in range(1, 31):
        check.add(cycle * FRAME_NS, visual(cycle * FRAME_NS, 6.8), gripping=False)
    check.start()
    for cycle in range(31, 91):
        if cycle == 60:
            check.settle(friction_n)
        check.add(cycle * FRAME_NS, visual(cycle * FRAME_NS, 7.7), gripping=True)
    assert bool(check.objection(4.5, 4.5)) == objects


def test_a_camera_that_starts_after_the_contact_confirms_a_grip():
    check = VisualCheck(CONFIG)
    check.start()
    check.settle(0.2)
    for cycle in range(1, 31):
        check.add(cycle * FRAME_NS, visual(cycle * FRAME_NS, 0.8), gripping=True)
    assert not check.objection(4.0, 4.0)
