"""The MuJoCo world: physics, contact force and pictures of one scene."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from gripper_force.config import GripperConfig
from gripper_force.errors import SimulationError
from gripper_force.types import NS_PER_S
from gripper_hw.sim.engine import mujoco, new_renderer
from gripper_hw.sim.scene import Scene, scene_mjcf
from gripper_hw.sim.surroundings import Surroundings

_MAX_PENETRATION_M = 0.004
_MAX_RACK_SLIP_M = 0.005
_GUARD_PERIOD_NS = 5_000_000
_LONGEST_STEP_S = 0.004
"""At 8 ms a tube goes on without a warning, and presses with 22 N where it should with 12."""

# Each costs more than the whole of the rest of a 128x128 picture in software.
_NOT_DRAWN = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_SKYBOX,
    mujoco.mjtRndFlag.mjRND_HAZE,
    mujoco.mjtRndFlag.mjRND_FOG,
)


class Motor(Protocol):
    """The servo's firmware, stepped with the physics."""

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        """Takes what the encoder sees and returns the motor current in ampere."""
        ...


@dataclass
class _Tap:
    period_ns: int
    due_ns: int
    call: Callable[[int], None]


class World:
    """One scene in motion.

    Args:
        scene: What is simulated.
        gripper: The gripper's geometry.
        motor: The servo's firmware.
        nm_per_a: Its torque constant by the catalogue.
        seed: Draws the current's noise.
        seen: Whether it may be drawn; a world that no camera sees has no textures.
        step_s: Time step in place of the scene's own, to see what the step does.

    Attributes:
        t_ns: Simulated time.
        step_ns: Time step of the physics.
        force_n: Grip force: mean of the normal forces on the two pads.
    """

    def __init__(
        self,
        scene: Scene,
        gripper: GripperConfig,
        motor: Motor,
        nm_per_a: float,
        seed: int,
        *,
        seen: bool = True,
        step_s: float | None = None,
    ) -> None:
        text, assets = scene_mjcf(scene, gripper, seen=seen)
        try:
            self._model: Any = mujoco.MjModel.from_xml_string(text, assets)
        except ValueError as error:
            raise SimulationError(f"MuJoCo refuses the scene of {scene.object!r}: {error}") from error
        if step_s is not None:
            self._model.opt.timestep = step_s
        if not 0 < self._model.opt.timestep <= _LONGEST_STEP_S:
            raise SimulationError(
                f"a step of {1e3 * self._model.opt.timestep:g} ms is no step for {scene.object!r}: what "
                f"comes of it can't be trusted; take one of at most {1e3 * _LONGEST_STEP_S:g} ms"
            )
        self._data: Any = mujoco.MjData(self._model)
        self._scene, self._motor, self._surroundings = scene, motor, Surroundings(scene)
        self._nm_per_a = nm_per_a * scene.nm_per_a
        self._rng = np.random.default_rng([seed, 1])
        self.step_ns = round(self._model.opt.timestep * NS_PER_S)
        servo = self._model.joint("servo")
        self._qpos, self._dof = int(servo.qposadr[0]), int(servo.dofadr[0])
        self._left = int(self._model.sensor("left_force").adr[0]) + 1
        self._right = int(self._model.sensor("right_force").adr[0]) + 1
        self._taps: list[_Tap] = []
        self._renderer: Any = None
        self._picture: tuple[int, npt.NDArray[np.uint8]] | None = None
        self.t_ns = 0
        self.force_n = 0.0
        mujoco.mj_forward(self._model, self._data)
        self.every(_GUARD_PERIOD_NS, self._guard)

    @property
    def unknowns(self) -> int:
        """Degrees of freedom of the scene."""
        return int(self._model.nv)

    @property
    def iterations(self) -> int:
        """The solver's, in the last step."""
        return int(self._data.solver_niter.sum())

    def every(self, period_ns: int, call: Callable[[int], None]) -> None:
        """Calls ``call(t_ns)`` at each multiple of a period, to the next physics step."""
        self._taps.append(_Tap(period_ns, self.t_ns + period_ns, call))

    def advance_to(self, t_ns: int) -> None:
        """Lets the world go on. Raises `SimulationError` once it can't be trusted any more."""
        data = self._data
        while self.t_ns + self.step_ns <= t_ns:
            noise_a = float(self._rng.normal(0.0, 0.003))
            current_a = self._motor.control(
                self.t_ns, float(data.qpos[self._qpos]), float(data.qvel[self._dof]), noise_a
            )
            data.ctrl[0] = self._nm_per_a * current_a
            try:
                mujoco.mj_step(self._model, data)
            except mujoco.FatalError as error:
                raise SimulationError(self._broken(str(error))) from error
            self.t_ns += self.step_ns
            sensors = data.sensordata
            self.force_n = 0.5 * (abs(float(sensors[self._left])) + abs(float(sensors[self._right])))
            for tap in self._taps:
                if tap.due_ns <= self.t_ns:
                    tap.due_ns += tap.period_ns
                    tap.call(self.t_ns)

    def render(self, side: int) -> npt.NDArray[np.uint8]:
        """The world as it stands, (side, side, 3) uint8. Raises `SimulationError` without EGL."""
        if self._renderer is None:
            self._renderer = self._new_renderer(side)
        if self._picture is None or self._picture[0] != self.t_ns:  # one drawing serves all light levels
            self._move_background()
            self._renderer.update_scene(self._data, "camera")
            self._picture = self.t_ns, self._renderer.render()
        return self._picture[1]

    def close(self) -> None:
        """Frees the drawing context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _new_renderer(self, side: int) -> Any:
        renderer = new_renderer(self._model, side)
        for flag in _NOT_DRAWN:
            renderer.scene.flags[flag] = 0
        return renderer

    def _move_background(self) -> None:
        """Nothing touches what passes, so it moves where it is drawn: the physics is the same without it."""
        for i, place_m in enumerate(self._surroundings.places_m(self.t_ns / NS_PER_S)):
            self._data.geom_xpos[self._model.geom(f"passing_{i}").id] = place_m

    def _guard(self, _: int) -> None:
        """`discrete` fails silently: a wrong world has to be looked for."""
        data = self._data
        if not np.isfinite(data.qacc).all():
            raise SimulationError(self._broken("an acceleration is not finite"))
        if (warnings := np.flatnonzero(data.warning.number)).size:
            raise SimulationError(self._broken(f"MuJoCo warns {mujoco.mjtWarning(int(warnings[0])).name}"))
        if data.ncon and (depth := -float(data.contact.dist.min())) > _MAX_PENETRATION_M:
            raise SimulationError(self._broken(f"a pad is {depth * 1e3:.1f} mm deep in the object"))
        if (slip := abs(float(data.ten_length[0]))) > _MAX_RACK_SLIP_M:
            raise SimulationError(self._broken(f"the rack has slipped {slip * 1e3:.1f} mm on its pinion"))
        if self.force_n > 200.0:
            raise SimulationError(self._broken(f"the grip force reads {self.force_n:.0f} N"))

    def _broken(self, what: str) -> str:
        s = self._scene
        return (
            f"the simulation of {s.object!r} ({s.detail}) broke at {self.t_ns / NS_PER_S:.3f} s: {what}; "
            "take a finer sim.detail or another seed"
        )

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()
