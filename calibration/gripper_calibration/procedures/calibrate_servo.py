"""Torque, friction and jaw geometry of a servo, with the load cell's body as a gauge between the jaws."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from gripper_calibration.fits.servo_fit import FreePass, Nominal, ServoFit, ServoPress, fit_servo
from gripper_calibration.plots.servo_plot import draw
from gripper_force.config import Config
from gripper_force.control.limits import largest_target_n
from gripper_force.control.safety import Safety
from gripper_force.control.transmission import Transmission
from gripper_force.errors import ConfigError, DataError, DeviceError
from gripper_force.interfaces import Devices
from gripper_force.profiles.rig_profile import RigProfile, ServoCalibration, read_rig, update_rig
from gripper_force.runtime.backends import open_devices
from gripper_force.types import NS_PER_S, ServoCommand, ServoState

PRESSES: Final = ((3.0, 1.0), (6.0, 1.0), (12.0, 1.0), (3.0, 0.6), (6.0, 0.8), (12.0, 0.8))
"""Rate in N/s and share of the greatest force of each press: several rates tell lag from friction."""

SPEEDS_M_S: Final = (0.012, 0.020, 0.028, 0.036, 0.044, 0.052)
"""Speeds of a jaw that the currents of free travel aim at."""

_RATE_HZ: Final = 200.0
_PEAK: Final = 1.05
"""Of the largest target, so that this is within what was calibrated."""
_APPROACH_M_S: Final = 0.008
_TOUCH_N: Final = 0.5
_FREE_N: Final = 0.2
_REST_S: Final = 0.5
_OFF_N: Final = 1.0
_CLEAR_M: Final = 0.005
_BRAKE_RAD: Final = 0.3
"""Before its goal, the servo's own position control takes over."""
_GATHER_S: Final = 0.1
_KICK: Final = 1.6
_MOVES_RAD_S: Final = 0.15
_LONGEST_S: Final = 4.0
_SILENT_NS: Final = NS_PER_S
_BEYOND_RAD: Final = 1.0
"""A goal this far away lets the current, and nothing else, tell how hard to press."""

Progress = Callable[[str, float], None]
"""Told of the step and the force in newtons, some times a second."""

Ask = Callable[[str], None]
"""Says what is to be done, and returns once it may have been."""


def calibrate(
    config: Config,
    gauges_m: Sequence[float],
    rig: Path,
    *,
    ask: Ask,
    progress: Progress = lambda _step, _force_n: None,
) -> dict[str, Any]:
    """Presses and travels with each gauge, writes the rig profile's section and a picture beside it.

    Args:
        config: The run.
        gauges_m: Width of each gauge between the jaws, in the order in which they are put there.
        rig: The rig profile to write, or to replace the section of.
        ask: Says which gauge to put between the jaws.
        progress: Told of the step and the force.

    Returns:
        The section, what else the fit says, and the paths.

    Raises:
        ConfigError: There is no load cell, a gauge does not fit, or the profile can't be read or written.
        DeviceError: A device failed. The servo has no torque.
        DataError: The jaws met nothing, or the readings give no calibration.
    """
    if config.load_cell.backend == "none":
        raise ConfigError("calibrate servo needs a load cell, and load_cell.backend is none; name yours")
    for width_m in gauges_m:
        if not 0 < width_m < config.gripper.open_width_m - 2 * _CLEAR_M:
            raise ConfigError(
                f"a gauge of {1e3 * width_m:g} mm does not fit between jaws that open to "
                f"{1e3 * config.gripper.open_width_m:g} mm (gripper.open_width_m)"
            )
    known = read_rig(rig) if rig.exists() else RigProfile()
    given = Nominal(
        config.gripper.pinion_radius_m, config.gripper.open_width_m, _scale_share(known, config, rig)
    )
    config = config.model_copy(update={"camera": config.camera.model_copy(update={"backend": "none"})})
    presses: list[ServoPress] = []
    passes: list[FreePass] = []
    for width_m in gauges_m:
        ask(f"Put the load cell with its width of {1e3 * width_m:g} mm between the open jaws")
        more = measure(config, width_m, progress)
        presses += more[0]
        passes += more[1]
    fit = fit_servo(presses, passes, given)
    found = _section(fit, config)
    update_rig(rig, found)
    report = rig.with_name(f"{rig.stem}-servo.png")
    draw(fit, presses, report)
    also = ("n_per_a", "friction_share", "free_friction_n", "lag_s", "offset_a")
    return {
        **found.model_dump(mode="json"),
        **{name: getattr(fit, name).model_dump() for name in also},
        "presses": len(presses),
        "passes": len(passes),
        "rig": rig,
        "report": report,
    }


