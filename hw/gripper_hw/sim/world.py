"""MuJoCo world: physics, contact force and rendering of one scene."""

from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from queue import SimpleQueue
from threading import Thread, current_thread
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from gripper_force.config import GripperConfig
from gripper_force.control.linkage import Linkage, RackAndPinion, make_linkage
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.types import NS_PER_S, STANDARD_GRAVITY_M_S2
from gripper_hw.sim.engine import mujoco, new_renderer
from gripper_hw.sim.objects import NO_OBJECT
from gripper_hw.sim.scene import Scene, horn_dynamics, scene_mjcf
from gripper_hw.sim.scene_checks import check_reach, check_view
from gripper_hw.sim.surroundings import Surroundings

_MAX_PENETRATION_M = 0.004
"""Deepest plausible contact of a pad in the object."""

_MAX_RACK_SLIP_M = 0.005
"""Largest plausible difference between rack and pinion; the gear play is at most 0.4 mm."""

_MAX_FORCE_N = 200.0
"""Largest plausible grip force."""

_MIN_NODE_KG = 0.004
"""Least mass of a node of an elastic solid that a pad presses; below 0.001 kg contacts can explode."""

_CHECK_PERIOD_NS = 5_000_000
_MAX_STEP_S = 0.004
"""At 8 ms a tube presses with 22 N instead of 12 N, without any warning of MuJoCo."""

_CURRENT_NOISE_A = 0.003
_JAW_HALF_HEIGHT_M = 0.011
_AWAY_M = (1.0, 0.0, 0.0)
"""Position of an object that has left the jaws, outside the image."""

# In software rendering, each of these costs more than all the rest of a 128x128 image.
_DISABLED_RENDER_FLAGS = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_SKYBOX,
    mujoco.mjtRndFlag.mjRND_HAZE,
    mujoco.mjtRndFlag.mjRND_FOG,
)


_T = TypeVar("_T")


class _OneThread:
    """Runs functions in a thread of its own. An executor can't: Python ends it before a program's last cycles."""

    def __init__(self) -> None:
        self._calls: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._thread = Thread(target=self._run, name="renderer", daemon=True)
        self._thread.start()

    def run(self, function: Callable[[], _T]) -> _T:
        """Returns or raises what the function returns or raises."""
        if current_thread() is self._thread:  # a world that is deleted there closes itself there
            return function()
        result: Future[_T] = Future()
        self._calls.put((result, function))
        return result.result()

    def end(self) -> None:
        """Ends the thread."""
        self._calls.put(None)

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            result, function = call
            try:
                result.set_result(function())
            except BaseException as error:  # raised in the thread that waits
                result.set_exception(error)
            del call, result, function  # they refer to the world, which could not be deleted while this waits


class Motor(Protocol):
    """The servo's firmware, called at each physics step."""

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        """Returns the motor current in A.

        Args:
            t_ns: Simulated time.
            position_rad: Angle of the horn.
            velocity_rad_s: Angular velocity of the horn.
            current_noise_a: Error of the current's measurement in this step.
        """


@dataclass(frozen=True)
class _Drive:
    """A servo in the world: its firmware and its place in MuJoCo's arrays."""

    motor: Motor
    scene: Scene
    nm_per_a: float
    rails: int
    qpos: int
    dof: int


@dataclass
class _PeriodicCall:
    period_ns: int
    due_ns: int
    call: Callable[[int], None]


