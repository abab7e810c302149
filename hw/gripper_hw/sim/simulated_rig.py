"""The simulated rig: one world behind a virtual servo, a camera and a load cell."""

import json
import threading
import time
from collections import deque
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.fault_injection import Faults
from gripper_force.interfaces import Camera, Clock, LoadCell
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.types import NS_PER_MS, NS_PER_S, Frame, Gray, LoadCellSample
from gripper_hw.dynamixel.control_table import load_model
from gripper_hw.dynamixel.virtual import VirtualBus, VirtualServo, register_bus, unregister_bus
from gripper_hw.sim.detail_level import resolve_detail
from gripper_hw.sim.scene import Scene, draw_scene
from gripper_hw.sim.surroundings import Surroundings
from gripper_hw.sim.world import World

if TYPE_CHECKING:
    from gripper_hw.dynamixel.bus_faults import WireFaults

FRAME_SIDE = 128
_OVERSAMPLED = 2
"""A pixel gathers light over its area; else edges would move by whole pixels."""

_EXPOSURE_US = 4000
_WHITE_LUX = 470.0
"""Light at which a perfectly white surface fills the range at that exposure."""

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_GAMMA = 2.2
_READ_NOISE = 0.002
_VIGNETTE = 0.12
_UNREAD = 64
"""Frames kept that have arrived and nobody took."""

_REALTIME_SLICE_NS = 5 * NS_PER_MS
_REALTIME_MAX_LAG_NS = 500 * NS_PER_MS


class LockstepClock:
    """Simulated time. To sleep is to let the world go on."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._now_ns = 0

    def now_ns(self) -> int:
        """Simulated time."""
        return self._now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Moves the world to ``t_ns``."""
        self._now_ns = max(self._now_ns, t_ns)
        self._world.advance_to(self._now_ns)


