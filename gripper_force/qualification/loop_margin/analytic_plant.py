"""Analytic model of a gripper and an object, fast enough for thousands of closed-loop runs.

One jaw, driven by half of the motor: current loop, inertia, Coulomb and viscous friction and gear play, as in
the simulated rig (docs/simulation.md), and an object that is a spring. The servo is an X-series
one in mode 5 (current-based position control). A linkage's travel per radian is that at the begin of each cycle.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

from gripper_force.config import GripperConfig
from gripper_force.control.speed_limit import PositionLoop
from gripper_force.control.transmission import Transmission
from gripper_force.types import NS_PER_MS, NS_PER_S, ServoCommand, ServoState, VisualForce

_NM_PER_A: Final = 1.78
CURRENT_STEP_A: Final = 0.00269
"""Current resolution of an XM430-W350: https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/"""

CYCLE_NS: Final = 5 * NS_PER_MS
_STALL_A: Final = 2.3
CURRENT_LOOP_S: Final = 0.002
_TICK_RAD: Final = 2 * math.pi / 4096
_NO_LOAD_RAD_S: Final = 4.8
_VELOCITY_STEP_RAD_S: Final = 0.024
_PWM_PER_TICK: Final = 800 / 128 / 885

_DUTY_PER_RAD: Final = _PWM_PER_TICK / _TICK_RAD
POSITION_LOOP: Final = PositionLoop(_STALL_A * _DUTY_PER_RAD, _NO_LOAD_RAD_S * _DUTY_PER_RAD)
"""Position loop of the simulated servo."""

NOISE_A: Final = 0.003
"""Standard deviation of the measured current in one reading."""


def transmission_of(gripper: GripperConfig, servos: int = 1) -> Transmission:
    """Returns the configured transmission; motor data that are not configured are those of XM430-W350 servos."""
    return Transmission.from_config(gripper, servos * _NM_PER_A, gripper.current_step_a or CURRENT_STEP_A)


@dataclass(slots=True)
class Gripper:
    """The true state and parameters of one jaw and the object. Travel is zero with the jaws open.

    Attributes:
        transmission: The transmission that the controller assumes.
        stiffness_n_m: Stiffness of the object at one jaw.
        stiffening_n_m2: Force per compression squared that adds to it.
        gain: True torque constant over the assumed one.
        friction_n: True Coulomb friction.
        damping_n_s_m: True viscous friction.
        play_m: Gear play in each direction.
        step_a: True resolution of the goal current.
        mass_kg: Mass of an open jaw with its half of the rotor, or its own rotor. A linkage multiplies it as it closes.
        contact_m: Travel at which the jaw meets the object.
        stops_m: Travel of the motor at its two end stops, at which it comes to rest.
        x_m: Travel of the motor, as travel of a jaw.
        v_m_s: Speed of the motor, as speed of a jaw.
        jaw_m: Travel of the jaw.
        current_a: Motor current.
        deepest_m: Largest travel of the jaw so far.
    """

    transmission: Transmission
    stiffness_n_m: float = 1000.0
    stiffening_n_m2: float = 0.0
    gain: float = 1.0
    friction_n: float = 0.95
    damping_n_s_m: float = 14.5
    play_m: float = 0.0003
    step_a: float = CURRENT_STEP_A
    mass_kg: float = 1.3
    contact_m: float = 0.010
    stops_m: tuple[float, float] = (-math.inf, math.inf)
    x_m: float = 0.0
    v_m_s: float = 0.0
    jaw_m: float = 0.0
    current_a: float = 0.0
    deepest_m: float = 0.0

    @property
    def force_n(self) -> float:
        """Contact force at one jaw."""
        return self._contact_force_n(self.jaw_m)

    @property
    def peak_n(self) -> float:
        """Largest contact force so far."""
        return self._contact_force_n(self.deepest_m)

    def _contact_force_n(self, jaw_m: float) -> float:
        depth_m = max(jaw_m - self.contact_m, 0.0)
        return self.stiffness_n_m * depth_m + self.stiffening_n_m2 * depth_m**2

    def advance(self, command: ServoCommand, time_s: float) -> None:
        """Integrates the motion for ``time_s`` while the servo follows ``command``."""
        stiffness_n_m, stiffening_n_m2 = self.stiffness_n_m, self.stiffening_n_m2
        contact_m, play_m, (low_m, high_m) = self.contact_m, self.play_m, self.stops_m
        damping_n_s_m, friction_n = self.damping_n_s_m, self.friction_n
        transmission, position_rad = self.transmission, self._position_rad
        n_per_a, radius_m = self.gain * transmission.n_per_a(position_rad), self._radius_m
        mass_kg = self.mass_kg * (transmission.jaw_m_per_rad(transmission.open_position_rad) / radius_m) ** 2
        x_m, v_m_s, jaw_m, current_a = self.x_m, self.v_m_s, self.jaw_m, self.current_a
        deepest_m = self.deepest_m
        limit_a = command.goal_current_a
        if self.step_a:
            limit_a = round(limit_a / self.step_a) * self.step_a
        goal_m = self.x_m + transmission.closing_m_s(command.goal_position_rad - position_rad, position_rad)
        pwm_per_m = _PWM_PER_TICK / (_TICK_RAD * radius_m)
        steps = math.ceil(time_s / self._step_s)
        dt_s = time_s / steps
        keep, brake_m_s = math.exp(-dt_s / CURRENT_LOOP_S), friction_n / mass_kg * dt_s
        for _ in range(steps):
            # Comparisons, as the calls of min and max would take a seventh of the time of a search.
            pwm = (goal_m - x_m) * pwm_per_m
            pwm = -1.0 if pwm < -1.0 else 1.0 if pwm > 1.0 else pwm
            wanted_a = _STALL_A * (pwm - v_m_s / radius_m / _NO_LOAD_RAD_S)
            wanted_a = -limit_a if wanted_a < -limit_a else limit_a if wanted_a > limit_a else wanted_a
            current_a = wanted_a + (current_a - wanted_a) * keep
            depth_m = jaw_m - contact_m if jaw_m > contact_m else 0.0
            force_n = stiffness_n_m * depth_m + stiffening_n_m2 * depth_m * depth_m
            drive_n = n_per_a * current_a - damping_n_s_m * v_m_s - force_n
            free_m_s = v_m_s + drive_n / mass_kg * dt_s
            if free_m_s > brake_m_s:
                v_m_s = free_m_s - brake_m_s
            else:
                v_m_s = free_m_s + brake_m_s if free_m_s < -brake_m_s else 0.0
            x_m += v_m_s * dt_s
            if not low_m <= x_m <= high_m:
                x_m, v_m_s = min(max(x_m, low_m), high_m), 0.0
            # The object pushes the jaw back onto the driving flank of the teeth.
            back_m, front_m = x_m - play_m, x_m + play_m
            jaw_m = contact_m if contact_m < jaw_m else jaw_m
            jaw_m = front_m if front_m < jaw_m else jaw_m
            jaw_m = back_m if back_m > jaw_m else jaw_m
            deepest_m = jaw_m if jaw_m > deepest_m else deepest_m
        self.x_m, self.v_m_s, self.jaw_m, self.current_a = x_m, v_m_s, jaw_m, current_a
        self.deepest_m = deepest_m

    def read(self, t_ns: int, noise_a: float) -> ServoState:
        """Returns the servo's reading in the servo's own steps; ``noise_a`` is added to the current."""
        sign = self.transmission.closing_sign
        velocity_rad_s = sign * self.v_m_s / self._radius_m
        measured_a = sign * self.current_a + noise_a
        return ServoState(
            t_ns=t_ns,
            position_rad=round(self._position_rad / _TICK_RAD) * _TICK_RAD,
            velocity_rad_s=round(velocity_rad_s / _VELOCITY_STEP_RAD_S) * _VELOCITY_STEP_RAD_S,
            current_a=round(measured_a / CURRENT_STEP_A) * CURRENT_STEP_A,
            temperature_c=35.0,
            voltage_v=12.0,
            hardware_error=0,
        )

    @property
    def _position_rad(self) -> float:
        return self.transmission.position_rad(self.transmission.open_width_m - 2 * self.x_m)

    @property
    def _radius_m(self) -> float:
        """Travel of a jaw per radian."""
        return self.transmission.jaw_m_per_rad(self._position_rad)

    @property
    def _step_s(self) -> float:
        """Integration step, short against the oscillation of jaw and object."""
        return min(0.0005, 0.4 * math.sqrt(self.mass_kg / self.stiffness_n_m))


class SimulatedVision:
    """Visual estimates of the force: delayed, with white noise.

    Attributes:
        delay_s: Time from a frame to its estimate; may be changed between frames.
        gain: Estimate over true force.
    """

    def __init__(self, delay_s: float, noise_n: float, rate_hz: float = 60.0, gain: float = 1.0) -> None:
        self.delay_s, self.gain = delay_s, gain
        self._noise_n, self._period_ns = noise_n, NS_PER_S / rate_hz
        self._pending: deque[VisualForce] = deque()
        self._seq = 0

    def sample(self, t_ns: int, force_n: float, noise: float) -> VisualForce | None:
        """Takes a frame if one is due and returns the newest estimate that is ready, or None.

        Args:
            t_ns: Now.
            force_n: True force.
            noise: A sample of the standard normal distribution.
        """
        if t_ns >= self._seq * self._period_ns:
            self._seq += 1
            estimate_n = max(self.gain * force_n + self._noise_n * noise, 0.0)
            std_n = max(self._noise_n, 0.1)
            ready_ns = t_ns + round(self.delay_s * NS_PER_S)
            self._pending.append(VisualForce(t_ns, ready_ns, self._seq, estimate_n, std_n, 12.0))
        newest = None
        while self._pending and self._pending[0].ready_ns <= t_ns:
            newest = self._pending.popleft()
        return newest