def _scale_share(known: RigProfile, config: Config, rig: Path) -> float:
    """Half of the interval of the load cell's scale over the scale, where the profile is of this cell."""
    cell = known.load_cell
    if cell is None or cell.sensor != config.load_cell.sensor:
        return 0.0
    if cell.n_per_raw.value != config.load_cell.n_per_raw:
        raise ConfigError(
            f"{rig} has calibrated this load cell to {cell.n_per_raw.value:g} N for one unit of its reading, "
            f"and load_cell.n_per_raw is {config.load_cell.n_per_raw}; go by the profile with --set "
            f"calibration.rig={rig}, or write another one with --rig"
        )
    return cell.n_per_raw.half / abs(cell.n_per_raw.value)


def _section(fit: ServoFit, config: Config) -> ServoCalibration:
    opening, sign = fit.open_position_rad, config.gripper.closing_sign
    ends = sorted(sign * end for end in (opening.low, opening.high) if end is not None)
    return ServoCalibration(
        date=datetime.now(UTC).replace(microsecond=0),
        model=config.servo.model,
        nm_per_a=fit.nm_per_a,
        friction_n=fit.friction_n,
        damping_n_s_m=fit.damping_n_s_m,
        pinion_radius_m=fit.pinion_radius_m,
        open_position_rad=opening.model_copy(
            update={"value": sign * opening.value, "low": ends[0], "high": ends[-1]}
        ),
        open_width_m=config.gripper.open_width_m,
        force_n=fit.force_n,
        speed_m_s=fit.speed_m_s,
        residual_n=fit.residual_n,
    )


def measure(config: Config, gauge_m: float, progress: Progress) -> tuple[list[ServoPress], list[FreePass]]:
    """Presses a gauge that is between the jaws, and travels where it is not.

    Raises:
        DeviceError: A device failed. The servo has no torque.
        DataError: The load cell reads a force without contact, or the jaws met nothing.
    """
    with open_devices(config) as devices, _moving(config, devices, progress) as jaws:
        jaws.open()
        jaws.tare()
        jaws.step_name = "closing on the gauge"
        touch_rad = jaws.touch(gauge_m)
        peak_n = _PEAK * largest_target_n(config.control.force_limit_n)
        presses = []
        for number, (rate_n_s, share) in enumerate(PRESSES, start=1):
            jaws.step_name = f"{1e3 * gauge_m:g} mm, press {number} of {len(PRESSES)}"
            if number > 1:
                jaws.touch(gauge_m)
            presses.append(jaws.press(gauge_m, rate_n_s, share * peak_n))
            jaws.back_off(touch_rad)
        jaws.step_name = f"{1e3 * gauge_m:g} mm, free travel"
        friction_a = float(np.median([_friction_a(press) for press in presses]))
        passes = [one for speed in SPEEDS_M_S for one in jaws.travel(friction_a, speed, touch_rad)]
    return presses, passes


def _friction_a(press: ServoPress) -> float:
    """Half of what the current differs by, up and down, at about half of the force."""
    middle_n = press.force_n[press.turn - 1] / 2
    near = np.abs(press.force_n - middle_n) < middle_n / 4
    rising = np.arange(len(press.force_n)) < press.turn
    up_a, down_a = press.current_a[near & rising], press.current_a[near & ~rising]
    return float(up_a.mean() - down_a.mean()) / 2 if len(up_a) and len(down_a) else 0.0


@contextmanager
def _moving(config: Config, devices: Devices, progress: Progress) -> Iterator["_Jaws"]:
    """Jaws under torque; on every way out it is off."""
    assert devices.load_cell is not None
    devices.load_cell.start()
    state = devices.servo.start()  # turns torque off itself where it fails
    try:
        yield _Jaws(config, devices, state, progress)
    finally:
        devices.servo.stop(hold=False)


