"""Shared fixtures."""

import gc
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.testing
from hypothesis import given, settings, strategies

from gripper_force.config import dump_config, load_config
from gripper_force.interfaces import Clock
from gripper_force.jobs import processes
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.profiles.rig_profile import CalibratedValue, ServoCalibration
from gripper_force.runtime import process
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import NS_PER_MS, Frame, LoadCellSample
from gripper_force.vision.preprocess import Preprocess
from gripper_hw.dynamixel.pty_server import PtyServer, serve_virtual_servo

# A shell that runs the tests in the background, or nohup, makes every process ignore these signals; tests send them.
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGQUIT, signal.SIG_DFL),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)

# A machine may be busy: how long an example takes says nothing about what it tests. The same commit has the same result:
# `pytest --hypothesis-profile=search` draws new examples.
settings.register_profile("search", deadline=None, derandomize=False)
settings.register_profile("unhurried", deadline=None, derandomize=True)
settings.load_profile("unhurried")


@given(strategies.none())
def _first_example(_: None) -> None:
    """Has no effect."""


def pytest_collection_finish() -> None:
    """Keeps the tests themselves, hundreds of thousands of objects, out of every later garbage collection."""
    _first_example()  # Hypothesis registers a generator, and warns where it does not find what refers to it
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def one_command_line() -> Iterator[None]:
    """Makes the command line once: typer would make it for each call, which takes longer than many a command."""
    made = cache(typer.main.get_command)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", made)
        patch.setattr(typer.testing, "_get_command", made)
        yield


@pytest.fixture(scope="session")
def real_grasps() -> Path:
    """The folder of real recordings, which is no part of the project."""
    folder = Path(__file__).parents[2] / "shared" / "real_grasps"
    if not folder.is_dir():
        pytest.skip(f"needs the real recordings, and {folder} is absent")
    return folder


@pytest.fixture(scope="session")
def quick() -> list[str]:
    """Overrides for the cheapest simulated grasp: motor current alone, and nothing to look at."""
    return [
        "object=stapler",
        "target_n=3",
        "sim.detail=coarse",
        "camera.backend=none",
        "vision.checkpoint=none",
        "vision.threads=1",
        "control.feedback=current",
        "control.settle_s=0.3",
        "control.hold_s=0.3",
    ]


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small networks that have learnt nothing, claim little, and say 0 N of a scene without contact."""
    import torch

    from gripper_force.vision.checkpoint_writer import save_checkpoint
    from gripper_force.vision.header import Header, NetworkConfig, Residual
    from gripper_force.vision.network import ForceNetwork

    torch.manual_seed(0)
    members = tuple(
        NetworkConfig(attention=attention, size=32, width=0.25, hidden=6, head=7)
        for attention in ("ssam", "scam")
    )
    header = Header(
        members=members,
        preprocess=Preprocess(size=32),
        residuals=(Residual(force_n=-99.0, std_n=1.0), Residual(force_n=99.0, std_n=1.0)),
        data_digest="",
        metrics={},
    )
    networks = [ForceNetwork(member).eval() for member in members]
    with torch.no_grad():
        for network in networks:
            network.out.weight *= 1000  # what a frame changes would else be lost in the noise
            for _ in range(2):
                seen, _ = network.step(torch.zeros(1, 1, 32, 32), None)
                network.out.bias.sub_(seen.force_n.mean() / 20)
    path = tmp_path_factory.mktemp("checkpoint") / "tiny.safetensors"
    save_checkpoint(path, networks, header)
    return path


@pytest.fixture(scope="session")
def quick_vision(quick: list[str], tiny_checkpoint: Path) -> list[str]:
    """As `quick`, with a camera and a network that take part."""
    eyes = ["camera.backend=simulated", f"vision.checkpoint={tiny_checkpoint}"]
    return [*quick, *eyes, "control.feedback=fused", "control.timeout_s=2.5"]


@pytest.fixture(scope="session")
def servo_calibration() -> ServoCalibration:
    """A section of a rig profile."""
    return ServoCalibration(
        date=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC),
        model="XM430-W350",
        nm_per_a=CalibratedValue(value=1.7, low=1.69, high=1.71),
        friction_n=CalibratedValue(value=0.9, low=0.8, high=1.0),
        damping_n_s_m=CalibratedValue(value=14, low=13, high=15),
        pinion_radius_m=CalibratedValue(value=0.02),
        open_position_rad=CalibratedValue(value=0.01, low=0.0, high=0.02),
        open_width_m=0.09,
        force_n=(1, 9),
        speed_m_s=(0.01, 0.05),
        residual_n=0.03,
    )


@pytest.fixture(scope="session")
def current_log(quick: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole lockstep grasp on motor current alone. Not to be written to."""
    from gripper_force.jobs.grasp import run_grasp

    path = tmp_path_factory.mktemp("current") / "grasp.mcap"
    run_grasp(load_config(None, quick), path)
    return path


