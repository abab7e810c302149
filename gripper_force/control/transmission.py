"""Conversion of servo angle and motor current to jaw width and jaw force."""

import math
from dataclasses import dataclass
from functools import lru_cache

from gripper_force.config import GripperConfig
from gripper_force.control.linkage import Linkage, make_linkage

GOAL_OFFSET_M = 0.010
"""Distance by which each jaw's goal lies inside the object, before the speed limit; the goal current sets the force.
The goal may lie this far beyond the closed jaws, because the servo could not press on a thin object otherwise."""

_IMPACT_RAD_S_PER_N = 0.18
"""Speed of the horn per newton of impact force, with a fifth to spare: for an object of 30 N/mm and the rotor of an
XM430, which acts like 1.4 kg per jaw at a pinion of 20 mm."""


@dataclass(frozen=True, slots=True)
class Transmission:
    """Nominal kinematics and statics of the gripper.

    Forces are motor forces at each jaw, *before* friction: while closing, the contact force is
    ``force_n - friction_n``. Positive closes. By virtual work, the force is the torque over the decrease of the
    width per radian; with one moving finger it acts at its tip.

    Attributes:
        linkage: Geometry between the horn and the jaws.
        closing_sign: Sign of the servo's rotation that closes the jaws.
        open_position_rad: Servo angle with the jaws open.
        nm_per_a: Torque at the horn per ampere.
        friction_n: Coulomb friction at each jaw.
        damping_n_s_m: Viscous friction at each jaw.
        current_step_a: Resolution of the servo's goal current; 0 if unknown.
        friction_std: Standard deviation of true friction, as a share of `friction_n`.
        torque_constant_std: Standard deviation of the true torque constant, as a share of the nominal.
        torque_constant_bound: Largest plausible ratio of the true torque constant to the nominal.
    """

    linkage: Linkage
    closing_sign: int
    open_position_rad: float
    nm_per_a: float
    friction_n: float
    damping_n_s_m: float
    current_step_a: float = 0.0
    friction_std: float = 0.25
    torque_constant_std: float = 0.06
    torque_constant_bound: float = 1.4

    @classmethod
    def from_config(
        cls, gripper: GripperConfig, servo_nm_per_a: float, current_step_a: float = 0.0
    ) -> "Transmission":
        """Returns the transmission of a configured gripper; its torque constant defaults to the servo's.

        Raises:
            ConfigError: The jaws cannot close with this geometry.
        """
        nm_per_a = servo_nm_per_a if gripper.nm_per_a is None else gripper.nm_per_a
        return cls(
            linkage=make_linkage(gripper),
            closing_sign=gripper.closing_sign,
            open_position_rad=gripper.open_position_rad,
            nm_per_a=nm_per_a,
            friction_n=gripper.friction_n,
            damping_n_s_m=gripper.damping_n_s_m,
            current_step_a=current_step_a,
            friction_std=gripper.friction_std,
            torque_constant_std=gripper.gain_std,
            torque_constant_bound=gripper.gain_bound,
        )

    @property
    def open_width_m(self) -> float:
        """Distance between the open jaws."""
        return self.linkage.width_m(0.0)

    @property
    def closed_position_rad(self) -> float:
        """Servo angle with the jaws closed."""
        return self.position_rad(0.0)

    @property
    def goal_range_rad(self) -> tuple[float, float]:
        """Lowest and highest goal position: from the open jaws to `GOAL_OFFSET_M` beyond the closed ones."""
        ends = (self.open_position_rad, self.position_rad(-2 * GOAL_OFFSET_M))
        return min(ends), max(ends)

    def width_m(self, position_rad: float) -> float:
        """Returns the distance between the jaws at a servo angle."""
        return self.linkage.width_m(self._closing_rad(position_rad))

    def position_rad(self, width_m: float) -> float:
        """Returns the servo angle at a distance between the jaws."""
        return self.open_position_rad + self.closing_sign * self.linkage.closing_rad(width_m)

    def jaw_m_per_rad(self, position_rad: float) -> float:
        """Returns half of the width's decrease per radian at a servo angle."""
        return self.linkage.jaw_m_per_rad(self._closing_rad(position_rad))

    def jaw_m_per_rad_range(self, position_rad: float) -> tuple[float, float]:
        """Returns the least and the greatest travel of a jaw per radian that are plausible at a servo angle."""
        return self.linkage.jaw_m_per_rad_range(self._closing_rad(position_rad))

    def force_share(self, position_rad: float) -> float:
        """Returns the least plausible ratio of the nominal motor force to the true one, by the linkage alone."""
        return self.jaw_m_per_rad_range(position_rad)[0] / self.jaw_m_per_rad(position_rad)

    def speed_share(self, position_rad: float) -> float:
        """Returns the least plausible ratio of the nominal jaw speed to the true one."""
        return self.jaw_m_per_rad(position_rad) / self.jaw_m_per_rad_range(position_rad)[1]

    @property
    def force_bound(self) -> float:
        """Largest plausible ratio of the true motor force to the nominal, anywhere in the travel."""
        return self.torque_constant_bound / min(map(self.force_share, self._travel_rad()))

    @property
    def friction_share(self) -> float:
        """Least plausible ratio of the true friction to the one that a motion shows, anywhere in the travel."""
        return min(map(self.speed_share, self._travel_rad()))

    def impact_m_s(self, force_n: float) -> float:
        """Returns the largest jaw speed whose impact on a hard object stays within a force, anywhere in the travel."""
        return _IMPACT_RAD_S_PER_N * force_n * min(map(self.jaw_m_per_rad, self._travel_rad()))

    def n_per_a(self, position_rad: float) -> float:
        """Returns the motor force at each jaw per ampere at a servo angle."""
        return self.nm_per_a / (2 * self.jaw_m_per_rad(position_rad))

    def closing_m_s(self, velocity_rad_s: float, position_rad: float) -> float:
        """Returns half of the speed at which the width falls: the closing speed of one of two jaws."""
        return self.closing_sign * self.jaw_m_per_rad(position_rad) * velocity_rad_s

    def fastest_closing_m_s(self, velocity_rad_s: float, position_rad: float) -> float:
        """Returns the `closing_m_s` of the greatest plausible magnitude: what the limits of the speed keep."""
        return self.closing_m_s(velocity_rad_s, position_rad) / self.speed_share(position_rad)

    def force_n(self, current_a: float, position_rad: float) -> float:
        """Returns the motor force at each jaw for a signed motor current."""
        return self.closing_sign * self.n_per_a(position_rad) * current_a

    def current_a(self, force_n: float, position_rad: float) -> float:
        """Returns the signed motor current for a motor force at each jaw."""
        return self.closing_sign * force_n / self.n_per_a(position_rad)

    def bias_std_n(self, force_n: float) -> float:
        """Returns the standard deviation of the contact force about the current estimate."""
        return math.hypot(self.friction_std * self.friction_n, self.torque_constant_std * force_n)

    def _closing_rad(self, position_rad: float) -> float:
        return self.closing_sign * (position_rad - self.open_position_rad)

    def _travel_rad(self) -> list[float]:
        return [self.position_rad(self.open_width_m * i / 32) for i in range(33)]


@lru_cache(maxsize=8)
def force_bound(gripper: GripperConfig) -> float:
    """Returns the largest plausible ratio of the true motor force to the nominal, anywhere in the travel."""
    return Transmission.from_config(gripper, 1.0).force_bound
