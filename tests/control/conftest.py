"""A closed loop of the controller and the analytic plant of `gripper_force.qualification.loop_margin`."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from gripper_force.config import ControlConfig, GripperConfig
from gripper_force.control.state_machine import Decision, GraspController
from gripper_force.control.transmission import Transmission
from gripper_force.qualification.loop_margin.analytic_plant import (
    CYCLE_NS,
    NOISE_A,
    POSITION_LOOP,
    Gripper,
    SimulatedVision,
    transmission_of,
)
from gripper_force.types import (
    NS_PER_S,
    GraspStatus,
    LoadCellSample,
    Phase,
    Request,
    RequestKind,
    ServoState,
    VisualForce,
)

TRANSMISSION = transmission_of(GripperConfig())
LATENCY_S = (0.027, 0.045)


def make_gripper(**changes: Any) -> Gripper:
    """The plant with end stops, and an object that the jaws reach after some travel."""
    return Gripper(TRANSMISSION, **{"contact_m": 0.016, "stops_m": (0.0, 0.045), **changes})


def make_vision(noise_n: float = 0.1, **changes: float) -> SimulatedVision:
    return SimulatedVision(LATENCY_S[0], noise_n, **changes)


@dataclass
class Run:
    """A closed loop with all its inputs and outputs."""

    config: ControlConfig
    plant: Gripper
    vision: SimulatedVision
    seed: int = 0
    vision_off_s: float = math.inf
    transmission: Transmission = TRANSMISSION
    inputs: list[tuple[int, ServoState, VisualForce | None, Request | None]] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    cell: list[LoadCellSample] = field(default_factory=list)
    speeds_m_s: list[float] = field(default_factory=list)  # of the jaws, positive while they close
    spoil: Callable[[int, ServoState], ServoState] = lambda _, servo: servo

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.controller = GraspController(self.config, self.transmission, 1.2, POSITION_LOOP)
        self.t_ns = 0

    def go(self, time_s: float, kind: str = "", target_n: float = 0.0, width_m: float = 0.0) -> "Run":
        request = Request(self.t_ns, kind, target_n, width_m) if kind else None
        for _ in range(round(time_s * NS_PER_S / CYCLE_NS)):
            servo_noise, vision_noise = self.rng.standard_normal(2).tolist()
            servo = self.spoil(self.t_ns, self.plant.read(self.t_ns, NOISE_A * servo_noise))
            self.vision.delay_s = float(self.rng.uniform(*LATENCY_S))
            visual = self.vision.sample(self.t_ns, self.plant.force_n, vision_noise)
            if self.t_ns >= self.vision_off_s * NS_PER_S:
                visual = None
            self.inputs.append((self.t_ns, servo, visual, request))
            self.decisions.append(self.controller.step(*self.inputs[-1]))
            self.cell.append(LoadCellSample(self.t_ns, self.plant.force_n, 0.0))
            self.plant.advance(self.decisions[-1].command, CYCLE_NS / NS_PER_S)
            self.speeds_m_s.append(self.plant.v_m_s)
            self.t_ns += CYCLE_NS
            request = None
        return self

    def grasp(self, target_n: float, time_s: float = 4.0) -> "Run":
        return self.go(time_s, RequestKind.GRASP, target_n)

    def move(self, width_m: float, time_s: float = 4.0) -> "Run":
        return self.go(time_s, RequestKind.MOVE, width_m=width_m)

    def to_phase(self, phase: str) -> "Run":
        """Steps until a phase, from the request that leads there."""
        if phase == Phase.OPEN:
            return self.go(0.05)
        if phase == Phase.MOVE:
            return self.move(0.06, 0.5)
        self.go(0.005, RequestKind.GRASP, 4.0)
        if phase == Phase.RELEASE:
            self.go(0.5).go(0.005, RequestKind.RELEASE)
        return self.until(lambda status: status.phase == phase, 5.0)

    def until(self, is_wanted: Callable[[GraspStatus], bool], within_s: float = 40.0) -> "Run":
        """Steps until a status, from the last request on."""
        end_ns = self.t_ns + round(within_s * NS_PER_S)
        while not is_wanted(self.last.status):
            assert self.t_ns < end_ns, self.last.status
            self.go(0.005)
        return self

    @property
    def last(self) -> Decision:
        return self.decisions[-1]

    @property
    def statuses(self) -> list[GraspStatus]:
        return [decision.status for decision in self.decisions]

    @property
    def reasons(self) -> list[str]:
        return [status.reason for status in self.statuses if status.reason]

    @property
    def texts(self) -> list[str]:
        return [event.text for decision in self.decisions for event in decision.events]


def draw_run(seed: int, **control: object) -> Run:
    """A gripper, an object and visual estimates drawn from the seed."""
    rng = np.random.default_rng([seed, 1])
    stiffness_n_m = float(rng.choice([300.0, 1000.0, 3000.0]))
    plant = make_gripper(
        stiffness_n_m=stiffness_n_m,
        stiffening_n_m2=float(rng.choice([0.0, 1e5])),
        mass_kg=float(rng.uniform(0.8, 1.5)),
        damping_n_s_m=float(rng.uniform(8.75, 16.0)),
        friction_n=float(rng.uniform(0.67, 1.23)),
        gain=float(rng.uniform(0.9, 1.1)),
        contact_m=float(rng.uniform(0.008, 0.014)),
    )
    vision = make_vision(noise_n=float(rng.uniform(0.05, 0.15)), gain=float(rng.uniform(0.95, 1.05)))
    return Run(ControlConfig.model_validate(control), plant, vision, seed)


@pytest.fixture(scope="session")
def transmission() -> Transmission:
    return TRANSMISSION


@pytest.fixture(scope="session")
def make_run() -> Callable[..., Run]:
    """Builds a closed loop: ``make_run(plant={...}, vision={...}, **control)``."""

    def make(
        plant: dict[str, float] | None = None,
        vision: dict[str, float] | None = None,
        vision_off_s: float = math.inf,
        **control: object,
    ) -> Run:
        run = draw_run(0, **control)
        gripper, visual = make_gripper(**(plant or {})), make_vision(**(vision or {}))
        return replace(run, plant=gripper, vision=visual, vision_off_s=vision_off_s)

    return make


@pytest.fixture(scope="session")
def drawn_run() -> Callable[..., Run]:
    return draw_run