class World:
    """Simulation of one scene.

    Args:
        scene: The scene.
        gripper: The gripper's geometry.
        motor: The servo's firmware.
        nm_per_a: The servo's torque constant by the catalogue.
        seed: Seed of the current noise.
        textured: False for blank textures, if the world is never rendered.
        step_s: Time step in place of the scene's, to study its effect.
        second: Motor of the left finger and its scene (see `draw_second_finger`); None: one servo drives both.
        hanging_mass_kg: Mass whose weight pulls the right jaw open.

    Attributes:
        t_ns: Simulated time.
        step_ns: Time step of the physics.
        force_n: Grip force: mean of the normal forces on the two pads.
        has_object: False if there is no object, or it has left the jaws.

    Raises:
        ConfigError: The object does not exist, does not fit between the open jaws, can't be touched by them, or the
            tool is not suitable for it; or the camera sees neither pads nor object, or is inside something.
        SimulationError: MuJoCo refuses the scene, or the time step is too long.
    """

    def __init__(
        self,
        scene: Scene,
        gripper: GripperConfig,
        motor: Motor,
        nm_per_a: float,
        seed: int,
        *,
        textured: bool = True,
        step_s: float | None = None,
        second: tuple[Motor, Scene] | None = None,
        hanging_mass_kg: float = 0.0,
    ) -> None:
        text, assets = scene_mjcf(scene, gripper, textured=textured, second=second and second[1])
        try:
            self._model: Any = mujoco.MjModel.from_xml_string(text, assets)
        except ValueError as error:
            raise SimulationError(
                f"MuJoCo refuses the scene of {scene.object!r} ({error}); check the object's file and the keys of sim"
            ) from error
        if step_s is not None:
            self._model.opt.timestep = step_s
        if not 0 < self._model.opt.timestep <= _MAX_STEP_S:
            raise SimulationError(
                f"a step of {1e3 * self._model.opt.timestep:g} ms gives wrong forces for {scene.object!r}; "
                f"take one above 0 and at most {1e3 * _MAX_STEP_S:g} ms"
            )
        self._data: Any = mujoco.MjData(self._model)
        if scene.object_file:
            self._make_nodes_heavier()
        self._scene, self._surroundings = scene, Surroundings(scene)
        self._rng = np.random.default_rng([seed, 1])
        self.step_ns = round(self._model.opt.timestep * NS_PER_S)
        drives = {"servo": (motor, scene)} | ({} if second is None else {"second_servo": second})
        self._drives = [
            _Drive(motor_, scene_, nm_per_a * scene_.nm_per_a, 2 // len(drives), *self._addresses(name))
            for name, (motor_, scene_) in drives.items()
        ]
        # The scene has pinions; another linkage acts between a horn and its pinion.
        linkage = make_linkage(gripper)
        self._linkage = None if isinstance(linkage, RackAndPinion) else linkage
        self._pinion = RackAndPinion(gripper.pinion_radius_m, gripper.open_width_m)
        self._left = int(self._model.sensor("left_force").adr[0]) + 1
        self._right = int(self._model.sensor("right_force").adr[0]) + 1
        self._periodic_calls: list[_PeriodicCall] = []
        self._graphics: _OneThread | None = None  # the renderer's thread, once it is used
        self._renderer: Any = None
        self._image: tuple[int, npt.NDArray[np.uint8]] | None = None
        self.t_ns = 0
        self.force_n = 0.0
        self.has_object = scene.object != NO_OBJECT
        self._racks = [
            i for i in range(self._model.ntendon) if self._model.tendon(i).name in ("rack", "second_rack")
        ]
        self._hang_up(hanging_mass_kg)
        mujoco.mj_forward(self._model, self._data)
        self._check_fit(gripper.open_width_m)
        if self.has_object:
            check_reach(self._model, self._data, scene.object)
        if textured:
            check_view(self._model, self._data)
        self.call_every(_CHECK_PERIOD_NS, self._check_state)

    @property
    def unknowns(self) -> int:
        """Number of degrees of freedom of the scene."""
        return int(self._model.nv)

    @property
    def iterations(self) -> int:
        """Number of iterations of the solver in the last step."""
        return int(self._data.solver_niter.sum())

    @property
    def closing_m_s(self) -> float:
        """Speed of the faster pinion as travel of one jaw, positive while it closes."""
        speeds_rad_s = [float(self._data.qvel[drive.dof]) for drive in self._drives]
        return self._pinion.radius_m * max(speeds_rad_s, key=abs)

    def remove_object(self) -> None:
        """Moves the object out of the jaws at once."""
        self._model.body_pos[self._model.body("object").id] = _AWAY_M
        self.has_object = False

    def call_every(self, period_ns: int, call: Callable[[int], None]) -> None:
        """Registers ``call(t_ns)`` for each multiple of a period, rounded up to the next physics step."""
        self._periodic_calls.append(_PeriodicCall(period_ns, self.t_ns + period_ns, call))

    def advance_to(self, t_ns: int) -> None:
        """Simulates up to a time. Raises `SimulationError` if the state becomes implausible."""
        data = self._data
        while self.t_ns + self.step_ns <= t_ns:
            for i, drive in enumerate(self._drives):
                noise_a = float(self._rng.normal(0.0, _CURRENT_NOISE_A))
                position_rad, velocity_rad_s = float(data.qpos[drive.qpos]), float(data.qvel[drive.dof])
                ratio = 1.0
                if self._linkage is not None:
                    position_rad, ratio = self._horn(self._linkage, drive, position_rad)
                current_a = drive.motor.control(self.t_ns, position_rad, ratio * velocity_rad_s, noise_a)
                data.ctrl[i] = ratio * drive.nm_per_a * current_a
            try:
                mujoco.mj_step(self._model, data)
            except mujoco.FatalError as error:
                raise SimulationError(self._failure_text(str(error))) from error
            self.t_ns += self.step_ns
            sensors = data.sensordata
            self.force_n = 0.5 * (abs(float(sensors[self._left])) + abs(float(sensors[self._right])))
            for periodic in self._periodic_calls:
                if periodic.due_ns <= self.t_ns:
                    periodic.due_ns += periodic.period_ns
                    periodic.call(self.t_ns)

    def _make_nodes_heavier(self) -> None:
        """Gives each node of a user's solid the least mass with which its contacts are stable.

        MuJoCo divides the mass by the vertices near a node, and a rounded solid leaves little at the corners of its
        cage. The shipped objects are stable without, and keep their masses.
        """
        nodes = np.unique(self._model.flex_nodebodyid)
        nodes = nodes[self._model.body_dofnum[nodes] > 0]
        self._model.body_mass[nodes] = np.maximum(self._model.body_mass[nodes], _MIN_NODE_KG)
        mujoco.mj_setConst(self._model, self._data)

    def _hang_up(self, mass_kg: float) -> None:
        """Adds a mass and its weight to the right jaw, which moves up while it closes."""
        if mass_kg == 0:
            return
        self._model.body_mass[self._model.body("right").id] += mass_kg
        mujoco.mj_setConst(self._model, self._data)
        self._data.qfrc_applied[self._addresses("right")[1]] = -mass_kg * STANDARD_GRAVITY_M_S2

    def _addresses(self, joint: str) -> tuple[int, int]:
        return int(self._model.joint(joint).qposadr[0]), int(self._model.joint(joint).dofadr[0])

    def _horn(self, linkage: Linkage, drive: "_Drive", pinion_rad: float) -> tuple[float, float]:
        """Returns the horn's angle and its rotation per rotation of the pinion.

        The rotor's inertia and friction act on the pinion through this ratio, by virtual work.
        """
        horn_rad = linkage.closing_rad(self._pinion.width_m(pinion_rad))
        ratio = self._pinion.radius_m / linkage.jaw_m_per_rad(horn_rad)
        inertia, damping, friction_nm, rail_friction_nm = horn_dynamics(
            drive.scene, self._pinion.radius_m, drive.rails
        )
        self._model.dof_armature[drive.dof] = inertia * ratio**2
        self._model.dof_damping[drive.dof] = damping * ratio**2
        self._model.dof_frictionloss[drive.dof] = friction_nm * ratio + rail_friction_nm
        return horn_rad, ratio

    def render(self, side_px: int) -> npt.NDArray[np.uint8]:
        """Renders the present state, (side_px, side_px, 3) uint8. Raises `SimulationError` without EGL.

        Any thread may call it. A rendering context can be used in one thread only, so it has a thread of its own.
        """
        if self._image is None or self._image[0] != self.t_ns:  # one rendering serves all light levels
            self._graphics = self._graphics or _OneThread()
            self._image = self.t_ns, self._graphics.run(lambda: self._rendered(side_px))
        return self._image[1]

    def close(self) -> None:
        """Frees the rendering context."""
        graphics, self._graphics = self._graphics, None
        if graphics is not None:
            if self._renderer is not None:
                graphics.run(self._renderer.close)
                self._renderer = None
            graphics.end()

    def _rendered(self, side_px: int) -> npt.NDArray[np.uint8]:
        if self._renderer is None:
            self._renderer = new_renderer(self._model, side_px)
            for flag in _DISABLED_RENDER_FLAGS:
                self._renderer.scene.flags[flag] = 0
        self._move_background()
        self._renderer.update_scene(self._data, "camera")
        image: npt.NDArray[np.uint8] = self._renderer.render()
        return image

    def _move_background(self) -> None:
        """Moves the background objects. They have no contacts, so only the rendered positions change."""
        for i, position_m in enumerate(self._surroundings.positions_m(self.t_ns / NS_PER_S)):
            self._data.geom_xpos[self._model.geom(f"background_{i}").id] = position_m

    def _check_fit(self, open_width_m: float) -> None:
        # A shell has no contact with jaws inside it: its nodes at the jaws' height show that it is too wide.
        x_m, _, z_m = self._data.flexvert_xpos.T
        is_between = np.abs(z_m - self._data.body("left").xpos[2]) < _JAW_HALF_HEIGHT_M
        pads = [self._model.geom(f"pad_{side}").id for side in ("left", "right")]
        # Parts of the object may touch each other.
        if np.isin(self._data.contact.geom, pads).any() or (np.abs(x_m[is_between]) > open_width_m / 2).any():
            raise ConfigError(
                f"the simulated object {self._scene.object!r} does not fit between jaws that open "
                f"{1e3 * open_width_m:.0f} mm; take another object, another seed, or a larger gripper.open_width_m"
            )

    def _check_state(self, _: int) -> None:
        """Raises `SimulationError` for an implausible state; the integrator `discrete` reports no error."""
        data = self._data
        if not np.isfinite(data.qacc).all():
            raise SimulationError(self._failure_text("an acceleration is not finite"))
        if (warnings := np.flatnonzero(data.warning.number)).size:
            raise SimulationError(
                self._failure_text(f"MuJoCo warns {mujoco.mjtWarning(int(warnings[0])).name}")
            )
        if data.ncon and (depth := -float(data.contact.dist.min())) > _MAX_PENETRATION_M:
            raise SimulationError(self._failure_text(f"a contact is {depth * 1e3:.1f} mm deep"))
        if (slip := float(np.abs(data.ten_length[self._racks]).max())) > _MAX_RACK_SLIP_M:
            raise SimulationError(
                self._failure_text(f"the rack has slipped {slip * 1e3:.1f} mm on its pinion")
            )
        if self.force_n > _MAX_FORCE_N:
            raise SimulationError(self._failure_text(f"the grip force reads {self.force_n:.0f} N"))

    def _failure_text(self, cause: str) -> str:
        s = self._scene
        return (
            f"the simulation of {s.object!r} ({s.detail}) broke at {self.t_ns / NS_PER_S:.3f} s: {cause}; "
            + (f"simplify {s.object_file} or take" if s.object_file else "take")
            + " a finer sim.detail or another seed"
        )

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()
