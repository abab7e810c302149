"""Hard cases for the fusion filter, compared with the same equations in decimal numbers of 50 digits.

The reference is a second implementation after the description of `gripper_force.control.fusion`, not a copy
of its code. Doubles have 16 digits, so a difference is rounding, or a mistake. Fractions would be exact but
grow with each step; the error of 50 digits is negligible over a million steps.
"""

import math
import sys
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, replace
from decimal import Decimal, localcontext
from pathlib import Path
from typing import Final

import numpy as np

from gripper_force.config import Config, ControlConfig, GripperConfig
from gripper_force.control import fusion
from gripper_force.control.current_estimate import FREE_FLOOR_N
from gripper_force.control.fusion import Fusion
from gripper_force.control.object_gain import GATE
from gripper_force.control.state_machine import GraspController
from gripper_force.control.transmission import Transmission
from gripper_force.qualification.loop_margin.analytic_plant import CYCLE_NS, transmission_of
from gripper_force.qualification.numerics.numerical_case import NumericalCase
from gripper_force.types import NS_PER_MS, NS_PER_S, Request, RequestKind, ServoState, VisualForce

LONG_CYCLES: Final = 1_000_000
"""Cycles of the longest case: 83 minutes at 200 Hz."""

SHORT_CYCLES: Final = 4000
"""Cycles of the other cases."""

_ROUNDING_N: Final = 1e-9
"""Bound of the rounding error. A filter whose error grows with the number of cycles exceeds it by far."""

_RESIDUE_SHARE: Final = 1e-15
"""Share of an outlier that may remain in later estimates: a few times the precision of a double."""

_DAY_NS: Final = 86_400 * NS_PER_S
_DIGITS: Final = 50

Input = tuple[int, float, VisualForce | None]
"""Time of a cycle, its motor force in N, and the newest visual estimate."""


class _DecimalFusion:
    """The filter of `Fusion` in contact, in decimal numbers."""

    def __init__(self, control: ControlConfig, transmission: Transmission) -> None:
        _, lag_s, _ = control.plant
        self._lag_s = Decimal(lag_s)
        self._oldest_ns = control.max_frame_age_ms * NS_PER_MS
        self._max_std_n = control.vision_std_n
        self._friction_n = Decimal(transmission.friction_n)
        self._friction_n2 = (Decimal(transmission.friction_std) * self._friction_n) ** 2
        self._torque_constant_std = Decimal(transmission.torque_constant_std)
        self._motor_force_n = self._force_n = self._difference_n = Decimal(0)
        self._share = Decimal(1)
        self._variance_n2 = self._prior_n2(self._force_n)
        cycles = math.ceil(control.rate_hz * control.max_frame_age_ms / 1e3) + 2
        self._history: deque[tuple[int, Decimal]] = deque(maxlen=cycles)
        self._reentry = round(control.frame_hz / 3)
        self._newest_ns = -1
        self._run = 0

    def step(self, t_ns: int, motor_force_n: float, visual: VisualForce | None) -> tuple[Decimal, Decimal]:
        """Runs a cycle; returns the force and its standard deviation, in N."""
        before_n = self._force_n
        dt_s = Decimal(0)
        if self._history:
            dt_s = Decimal(max(t_ns - self._history[-1][0], 0)) / NS_PER_S
            self._motor_force_n += (
                (Decimal(motor_force_n) - self._motor_force_n) * dt_s / (dt_s + self._lag_s)
            )
        else:
            self._motor_force_n = Decimal(motor_force_n)
        play_n = self._friction_n
        self._force_n = min(max(before_n, self._motor_force_n - play_n), self._motor_force_n + play_n)
        back = (1 + (self._force_n - self._motor_force_n) / play_n) / 2 if play_n else Decimal(0)
        drift_n2 = Decimal(fusion._DRIFT_N2_S) + Decimal(fusion._OPENING_DRIFT_N2_S) * back
        gearing_n2 = self._torque_constant_std**2 * abs(self._force_n**2 - before_n**2)
        grown_n2 = self._variance_n2 + drift_n2 * dt_s + gearing_n2
        self._variance_n2 = min(grown_n2, self._prior_n2(self._force_n))
        self._history.append((t_ns, self._force_n))
        if visual is not None and visual.t_ns > self._newest_ns:
            self._newest_ns = visual.t_ns
            self._correct(t_ns, visual)
        prior_n2 = self._prior_n2(self._force_n)
        force_n = max(self._force_n + self._share * self._difference_n, Decimal(0))
        return force_n, (self._variance_n2 + (1 - self._share) * prior_n2).sqrt()

    def _correct(self, t_ns: int, visual: VisualForce) -> None:
        usable = abs(visual.force_n) <= 1e9 and abs(visual.std_n) <= 1e9
        if not (usable and 0 <= t_ns - visual.t_ns <= self._oldest_ns and visual.std_n <= self._max_std_n):
            return
        claimed_n2 = Decimal(max(visual.std_n, fusion._VISION_FLOOR_N)) ** 2
        then_n = self._force_at(visual.t_ns)
        prior_n2 = self._prior_n2(then_n)
        difference_n = Decimal(visual.force_n) - then_n
        surprise_n = difference_n - self._difference_n
        if abs(difference_n) > 3 * (prior_n2 + claimed_n2).sqrt():
            return
        if abs(surprise_n) > Decimal(GATE) * (self._variance_n2 + claimed_n2).sqrt():
            side = 1 if surprise_n > 0 else -1
            self._run = self._run + side if self._run * side > 0 else side
            if abs(self._run) < self._reentry:
                return
            self._variance_n2 = prior_n2
        self._run = 0
        # Information form: the information of prior and measurement adds up.
        noise_n2 = Decimal(fusion._FRAME_NOISE_N) ** 2
        total_n2 = self._variance_n2 + noise_n2
        self._difference_n = (self._difference_n * noise_n2 + difference_n * self._variance_n2) / total_n2
        self._variance_n2 = self._variance_n2 * noise_n2 / total_n2
        self._share = prior_n2 / (prior_n2 + claimed_n2)

    def _force_at(self, t_ns: int) -> Decimal:
        later_ns, later_n = self._history[-1]
        for earlier_ns, earlier_n in reversed(self._history):
            if earlier_ns <= t_ns < later_ns:
                share = Decimal(t_ns - earlier_ns) / (later_ns - earlier_ns)
                return earlier_n + share * (later_n - earlier_n)
            if earlier_ns <= t_ns:
                return later_n
            later_ns, later_n = earlier_ns, earlier_n
        return later_n

    def _prior_n2(self, force_n: Decimal) -> Decimal:
        floor_n2 = Decimal(FREE_FLOOR_N) ** 2
        return self._friction_n2 + floor_n2 + (self._torque_constant_std * force_n) ** 2


