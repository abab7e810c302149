"""Simulated rig: a world that drives a virtual servo, a camera and a load cell."""

import json
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import numpy as np
import numpy.typing as npt

from gripper_force.config import VIRTUAL_PREFIX, Config
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.interfaces import Camera, Clock, LoadCell, WorldState
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, Gray, LoadCellSample
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.virtual import VirtualBus, VirtualServo, register_bus, unregister_bus
from gripper_hw.fault_injection import Faults, FaultyEstimator, FaultyFile
from gripper_hw.sim.detail_level import resolve_detail
from gripper_hw.sim.object_files import digest
from gripper_hw.sim.scene import Scene, draw_scene, draw_second_finger, true_gripper
from gripper_hw.sim.surroundings import Surroundings
from gripper_hw.sim.world import World

if TYPE_CHECKING:
    from gripper_hw.dynamixel.bus_faults import WireFaults

FRAME_SIDE_PX = 128
_SUPERSAMPLING = 2
"""Rendered pixels per frame pixel and axis. Without it, edges would move by whole pixels."""

_NOMINAL_EXPOSURE_US = 4000
_WHITE_LUX = 470.0
"""Light at which a perfectly white surface reaches full scale at the nominal exposure."""

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in gray (ITU-R BT.601)."""

GAMMA = 2.2
"""Encoding of the simulated camera."""

_READ_NOISE = 0.002
"""Standard deviation of the read noise, as a share of full scale."""

_VIGNETTE = 0.12
"""Loss of light at the middle of an image's edge."""

_MAX_UNREAD_FRAMES = 64
_MAX_UNREAD_SAMPLES = 100_000
"""Frames and samples kept if they are never read; the oldest are dropped."""

_REALTIME_SLICE_NS = 5 * NS_PER_MS
"""Longest simulated time between two checks for the end of the thread."""

_REALTIME_MAX_LAG_NS = 500 * NS_PER_MS
"""Largest lag of the world behind the host's time; more is an error."""


class LockstepClock:
    """Simulated time. Sleeping advances the world."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._now_ns = 0

    def now_ns(self) -> int:
        """Returns the simulated time."""
        return self._now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Simulates the world up to ``t_ns``."""
        self._now_ns = max(self._now_ns, t_ns)
        self._world.advance_to(self._now_ns)


class _SimulatedSensor(ABC):
    """A sensor that the world calls in each of its periods, from its start until it is closed."""

    def __init__(self, world: World, rate_hz: float) -> None:
        self._world, self._period_ns = world, round(NS_PER_S / rate_hz)
        self._started = self._closed = False

    def start(self) -> None:
        """Starts capturing or sampling."""
        if not self._started:
            self._started = True
            self._world.call_every(self._period_ns, self._sense)

    def counts(self) -> dict[str, int]:
        """Returns an empty mapping: without injected faults nothing is lost or rejected."""
        return {}

    @abstractmethod
    def _sense(self, t_ns: int) -> None:
        """Takes a frame or sample."""


