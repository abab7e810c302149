"""Measurements for the calibration of a servo: presses on a gauge, and free travel beside it."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final, NoReturn

import numpy as np

from gripper_calibration.fits.servo_fit import MIN_PASSES, FreePass, ServoPress
from gripper_calibration.procedures.powered_servo import RATE_HZ, BusCycles, torque_on
from gripper_force.config import Config, GripperConfig
from gripper_force.control.limits import largest_target_n
from gripper_force.control.linkage import make_linkage
from gripper_force.control.transmission import Transmission, force_bound
from gripper_force.errors import DataError, DeviceError
from gripper_force.interfaces import Devices, LoadCell
from gripper_force.jobs.recording.record import FIRST_SAMPLE_NS
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.resolve import make_controller
from gripper_force.types import NS_PER_S, ServoState

PRESSES: Final = ((3.0, 1.0), (6.0, 1.0), (12.0, 1.0), (3.0, 0.6), (6.0, 0.8), (12.0, 0.8))
"""Rate in N/s and share of the largest force of each press. Several rates separate lag from friction."""

SPEEDS_M_S: Final = (0.012, 0.020, 0.028, 0.036, 0.044, 0.052)
"""Target speeds of one jaw in free travel. They are proportionally lower if a pass at the last one is too short."""

CLEARANCE_M: Final = 0.005
"""Distance that the jaws keep from the gauge and from their ends."""

_PASS_S: Final = 0.3
"""Least time of a pass, with its acceleration."""

_PEAK_SHARE: Final = 1.05
"""Peak force as a share of the largest target, so that every target lies within the calibrated range."""
_APPROACH_M_S: Final = 0.008
_CONTACT_N: Final = 0.5
_NO_CONTACT_N: Final = 0.2
_REST_S: Final = 0.5
_TARE_SAMPLES: Final = 5
_MAX_TARE_S: Final = 3.0
_OVERSHOOT_SHARE: Final = 0.05
"""The first press is so slow that the force rises by at most this share until a sample shows it."""
_MIN_SHARE: Final = 0.7
"""Least share of the peak force that a press at the current ceiling must reach."""
_MAX_TARE_N: Final = 1.0
_MIN_TRAVEL_M: Final = 0.001
"""Jaws that closed by less than this did not move."""
_BRAKE_RAD: Final = 0.3
"""Distance from the goal at which the servo's own position control takes over, and at most a fifth of the pass."""
_SPEED_UP_S: Final = 0.1
_START_FACTOR: Final = 1.6
_MIN_SPEED_RAD_S: Final = 0.15
_MAX_PASS_S: Final = 4.0
_SILENT_NS: Final = 3 * NS_PER_S // 2
"""Longest silence during a motion. At 10 samples/s, a sample waits 0.3 s for those that show if it is a spike."""
_BEYOND_RAD: Final = 1.0
"""Distance of the goal beyond the contact, so that only the current limits the force."""


def measure(
    config: Config, gauge_m: float, progress: Progress = no_progress
) -> tuple[list[ServoPress], list[FreePass]]:
    """Presses the gauge between the jaws, and moves freely beside it.

    Args:
        config: A resolved configuration.
        gauge_m: Width of the gauge in metres.
        progress: Called with the step and the force.

    Raises:
        DeviceError: A device failed, or the jaws start outside their travel. The servo has no torque.
        DataError: The load cell reads a force without contact, or the jaws met nothing.
    """
    with open_devices(config) as devices, _torque_on(config, devices, progress) as jaws:
        jaws.open()
        jaws.tare()
        jaws.step_name = "closing on the gauge"
        contact_rad = jaws.close_on_gauge(gauge_m)
        peak_n = _PEAK_SHARE * largest_target_n(config.control.force_limit_n, force_bound(config.gripper))
        presses = []
        for number, (rate_n_s, share) in enumerate(PRESSES, start=1):
            jaws.step_name = f"{1e3 * gauge_m:g} mm, press {number} of {len(PRESSES)}"
            if number > 1:
                jaws.close_on_gauge(gauge_m)
            presses.append(jaws.press(gauge_m, contact_rad, rate_n_s, share, peak_n))
            jaws.back_off(contact_rad)
        jaws.step_name = f"{1e3 * gauge_m:g} mm, free travel"
        n_per_a = (config.gripper.nm_per_a or 0.0) / (2 * reference_m_per_rad(config.gripper))
        friction_n = n_per_a * float(np.median([_friction_a(press) for press in presses]))
        passes = [one for speed in SPEEDS_M_S for one in jaws.travel(friction_n, speed, contact_rad)]
        if len(passes) < MIN_PASSES:  # some were too short, or the jaws stuck
            passes += [one for speed in SPEEDS_M_S for one in jaws.travel(friction_n, speed, contact_rad)]
    return presses, passes