class _Jaws:
    """Moves the jaws cycle by cycle, and keeps what servo and load cell say. Angles close positively."""

    def __init__(self, config: Config, devices: Devices, state: ServoState, progress: Progress) -> None:
        assert devices.load_cell is not None
        self._config, self._devices, self._cell = config, devices, devices.load_cell
        self._progress = progress
        self._sign = config.gripper.closing_sign
        gripper, servo = config.gripper, devices.servo
        self._nominal = Transmission.from_config(gripper, servo.nm_per_a, servo.current_step_a)
        self._safety = Safety(config.control)
        self._period_ns = round(NS_PER_S / _RATE_HZ)
        self._due_ns = devices.clock.now_ns()
        self._heard_ns = self._due_ns
        self._goal_a = 0.0
        self._told_ns = 0
        self._tare_n = 0.0
        self._states: list[ServoState] = []
        self._felt: list[tuple[int, float]] = []
        self.force_n = 0.0
        self.state = state
        self.step_name = "opening"

    @property
    def closing_rad(self) -> float:
        return self._sign * self.state.position_rad

    def cycle(self, goal_rad: float, current_a: float) -> None:
        """One cycle of the bus: where to go, and with how much current at most."""
        devices = self._devices
        self._due_ns = max(self._due_ns + self._period_ns, devices.clock.now_ns())
        devices.clock.sleep_until_ns(self._due_ns)
        devices.check()
        self.state = state = devices.servo.read()
        for sample in self._cell.drain():
            if sample.valid:
                self._heard_ns = max(self._heard_ns, sample.t_ns)
                self.force_n = sample.force_n - self._tare_n
                self._felt.append((sample.t_ns, self.force_n))
        self._states.append(state)
        limit_n = self._config.control.force_limit_n
        over = self.force_n > limit_n
        if self._safety.check(state, self._goal_a, 1 / _RATE_HZ, over_force=over):
            raise DeviceError(f"stopped in {self.step_name}: {self._safety.reason}; see what caused it")
        if state.t_ns - self._heard_ns > _SILENT_NS:
            counts = ", ".join(f"{n} {name}" for name, n in self._cell.counts().items() if n)
            raise DeviceError(
                f"the load cell has given no valid sample for {_SILENT_NS / NS_PER_S:g} s in "
                f"{self.step_name} (rejected: {counts or 'none'}); check its wiring, calibrate it first, and "
                "see what doctor says"
            )
        self._goal_a = min(max(current_a, 0.0), self._config.servo.current_limit_a)
        devices.servo.write(ServoCommand(self._due_ns, self._sign * goal_rad, self._goal_a))
        if state.t_ns - self._told_ns > NS_PER_S // 5:
            self._told_ns = state.t_ns
            self._progress(self.step_name, self.force_n)

    def open(self) -> None:
        """Goes to the open position, or as far as the jaws do."""
        self._go(self._sign * self._nominal.open_position_rad)

    def tare(self) -> None:
        """Takes what the load cell reads at rest for no force."""
        goal_rad = self.closing_rad
        mark = len(self._felt)
        for _ in range(round(_REST_S * _RATE_HZ)):
            self.cycle(goal_rad, self._carry_a())
        rest_n = np.array([force for _, force in self._felt[mark:]])
        if len(rest_n) < 3:
            raise DataError(
                "the load cell gives no valid sample at rest; calibrate it first, with calibrate load-cell"
            )
        self._tare_n = float(np.mean(rest_n))
        if abs(self._tare_n) > _OFF_N:
            raise DataError(
                f"the load cell reads {self._tare_n:.2f} N with open jaws; take away what presses on it, or "
                "calibrate it first, with calibrate load-cell"
            )
        self.force_n -= self._tare_n

    def touch(self, gauge_m: float) -> float:
        """Closes slowly until the gauge is felt. Returns the angle."""
        speed_rad = _APPROACH_M_S / self._nominal.pinion_radius_m / _RATE_HZ
        goal_rad = self.closing_rad
        end_rad = self._sign * self._nominal.closed_position_rad
        while self.force_n < _TOUCH_N:
            goal_rad += speed_rad
            if goal_rad > end_rad + _BEYOND_RAD / 4:
                raise DataError(
                    "the jaws closed and the load cell felt nothing; see that it lies between them and in "
                    "the way of the force, and to load_cell.n_per_raw and its sign"
                )
            self.cycle(goal_rad, self._carry_a())
        width_m = self._nominal.width_m(self.state.position_rad)
        if abs(width_m - gauge_m) > 0.25 * self._nominal.open_width_m:
            raise DataError(
                f"a gauge of {1e3 * gauge_m:g} mm was met where the jaws should be {1e3 * width_m:.0f} mm "
                "apart; see that --gauge-mm is its width, and to the gripper's section of the configuration"
            )
        return self.closing_rad

    def press(self, gauge_m: float, rate_n_s: float, peak_n: float) -> ServoPress:
        """Lets the current rise until the peak is felt, and fall until nothing is."""
        step_a = abs(self._nominal.current_a(rate_n_s)) / _RATE_HZ
        most_a = 1.5 * abs(self._nominal.current_a(peak_n + self._nominal.friction_n))
        current_a = abs(self.state.current_a)
        for _ in range(round(_REST_S * _RATE_HZ)):  # what the throw against the gauge gave is no push's force
            self.cycle(self.closing_rad + _BEYOND_RAD, current_a)
        first, mark = len(self._states), len(self._felt)
        while self.force_n < peak_n:
            if current_a > min(most_a, self._config.servo.current_limit_a):
                raise DataError(
                    f"{current_a:.2f} A give {self.force_n:.1f} N, where {peak_n:.1f} N were to come; see "
                    "that the load cell lies in the way of the force, to its scale, and to "
                    "servo.current_limit_a"
                )
            current_a += step_a
            self.cycle(self.closing_rad + _BEYOND_RAD, current_a)
        turn = len(self._states) - first
        least_a = -most_a
        while self.force_n > _FREE_N and current_a > least_a:
            current_a -= step_a
            self.cycle(self.closing_rad + np.sign(current_a) * _BEYOND_RAD, abs(current_a))
        states, felt = self._states[first:], self._felt[mark:]
        t_ns = np.array([state.t_ns for state in states])
        if len(felt) < 2:
            raise DataError(
                "the load cell gave hardly a valid sample while the jaws pressed; see what doctor says"
            )
        felt_ns, felt_n = np.array(felt).T
        return ServoPress(
            gauge_m=gauge_m,
            t_s=(t_ns - t_ns[0]) / NS_PER_S,
            current_a=self._sign * np.array([state.current_a for state in states]),
            force_n=np.interp(t_ns, felt_ns, felt_n),
            closing_rad=self._sign * np.array([state.position_rad for state in states]),
            turn=turn,
        )

    def back_off(self, touch_rad: float) -> None:
        """Leaves the gauge."""
        self._go(touch_rad - 2 * _CLEAR_M / self._nominal.pinion_radius_m)

    def travel(self, friction_a: float, speed_m_s: float, touch_rad: float) -> list[FreePass]:
        """Opens and closes under a constant current; a pass that sticks is left out."""
        nominal = self._nominal
        grid_a = nominal.current_step_a
        wanted_a = friction_a + abs(nominal.current_a(nominal.damping_n_s_m * speed_m_s))
        current_a = round(wanted_a / grid_a) * grid_a
        clear_rad = _CLEAR_M / nominal.pinion_radius_m
        ends = (self._sign * nominal.open_position_rad + clear_rad, touch_rad - clear_rad)
        passes = []
        for side, end_rad in ((-1, ends[0]), (1, ends[1])):
            one = self._pass(side, end_rad, current_a)
            passes += [] if one is None else [one]
        return passes

    def _pass(self, side: int, end_rad: float, current_a: float) -> FreePass | None:
        for _ in range(round(_LONGEST_S * _RATE_HZ)):
            if side * self._sign * self.state.velocity_rad_s > _MOVES_RAD_S:
                break
            self.cycle(end_rad, _KICK * current_a)
        first = len(self._states) + round(_GATHER_S * _RATE_HZ)
        for _ in range(round(_LONGEST_S * _RATE_HZ)):
            self.cycle(end_rad, current_a)
            if side * (end_rad - self.closing_rad) < _BRAKE_RAD:
                break
        states = self._states[first:]
        self._go(end_rad)
        if len(states) < _RATE_HZ / 10 or abs(states[-1].velocity_rad_s) < _MOVES_RAD_S:
            return None
        return FreePass(
            t_s=np.array([state.t_ns / NS_PER_S for state in states]),
            current_a=self._sign * np.array([state.current_a for state in states]),
            closing_rad=self._sign * np.array([state.position_rad for state in states]),
            closing_rad_s=self._sign * np.array([state.velocity_rad_s for state in states]),
        )

    def _go(self, goal_rad: float) -> None:
        """Moves at an even, modest speed, and rests there."""
        speed_rad = 4 * _APPROACH_M_S / self._nominal.pinion_radius_m / _RATE_HZ
        at_rad = self.closing_rad
        while abs(goal_rad - at_rad) > speed_rad:
            at_rad += float(np.copysign(speed_rad, goal_rad - at_rad))
            self.cycle(at_rad, self._carry_a())
        for _ in range(round(_REST_S * _RATE_HZ)):
            self.cycle(goal_rad, self._carry_a())

    def _carry_a(self) -> float:
        """Current that moves the jaws past any friction they may have, and presses with little more."""
        return abs(self._nominal.current_a(2 * self._nominal.friction_n + _TOUCH_N))
