"""A small gripper: inertia, spring, Coulomb and viscous friction, a mode-5 servo, a late and noisy vision."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from gripper_force.config import ControlConfig, GripperConfig
from gripper_force.control.state_machine import Decision, GraspController
from gripper_force.control.transmission import Transmission
from gripper_force.types import (
    NS_PER_S,
    LoadCellSample,
    Request,
    RequestKind,
    ServoCommand,
    ServoState,
    VisualForce,
)

CYCLE_NS = 5_000_000
STEP_A = 0.00269
TICK_RAD = 2 * math.pi / 4096
TRANSMISSION = Transmission.from_config(GripperConfig(), 1.78, STEP_A)


@dataclass
class Plant:
    """True gripper and object; forces and travel are those of one jaw."""

    stiffness_n_m: float = 1000.0
    stiffening_n_m2: float = 0.0
    mass_kg: float = 1.3
    damping_n_s_m: float = 12.5
    friction_n: float = 0.95
    gain: float = 1.0
    contact_m: float = 0.016
    noise_a: float = 0.003
    x_m: float = 0.0
    v_m_s: float = 0.0
    current_a: float = 0.0
    dt_s: float = 0.00025

    def force_n(self) -> float:
        depth_m = max(self.x_m - self.contact_m, 0.0)
        return self.stiffness_n_m * depth_m + self.stiffening_n_m2 * depth_m**2

    def advance(self, command: ServoCommand, time_s: float) -> None:
        lsb = round(command.goal_current_a / STEP_A) * STEP_A
        goal_ticks = command.goal_position_rad / TICK_RAD
        radius_m = TRANSMISSION.pinion_radius_m
        for _ in range(round(time_s / self.dt_s)):
            ticks = round(self.x_m / radius_m / TICK_RAD)
            pwm = (goal_ticks - ticks) * 800 / 128 / 885 - self.v_m_s / radius_m / 4.8
            wanted_a = max(-lsb, min(lsb, 2.3 * pwm))
            self.current_a += (wanted_a - self.current_a) * self.dt_s / 0.002
            drive_n = TRANSMISSION.n_per_a * self.gain * self.current_a - self.force_n()
            drive_n -= self.damping_n_s_m * self.v_m_s
            free_m_s = self.v_m_s + drive_n / self.mass_kg * self.dt_s
            brake_m_s = self.friction_n / self.mass_kg * self.dt_s
            self.v_m_s = math.copysign(max(abs(free_m_s) - brake_m_s, 0.0), free_m_s)
            self.x_m += self.v_m_s * self.dt_s
            if not 0.0 <= self.x_m <= 0.045:
                self.x_m, self.v_m_s = min(max(self.x_m, 0.0), 0.045), 0.0

    def read(self, t_ns: int, rng: np.random.Generator) -> ServoState:
        measured_a = self.current_a + float(rng.normal(0.0, self.noise_a))
        return ServoState(
            t_ns=t_ns,
            position_rad=round(self.x_m / TRANSMISSION.pinion_radius_m / TICK_RAD) * TICK_RAD,
            velocity_rad_s=round(self.v_m_s / TRANSMISSION.pinion_radius_m / 0.024) * 0.024,
            current_a=round(measured_a / STEP_A) * STEP_A,
            temperature_c=35.0,
            voltage_v=12.0,
            hardware_error=0,
        )


@dataclass
class SimulatedVision:
    """Vision: 60 frames a second, late, with white noise and an error that stays over a grasp."""

    noise_n: float = 0.1
    gain: float = 1.0
    latency_s: tuple[float, float] = (0.027, 0.045)
    off_after_s: float = math.inf
    seq: int = 0
    due: list[VisualForce] = field(default_factory=list)

    def sample(self, t_ns: int, force_n: float, rng: np.random.Generator) -> VisualForce | None:
        if t_ns * 60 >= self.seq * NS_PER_S and t_ns < self.off_after_s * NS_PER_S:
            self.seq += 1
            ready_ns = t_ns + round(float(rng.uniform(*self.latency_s)) * NS_PER_S)
            seen_n = self.gain * force_n + float(rng.normal(0.0, self.noise_n))
            self.due.append(VisualForce(t_ns, ready_ns, self.seq, max(seen_n, 0.0), self.noise_n, 12.0))
        if self.due and self.due[0].ready_ns <= t_ns:
            return self.due.pop(0)
        return None


@dataclass
class Run:
    """A closed loop and all that went in and out of it."""

    config: ControlConfig
    plant: Plant
    vision: SimulatedVision
    seed: int = 0
    transmission: Transmission = TRANSMISSION
    inputs: list[tuple[int, ServoState, VisualForce | None, Request | None]] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    cell: list[LoadCellSample] = field(default_factory=list)
    spoil: Callable[[int, ServoState], ServoState] = lambda _, servo: servo

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.controller = GraspController(self.config, self.transmission, current_limit_a=1.2)
        self.t_ns = 0

    def go(self, time_s: float, kind: str = "", target_n: float = 0.0, width_m: float = 0.0) -> "Run":
        request = Request(self.t_ns, kind, target_n, width_m) if kind else None
        for _ in range(round(time_s * NS_PER_S / CYCLE_NS)):
            servo = self.spoil(self.t_ns, self.plant.read(self.t_ns, self.rng))
            visual = self.vision.sample(self.t_ns, self.plant.force_n(), self.rng)
            self.inputs.append((self.t_ns, servo, visual, request))
            self.decisions.append(self.controller.step(*self.inputs[-1]))
            self.cell.append(LoadCellSample(self.t_ns, self.plant.force_n(), 0.0))
            self.plant.advance(self.decisions[-1].command, CYCLE_NS / NS_PER_S)
            self.t_ns += CYCLE_NS
            request = None
        return self

    def grasp(self, target_n: float, time_s: float = 6.0) -> "Run":
        return self.go(time_s, RequestKind.GRASP, target_n)

    def move(self, width_m: float, time_s: float = 4.0) -> "Run":
        return self.go(time_s, RequestKind.MOVE, width_m=width_m)

    @property
    def last(self) -> Decision:
        return self.decisions[-1]

    @property
    def texts(self) -> list[str]:
        return [event.text for decision in self.decisions for event in decision.events]


def draw_run(seed: int, **control: object) -> Run:
    """A gripper, an object and an vision drawn from the seed."""
    rng = np.random.default_rng([seed, 1])
    stiffness_n_m = float(rng.choice([300.0, 1000.0, 3000.0]))
    plant = Plant(
        stiffness_n_m=stiffness_n_m,
        stiffening_n_m2=float(rng.choice([0.0, 1e5])),
        mass_kg=float(rng.uniform(0.8, 1.5)),
        damping_n_s_m=float(rng.uniform(8.75, 16.0)),
        friction_n=float(rng.uniform(0.67, 1.23)),
        gain=float(rng.uniform(0.9, 1.1)),
        contact_m=float(rng.uniform(0.008, 0.014)),
    )
    vision = SimulatedVision(noise_n=float(rng.uniform(0.05, 0.15)), gain=float(rng.uniform(0.95, 1.05)))
    return Run(ControlConfig(**control), plant, vision, seed)  # type: ignore[arg-type]


@pytest.fixture(scope="session")
def transmission() -> Transmission:
    return TRANSMISSION


@pytest.fixture(scope="session")
def make_run() -> Callable[..., Run]:
    """Builds a closed loop: ``make_run(plant={...}, vision={...}, **control)``."""

    def make(
        plant: dict[str, float] | None = None, vision: dict[str, float] | None = None, **control: object
    ) -> Run:
        run = draw_run(0, **control)
        return replace(run, plant=Plant(**(plant or {})), vision=SimulatedVision(**(vision or {})))  # type: ignore[arg-type]

    return make


@pytest.fixture(scope="session")
def drawn_run() -> Callable[..., Run]:
    return draw_run