def _friction_a(press: ServoPress) -> float:
    """Half the difference of the currents while the force rises and falls, near half of the largest force."""
    middle_n = press.force_n[press.turn - 1] / 2
    near = np.abs(press.force_n - middle_n) < middle_n / 4
    rising = np.arange(len(press.force_n)) < press.turn
    rising_a, falling_a = press.current_a[near & rising], press.current_a[near & ~rising]
    if not (len(rising_a) and len(falling_a)):
        return 0.0
    return float(rising_a.mean() - falling_a.mean()) / 2


@contextmanager
def _torque_on(config: Config, devices: Devices, progress: Progress) -> Iterator["_Jaws"]:
    """Yields jaws under torque, and turns torque off at every end."""
    assert devices.load_cell is not None
    devices.load_cell.start()
    _wait_for_sample(devices)
    with torque_on(devices.servo) as (state, raise_if_interrupted):
        if problem := make_controller(config).start_problem(state):
            raise DeviceError(problem)
        yield _Jaws(config, devices, BusCycles(config, devices, state, raise_if_interrupted), progress)


def _wait_for_sample(devices: Devices) -> None:
    """Returns once the load cell has given a valid sample."""
    cell, clock = devices.load_cell, devices.clock
    assert cell is not None
    begin_ns = clock.now_ns()
    while not any(sample.valid for sample in cell.drain()):
        if clock.now_ns() - begin_ns > FIRST_SAMPLE_NS:
            raise DataError(
                f"the load cell has given no valid sample for {FIRST_SAMPLE_NS / NS_PER_S:g} s "
                f"(rejected: {_rejected(cell)}); check its wiring, calibrate it first with "
                "`calibrate load-cell`, and run `gripper-force doctor`"
            )
        clock.sleep_until_ns(clock.now_ns() + round(NS_PER_S / RATE_HZ))


def _rejected(cell: LoadCell) -> str:
    return ", ".join(f"{n} {name}" for name, n in cell.counts().items() if n) or "none"


def reference_m_per_rad(gripper: GripperConfig) -> float:
    """Travel of one jaw per radian with half-open jaws: the fit reduces every linkage to this pinion."""
    linkage = make_linkage(gripper)
    return linkage.jaw_m_per_rad(linkage.closing_rad(gripper.open_width_m / 2))


def _reduce(transmission: Transmission, states: Sequence[ServoState]) -> FreePass:
    """Converts readings to those of a rack and pinion with the same widths, speeds and forces at the jaws."""
    half_m = transmission.open_width_m / 2
    reference_m_per_rad = transmission.jaw_m_per_rad(transmission.position_rad(half_m))
    sign, open_rad = transmission.closing_sign, transmission.closing_sign * transmission.open_position_rad
    at_rad = [state.position_rad for state in states]
    closed_m = transmission.open_width_m - np.array([transmission.width_m(one) for one in at_rad])
    share = np.array([transmission.jaw_m_per_rad(one) for one in at_rad]) / reference_m_per_rad
    return FreePass(
        t_s=np.array([state.t_ns / NS_PER_S for state in states]),
        current_a=sign * np.array([state.current_a for state in states]) / share,
        closing_rad=open_rad + closed_m / (2 * reference_m_per_rad),
        closing_rad_s=sign * np.array([state.velocity_rad_s for state in states]) * share,
    )


