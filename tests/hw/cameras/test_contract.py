"""The camera contract on every built-in camera, and tests of what some of them add to it."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import CameraConfig, Config, load_config
from gripper_force.errors import ConfigError
from gripper_force.interfaces import Camera, Clock
from gripper_force.runtime.backends import CAMERAS, MonotonicClock
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.testing.camera_contract import CameraContract
from gripper_force.types import NS_PER_MS, Frame
from gripper_hw.cameras.oak import OakCamera
from gripper_hw.cameras.reader import BackgroundCamera
from gripper_hw.cameras.uvc import UvcCamera
from gripper_hw.playback import PlaybackCamera
from gripper_hw.sim.simulated_rig import SimulatedRig

Take = Callable[..., list[Frame]]


class TestSimulatedCamera(CameraContract):
    @pytest.fixture
    def config(self, quick: list[str]) -> Config:
        return load_config(None, [*quick, "camera.backend=simulated"])

    @pytest.fixture
    def rig(self, config: Config) -> Iterator[SimulatedRig]:
        with closing(SimulatedRig(config)) as rig:
            yield rig

    @pytest.fixture
    def camera(self, rig: SimulatedRig) -> Camera:
        return rig.camera

    @pytest.fixture
    def clock(self, rig: SimulatedRig) -> Clock:
        return rig.clock

    def test_second_rig_on_same_port_is_refused(
        self, config: Config, camera: Camera, wait: Callable[[float], None], take: Take
    ) -> None:
        camera.start()
        with pytest.raises(ConfigError, match="is in use in this process"):
            SimulatedRig(config)
        take(camera, 2, lambda: wait(0.002))


class TestSimulatedCameraWithFaults(TestSimulatedCamera):
    @pytest.fixture
    def config(self, quick: list[str]) -> Config:
        faults = "faults=[{unit: camera, kind: garbage}]"
        return load_config(None, [*quick, "camera.backend=simulated", faults])


class TestPlaybackCamera(CameraContract):
    @pytest.fixture
    def section(self, tmp_path: Path) -> CameraConfig:
        path = tmp_path / "run.mcap"
        with LogWriter(path, config="", metadata={}) as writer:
            for i in range(250):
                t_ns = 20 * i * NS_PER_MS
                writer.write(Frame(t_ns, t_ns + 15 * NS_PER_MS, i, np.full((8, 8), i, np.uint8)))
        return CameraConfig(backend="playback", path=path)

    @pytest.fixture
    def camera(self, section: CameraConfig) -> Camera:
        return PlaybackCamera(section, MonotonicClock())

    @pytest.fixture
    def second_camera(self, section: CameraConfig) -> Camera:
        return PlaybackCamera(section, MonotonicClock())


class RealCameraContract(CameraContract):
    """The contract, and the tests of `BackgroundCamera` on a driver."""

    def test_lost_camera_gives_no_frames_and_comes_back(
        self, camera: BackgroundCamera, take: Take, plugged: threading.Event
    ) -> None:
        camera.start()
        before = take(camera, 3)
        assert camera.counts() == {"losses": 0}
        plugged.clear()
        deadline_s = time.monotonic() + 30
        while camera.counts() == {"losses": 0}:
            assert time.monotonic() < deadline_s
            camera.newest()
            time.sleep(0.002)
        camera.newest()
        time.sleep(0.002)
        assert camera.newest() is None
        plugged.set()
        after = take(camera, 3)
        frames = before + after
        assert all(a.seq < b.seq and a.t_ns < b.t_ns for a, b in pairwise(frames))
        assert camera.counts() == {"losses": 1}


class TestOakCamera(RealCameraContract):
    @pytest.fixture
    def camera(self, make_oak: Callable[..., OakCamera]) -> Camera:
        return make_oak(np.zeros((60, 80), np.uint8), timeout_ms=1000)

    @pytest.fixture
    def second_camera(self, make_oak: Callable[..., OakCamera]) -> Camera:
        return make_oak(np.zeros((60, 80), np.uint8), timeout_ms=1000)


class TestUvcCamera(RealCameraContract):
    @pytest.fixture
    def camera(self, make_uvc: Callable[[], UvcCamera]) -> Camera:
        return make_uvc()

    @pytest.fixture
    def second_camera(self, make_uvc: Callable[[], UvcCamera]) -> Camera:
        return make_uvc()


def test_contract_runs_on_every_built_in_camera() -> None:
    assert set(CAMERAS) == {"none", "simulated", "playback", "oak", "uvc"}
    for module, _, name in (path.partition(":") for path in CAMERAS.values() if path):
        assert callable(getattr(import_module(module), name))
