import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pytest

from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.interfaces import WorldState
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, LoadCellSample, ServoCommand, ServoState
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.virtual import find_bus
from gripper_hw.sim import simulated_rig as rig_module
from gripper_hw.sim.simulated_rig import SimulatedRig, expose

MakeRig = Callable[..., SimulatedRig]


@pytest.fixture
def make_rig(quick: list[str]) -> Iterator[MakeRig]:
    rigs: list[SimulatedRig] = []

    def make(*overrides: str) -> SimulatedRig:
        config = load_config(None, [*quick, "camera.backend=simulated", "camera.rate_hz=20", *overrides])
        rigs.append(SimulatedRig(config))
        rigs[-1].config = config  # type: ignore[attr-defined]
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.close()


def servo_of(rig: SimulatedRig) -> DynamixelServo:
    config: Config = rig.config  # type: ignore[attr-defined]
    return DynamixelServo(config.servo, rig.clock.now_ns)


def squeeze(rig: SimulatedRig) -> tuple[list[ServoState], list[Frame], list[LoadCellSample]]:
    """Half a second of closing with 0.15 A."""
    servo = servo_of(rig)
    states, frames, samples = [servo.start()], [], []
    rig.camera.start()
    rig.load_cell.start()
    for i in range(1, 101):
        rig.clock.sleep_until_ns(i * 5 * NS_PER_MS)
        states.append(servo.read())
        servo.write(ServoCommand(0, 1.5, 0.15))
        frame = rig.camera.newest()
        frames += [frame] if frame is not None else []
        samples += rig.load_cell.drain()
    servo.stop(hold=False)
    servo.close()
    rig.close()
    return states, frames, samples


def test_same_seed_gives_identical_data_and_another_seed_differs(make_rig: MakeRig) -> None:
    first, again, other = (squeeze(make_rig(f"seed={seed}")) for seed in (5, 5, 6))
    assert first[0] == again[0]
    assert first[2] == again[2]
    assert all((a.gray == b.gray).all() for a, b in zip(first[1], again[1], strict=True))
    assert max(sample.force_n for sample in first[2]) > 1.0
    assert first[0] != other[0]
    assert [s.force_n for s in first[2]] != [s.force_n for s in other[2]]
    assert (first[1][0].gray != other[1][0].gray).any()


def test_moving_background_changes_images_only(make_rig: MakeRig) -> None:
    still, moving = (squeeze(make_rig(f"sim.moving_background={asked}")) for asked in ("false", "true"))
    assert moving[0] == still[0]
    assert moving[2] == still[2]
    differs = np.array([a.gray != b.gray for a, b in zip(moving[1], still[1], strict=True)])  # (T, H, W)
    assert differs.any((1, 2)).mean() > 0.3  # they also move out of view
    assert (differs[0] != differs[-1]).any()
    assert differs.mean() < 0.5


def test_changing_light_changes_images_only(make_rig: MakeRig) -> None:
    steady, changing = (squeeze(make_rig(f"sim.changing_light={asked}")) for asked in ("false", "true"))
    assert changing[2] == steady[2]
    linear = [[(f.gray / 255.0) ** 2.2 for f in frames] for frames in (changing[1], steady[1])]
    light = [a.mean() / b.mean() for a, b in zip(*linear, strict=True)]
    assert 0.65 < min(light) < max(light) < 1.35
    assert max(light) - min(light) > 0.02


@pytest.mark.parametrize("latency_ms", [0.0, 40.0])
def test_frame_is_available_after_camera_latency(make_rig: MakeRig, latency_ms: float) -> None:
    rig = make_rig(f"sim.camera_latency_ms={latency_ms}", "camera.rate_hz=100")
    rig.camera.start()
    frames = []
    for t_ms in range(0, 200, 2):
        rig.clock.sleep_until_ns(t_ms * NS_PER_MS)
        if (frame := rig.camera.newest()) is not None:
            assert frame.received_ns <= t_ms * NS_PER_MS < frame.received_ns + 3 * NS_PER_MS
            frames.append(frame)
    assert {f.received_ns - f.t_ns for f in frames} == {round(latency_ms * NS_PER_MS)}
    assert [f.seq for f in frames] == list(range(len(frames)))
    assert [f.t_ns for f in frames] == [10 * NS_PER_MS * (i + 1) for i in range(len(frames))]
    assert frames[0].gray.shape == (128, 128)
    assert frames[0].gray.dtype == np.uint8