class _Jaws:
    """Moves the jaws cycle by cycle, and records servo and load cell. Positive angles close the jaws."""

    def __init__(self, config: Config, devices: Devices, cycles: BusCycles, progress: Progress) -> None:
        assert devices.load_cell is not None
        self._config, self._cell, self._cycles, self._progress = config, devices.load_cell, cycles, progress
        self._sign = config.gripper.closing_sign
        self._nominal, self._limits = cycles.transmission, cycles.limits
        self._free_friction_n = 0.0  # measured while the jaws close on the gauge
        self._clearance_m = CLEARANCE_M  # at most a tenth of the free travel
        self._full_a: float | None = None  # current at the peak of the first press
        self._max_age_s = 0.0  # of the newest force sample
        self._sample_ns = devices.clock.now_ns()
        self._reported_ns = 0
        self._tare_n = 0.0
        self._states: list[ServoState] = []
        self._forces: list[tuple[int, float]] = []
        self.force_n = 0.0
        self.step_name = "opening"

    @property
    def state(self) -> ServoState:
        return self._cycles.state

    @property
    def closing_rad(self) -> float:
        return self._sign * self.state.position_rad

    @property
    def _ceiling_a(self) -> float:
        """Largest current: whatever the load cell reads, the motor cannot exceed the force limit."""
        return self._limits.ceiling_a(self._free_friction_n, self.state.position_rad)

    @property
    def _jaw_m_per_rad(self) -> float:
        return self._nominal.jaw_m_per_rad(self.state.position_rad)

    def _current_a(self, force_n: float) -> float:
        """Size of the motor current for a motor force at each jaw, at the present angle."""
        return abs(self._nominal.current_a(force_n, self.state.position_rad))

    def cycle(self, goal_rad: float, current_a: float, speed_m_s: float | None = None) -> None:
        """Runs one bus cycle with a goal angle, a current limit, and a speed limit; None: the approach speed."""
        state = self._cycles.read()
        for sample in self._cell.drain():
            if sample.valid:
                self._sample_ns = max(self._sample_ns, sample.t_ns)
                self.force_n = sample.force_n - self._tare_n
                self._forces.append((sample.t_ns, self.force_n))
        self._states.append(state)
        if state.t_ns - self._sample_ns > _SILENT_NS:
            raise DeviceError(
                f"the load cell has given no valid sample for {_SILENT_NS / NS_PER_S:g} s in "
                f"{self.step_name} (rejected: {_rejected(self._cell)}); check its wiring, calibrate it first, and "
                "run `gripper-force doctor`"
            )
        self._cycles.write(
            self._sign * goal_rad,
            min(max(current_a, 0.0), self._ceiling_a),
            speed_m_s or self._cycles.approach_m_s,
            over_force=self.force_n > self._config.control.force_limit_n,
            step=self.step_name,
        )
        if state.t_ns - self._reported_ns > NS_PER_S // 5:
            self._reported_ns = state.t_ns
            self._progress(f"{self.step_name}: {self.force_n:.1f} N", 0)

    def open(self) -> None:
        """Moves to the open position, or as far as the jaws go."""
        self._move_to(self._sign * self._nominal.open_position_rad)

    def tare(self) -> None:
        """Takes the load cell's reading at rest as zero force."""
        goal_rad = self.closing_rad
        mark = len(self._forces)
        for i in range(round(_MAX_TARE_S * RATE_HZ)):
            self.cycle(goal_rad, self._moving_current_a())
            self._max_age_s = max(self._max_age_s, (self.state.t_ns - self._sample_ns) / NS_PER_S)
            if i > _REST_S * RATE_HZ and len(self._forces) >= mark + _TARE_SAMPLES:
                break
        rest_n = np.array([force for _, force in self._forces[mark:]])
        if len(rest_n) < _TARE_SAMPLES:
            raise DataError(
                f"the load cell gave {len(rest_n)} valid samples in {_MAX_TARE_S:g} s at rest; it needs "
                f"{_TARE_SAMPLES}: check its wiring and its rate, and run `gripper-force doctor`"
            )
        self._tare_n = float(np.mean(rest_n))
        if abs(self._tare_n) > _MAX_TARE_N:
            raise DataError(
                f"the load cell reads {self._tare_n:.2f} N with open jaws; remove what presses on it, or "
                "calibrate it first with `calibrate load-cell`"
            )
        self.force_n -= self._tare_n

    def close_on_gauge(self, gauge_m: float) -> float:
        """Closes slowly until the load cell measures contact. Returns the angle."""
        speed_rad = _APPROACH_M_S / self._jaw_m_per_rad / RATE_HZ
        start_rad = goal_rad = self.closing_rad
        end_rad = self._sign * self._nominal.closed_position_rad
        first = len(self._states)
        while self.force_n < _CONTACT_N:
            goal_rad += speed_rad
            if goal_rad > end_rad + _BEYOND_RAD / 4:
                self._raise_no_contact(self.closing_rad - start_rad)
            self.cycle(goal_rad, self._moving_current_a())
        if self._free_friction_n == 0.0:
            self._free_friction_n = self._friction_n(self._states[first:])
            free_m = (self.closing_rad - start_rad) * self._jaw_m_per_rad
            self._clearance_m = min(CLEARANCE_M, free_m / 10)
        width_m = self._nominal.width_m(self.state.position_rad)
        if abs(width_m - gauge_m) > 0.25 * self._nominal.open_width_m:
            raise DataError(
                f"the jaws met the gauge of {1e3 * gauge_m:g} mm at a width of {1e3 * width_m:.0f} mm; check "
                "--gauge-mm and the gripper keys of the configuration"
            )
        return self.closing_rad

    def _raise_no_contact(self, moved_rad: float) -> NoReturn:
        if moved_rad * self._jaw_m_per_rad < _MIN_TRAVEL_M:
            raise DataError(
                f"the jaws do not move with {self._moving_current_a():.2f} A, twice gripper.friction_n; find their "
                "friction with `calibrate jaws`, and check that they are not at the closed end already "
                "(gripper.closing_sign, gripper.open_position_rad)"
            )
        raise DataError(
            "the jaws closed without a force on the load cell; check that it lies between them, in the path of the "
            "force, and check load_cell.n_per_raw and its sign"
        )

    def _friction_n(self, states: Sequence[ServoState]) -> float:
        """Friction by the motor current of jaws that close freely; 0 if they never did."""
        nominal, forces_n = self._nominal, []
        for state in states:
            closing_m_s = nominal.closing_m_s(state.velocity_rad_s, state.position_rad)
            if closing_m_s > _APPROACH_M_S / 2:
                motor_n = nominal.force_n(state.current_a, state.position_rad)
                forces_n.append(motor_n - nominal.damping_n_s_m * closing_m_s)
        return float(np.median(forces_n)) if forces_n else 0.0

    def press(
        self, gauge_m: float, contact_rad: float, rate_n_s: float, share: float, full_n: float
    ) -> ServoPress:
        """Raises the current up to a share of the full force, then lowers it until the force is gone.

        The first press ends at the measured force. Later ones also end at the current of the first, because
        the samples of a slow load cell come too late to end a fast press.
        """
        peak_n = share * full_n
        if self._full_a is None and self._max_age_s > 0:
            rate_n_s = min(rate_n_s, _OVERSHOOT_SHARE * peak_n / self._max_age_s)
        last_a = math.inf if self._full_a is None else share * self._full_a
        step_a = self._current_a(rate_n_s) / RATE_HZ
        max_a = 1.5 * self._current_a(peak_n + self._nominal.friction_n)
        current_a = abs(self.state.current_a)
        for _ in range(round(_REST_S * RATE_HZ)):  # lets the force of the impact fade
            self.cycle(self.closing_rad + _BEYOND_RAD, current_a)
        first, mark = len(self._states), len(self._forces)
        while self.force_n < peak_n and current_a < last_a:
            if current_a > min(max_a, self._ceiling_a):
                break
            current_a += step_a
            self.cycle(self.closing_rad + _BEYOND_RAD, current_a)
        if self._full_a is None:
            self._wait_for_force(peak_n, current_a)
            self._full_a = current_a / share
        turn = len(self._states) - first
        while self.force_n > _NO_CONTACT_N and current_a > -max_a:
            current_a -= step_a
            goal_rad = self.closing_rad + _BEYOND_RAD if current_a > 0 else self._clear_of(contact_rad)
            self.cycle(goal_rad, abs(current_a))
        states, forces = self._states[first:], self._forces[mark:]
        t_ns = np.array([state.t_ns for state in states])
        if len(forces) < 2:
            raise DataError(
                "the load cell gave fewer than two valid samples during a press; run `gripper-force doctor`"
            )
        force_ns, force_n = np.array(forces).T
        reduced = _reduce(self._nominal, states)
        return ServoPress(
            gauge_m=gauge_m,
            t_s=(t_ns - t_ns[0]) / NS_PER_S,
            current_a=reduced.current_a,
            force_n=np.interp(t_ns, force_ns, force_n),
            closing_rad=reduced.closing_rad,
            turn=turn,
        )

    def _wait_for_force(self, peak_n: float, current_a: float) -> None:
        """Raises `DataError` if the current gives much less than the peak force, by samples as new as the current."""
        for _ in range(round(self._max_age_s * RATE_HZ)):
            if self.force_n >= peak_n:
                return
            self.cycle(self.closing_rad + _BEYOND_RAD, current_a)
        if self.force_n < _MIN_SHARE * peak_n:
            raise DataError(
                f"{current_a:.2f} A give {self.force_n:.1f} N instead of {peak_n:.1f} N; check that the load "
                "cell lies in the path of the force, its scale, and servo.current_limit_a; if the servo is that weak, "
                "lower control.force_limit_n"
            )

    def back_off(self, contact_rad: float) -> None:
        """Moves away from the gauge."""
        self._move_to(self._clear_of(contact_rad))

    def _clear_of(self, contact_rad: float) -> float:
        return contact_rad - 2 * self._clearance_m / self._jaw_m_per_rad

    def travel(self, friction_n: float, speed_m_s: float, contact_rad: float) -> list[FreePass]:
        """Opens and closes under a constant motor force. A pass in which the jaws stick is left out."""
        nominal = self._nominal
        clear_rad = self._clearance_m / self._jaw_m_per_rad
        ends = (self._sign * nominal.open_position_rad + clear_rad, contact_rad - clear_rad)
        length_m = (ends[1] - ends[0]) * self._jaw_m_per_rad
        speed_m_s *= min(length_m / (_PASS_S * SPEEDS_M_S[-1]), 1.0)
        motor_force_n = friction_n + nominal.damping_n_s_m * speed_m_s
        passes = []
        for side, end_rad in ((-1, ends[0]), (1, ends[1])):
            if (one := self._pass(side, end_rad, motor_force_n, 2 * speed_m_s)) is not None:
                passes.append(one)
        return passes

    def _pass(self, side: int, end_rad: float, motor_force_n: float, limit_m_s: float) -> FreePass | None:
        """One pass, without its acceleration; None if the jaws stuck."""
        brake_rad = min(_BRAKE_RAD, abs(end_rad - self.closing_rad) / 5)
        for _ in range(round(_MAX_PASS_S * RATE_HZ)):
            if side * self._sign * self.state.velocity_rad_s > _MIN_SPEED_RAD_S:
                break
            self.cycle(end_rad, _START_FACTOR * self._whole_steps_a(motor_force_n), limit_m_s)
        first = len(self._states) + round(_SPEED_UP_S * RATE_HZ)
        for _ in range(round(_MAX_PASS_S * RATE_HZ)):
            self.cycle(end_rad, self._whole_steps_a(motor_force_n), limit_m_s)
            if side * (end_rad - self.closing_rad) < brake_rad:
                break
        states = self._states[first:]
        self._move_to(end_rad)
        if len(states) < RATE_HZ / 10 or abs(states[-1].velocity_rad_s) < _MIN_SPEED_RAD_S:
            return None
        return _reduce(self._nominal, states)

    def _whole_steps_a(self, motor_force_n: float) -> float:
        step_a = self._nominal.current_step_a
        return round(self._current_a(motor_force_n) / step_a) * step_a

    def _move_to(self, goal_rad: float) -> None:
        """Moves at a constant low speed, and rests at the goal."""
        speed_rad = 3 * _APPROACH_M_S / self._jaw_m_per_rad / RATE_HZ
        next_rad = self.closing_rad
        while abs(goal_rad - next_rad) > speed_rad:
            next_rad += float(np.copysign(speed_rad, goal_rad - next_rad))
            self.cycle(next_rad, self._moving_current_a())
        for _ in range(round(_REST_S * RATE_HZ)):
            self.cycle(goal_rad, self._moving_current_a())

    def _moving_current_a(self) -> float:
        """Current that moves the jaws against twice the nominal friction, and presses with little more."""
        return self._current_a(2 * self._nominal.friction_n + _CONTACT_N)
