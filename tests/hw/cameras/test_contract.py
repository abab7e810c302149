"""What every camera promises, held against all of them."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import CameraConfig, load_config
from gripper_force.errors import ConfigError
from gripper_force.interfaces import Camera, Clock
from gripper_force.runtime.backends import CAMERAS, MonotonicClock
from gripper_force.runtime.log import LogWriter
from gripper_force.types import NS_PER_MS, Frame
from gripper_hw.playback import PlaybackCamera
from gripper_hw.sim.simulated_rig import SimulatedRig

Take = Callable[..., list[Frame]]
REAL = ("oak", "uvc")
ALL = ("simulated", "playback", *REAL)


@dataclass
class Stand:
    """A camera, its clock, how to open the same thing again, and whether that is refused."""

    camera: Camera
    clock: Clock
    again: Callable[[], Camera]
    exclusive: bool

    def wait(self) -> None:
        """Lets time pass."""
        self.clock.sleep_until_ns(self.clock.now_ns() + 2 * NS_PER_MS)


@pytest.fixture(params=ALL)
def stand(request: pytest.FixtureRequest) -> Iterator[Stand]:
    clock: Clock = MonotonicClock()
    with ExitStack() as stack:

        def closed_at_the_end(camera: Camera) -> Camera:
            stack.callback(camera.close)
            return camera

        if request.param == "simulated":
            config = load_config(None, [*request.getfixturevalue("quick"), "camera.backend=simulated"])
            rig = stack.enter_context(closing(SimulatedRig(config)))
            yield Stand(rig.camera, rig.clock, lambda: SimulatedRig(config).camera, exclusive=True)
            return
        if request.param == "playback":
            section = CameraConfig(backend="playback", path=request.getfixturevalue("recording"))
            make: Callable[[], Camera] = lambda: PlaybackCamera(section, clock)  # noqa: E731
        else:
            make = request.getfixturevalue(f"make_{request.param}")
        yield Stand(closed_at_the_end(make()), clock, lambda: closed_at_the_end(make()), exclusive=False)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "run.mcap"
    with LogWriter(path, config="", metadata={}) as writer:
        for i in range(100):
            t_ns = 20 * i * NS_PER_MS
            writer.write(Frame(t_ns, t_ns + 15 * NS_PER_MS, i, np.full((8, 8), i, np.uint8)))
    return path


def test_every_camera_is_held_to_the_contract() -> None:
    assert set(CAMERAS) == {"none", *ALL}
    for module, _, name in (path.partition(":") for path in CAMERAS.values() if path is not None):
        assert callable(getattr(import_module(module), name))


def test_there_is_nothing_before_the_start(stand: Stand) -> None:
    assert stand.camera.newest() is None


def test_frames_are_gray_and_come_in_order_and_not_from_the_future(stand: Stand, take: Take) -> None:
    stand.camera.start()
    frames = take(stand.camera, 8, stand.wait)
    now_ns = stand.clock.now_ns()
    assert not any(stand.camera.counts().values())
    for frame in frames:
        assert frame.gray.ndim == 2
        assert frame.gray.dtype == np.uint8
        assert frame.t_ns <= frame.received_ns <= now_ns
    for older, newer in pairwise(frames):
        assert older.t_ns < newer.t_ns
        assert older.received_ns < newer.received_ns
        assert older.seq < newer.seq


def test_a_slow_reader_gets_the_newest_frame_once(stand: Stand, take: Take) -> None:
    stand.camera.start()
    seqs = [take(stand.camera, 1, stand.wait)[0].seq]
    while len(seqs) < 15:
        stand.clock.sleep_until_ns(stand.clock.now_ns() + 100 * NS_PER_MS)
        seqs.append(take(stand.camera, 1, stand.wait)[0].seq)
        if seqs[-1] > seqs[-2] + 1:
            return
    pytest.fail(f"each of {seqs} was handed out, however old")  # a busy machine skips none once or twice


def test_to_start_twice_changes_nothing(stand: Stand, take: Take) -> None:
    stand.camera.start()
    stand.camera.start()
    take(stand.camera, 3, stand.wait)


def test_a_closed_camera_has_nothing_more_and_may_be_closed_again(stand: Stand, take: Take) -> None:
    stand.camera.start()
    take(stand.camera, 2, stand.wait)
    stand.clock.sleep_until_ns(stand.clock.now_ns() + 100 * NS_PER_MS)  # one more is there
    stand.camera.close()
    stand.camera.close()
    assert stand.camera.newest() is None


def test_a_camera_that_was_never_started_can_be_closed(stand: Stand) -> None:
    stand.camera.close()
    stand.camera.close()
    assert stand.camera.newest() is None


def test_a_second_one_of_the_same_either_works_or_says_why_not(stand: Stand, take: Take) -> None:
    stand.camera.start()
    if stand.exclusive:
        with pytest.raises(ConfigError, match="already registered"):
            stand.again()
    else:
        second = stand.again()
        second.start()
        take(second, 2, stand.wait)
    take(stand.camera, 2, stand.wait)


@pytest.mark.parametrize("stand", REAL, indirect=True)
def test_a_lost_camera_is_silent_and_comes_back(stand: Stand, take: Take, plugged: threading.Event) -> None:
    camera = stand.camera
    camera.start()
    before = take(camera, 3)
    plugged.clear()
    deadline = time.monotonic() + 30
    while camera.counts() == {"losses": 0}:
        assert time.monotonic() < deadline
        camera.newest()
        stand.wait()
    camera.newest()
    stand.wait()
    assert camera.newest() is None
    plugged.set()
    after = take(camera, 3)
    frames = before + after
    assert all(a.seq < b.seq and a.t_ns < b.t_ns for a, b in pairwise(frames))
    assert camera.counts() == {"losses": 1}


@pytest.mark.parametrize("stand", REAL, indirect=True)
def test_the_rate_that_is_got_is_measured(stand: Stand, take: Take) -> None:
    assert stand.camera.rate_hz_measured == 0.0  # type: ignore[attr-defined]
    stand.camera.start()
    frames = take(stand.camera, 10)
    assert 0 < stand.camera.rate_hz_measured <= 110  # type: ignore[attr-defined]
    assert frames[-1].seq >= 9
