"""A servo under torque in a calibration: signals, and a bus that is silent for a moment."""

import signal
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from gripper_calibration.procedures.calibrate_jaws import calibrate_jaws
from gripper_calibration.procedures.calibrate_servo import calibrate_servo
from gripper_calibration.procedures.powered_servo import BusCycles, servo_alone, torque_on
from gripper_force.config import load_config
from gripper_force.progress import Progress
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.process import SIGNALS, raise_interrupt
from gripper_force.runtime.resolve import resolve
from gripper_hw.dynamixel.servo import DynamixelServo
from gripper_hw.dynamixel.virtual import VirtualBus, find_bus


def run_servo(folder: Path, progress: Progress) -> None:
    config = load_config(None, ["object=block", "sim.detail=coarse"])
    calibrate_servo(config, [0.03], folder / "rig.yaml", prompt=lambda text: None, progress=progress)


def run_jaws(_: Path, progress: Progress) -> None:
    config = load_config(None, ["object=none", "sim.detail=coarse"])
    calibrate_jaws(config, prompt=lambda text: None, progress=progress)


@pytest.fixture
def command_line_handlers() -> Iterator[None]:
    earlier = {number: signal.signal(number, raise_interrupt) for number in SIGNALS}
    yield
    for number, handler in earlier.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("own_process", "command_line_handlers")
@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("calibrate", [run_servo, run_jaws])
def test_signals_of_a_lost_connection_leave_the_torque_off(
    calibrate: Callable[[Path, Progress], None],
    number: signal.Signals,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    buses: list[VirtualBus] = []
    stop = DynamixelServo.stop

    def stop_at_another_signal(servo: DynamixelServo, *, hold: bool) -> None:
        signal.raise_signal(number)
        stop(servo, hold=hold)

    def send(text: str, steps: int = 1) -> None:
        bus = find_bus("rig")
        assert bus is not None
        assert bus.servos[0].get("torque_enable") == 1
        buses.append(bus)
        signal.raise_signal(number)

    monkeypatch.setattr(DynamixelServo, "stop", stop_at_another_signal)
    with pytest.raises(KeyboardInterrupt):
        calibrate(tmp_path, send)
    assert len(buses) == 1
    assert buses[0].servos[0].get("torque_enable") == 0
    assert signal.getsignal(number) is raise_interrupt


def test_a_silence_of_the_bus_that_the_watchdog_tolerates_is_no_error() -> None:
    fault = "faults=[{unit: bus, kind: slow, at_s: 0.05, for_s: 0.02}]"
    config = resolve(
        servo_alone(load_config(None, ["object=none", "sim.detail=coarse", fault])), vision=False
    ).config
    with open_devices(config) as devices, torque_on(devices.servo) as (state, raise_if_interrupted):
        cycles = BusCycles(config, devices, state, raise_if_interrupted)
        times_ns: list[int] = []
        while not times_ns or times_ns[-1] < times_ns[0] + 100_000_000:
            times_ns.append(cycles.read().t_ns)
            cycles.write(cycles.state.position_rad, 0.0, cycles.approach_m_s)
    periods_ns = [after - before for before, after in pairwise(times_ns)]
    assert max(periods_ns) > 3 * min(periods_ns), "the bus was silent once"