class SimulatedCamera(_SimulatedSensor):
    """Renders the world at the middle of each exposure; a frame is available after the camera's latency."""

    def __init__(self, world: World, scene: Scene, config: Config, clock: Clock, start_ns: int) -> None:
        super().__init__(world, config.camera.rate_hz)
        self._scene, self._clock, self._start_ns = scene, clock, start_ns
        self._surroundings = Surroundings(scene)
        self._latency_ns = round(config.sim.camera_latency_ms * NS_PER_MS)
        self._exposure = _relative_exposure(config)
        self._rng = np.random.default_rng([config.seed, 2])
        self._pending: deque[Frame] = deque(maxlen=_MAX_UNREAD_FRAMES + self._latency_ns // self._period_ns)
        self._seq = 0

    def newest(self) -> Frame | None:
        """Returns the newest available frame that was not returned yet, or None."""
        now_ns, frame = self._clock.now_ns(), None
        while self._pending and self._pending[0].received_ns <= now_ns:
            frame = self._pending.popleft()
        return frame

    def close(self) -> None:
        """Stops capturing. May be called twice. The world frees the rendering context."""
        self._closed = True
        self._pending.clear()

    def _sense(self, t_ns: int) -> None:
        if self._closed:
            return
        scene, image = self._scene, self._world.render(_SUPERSAMPLING * FRAME_SIDE_PX)
        lux = scene.lux * self._surroundings.light_factor(t_ns / NS_PER_S)
        gray = expose(image, lux * self._exposure, scene.shot_noise, self._rng, scene.camera_blur_px)
        t_ns += self._start_ns
        self._pending.append(Frame(t_ns, t_ns + self._latency_ns, self._seq, gray))
        self._seq += 1


class SimulatedLoadCell(_SimulatedSensor):
    """Simulated load cell: mean force on the two pads, with white noise."""

    _NOISE_N = 0.01  # standard deviation

    def __init__(self, world: World, config: Config, start_ns: int) -> None:
        super().__init__(world, config.load_cell.rate_hz)
        self._start_ns = start_ns
        self._rng = np.random.default_rng([config.seed, 3])
        self._samples: deque[LoadCellSample] = deque(maxlen=_MAX_UNREAD_SAMPLES)

    def drain(self) -> list[LoadCellSample]:
        """Returns all samples since the last call, oldest first."""
        return [self._samples.popleft() for _ in range(len(self._samples))]

    def close(self) -> None:
        """Stops sampling. May be called twice."""
        self._closed = True
        self._samples.clear()

    def _sense(self, t_ns: int) -> None:
        if self._closed:
            return
        force_n = self._world.force_n + float(self._rng.normal(0.0, self._NOISE_N))
        self._samples.append(LoadCellSample(t_ns + self._start_ns, force_n, force_n))


class _LockedMotor:
    """A virtual servo's firmware as the world's motor: holds the bus's lock and applies wire faults.

    With ``sign`` -1 it is mirrored: it turns the other way than the finger that it drives.
    """

    def __init__(
        self,
        servo: VirtualServo,
        lock: AbstractContextManager[object],
        faults: "WireFaults | None",
        sign: int,
    ) -> None:
        self._servo, self._lock, self._faults, self._sign = servo, lock, faults, sign

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        with self._lock:
            if self._faults is not None:
                self._faults.update(t_ns)
            state = self._sign * position_rad, self._sign * velocity_rad_s
            return self._sign * self._servo.control(t_ns, *state, current_noise_a)


class SimulatedRig:
    """Owns the world, and offers its servo at the virtual port ``servo.port``.

    In lockstep the run's clock advances the world. In real time a thread keeps the world at the host's time;
    if the machine is too slow for the scene, `check` raises `SimulationError`.

    Args:
        config: A configuration without ``sim.detail: auto`` (see `resolve`).

    Attributes:
        scene: The simulated scene.
        clock: The run's clock.
        camera: The simulated camera, with its faults.
        load_cell: The simulated load cell, with its faults.
        start_ns: Start of the run on its clock.
        wrap_estimator: Makes an estimator fail as configured; None without such a fault.
        wrap_file: The same for the log's file.

    Raises:
        ConfigError: ``servo.port`` is already in use, ``sim.detail`` is not resolved, the object does not exist,
            or a sensor's rate is higher than that of the physics steps.
        SimulationError: The scene cannot be built.
    """

    def __init__(self, config: Config) -> None:
        if config.sim.detail == "auto":
            raise ConfigError(
                "sim.detail is still auto; resolve the configuration with SimulatedRig.resolve first"
            )
        self._config = config
        self.scene = draw_scene(config.object, config.seed, config.sim)
        model = load_model(config.servo.model)
        servos = [VirtualServo(id_, model) for id_ in config.servo.ids]
        bus = VirtualBus(servos, self._bus_time_ns)
        self._lockstep = config.clock == "lockstep"
        self.start_ns = start_ns = 0 if self._lockstep else time.monotonic_ns()
        faults = Faults(config.faults, start_ns)
        wire = None
        if config.faults:
            from gripper_hw.dynamixel.bus_faults import WireFaults

            wire = WireFaults(bus, faults, config.seed)
        motors = [
            _LockedMotor(servo, bus.lock, wire, sign) for servo, sign in zip(servos, (1, -1), strict=False)
        ]
        self._second = draw_second_finger(self.scene, config.seed, config.sim) if len(servos) > 1 else None
        self._world = World(
            self.scene,
            true_gripper(config),
            motors[0],
            model.nm_per_a,
            config.seed,
            textured=config.camera.backend == "simulated",
            second=None if self._second is None else (motors[1], self._second),
            hanging_mass_kg=config.sim.hanging_mass_kg,
        )
        max_hz = NS_PER_S / self._world.step_ns
        for unit, sensor in (("camera", config.camera), ("load_cell", config.load_cell)):
            if sensor.backend == "simulated" and sensor.rate_hz > max_hz:
                raise ConfigError(
                    f"{unit}.rate_hz {sensor.rate_hz:g} is more than the {max_hz:g} physics steps per second; set less"
                )
        self._object_digest = "" if config.sim.object is None else digest(config.sim.object)
        self._exposure_ms = config.sim.exposure_ms * _relative_exposure(config)
        self.clock: Clock = LockstepClock(self._world) if self._lockstep else MonotonicClock()
        self.camera: Camera = SimulatedCamera(self._world, self.scene, config, self.clock, start_ns)
        self.load_cell: LoadCell = SimulatedLoadCell(self._world, config, start_ns)
        self.wrap_estimator: Callable[[Any], Any] | None = None
        self.wrap_file: Callable[[BinaryIO], BinaryIO] | None = None
        self._closing = ExitStack()
        if config.faults:
            self._wrap_in_faults(faults, config.seed)
        bus_name = config.servo.port.removeprefix(VIRTUAL_PREFIX)
        register_bus(bus_name, bus)
        self._closing.callback(unregister_bus, bus_name)
        self._failure: Exception | None = None
        self._stop, self._is_prepared = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    resolve = staticmethod(resolve_detail)

    def _wrap_in_faults(self, faults: Faults, seed: int) -> None:
        def remove_object(t_ns: int) -> None:
            if faults.active("plant", faults.start_ns + t_ns) == "off":
                self._world.remove_object()

        from gripper_hw.sim.rig_faults import FaultyCamera, FaultyClock, FaultyLoadCell

        clock = self.clock
        if faults.has("plant"):
            self._world.call_every(self._world.step_ns, remove_object)
        if faults.has("clock"):
            self.clock = faulty = FaultyClock(clock, faults)
            self._closing.callback(faulty.close)
        if faults.has("camera"):
            self.camera = FaultyCamera(self.camera, faults, clock, seed)
        if faults.has("load_cell"):
            self.load_cell = FaultyLoadCell(self.load_cell, faults, clock, seed)
        if faults.has("estimator"):
            self.wrap_estimator = partial(
                FaultyEstimator, faults=faults, clock=self.clock, lockstep=self._lockstep
            )
        if faults.has("disk"):
            self.wrap_file = cast(
                Callable[[BinaryIO], BinaryIO],
                partial(FaultyFile, faults=faults, clock=self.clock, lockstep=self._lockstep),
            )

    def start(self) -> None:
        """Starts the world's thread, and waits until it keeps time; in lockstep the clock advances the world."""
        if not self._lockstep and self._thread is None:
            self._thread = threading.Thread(target=self._run_in_real_time, name="simulated-rig", daemon=True)
            self._thread.start()
            self._is_prepared.wait()

    def check(self) -> None:
        """Re-raises an exception of the world's thread, if there was one."""
        if self._failure is not None:
            raise self._failure

    def notes(self) -> dict[str, str]:
        """Facts for the log: set, the scene's parameters, the exposure, and the digest of a user's object file."""
        finger_notes = {} if self._second is None else {"second finger": json.dumps(asdict(self._second))}
        file = self._config.sim.object
        files = {} if file is None else {"object file": str(file), "object file sha256": self._object_digest}
        return {
            "set": f"{self._config.object}-{self._config.seed}",  # logs of one scene
            "scene": json.dumps(asdict(self.scene)),
            "exposure_ms": str(self._exposure_ms),
            **finger_notes,
            **files,
        }

    def render_under_light(self, lux: float) -> tuple[Camera, dict[str, str]]:
        """Returns a camera of this world with the images of a rig of this ``sim.lux``, and its notes."""
        config = self._config.with_values(sim={"lux": lux})
        scene = draw_scene(config.object, config.seed, config.sim)
        camera = SimulatedCamera(self._world, scene, config, self.clock, self.start_ns)
        return camera, {**self.notes(), "scene": json.dumps(asdict(scene))}

    def observe_world(self, call: Callable[[WorldState], None]) -> None:
        """Calls a function with the true state after each step of the world, in the world's thread."""

        def observe(t_ns: int) -> None:
            world = self._world
            call(WorldState(t_ns + self.start_ns, world.force_n, world.closing_m_s, world.has_object))

        self._world.call_every(self._world.step_ns, observe)

    def close(self) -> None:
        """Stops the world and unregisters its bus. May be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._closing.close()
        self._world.close()

    def _bus_time_ns(self) -> int:
        # Simulated time, so that the watchdog of the firmware counts it.
        return self._world.t_ns

    def _run_in_real_time(self) -> None:
        try:
            if self._config.camera.backend == "simulated":
                # The first image takes 0.2 s, in which the control loop would not run either.
                self._world.render(_SUPERSAMPLING * FRAME_SIDE_PX)
            self._world.advance_to(time.monotonic_ns() - self.start_ns)
            self._is_prepared.set()
            while not self._stop.is_set():
                due_ns = time.monotonic_ns() - self.start_ns
                lag_ns = due_ns - self._world.t_ns
                if lag_ns > _REALTIME_MAX_LAG_NS:
                    simpler = "" if self.scene.detail == "coarse" else "sim.detail=coarse or "
                    raise SimulationError(  # noqa: TRY301
                        f"this machine is too slow to simulate {self.scene.object!r} ({self.scene.detail}) "
                        f"in real time; set {simpler}clock=lockstep"
                    )
                self._world.advance_to(min(due_ns, self._world.t_ns + _REALTIME_SLICE_NS))
                if lag_ns < _REALTIME_SLICE_NS:
                    self._stop.wait(1e-3)
        except Exception as error:  # `check` raises it in the session's thread
            self._failure = error
        finally:
            self._is_prepared.set()


def _relative_exposure(config: Config) -> float:
    """Returns the exposure time divided by the nominal one."""
    return (config.camera.exposure_us or _NOMINAL_EXPOSURE_US) / _NOMINAL_EXPOSURE_US


def expose(
    image: npt.NDArray[np.uint8],
    lux: float,
    shot_noise: float,
    rng: np.random.Generator,
    blur_px: float = 0.0,
) -> Gray:
    """Converts a rendered image to a frame of a gray camera with locked exposure.

    The image is averaged over each pixel and linearised; light, blur, vignette, photon and read noise are
    applied; the result is encoded with gamma 2.2.

    Args:
        image: Rendered image, (2 H, 2 W, 3) uint8.
        lux: Illumination, scaled by the relative exposure.
        shot_noise: Standard deviation of the photon noise at full scale, as a share of it.
        rng: Source of the noise.
        blur_px: Standard deviation of the lens's blur, in pixels of the frame.

    Returns:
        Frame, (H, W) uint8.
    """
    import cv2

    height, width = image.shape[0] // _SUPERSAMPLING, image.shape[1] // _SUPERSAMPLING
    pixels = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    gray = pixels @ _LUMA / 255.0  # (H, W)
    y, x = np.ogrid[:height, :width]
    radius2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width * width / 4)
    linear = gray**GAMMA
    if blur_px:
        linear = cv2.GaussianBlur(linear, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE)
    linear = linear * np.float32(lux / _WHITE_LUX) * (1 - _VIGNETTE * radius2).astype(np.float32)
    spread = np.sqrt(shot_noise**2 * linear + _READ_NOISE**2)
    linear += rng.standard_normal(gray.shape, dtype=np.float32) * spread
    encoded: Gray = (255 * np.clip(linear, 0, 1) ** (1 / GAMMA)).astype(np.uint8)
    return encoded
