"""Tests that every `gripper_force.interfaces.Servo` must pass.

Subclass `ServoContract` in a test module and override its fixtures::

    class TestMyServo(ServoContract):
        @pytest.fixture
        def config(self):
            return gf.ServoConfig(port="/dev/ttyUSB0")

        @pytest.fixture
        def servo(self, config):
            return MyServo(config, time.monotonic_ns)

        @pytest.fixture
        def spec(self, config):
            return MyServo.spec(config)

On a real servo the horn moves: `ServoContract.travel_rad` must be free in front of it.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import pairwise

import pytest

from gripper_force.config import ServoConfig
from gripper_force.errors import DeviceError, NonFiniteError
from gripper_force.interfaces import BusStats, Servo, ServoSpec
from gripper_force.types import NS_PER_S, ServoCommand, ServoState

_MAX_CYCLES = 4000
"""Cycles within which a commanded motion must happen."""

_STILL_RAD = 0.01
"""Tolerance of a position that must not change."""

_STILL_RAD_S = 0.05
"""Velocity below which the horn counts as at rest; two steps of a Dynamixel's Present Velocity."""


class ServoContract:
    """Contract tests of a servo. Every fixture may be overridden; `servo` and `spec` must be."""

    @pytest.fixture
    def config(self) -> ServoConfig:
        """Configuration of the servo under test."""
        return ServoConfig()

    @pytest.fixture
    def servo(self, config: ServoConfig) -> Servo:
        """A servo that was not started yet, without an active hardware error and with the horn at rest."""
        raise NotImplementedError("override the fixture servo")

    @pytest.fixture
    def spec(self, config: ServoConfig) -> ServoSpec:
        """Result of the static method ``spec`` of the servo's class."""
        raise NotImplementedError("override the fixture spec")

    @pytest.fixture
    def second_servo(self, config: ServoConfig) -> Servo | None:
        """Another object for the same device, not started; None skips the test of exclusive access."""
        return None

    @pytest.fixture
    def now_ns(self) -> Callable[[], int]:
        """The clock of the servo's states."""
        return time.monotonic_ns

    @pytest.fixture
    def wait(self) -> Callable[[], None]:
        """Waits for one control cycle, which must be shorter than ``config.bus_watchdog_ms``."""
        return lambda: time.sleep(0.005)

    @pytest.fixture
    def torque_on(self) -> Callable[[], bool] | None:
        """Reads whether torque is on without the servo under test; None skips the checks of torque."""
        return None

    @pytest.fixture
    def travel_rad(self) -> float:
        """Signed angle by which the horn can turn freely from its present position."""
        return 0.2

    @pytest.fixture
    def goal_current_a(self) -> float:
        """Goal current that moves the horn, at most ``config.current_limit_a``."""
        return 0.4

    @pytest.fixture(autouse=True)
    def _stop_and_close(self, servo: Servo, second_servo: Servo | None) -> Iterator[None]:
        yield
        for one in (servo,) if second_servo is None else (servo, second_servo):
            with suppress(DeviceError):
                one.stop(hold=False)
            one.close()

    # Spec.

    def test_spec_is_plausible(self, spec: ServoSpec) -> None:
        """Torque constant and current step are positive; the voltage range is not empty."""
        low_v, high_v = spec.voltage_range_v
        assert 0 < spec.nm_per_a < math.inf
        assert 0 < spec.current_step_a < math.inf
        assert 0 < low_v < high_v < math.inf

    # States.

    def test_times_increase_and_values_are_plausible(
        self, servo: Servo, spec: ServoSpec, now_ns: Callable[[], int], wait: Callable[[], None]
    ) -> None:
        """States carry the time of their read, finite values, and a supply voltage within the spec."""
        before_ns = now_ns()
        states = [servo.start()]
        for _ in range(20):
            wait()
            states.append(servo.read())
        times_ns = [state.t_ns for state in states]
        assert times_ns == sorted(set(times_ns))
        assert before_ns <= times_ns[0]
        assert times_ns[-1] <= now_ns()
        low_v, high_v = spec.voltage_range_v
        for state in states:
            assert low_v <= state.voltage_v <= high_v
            assert 0 < state.temperature_c < 100
            assert state.hardware_error == 0
            assert all(map(math.isfinite, (state.position_rad, state.velocity_rad_s, state.current_a)))

    def test_every_read_counts_as_one_cycle(self, servo: Servo, wait: Callable[[], None]) -> None:
        """``stats.cycles`` increases by one per ``read``."""
        servo.start()
        before = servo.stats.cycles
        _cycles(servo, wait, 10)
        stats = servo.stats
        assert isinstance(stats, BusStats)
        assert stats.cycles == before + 10
        assert min(stats.retries, stats.timeouts, stats.corrupt) >= 0

    # Motion.

    def test_moves_to_the_goal(
        self, servo: Servo, wait: Callable[[], None], travel_rad: float, goal_current_a: float
    ) -> None:
        """A goal with enough current moves the horn."""
        start_rad = servo.start().position_rad
        servo.write(ServoCommand(0, start_rad + travel_rad, goal_current_a))
        _read_until(servo, wait, lambda state: (state.position_rad - start_rad) / travel_rad > 0.5)

    def test_velocity_and_current_belong_to_the_motion(
        self,
        servo: Servo,
        config: ServoConfig,
        wait: Callable[[], None],
        travel_rad: float,
        goal_current_a: float,
    ) -> None:
        """Both have the sign and the size of the motion: rad/s and A, positive where the position rises."""
        states = [servo.start()]
        start_rad = states[0].position_rad

        def is_half_way(state: ServoState) -> bool:
            states.append(state)
            return (state.position_rad - start_rad) / travel_rad > 0.5

        servo.write(ServoCommand(0, start_rad + travel_rad, goal_current_a))
        _read_until(servo, wait, is_half_way)
        integral_rad = sum(
            0.5 * (old.velocity_rad_s + new.velocity_rad_s) * (new.t_ns - old.t_ns) / NS_PER_S
            for old, new in pairwise(states)
        )
        assert 0.3 < integral_rad / (states[-1].position_rad - start_rad) < 3
        assert sum(state.current_a for state in states) / travel_rad > 0
        assert max(abs(state.current_a) for state in states) < 3 * config.current_limit_a

    def test_start_turns_torque_on_and_keeps_the_position(
        self, servo: Servo, wait: Callable[[], None], torque_on: Callable[[], bool] | None
    ) -> None:
        """``start`` takes the present position as goal."""
        start_rad = servo.start().position_rad
        assert torque_on is None or torque_on()
        _assert_still(servo, wait, start_rad)

    def test_restart_does_not_continue_to_the_last_goal(
        self, servo: Servo, wait: Callable[[], None], travel_rad: float, goal_current_a: float
    ) -> None:
        """``start`` discards the goal of an earlier run."""
        start_rad = servo.start().position_rad
        servo.write(ServoCommand(0, start_rad + travel_rad, goal_current_a))
        _read_until(servo, wait, lambda state: (state.position_rad - start_rad) / travel_rad > 0.25)
        servo.stop(hold=False)
        _read_until(servo, wait, lambda state: abs(state.velocity_rad_s) < _STILL_RAD_S)
        servo.close()
        _assert_still(servo, wait, servo.start().position_rad)

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_non_finite_goals_are_refused(
        self, servo: Servo, wait: Callable[[], None], goal_current_a: float, bad: float
    ) -> None:
        """``write`` raises `NonFiniteError` and does not change the goals."""
        start_rad = servo.start().position_rad
        for command in (ServoCommand(0, bad, goal_current_a), ServoCommand(0, start_rad, bad)):
            with pytest.raises(NonFiniteError):
                servo.write(command)
        _assert_still(servo, wait, start_rad)

    # Stop and close.

    def test_stop_turns_torque_off(
        self,
        servo: Servo,
        wait: Callable[[], None],
        torque_on: Callable[[], bool] | None,
        travel_rad: float,
        goal_current_a: float,
    ) -> None:
        """``stop`` turns torque off, leaves the port open, and may be called twice."""
        start_rad = servo.start().position_rad
        servo.write(ServoCommand(0, start_rad + travel_rad, goal_current_a))
        _cycles(servo, wait, 5)
        servo.stop(hold=False)
        assert torque_on is None or not torque_on()
        servo.read()  # works until `close`
        servo.stop(hold=False)

    def test_stop_with_hold_keeps_torque_without_a_client(
        self, servo: Servo, wait: Callable[[], None], torque_on: Callable[[], bool] | None
    ) -> None:
        """With ``hold`` torque stays on after ``close``, without any further call."""
        if torque_on is None:
            pytest.skip("the fixture torque_on is not overridden")
        servo.start()
        servo.stop(hold=True)
        servo.close()
        for _ in range(100):
            wait()
        assert torque_on()
        servo.start()  # so that the torque can be turned off

    @pytest.mark.parametrize("call", ["read", "write", "stop"])
    def test_calls_before_start_and_after_close_fail(self, servo: Servo, call: str) -> None:
        """``read``, ``write`` and ``stop`` raise `DeviceError` unless the servo is started."""
        calls: dict[str, Callable[[], object]] = {
            "read": servo.read,
            "write": lambda: servo.write(ServoCommand(0, 0.0, 0.0)),
            "stop": lambda: servo.stop(hold=False),
        }
        with pytest.raises(DeviceError):
            calls[call]()
        servo.start()
        servo.stop(hold=False)
        servo.close()
        with pytest.raises(DeviceError):
            calls[call]()

    def test_close_works_twice_and_before_start(self, servo: Servo) -> None:
        """``close`` is harmless on a closed servo, and a closed servo can be started."""
        servo.close()
        servo.start()
        servo.stop(hold=False)
        servo.close()
        servo.close()

    def test_second_servo_is_refused_until_the_first_is_closed(
        self, servo: Servo, second_servo: Servo | None, wait: Callable[[], None]
    ) -> None:
        """Only one object at a time can use the device."""
        if second_servo is None:
            pytest.skip("the fixture second_servo is not overridden")
        servo.start()
        with pytest.raises(DeviceError):
            second_servo.start()
        _cycles(servo, wait, 1)  # the first one still works
        servo.stop(hold=False)
        servo.close()
        second_servo.start()
        second_servo.stop(hold=False)
        second_servo.close()


def _cycles(servo: Servo, wait: Callable[[], None], count: int) -> ServoState:
    """Reads ``count`` times, which also feeds a watchdog, and returns the last state."""
    for _ in range(count):
        wait()
        state = servo.read()
    return state


def _read_until(servo: Servo, wait: Callable[[], None], condition: Callable[[ServoState], bool]) -> None:
    for _ in range(_MAX_CYCLES):
        state = _cycles(servo, wait, 1)
        if condition(state):
            return
    raise AssertionError(f"expected state not reached within {_MAX_CYCLES} cycles: {state}")


def _assert_still(servo: Servo, wait: Callable[[], None], position_rad: float) -> None:
    for _ in range(50):
        state = _cycles(servo, wait, 1)
        assert state.position_rad == pytest.approx(position_rad, abs=_STILL_RAD)