def cases(
    config: Config, _maps: Path | None, long_cycles: int = LONG_CYCLES, short_cycles: int = SHORT_CYCLES
) -> Iterator[NumericalCase]:
    """Yields the cases of the filter.

    Args:
        config: Control and gripper under test.
        long_cycles: Cycles of the longest case.
        short_cycles: Cycles of the other cases; those with irregular frames have twice as many.
    """
    control, gripper = config.control, config.gripper

    def against(
        case: str,
        detail: str,
        inputs: Iterator[Input],
        bound_n: float = _ROUNDING_N,
        **changed: float,
    ) -> NumericalCase:
        other = GripperConfig.model_validate({**gripper.model_dump(), **changed})
        return NumericalCase(
            case, f"{detail}; against 50 digits", worst_n(control, other, inputs), bound_n, "N"
        )

    rng = np.random.default_rng([config.seed, 40])
    yield against(f"{long_cycles} cycles", "4 ± 3 N, frames at 60 Hz", _steady(rng, long_cycles))
    yield NumericalCase(
        "clock near 2^62 ns",
        "146 years of uptime, compared with the same cycles from 0; number of estimates that differ",
        _count_shifted(control, gripper, 2**62, config.seed, 2 * short_cycles),
        0.0,
    )
    late = (
        one
        for day in range(10)
        for one in _steady(rng, short_cycles // 20, begin_ns=NS_PER_S + day * _DAY_NS)
    )
    yield against("ten days of uptime", "one second of cycles per day", late)
    yield against(
        "repeated timestamps", "every cycle and every frame four times", _repeated(rng, short_cycles // 2)
    )
    yield against("clock that jumps backward", "100 ms back, twice a second", _backward(rng, short_cycles))
    yield against("irregular cycles", "1 to 50 ms, with pauses of 2 s", _irregular(rng, short_cycles))
    yield against(
        "irregular and dropped frames",
        "two of three lost, 5 to 95 ms late, out of order",
        _ragged(rng, 2 * short_cycles),
    )
    for name, std_n in (("0", 0.0), ("5e-324", 5e-324), ("negative", -1.0)):
        yield against(
            f"claimed error {name}",
            "the weight of a frame stays bounded",
            _steady(rng, short_cycles, std_n=std_n),
        )
    for name, force_n, std_n in _REFUSED:
        yield NumericalCase(
            f"estimates of {name}",
            "every second estimate; difference to a filter that does not get them",
            _effect_of_refused_n(control, gripper, force_n, std_n, config.seed, short_cycles),
            0.0,
            "N",
        )
    nothing = {"friction_n": 0.0, "friction_std": 0.0, "gain_std": 0.0}
    yield against("prior variance 0", "rig parameters known exactly", _steady(rng, short_cycles), **nothing)
    wide = {"friction_std": 1e9, "gain_std": 1e9}
    yield against(
        "largest prior variance",
        "10^18 N², the largest that can be configured",
        _steady(rng, short_cycles),
        **wide,
    )
    tiny = ((t_ns, 5e-324 * (t_ns // CYCLE_NS % 3), None) for t_ns in range(0, NS_PER_S, CYCLE_NS))
    yield against("denormal currents", "0 to 2 times the smallest double", tiny)
    for huge_n in (1e3, 1e9):
        yield against(
            f"one reading of {huge_n:g} N",
            "followed by a second of normal readings",
            _spiked(rng, huge_n),
            bound_n=max(_ROUNDING_N, _RESIDUE_SHARE * huge_n),
        )
    yield NumericalCase(
        "non-finite servo readings",
        "every tenth, each quantity in turn, in a whole grasp; number of commands outside limits",
        float(_count_bad_commands(control, gripper, config.servo.current_limit_a)),
        0.0,
    )


_REFUSED: Final = (
    ("NaN N", math.nan, 0.1),
    ("infinite N", math.inf, 0.1),
    ("1e300 N", 1e300, 0.1),
    ("4 N with error NaN", 4.0, math.nan),
    ("4 N with infinite error", 4.0, math.inf),
)


def worst_n(control: ControlConfig, gripper: GripperConfig, inputs: Iterator[Input]) -> float:
    """Largest error of force and standard deviation against the reference, in N; infinite if not finite.

    Above 1 N the error is relative.
    """
    transmission = transmission_of(gripper)
    tested, reference = Fusion(control, transmission), _DecimalFusion(control, transmission)
    worst = 0.0
    with localcontext(prec=_DIGITS):
        for t_ns, motor_force_n, visual in inputs:
            servo = _servo(t_ns, transmission.current_a(motor_force_n, 0.0))
            found, _ = tested.step(t_ns, servo, visual)
            if not (math.isfinite(found.force_n) and math.isfinite(found.std_n)):
                return math.inf
            force_n, std_n = reference.step(
                t_ns, transmission.force_n(servo.current_a, servo.position_rad), visual
            )
            for number, true in ((found.force_n, force_n), (found.std_n, std_n)):
                worst = max(worst, float(abs(Decimal(number) - true) / max(true, Decimal(1))))
    return worst


# Inputs.


def _servo(t_ns: int, current_a: float) -> ServoState:
    return ServoState(t_ns, 0.0, 0.0, current_a, 35.0, 12.0, 0)


def _motor_force_n(rng: np.random.Generator, t_ns: int) -> float:
    """Motor force of an oscillating grip, which reverses friction."""
    return 5.0 + 3.0 * math.sin(t_ns / NS_PER_S) + float(rng.normal(0.0, 0.2))


def _visual(rng: np.random.Generator, t_ns: int, seq: int, std_n: float = 0.1) -> VisualForce:
    force_n = 4.0 + 3.0 * math.sin(t_ns / NS_PER_S) + float(rng.normal(0.0, 0.15))
    return VisualForce(t_ns, t_ns, seq, force_n, std_n, 12.0)


def _steady(
    rng: np.random.Generator, cycles: int, begin_ns: int = NS_PER_S, std_n: float = 0.1
) -> Iterator[Input]:
    for cycle in range(cycles):
        t_ns = begin_ns + cycle * CYCLE_NS
        visual = _visual(rng, t_ns - 40 * NS_PER_MS, cycle, std_n) if cycle % 10 in (0, 3, 6) else None
        yield t_ns, _motor_force_n(rng, t_ns), visual


def _repeated(rng: np.random.Generator, cycles: int) -> Iterator[Input]:
    for one in _steady(rng, cycles):
        yield from (one,) * 4


def _backward(rng: np.random.Generator, cycles: int) -> Iterator[Input]:
    for cycle, (t_ns, motor_force_n, visual) in enumerate(_steady(rng, cycles)):
        back_ns = 100 * NS_PER_MS * (cycle // 100)
        moved = visual and replace(visual, t_ns=visual.t_ns - back_ns, ready_ns=visual.ready_ns - back_ns)
        yield t_ns - back_ns, motor_force_n, moved


def _irregular(rng: np.random.Generator, cycles: int) -> Iterator[Input]:
    t_ns = 0
    for cycle in range(cycles):
        t_ns += 2 * NS_PER_S if rng.random() < 0.002 else int(rng.integers(NS_PER_MS, 50 * NS_PER_MS))
        yield (
            t_ns,
            _motor_force_n(rng, t_ns),
            _visual(rng, t_ns - 40 * NS_PER_MS, cycle) if cycle % 3 == 0 else None,
        )


def _ragged(rng: np.random.Generator, cycles: int) -> Iterator[Input]:
    for cycle, (t_ns, motor_force_n, visual) in enumerate(_steady(rng, cycles)):
        late_ns = int(rng.integers(5 * NS_PER_MS, 95 * NS_PER_MS))
        kept = visual is not None and rng.random() < 1 / 3
        yield t_ns, motor_force_n, _visual(rng, t_ns - late_ns, cycle) if kept else None


def _spiked(rng: np.random.Generator, huge_n: float) -> Iterator[Input]:
    for cycle, (t_ns, motor_force_n, visual) in enumerate(_steady(rng, 600)):
        yield t_ns, huge_n if cycle == 400 else motor_force_n, visual


# Comparisons of the filter with itself.


def _count_shifted(
    control: ControlConfig, gripper: GripperConfig, by_ns: int, seed: int, cycles: int
) -> float:
    """Number of estimates that change when all times are shifted by ``by_ns``."""
    transmission = transmission_of(gripper)
    original, shifted = Fusion(control, transmission), Fusion(control, transmission)
    different = 0
    for t_ns, motor_force_n, visual in _ragged(np.random.default_rng([seed, 41]), cycles):
        current_a = transmission.current_a(motor_force_n, 0.0)
        later = visual and replace(visual, t_ns=visual.t_ns + by_ns, ready_ns=visual.ready_ns + by_ns)
        one, _ = original.step(t_ns, _servo(t_ns, current_a), visual)
        other, _ = shifted.step(t_ns + by_ns, _servo(t_ns + by_ns, current_a), later)
        different += replace(other, t_ns=t_ns) != one
    return float(different)


def _effect_of_refused_n(
    control: ControlConfig, gripper: GripperConfig, force_n: float, std_n: float, seed: int, cycles: int
) -> float:
    """Largest change of the fused estimate by visual estimates that must be rejected, in N."""
    transmission = transmission_of(gripper)
    with_bad, without_bad = Fusion(control, transmission), Fusion(control, transmission)
    worst = 0.0
    inputs = _steady(np.random.default_rng([seed, 42]), cycles)
    for number, (t_ns, motor_force_n, visual) in enumerate(inputs):
        servo = _servo(t_ns, transmission.current_a(motor_force_n, 0.0))
        bad = visual is not None and number % 2 == 1
        changed = replace(visual, force_n=force_n, std_n=std_n) if visual and bad else visual
        found, _ = with_bad.step(t_ns, servo, changed)
        expected, _ = without_bad.step(t_ns, servo, None if bad else visual)
        off = max(abs(found.force_n - expected.force_n), abs(found.std_n - expected.std_n))
        worst = max(worst, off) if math.isfinite(off) else math.inf
    return worst


def _count_bad_commands(control: ControlConfig, gripper: GripperConfig, current_limit_a: float) -> int:
    """Number of commands of a grasp beyond a limit while servo readings are extreme or not finite."""
    transmission = transmission_of(gripper)
    bad = 0
    for name in ("position_rad", "velocity_rad_s", "current_a", "temperature_c", "voltage_v"):
        for extreme in (math.nan, math.inf, -math.inf, sys.float_info.max):
            controller = GraspController(control, transmission, current_limit_a)
            request: Request | None = Request(0, RequestKind.GRASP, 4.0)
            for cycle in range(400):
                t_ns = cycle * CYCLE_NS
                servo = replace(_servo(t_ns, 0.03), position_rad=min(0.001 * cycle, 0.3))
                if cycle % 10 == 9:
                    servo = ServoState(**(asdict(servo) | {name: extreme}))
                command = controller.step(t_ns, servo, None, request).command
                request = None
                ends = transmission.goal_range_rad
                bad += not (
                    0 <= command.goal_current_a <= current_limit_a
                    and ends[0] <= command.goal_position_rad <= ends[1]
                )
    return bad