@pytest.mark.parametrize("rate_hz", [80, 200])
def test_load_cell_has_its_rate_and_noise(make_rig: MakeRig, rate_hz: int) -> None:
    rig = make_rig(f"load_cell.rate_hz={rate_hz}")
    rig.load_cell.start()
    rig.load_cell.start()  # has no effect
    rig.clock.sleep_until_ns(NS_PER_S)
    samples = rig.load_cell.drain()
    assert len(samples) == rate_hz
    assert rig.load_cell.drain() == []
    forces_n = [sample.force_n for sample in samples]
    assert abs(np.mean(forces_n)) < 0.005
    assert 0.007 < np.std(forces_n) < 0.013


@pytest.mark.parametrize("unit", ["camera", "load_cell"])
def test_a_rate_above_that_of_the_physics_steps_is_refused(make_rig: MakeRig, unit: str) -> None:
    with pytest.raises(
        ConfigError, match=rf"{unit}\.rate_hz 500 is more than the 400 physics steps per second"
    ):
        make_rig(f"{unit}.rate_hz=500", "object=sponge")
    assert find_bus("rig") is None
    make_rig(f"{unit}.rate_hz=500", "object=sponge", "camera.backend=none", "load_cell.backend=none")


def test_notes_hold_scene_and_exposure(make_rig: MakeRig) -> None:
    rig = make_rig("sim.exposure_ms=7")
    notes = rig.notes()
    assert json.loads(notes["scene"]) == json.loads(json.dumps(asdict(rig.scene)))
    assert notes["exposure_ms"] == "7.0"


def first_gray(rig: SimulatedRig) -> np.ndarray:
    rig.camera.start()
    rig.clock.sleep_until_ns(100 * NS_PER_MS)
    frame = rig.camera.newest()
    assert frame is not None
    rig.close()
    return frame.gray


def test_longer_exposure_is_brighter_up_to_saturation(make_rig: MakeRig) -> None:
    grays = {us: first_gray(make_rig(f"camera.exposure_us={us}")) for us in ("null", 2000, 4000, 400_000)}
    assert (grays["null"] == grays[4000]).all()
    ratio = np.median(grays[4000] / np.maximum(grays[2000], 1.0))
    assert ratio == pytest.approx(2 ** (1 / 2.2), rel=0.03)
    assert np.mean(grays[400_000] == 255) > 0.5
    assert make_rig("camera.exposure_us=6000").notes()["exposure_ms"] == "6.0"


def test_servo_watchdog_counts_simulated_time(make_rig: MakeRig) -> None:
    rig = make_rig()
    servo = servo_of(rig)
    servo.start()
    time.sleep(0.06)
    servo.read()
    rig.clock.sleep_until_ns(60 * NS_PER_MS)
    bus = find_bus("rig")
    assert bus is not None
    assert bus.servos[0].tripped
    servo.close()


def test_unknown_object_is_refused_and_leaves_no_bus(quick: list[str]) -> None:
    with pytest.raises(ConfigError, match="no simulated object 'egg'; there are sponge"):
        SimulatedRig(load_config(None, [*quick, "object=egg"]))
    assert find_bus("rig") is None


def test_closed_rig_leaves_no_bus_and_no_thread(make_rig: MakeRig) -> None:
    rig = make_rig("clock=realtime")
    rig.start()
    rig.start()
    assert "simulated-rig" in {thread.name for thread in threading.enumerate()}
    rig.close()
    rig.close()
    assert find_bus("rig") is None
    assert "simulated-rig" not in {thread.name for thread in threading.enumerate()}


def test_second_close_leaves_the_bus_of_another_rig(make_rig: MakeRig) -> None:
    rig = make_rig()
    rig.close()
    other = make_rig()
    rig.close()
    assert find_bus("rig") is not None
    other.close()
    assert find_bus("rig") is None