class SimulatedCamera:
    """Draws the world at the middle of each exposure and hands the picture on after the camera's latency."""

    def __init__(self, world: World, scene: Scene, config: Config, clock: Clock, start_ns: int) -> None:
        self._world, self._scene, self._clock, self._start_ns = world, scene, clock, start_ns
        self._surroundings = Surroundings(scene)
        self._latency_ns = round(config.sim.camera_latency_ms * NS_PER_MS)
        self._period_ns = round(NS_PER_S / config.camera.rate_hz)
        self._exposure = _exposure(config)
        self._rng = np.random.default_rng([config.seed, 2])
        self._under_way: deque[Frame] = deque(maxlen=_UNREAD + self._latency_ns // self._period_ns)
        self._seq = 0
        self._started = self._closed = False

    def start(self) -> None:
        """Begins to capture."""
        if not self._started:
            self._started = True
            self._world.every(self._period_ns, self._capture)

    def newest(self) -> Frame | None:
        """The newest frame that has arrived and was not handed out, or None."""
        now_ns, frame = self._clock.now_ns(), None
        while self._under_way and self._under_way[0].received_ns <= now_ns:
            frame = self._under_way.popleft()
        return frame

    def counts(self) -> dict[str, int]:
        """Nothing goes wrong here."""
        return {}

    def close(self) -> None:
        """Stops capturing; the world owns the drawing context. May be called twice."""
        self._closed = True
        self._under_way.clear()

    def _capture(self, t_ns: int) -> None:
        if self._closed:
            return
        picture = self._world.render(_OVERSAMPLED * FRAME_SIDE)
        lux = self._scene.lux * self._surroundings.light(t_ns / NS_PER_S)
        gray = expose(picture, lux * self._exposure, self._scene.shot_noise, self._rng)
        t_ns += self._start_ns
        self._under_way.append(Frame(t_ns, t_ns + self._latency_ns, self._seq, gray))
        self._seq += 1


class SimulatedLoadCell:
    """Strain gauges behind the pads: the mean of both, with white noise."""

    _NOISE_N = 0.01

    def __init__(self, world: World, config: Config, start_ns: int) -> None:
        self._world, self._start_ns = world, start_ns
        self._period_ns = round(NS_PER_S / config.load_cell.rate_hz)
        self._rng = np.random.default_rng([config.seed, 3])
        self._samples: deque[LoadCellSample] = deque(maxlen=100_000)
        self._started = self._closed = False

    def start(self) -> None:
        """Begins to sample."""
        if not self._started:
            self._started = True
            self._world.every(self._period_ns, self._sample)

    def drain(self) -> list[LoadCellSample]:
        """Every sample since the last call."""
        return [self._samples.popleft() for _ in range(len(self._samples))]

    def counts(self) -> dict[str, int]:
        """Nothing goes wrong here."""
        return {}

    def close(self) -> None:
        """Stops sampling. May be called twice."""
        self._closed = True
        self._samples.clear()

    def _sample(self, t_ns: int) -> None:
        if self._closed:
            return
        force_n = self._world.force_n + float(self._rng.normal(0.0, self._NOISE_N))
        self._samples.append(LoadCellSample(t_ns + self._start_ns, force_n, force_n))


class _LockedMotor:
    """Keeps the world's thread and the bus' apart."""

    def __init__(
        self, servo: VirtualServo, lock: AbstractContextManager[object], faults: "WireFaults | None"
    ) -> None:
        self._servo, self._lock, self._faults = servo, lock, faults

    def control(self, t_ns: int, position_rad: float, velocity_rad_s: float, current_noise_a: float) -> float:
        with self._lock:
            if self._faults is not None:
                self._faults.update(t_ns)
            return self._servo.control(t_ns, position_rad, velocity_rad_s, current_noise_a)


class SimulatedRig:
    """Owns the world, and serves its servo as the port that the configuration names.

    In lockstep the session's clock moves the world. In real time a thread of the rig's own keeps the world at
    the host's time, and says so in a `SimulationError` where the machine is too slow for the scene.
    """

    def __init__(self, config: Config) -> None:
        if not config.servo.port.startswith("virtual:"):
            raise ConfigError(
                f"servo.port {config.servo.port!r} is no virtual port, and a simulated camera or load cell "
                "sees the simulated rig's servo alone; set camera.backend and load_cell.backend to what you "
                "have, or to none, or set servo.port to virtual:rig"
            )
        config, self._why = resolve_detail(config)
        self._config = config
        self.scene = draw_scene(config.object, config.seed, config.sim)
        model = load_model(config.servo.model)
        servo = VirtualServo(config.servo.id, model)
        bus = VirtualBus([servo], self._bus_time_ns)
        self._lockstep = config.clock == "lockstep"
        start_ns = 0 if self._lockstep else time.monotonic_ns()
        faults = Faults(config.faults, start_ns)
        wire = None
        if config.faults:
            from gripper_hw.dynamixel.bus_faults import WireFaults

            wire = WireFaults(bus, faults, config.seed)
        motor = _LockedMotor(servo, bus.lock, wire)
        seen = config.camera.backend == "simulated"
        self._world = World(self.scene, config.gripper, motor, model.nm_per_a, config.seed, seen=seen)
        self._exposure_ms = config.sim.exposure_ms * _exposure(config)
        clock: Clock = LockstepClock(self._world) if self._lockstep else MonotonicClock()
        self.clock: Clock = clock
        self.camera: Camera = SimulatedCamera(self._world, self.scene, config, clock, start_ns)
        self.load_cell: LoadCell = SimulatedLoadCell(self._world, config, start_ns)
        self._closing = ExitStack()
        if config.faults:
            self._break_devices(faults, config.seed)
        self._bus_name = config.servo.port.removeprefix("virtual:")
        register_bus(self._bus_name, bus)
        self.start_ns = start_ns
        self._failure: Exception | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def _break_devices(self, faults: Faults, seed: int) -> None:
        from gripper_hw.sim.rig_faults import FaultyCamera, FaultyClock, FaultyLoadCell

        clock = self.clock
        if faults.has("clock"):
            self.clock = faulty = FaultyClock(clock, faults)
            self._closing.callback(faulty.close)
        if faults.has("camera"):
            self.camera = FaultyCamera(self.camera, faults, clock, seed)
        if faults.has("load_cell"):
            self.load_cell = FaultyLoadCell(self.load_cell, faults, clock, seed)

    def start(self) -> None:
        """Sets the world going; in lockstep the clock does that."""
        if not self._lockstep and self._thread is None:
            self._thread = threading.Thread(target=self._keep_pace, name="simulated-rig", daemon=True)
            self._thread.start()

    def check(self) -> None:
        """Raises what broke the world's own thread, if anything did."""
        if self._failure is not None:
            raise self._failure

    def notes(self) -> dict[str, str]:
        """What a log should know of the scene."""
        why = {"detail": self._why} if self._why else {}
        return {"scene": json.dumps(asdict(self.scene)), "exposure_ms": str(self._exposure_ms), **why}

    def render_under_light(self, lux: float) -> tuple[Camera, dict[str, str]]:
        """A further camera, which sees what a rig of its own with this ``sim.lux`` would, and its notes."""
        config = self._config.model_copy(update={"sim": self._config.sim.model_copy(update={"lux": lux})})
        scene = draw_scene(config.object, config.seed, config.sim)
        camera = SimulatedCamera(self._world, scene, config, self.clock, self.start_ns)
        return camera, {**self.notes(), "scene": json.dumps(asdict(scene))}

    def close(self) -> None:
        """Stops the world and takes its bus away. May be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        unregister_bus(self._bus_name)
        self._closing.close()
        if self._lockstep:
            self._world.close()

    def _bus_time_ns(self) -> int:
        # The firmware's clock is the world's, so that its watchdog counts simulated time.
        return self._world.t_ns

    def _keep_pace(self) -> None:
        try:
            while not self._stop.is_set():
                due_ns = time.monotonic_ns() - self.start_ns
                lag_ns = due_ns - self._world.t_ns
                if lag_ns > _REALTIME_MAX_LAG_NS:
                    raise SimulationError(  # noqa: TRY301
                        f"this machine can't simulate {self.scene.object!r} ({self.scene.detail}) in real "
                        "time: take sim.detail=coarse, or clock=lockstep"
                    )
                self._world.advance_to(min(due_ns, self._world.t_ns + _REALTIME_SLICE_NS))
                if lag_ns < _REALTIME_SLICE_NS:
                    self._stop.wait(1e-3)
        except Exception as error:  # `check` raises it in the session's thread
            self._failure = error
        finally:
            self._world.close()  # the drawing context belongs to this thread


def _exposure(config: Config) -> float:
    """Share of the light that falls in, against the simulated camera's usual exposure."""
    return (config.camera.exposure_us or _EXPOSURE_US) / _EXPOSURE_US


def expose(picture: npt.NDArray[np.uint8], lux: float, shot_noise: float, rng: np.random.Generator) -> Gray:
    """Turns a rendered picture (2H, 2W, 3) into what a gray camera with locked exposure sees: (H, W) uint8.

    It is averaged over each pixel, linearised, lit, vignetted, given photon and read noise, and encoded.
    """
    import cv2

    height, width = picture.shape[0] // _OVERSAMPLED, picture.shape[1] // _OVERSAMPLED
    pixels = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    gray = pixels @ _LUMA / 255.0  # (H, W)
    y, x = np.ogrid[:height, :width]
    radius2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width * width / 4)
    linear = gray**_GAMMA * np.float32(lux / _WHITE_LUX) * (1 - _VIGNETTE * radius2).astype(np.float32)
    spread = np.sqrt(shot_noise**2 * linear + _READ_NOISE**2)
    linear += rng.standard_normal(gray.shape, dtype=np.float32) * spread
    encoded: Gray = (255 * np.clip(linear, 0, 1) ** (1 / _GAMMA)).astype(np.uint8)
    return encoded
