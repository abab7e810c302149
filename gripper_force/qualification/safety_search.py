"""Random search for wrong configurations and plants with which a grasp is not safe.

Every case draws a plant and a configuration that is wrong about it. Three of four cases grasp, half of the time change
the force, and release. The fourth draws a sequence of requests, at any time and from any phase; an eighth of the
sequences are streams of requests, as of a policy. Some cases begin with jaws that touch the object or nearly do. The
statements of `safety_statements` must hold. With motor current alone an end stop cannot be told from a rigid object. So
such cases are counted, but are no violations; `calibrate jaws` prevents them.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple, TypedDict

import numpy as np

from gripper_force import __version__
from gripper_force.config import Config, ControlConfig
from gripper_force.control.limits import largest_target_n
from gripper_force.control.state_machine import GraspController
from gripper_force.control.transmission import Transmission
from gripper_force.errors import ConfigError, DataError
from gripper_force.jobs.processes import process_pool
from gripper_force.progress import Progress, no_progress
from gripper_force.qualification.loop_margin.analytic_plant import (
    CYCLE_NS,
    NOISE_A,
    POSITION_LOOP,
    Gripper,
    SimulatedVision,
    transmission_of,
)
from gripper_force.qualification.result_lines import whole_lines
from gripper_force.qualification.safety_statements import FORCE_SHARE, SPEED_SHARE, SafetyStatements
from gripper_force.types import NS_PER_S, Outcome, Request, RequestKind, ServoCommand, ServoState

WORST: Final = 5
"""Cases listed for each statement."""

_MIN_N: Final = 0.3
"""Least target of a sequence, and of a case near the object."""

_GRASP_S: Final = 5.0
_RELEASE_S: Final = 1.5
_CHUNK: Final = 20
_SEQUENCE: Final = 4
"""Every fourth case is a sequence of requests: those with the remainder 2."""

_NEAR: Final = 32
_NEAR_REMAINDERS: Final = (2, 5, 10, 13, 21, 29)
"""Cases with these remainders begin near the object or in contact with it: a quarter of the sequences, a sixth of the
others."""

_STREAM_REMAINDER: Final = 14
_STREAM_S: Final = 8.0
_STREAM_CHANGES_HZ: Final = 0.5
_STREAM_NOISE: Final = 0.02
"""Sequences with this remainder are streams of requests, as of a policy, for this time. Kind, target and width change
at this rate; between the changes they have noise of this share of their range."""

_GAP_M: Final = 0.002
_NEAR_LIMIT_N: Final = (0.8, 3.0)
"""Largest gap of such a case, and range of its force limit: a large limit leaves room for any friction."""

_REACH_SHARE: Final = 0.2
"""The object of such a case is nearer by this factor, so that requests meet jaws that hold it. Its closing direction is
right: with a wrong one no grasp reaches an object, and a springy one that a release presses pushes the jaws open."""

_GONE_M: Final = 1.0
_PINION_M: Final = 0.020
"""Travel of a jaw per radian to which the drawn masses belong."""

_STOP_MARGIN_M: Final = 0.0005
"""Distance of each jaw from the middle at the end stop."""


class TimedRequest(NamedTuple):
    """A request, and the time until the next one.

    Attributes:
        time_s: The time.
        kind: Kind of the request.
        value: Target in N, or width in m.
    """

    time_s: float
    kind: str
    value: float


@dataclass(frozen=True, slots=True)
class Draw:
    """One case: the plant, and the wrong configuration of it.

    Attributes:
        target_n: Requested force.
        then_n: Force requested after it; NaN for none.
        then_s: Time of this request.
        force_limit_n: As ``control.force_limit_n``.
        approach_m_s: As ``control.approach_speed_m_s``.
        feedback: As ``control.feedback``.
        on_slip: As ``control.on_slip``.
        friction: True friction over the configured one.
        gain: True torque constant over the configured one.
        stiffness_n_m: Stiffness of the object at one jaw.
        mass_kg: Mass of a jaw with its half of the rotor, or with its own rotor.
        damping_n_s_m: Viscous friction.
        play_m: Gear play in each direction.
        contact_m: Travel of a jaw at which it meets the object; 1 m without an object.
        leaves_s: Time at which the object leaves the jaws; infinite for never.
        away_s: Time for which it is away; infinite for ever.
        start_m: Error of the configured open position, as travel of a jaw.
        sign: -1 if the configured closing direction is wrong.
        width: Configured open width over the true one.
        camera_hz: Frames per second.
        vision_gain: Visual estimate over true force.
        vision_noise_n: Its noise.
        motion_n: Force that the network sees in the motion of the jaws alone, once they are closed.
        seed: Seed of the noise.
        on_fault: As ``control.on_fault``.
        requests: Requests instead of a grasp and a change of its force; none in most cases.
        begins_m: Travel of a jaw at which it begins; 0 for open jaws.
    """

    target_n: float
    then_n: float
    then_s: float
    force_limit_n: float
    approach_m_s: float
    feedback: str
    on_slip: str
    friction: float
    gain: float
    stiffness_n_m: float
    mass_kg: float
    damping_n_s_m: float
    play_m: float
    contact_m: float
    leaves_s: float
    away_s: float
    start_m: float
    sign: int
    width: float
    camera_hz: float
    vision_gain: float
    vision_noise_n: float
    motion_n: float
    seed: int
    on_fault: str
    requests: tuple[TimedRequest, ...]
    begins_m: float


@dataclass(frozen=True, slots=True)
class CaseResult:
    """Outcome of one case.

    Attributes:
        index: Number of the case.
        outcome: Last outcome of the grasp, or ``refused`` if the run did not start.
        force_share: Largest contact force over the force limit.
        speed_share: Largest speed without contact over the configured one.
        held_nothing: True if the outcome was ``held`` without contact force, although a camera was in use.
        held_stop: True if it was, on an end stop, by motor current alone.
    """

    index: int
    outcome: str
    force_share: float
    speed_share: float
    held_nothing: bool
    held_stop: bool

    @property
    def ok(self) -> bool:
        """True if the three statements hold."""
        return self.force_share <= FORCE_SHARE and self.speed_share <= SPEED_SHARE and not self.held_nothing


class WorstCase(TypedDict):
    """A case with what was drawn for it. What is not finite is null."""

    index: int
    outcome: str
    force_share: float
    speed_share: float
    held_nothing: bool
    held_stop: bool
    drawn: dict[str, object]


class SearchReport(TypedDict):
    """Result of `search`.

    Attributes:
        ok: True if there are no violations.
        cases: Number of cases.
        seed: Seed of all draws.
        outcomes: Number of cases by outcome.
        violations: Number of violations by statement.
        held_stops: Number of end stops that were taken for an object by motor current alone.
        worst: The worst cases by statement.
    """

    ok: bool
    cases: int
    seed: int
    outcomes: dict[str, int]
    violations: dict[str, int]
    held_stops: int
    worst: dict[str, list[WorstCase]]


class _Random:
    """Random numbers of one case. Each call takes the next ones."""

    def __init__(self, seed: int, index: int) -> None:
        self.generator = np.random.default_rng([seed, 50, index])

    def between(self, low: float, high: float) -> float:
        return float(self.generator.uniform(low, high))

    def log_between(self, low: float, high: float) -> float:
        return math.exp(self.between(math.log(low), math.log(high)))

    def rarely(self, share: float, value: float, otherwise: float) -> float:
        return value if self.generator.uniform() < share else otherwise


def draw(config: ControlConfig, truth: Transmission, seed: int, index: int, servos: int = 1) -> Draw:
    """Draws a case. The same arguments give the same case.

    Args:
        config: Force limit and speed of half of the cases.
        truth: The gripper.
        seed: Seed of all draws.
        index: Number of the case.
        servos: 2 if each jaw has its own servo.
    """
    random = _Random(seed, index)
    is_sequence = index % _SEQUENCE == _SEQUENCE - 2
    drawn = _draw_far(random, config, truth, is_sequence=is_sequence)
    drawn = replace(drawn, mass_kg=servos * drawn.mass_kg)  # of one servo, a jaw has half
    if index % _NEAR == _STREAM_REMAINDER:
        max_n = largest_target_n(drawn.force_limit_n, truth.force_bound)
        return replace(drawn, requests=tuple(_draw_stream(random, max_n, truth.open_width_m)))
    if index % _NEAR in _NEAR_REMAINDERS:
        return _move_near(random, drawn, truth)
    return drawn


def _draw_far(random: _Random, config: ControlConfig, truth: Transmission, *, is_sequence: bool) -> Draw:
    """Draws a case that begins with open jaws. The order of the calls is part of the result."""
    between, log_between, rarely = random.between, random.log_between, random.rarely
    rng, width_m = random.generator, truth.open_width_m
    reach = _REACH_SHARE if is_sequence else 1.0
    force_limit_n = rarely(0.5, log_between(0.8, 20.0), config.force_limit_n)
    max_n = largest_target_n(force_limit_n, truth.force_bound)
    min_n = min(0.5, max_n)
    open_m_per_rad = truth.jaw_m_per_rad(truth.open_position_rad)
    return Draw(
        force_limit_n=force_limit_n,
        approach_m_s=rarely(0.5, log_between(0.01, 0.04), config.approach_speed_m_s),
        target_n=between(min_n, max_n),
        then_n=rarely(0.5, between(min_n, max_n), math.nan),
        then_s=between(1.0, 4.0),
        feedback=str(rng.choice(["fused", "current", "vision"])),
        on_slip=str(rng.choice(["regrip", "hold", "open"])),
        friction=log_between(0.3, 5.0),
        gain=between(0.7, 1.4),
        stiffness_n_m=log_between(200.0, 30_000.0),
        mass_kg=between(0.8, 1.5) * (_PINION_M / open_m_per_rad) ** 2,
        damping_n_s_m=between(0.55, 1.1) * truth.damping_n_s_m,
        play_m=between(0.0002, 0.0004),
        contact_m=rarely(0.2, _GONE_M, reach * between(0.002, width_m / 2 - 0.003)),
        leaves_s=rarely(0.25, between(0.5, _GRASP_S), math.inf),
        start_m=rarely(0.3, between(-0.02, 0.02), 0.0),
        sign=int(rarely(0.0 if is_sequence else 0.1, -1, 1)),
        width=rarely(0.3, between(0.8, 1.2), 1.0),
        camera_hz=between(5.0, 60.0),
        vision_gain=log_between(0.4, 2.5),
        vision_noise_n=between(0.03, 0.3),
        seed=int(rng.integers(2**31)),
        motion_n=rarely(0.3, between(0.0, 6.0), 0.0),
        away_s=rarely(0.5, log_between(0.02, 1.5), math.inf),
        on_fault=str(rng.choice(["limp", "hold", "open"])),
        requests=tuple(
            _draw_request(random, max_n, width_m)
            for _ in range(int(rng.integers(3, 9)) if is_sequence else 0)
        ),
        begins_m=0.0,
    )


def _draw_request(random: _Random, max_n: float, open_width_m: float) -> TimedRequest:
    kinds = [RequestKind.GRASP, RequestKind.RELEASE, RequestKind.MOVE, RequestKind.STOP]
    kind = RequestKind(random.generator.choice(kinds, p=[0.6, 0.2, 0.12, 0.08]))
    low_n = min(_MIN_N, max_n)
    value = random.between(low_n, max_n) if kind == RequestKind.GRASP else random.between(0.0, open_width_m)
    return TimedRequest(random.log_between(0.05, 8.0), kind, value)


def _draw_stream(random: _Random, max_n: float, open_width_m: float) -> Iterator[TimedRequest]:
    """Draws a stream of requests, as of a policy."""
    period_s = random.log_between(0.005, 0.1)
    ranges = {RequestKind.GRASP: (min(_MIN_N, max_n), max_n), RequestKind.MOVE: (0.0, open_width_m)}
    kind, values = RequestKind.GRASP, {key: random.between(*bounds) for key, bounds in ranges.items()}
    for _ in range(round(_STREAM_S / period_s)):
        if random.generator.uniform() < _STREAM_CHANGES_HZ * period_s:
            kind = RequestKind(random.generator.choice([*ranges, RequestKind.RELEASE], p=[0.6, 0.3, 0.1]))
            values = {key: random.between(*bounds) for key, bounds in ranges.items()}
        low, high = ranges.get(kind, (0.0, 0.0))
        noise = _STREAM_NOISE * (high - low) * float(random.generator.standard_normal())
        yield TimedRequest(period_s, kind, min(max(values.get(kind, 0.0) + noise, low), high))


def _move_near(random: _Random, drawn: Draw, truth: Transmission) -> Draw:
    """Returns the case with jaws that begin near the object, and a force limit and targets that suit this."""
    gap_m = random.rarely(0.3, 0.0, random.between(0.0, _GAP_M))
    to_m = random.between(0.0, truth.open_width_m / 4) if drawn.contact_m == _GONE_M else drawn.contact_m
    limit_n = random.log_between(*_NEAR_LIMIT_N)
    scale = limit_n / drawn.force_limit_n
    min_n = min(_MIN_N, largest_target_n(limit_n, truth.force_bound))
    return replace(
        drawn,
        begins_m=max(to_m - gap_m, 0.0),
        force_limit_n=limit_n,
        target_n=max(scale * drawn.target_n, min_n),
        then_n=max(scale * drawn.then_n, min_n),  # not a number stays
        requests=tuple(
            step._replace(value=max(scale * step.value, min_n)) if step.kind == RequestKind.GRASP else step
            for step in drawn.requests
        ),
    )


def run_case(config: Config, seed: int, index: int) -> CaseResult:
    """Grasps and releases with one drawn plant, in closed loop with the unmodified controller."""
    refused = CaseResult(index, "refused", 0.0, 0.0, held_nothing=False, held_stop=False)
    servos = len(config.servo.ids)
    truth = transmission_of(config.gripper, servos)
    drawn = draw(config.control, truth, seed, index, servos)
    width_m = drawn.width * truth.open_width_m
    try:
        believed = transmission_of(config.gripper.model_copy(update={"open_width_m": width_m}), servos)
    except ConfigError:  # the linkage cannot close so far
        return refused
    control = config.control.model_copy(
        update={
            "feedback": drawn.feedback,
            "on_slip": drawn.on_slip,
            "vision_rate_hz": drawn.camera_hz,
            "force_limit_n": drawn.force_limit_n,
            "approach_speed_m_s": drawn.approach_m_s,
            "on_fault": drawn.on_fault,
        }
    )
    plant = Gripper(
        truth,
        stiffness_n_m=drawn.stiffness_n_m,
        gain=drawn.gain,
        friction_n=drawn.friction * truth.friction_n,
        damping_n_s_m=drawn.damping_n_s_m,
        play_m=drawn.play_m,
        mass_kg=drawn.mass_kg,
        contact_m=drawn.contact_m,
        stops_m=(0.0, truth.open_width_m / 2 - _STOP_MARGIN_M),
    )
    plant.x_m = plant.jaw_m = drawn.begins_m
    controller = GraspController(control, believed, config.servo.current_limit_a, POSITION_LOOP)
    offset_rad = drawn.start_m / truth.jaw_m_per_rad(truth.open_position_rad)
    run = _Run(plant, controller, drawn, offset_rad, control)
    if controller.start_problem(run.read(0, 0.0)):
        return refused
    if drawn.requests:
        for step in drawn.requests:
            run.request(step)
    else:
        run.request(TimedRequest(run.slower_s + drawn.then_s, RequestKind.GRASP, drawn.target_n))
        if math.isfinite(drawn.then_n) and run.outcome in (Outcome.NONE, Outcome.HELD):
            run.request(TimedRequest(_GRASP_S - drawn.then_s, RequestKind.GRASP, drawn.then_n))
        else:
            run.go(_GRASP_S - drawn.then_s, None)
    run.go(run.slower_s + _RELEASE_S, Request(run.t_ns, RequestKind.RELEASE))
    shown = run.statements
    return CaseResult(
        index,
        str(run.outcome),
        shown.force_share,
        shown.speed_share,
        shown.held_nothing and not (drawn.feedback == "current" and run.is_at_stop),
        shown.held_nothing and drawn.feedback == "current" and run.is_at_stop,
    )


class _Run:
    """A closed loop whose servo angle has another zero and sign than the controller believes."""

    def __init__(
        self,
        plant: Gripper,
        controller: GraspController,
        drawn: Draw,
        offset_rad: float,
        control: ControlConfig,
    ) -> None:
        self._plant, self._controller, self._drawn = plant, controller, drawn
        self._offset_rad = offset_rad
        # Jaws with a small force limit are slow, so that all else happens later.
        self.slower_s = controller.timeout_s(math.inf) - control.timeout_s
        self._leaves_ns = (self.slower_s + drawn.leaves_s) * NS_PER_S
        self._returns_ns = self._leaves_ns + drawn.away_s * NS_PER_S
        self._rng = np.random.default_rng(drawn.seed)
        self._vision = SimulatedVision(
            0.035 + 0.5 / drawn.camera_hz, drawn.vision_noise_n, drawn.camera_hz, drawn.vision_gain
        )
        self.t_ns = 0
        self.outcome: str = Outcome.NONE
        self.is_at_stop = False
        self.statements = SafetyStatements(control, drawn.target_n, drawn.sign)

    def read(self, t_ns: int, noise: float) -> ServoState:
        state = self._plant.read(t_ns, NOISE_A * noise)
        sign = self._drawn.sign
        return replace(
            state,
            position_rad=sign * state.position_rad + self._offset_rad,
            velocity_rad_s=sign * state.velocity_rad_s,
            current_a=sign * state.current_a,
        )

    def request(self, step: TimedRequest) -> None:
        if step.kind == RequestKind.GRASP:
            self.statements.change_target(step.value)
        self.go(step.time_s, Request(self.t_ns, step.kind, target_n=step.value, width_m=step.value))

    def go(self, time_s: float, request: Request | None) -> None:
        for servo_noise, vision_noise in self._rng.standard_normal(
            (round(time_s * NS_PER_S / CYCLE_NS), 2)
        ).tolist():
            plant = self._plant
            if self.t_ns >= self._leaves_ns and plant.contact_m < _GONE_M:
                plant.contact_m, plant.deepest_m = _GONE_M, 0.0
                self._leaves_ns = math.inf
            if self.t_ns >= self._returns_ns:  # at the jaws, if they have closed beyond its place
                plant.contact_m, plant.deepest_m = max(self._drawn.contact_m, plant.jaw_m), plant.jaw_m
                self._returns_ns = math.inf
            servo = self.read(self.t_ns, servo_noise)
            seen_n = plant.force_n + self._drawn.motion_n * plant.x_m / plant.stops_m[1]
            visual = self._vision.sample(self.t_ns, seen_n, vision_noise)
            decision = self._controller.step(self.t_ns, servo, visual, request)
            request = None
            command = decision.command
            goal_rad = self._drawn.sign * (command.goal_position_rad - self._offset_rad)
            plant.advance(ServoCommand(self.t_ns, goal_rad, command.goal_current_a), CYCLE_NS / NS_PER_S)
            self.t_ns += CYCLE_NS
            self.outcome = decision.status.outcome
            held_nothing = self.statements.held_nothing
            self.statements.observe(
                CYCLE_NS / NS_PER_S,
                decision.status.phase,
                decision.status.outcome,
                force_n=plant.force_n,
                object_n=plant.force_n,
                peak_n=plant.peak_n,
                closing_m_s=plant.v_m_s,
                has_torque=command.goal_current_a > 0,
            )
            if self.statements.held_nothing and not held_nothing:
                self.is_at_stop = plant.x_m in plant.stops_m


def search(
    config: Config,
    cases: int,
    workers: int,
    keep: Path,
    *,
    resume: bool = False,
    progress: Progress = no_progress,
) -> SearchReport:
    """Runs the cases 0 to ``cases`` - 1 of the configuration's seed.

    Args:
        config: Gripper and control; the seed of all draws.
        cases: Number of cases.
        workers: Processes.
        keep: File for the results, one line each.
        resume: True to continue from the results in that file.
        progress: Called after each case.

    Raises:
        DataError: The file can't be read or written, or is of another configuration, seed or version.
    """
    results = _read(keep, config) if resume else {}
    missing = [index for index in range(cases) if index not in results]
    progress("", min(len(results), cases))
    try:
        keep.parent.mkdir(parents=True, exist_ok=True)
        with keep.open("a" if results else "w", encoding="utf-8") as file:
            if not results:
                file.write(json.dumps(_identity(config)) + "\n")
            with process_pool(workers) as pool:
                run = partial(run_case, config, config.seed)
                for result in pool.map(run, missing, chunksize=_CHUNK):
                    results[result.index] = result
                    file.write(json.dumps(asdict(result)) + "\n")
                    file.flush()
                    progress(f"case {result.index}")
    except OSError as error:
        raise DataError(f"can't write {keep} ({error}); set log.directory to a writable folder") from error
    return _report(config, [results[index] for index in range(cases)])


def _identity(config: Config) -> dict[str, object]:
    sections = {
        name: getattr(config, name).model_dump(mode="json") for name in ("control", "gripper", "servo")
    }
    return {"version": __version__, "seed": config.seed, **sections}


def _read(keep: Path, config: Config) -> dict[int, CaseResult]:
    if not keep.exists():
        return {}
    try:
        first, *lines = whole_lines(keep)
        identity = json.loads(first)
        results = [CaseResult(**json.loads(line)) for line in lines]
    except (OSError, ValueError, TypeError) as error:
        raise DataError(f"can't read {keep} ({error}); start again without --resume") from error
    if identity != _identity(config):
        raise DataError(f"{keep} is of another configuration, seed or version; start again without --resume")
    return {result.index: result for result in results}


def _report(config: Config, results: list[CaseResult]) -> SearchReport:
    statements: dict[str, tuple[Callable[[CaseResult], float], Callable[[CaseResult], bool]]] = {
        "force": (lambda r: r.force_share, lambda r: r.force_share > FORCE_SHARE),
        "speed": (lambda r: r.speed_share, lambda r: r.speed_share > SPEED_SHARE),
        "held nothing": (lambda r: float(r.held_nothing), lambda r: r.held_nothing),
    }

    def worst_cases(name: str) -> Iterator[WorstCase]:
        key, _ = statements[name]
        for result in sorted(results, key=key, reverse=True)[:WORST]:
            if name == "held nothing" and not result.held_nothing:
                return
            servos = len(config.servo.ids)
            truth = transmission_of(config.gripper, servos)
            drawn = asdict(draw(config.control, truth, config.seed, result.index, servos))
            finite = {
                k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in drawn.items()
            }
            yield {**asdict(result), "drawn": finite}  # type: ignore[typeddict-item]

    return {
        "ok": all(result.ok for result in results),
        "cases": len(results),
        "seed": config.seed,
        "outcomes": dict(Counter(result.outcome for result in results).most_common()),
        "violations": {name: sum(bad(r) for r in results) for name, (_, bad) in statements.items()},
        "held_stops": sum(result.held_stop for result in results),
        "worst": {name: list(worst_cases(name)) for name in statements},
    }