def error_of_patched_rig(make_rig: MakeRig, patch: Callable[[SimulatedRig], None]) -> BaseException:
    """Returns the exception that `check` raises for a patched rig in real time."""
    rig = make_rig("clock=realtime")
    patch(rig)
    rig.start()
    until_s = time.monotonic() + 20
    with pytest.raises(Exception) as caught:
        while time.monotonic() < until_s:
            rig.check()
            time.sleep(0.005)
    return caught.value


def test_a_rig_that_has_started_in_real_time_is_ready_to_render(make_rig: MakeRig) -> None:
    """A rendering context that is made later holds up the control loop, until the servo's watchdog trips."""
    rig = make_rig("clock=realtime", "camera.rate_hz=0.1")
    rendered: list[int] = []
    world = rig._world
    render = world.render
    world.render = lambda side_px: (rendered.append(side_px), render(side_px))[1]  # type: ignore[method-assign, func-returns-value]
    rig.start()
    assert rendered
    assert world.t_ns > 0


def test_too_slow_machine_is_an_error(make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig_module, "_REALTIME_MAX_LAG_NS", -1)
    error = error_of_patched_rig(make_rig, lambda _: None)
    assert isinstance(error, SimulationError)
    slow = "this machine is too slow to simulate 'stapler' (coarse) in real time; set clock=lockstep"
    assert str(error) == slow, "it is coarse already"


def test_exception_of_thread_is_raised_by_check(make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise MemoryError("no more")

    error = error_of_patched_rig(
        make_rig,
        lambda rig: monkeypatch.setattr(rig.load_cell._world, "advance_to", fail),  # type: ignore[attr-defined]
    )
    assert isinstance(error, MemoryError)


def test_light_sets_brightness_and_noise_sets_variance() -> None:
    picture = np.full((64, 64, 3), 128, np.uint8)

    def grays(lux: float, noise: float) -> np.ndarray:
        return expose(picture, lux, noise, np.random.default_rng(0)).astype(float)

    assert grays(550, 0.0).shape == (32, 32)
    means = [grays(lux, 0.0).mean() for lux in (350, 550, 750)]
    assert means == sorted(means)
    assert means[2] / means[0] == pytest.approx((750 / 350) ** (1 / 2.2), rel=0.02)
    assert np.diff(grays(550, 0.03)).std() > 2 * np.diff(grays(550, 0.0)).std()
    assert grays(550, 0.0)[16, 16] > 1.02 * grays(550, 0.0)[0, 0]  # the lens darkens the corners
    assert grays(1e6, 0.0).max() == 255


def test_the_true_state_is_observed_at_each_step(make_rig: MakeRig) -> None:
    fault = "faults=[{unit: plant, kind: off, at_s: 0.3}]"
    rig = make_rig(fault, "gripper.open_width_m=0.066", "camera.rate_hz=1")  # near the object
    seen: list[WorldState] = []
    rig.observe_world(seen.append)
    squeeze(rig)
    steps_ns = {after.t_ns - before.t_ns for before, after in pairwise(seen)}
    assert len(steps_ns) == 1
    assert max(state.closing_m_s for state in seen) > 0.01
    before, after = ([s for s in seen if s.has_object is there] for there in (True, False))
    assert after[0].t_ns == pytest.approx(300 * NS_PER_MS, abs=max(steps_ns))
    assert max(s.force_n for s in before) > 1.0
    assert after[1].force_n == 0.0


def test_the_true_open_width_is_not_the_believed_one(make_rig: MakeRig) -> None:
    def contact_rad(*keys: str) -> float:
        states, _, samples = squeeze(make_rig("sim.randomise=false", "camera.rate_hz=1", *keys))
        return states[next(i for i, s in enumerate(samples) if s.force_n > 0.5)].position_rad

    radius_m = 0.02
    wide, narrow = (contact_rad("sim.open_width_m=" + width) for width in ("0.074", "0.068"))
    assert wide - narrow == pytest.approx(0.003 / radius_m, abs=0.02)
    believed = contact_rad("sim.open_width_m=0.068", "gripper.open_width_m=0.08")
    assert believed == narrow