@pytest.fixture(scope="session")
def fused_log(quick_vision: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole lockstep grasp with vision. Not to be written to."""
    from gripper_force.jobs.grasp import run_grasp

    path = tmp_path_factory.mktemp("fused") / "grasp.mcap"
    run_grasp(load_config(None, quick_vision), path)
    return path


class ManualClock:
    """A clock that only a sleep advances."""

    def __init__(self) -> None:
        self._t_ns = 0

    def now_ns(self) -> int:
        return self._t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        self._t_ns = max(self._t_ns, t_ns)


@pytest.fixture
def clock() -> Clock:
    """A clock at 0 that only a sleep advances."""
    return ManualClock()


@pytest.fixture(autouse=True)
def library_process() -> Iterator[None]:
    """Takes back the permission to change process-wide settings, which the command line gives."""
    yield
    process.own_process(signals=False, switch_interval=False, real_time_priority=False, torch_threads=False)


@pytest.fixture
def own_process() -> None:
    """Allows the library to change process-wide settings, as the command line does."""
    process.own_process()


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Sums split over threads differ in their last bits, and threads contend where tests run side by side."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def small_recipe() -> TrainConfig:
    """Trains one small network in no time."""
    return TrainConfig(
        attentions=("ssam",),
        width=0.25,
        hidden=16,
        head=24,
        preprocess=Preprocess(size=16),
        steps=4,
        clips=3,
        device="cpu",
        validation=0.3,
    )


@pytest.fixture(scope="session")
def press() -> Callable[..., Clip]:
    """Makes a clip of a dark disc that grows with the force on a random background."""

    def make(seed: int, frames: int = 60) -> Clip:
        rng = np.random.default_rng(seed)
        forces_n = 8 * np.maximum(0, np.sin(np.linspace(-0.6, 3.4, frames))).astype(np.float32)
        y, x = np.mgrid[:16, :16]
        radius = np.hypot(y - 7.5, x - 7.5)
        background = rng.integers(90, 220, (16, 16))
        edge = 1 + 0.7 * forces_n[:, None, None] - radius
        images = np.where(edge > 0, 40, background) + (5 * edge).clip(0, 20)
        valid = np.ones(frames, np.bool_)
        return Clip(images.astype(np.uint8), forces_n, valid, f"p{seed}", "disc", f"s{seed}")

    return make


@pytest.fixture
def clips(press: Callable[..., Clip]) -> list[Clip]:
    """Six sets of one object."""
    return [press(seed) for seed in range(6)]


@pytest.fixture(scope="session")
def write_log() -> Callable[[Clip, Path], Path]:
    """Writes a clip as a log into a folder."""
    return _write_log


@pytest.fixture
def few_logs(clips: list[Clip], tmp_path: Path) -> Path:
    """Three of the clips as logs in a folder."""
    for clip in clips[:3]:
        _write_log(clip, tmp_path / "logs")
    return tmp_path / "logs"


@pytest.fixture
def loaded_log(few_logs: Path, press: Callable[..., Clip]) -> Path:
    """One more log in the folder of `few_logs`, which starts in contact."""
    clip = press(7)
    return _write_log(replace(clip, frames=clip.frames[20:], forces_n=clip.forces_n[20:]), few_logs)


def _write_log(clip: Clip, folder: Path, *keys: str) -> Path:
    path = folder / f"{clip.name}.mcap"
    config = dump_config(load_config(None, [f"object={clip.object}", *keys]))
    with LogWriter(path, config=config, metadata={"set": clip.set}) as log:
        for i, (gray, force_n) in enumerate(zip(clip.frames, clip.forces_n.tolist(), strict=True)):
            log.write(Frame(i * 20 * NS_PER_MS, i * 20 * NS_PER_MS, i, gray))
            log.write(LoadCellSample(i * 20 * NS_PER_MS, force_n, force_n, True))
    return path


class PicklingPool(ThreadPoolExecutor):
    """Threads that run jobs as `process_pool` does: pickled. A process takes seconds to start."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(_run, bytes(ForkingPickler.dumps((fn, args, kwargs))))


def _run(call: bytes) -> Any:
    succeeded, result = ForkingPickler.loads(processes.answer(call))
    if not succeeded:
        raise result
    return result


@pytest.fixture(scope="session")
def thread_pool() -> type[PicklingPool]:
    """Takes the place of `process_pool`."""
    return PicklingPool


@pytest.fixture
def pool_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces the processes of jobs; `test_processes` has those."""
    monkeypatch.setattr(processes, "process_pool", PicklingPool)


@pytest.fixture
def server() -> Iterator[PtyServer]:
    """A virtual servo behind a pseudo-terminal."""
    with serve_virtual_servo("XM430-W350") as served:
        yield served
