"""Signals during a calibration that moves the jaws."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gripper_calibration.procedures.calibrate_jaws import calibrate_jaws
from gripper_calibration.procedures.calibrate_servo import calibrate_servo
from gripper_force.config import load_config
from gripper_force.progress import Progress
from gripper_force.runtime.process import SIGNALS, raise_interrupt
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
