from pathlib import Path

import numpy as np
import pytest

from gripper_force.config import dump_config, load_config
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.grasp import PAPER_OBJECTS
from gripper_force.qualification.paper.experiment import Test as Estimates
from gripper_force.qualification.paper.experiment import networks
from gripper_force.qualification.paper.models import MODELS, Scale
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.types import Frame, LoadCellSample

FRAMES = 30
SEEDS = 3


def forces_n() -> np.ndarray:
    return 10 * np.sin(np.linspace(0, np.pi, FRAMES)).astype(np.float32)


@pytest.fixture(scope="session")
def touches(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of two sets of each object, in train and test, with a bright square that grows with the force."""
    folder = tmp_path_factory.mktemp("touches")
    rng = np.random.default_rng(0)
    for side in ("train", "test"):
        for name in PAPER_OBJECTS:
            for number in range(2):
                config = load_config(None, [f"object={name}"])
                path = folder / side / f"{name}-{number}.mcap"
                path.parent.mkdir(exist_ok=True)
                with LogWriter(path, config=dump_config(config), metadata={}) as log:
                    for i, force_n in enumerate(forces_n()):
                        gray = rng.integers(90, 110, (32, 32)).astype(np.uint8)
                        gray[: 4 + int(force_n), : 4 + int(force_n)] = 200
                        t_ns = i * 10_000_000
                        log.write(Frame(t_ns, t_ns, i, gray))
                        log.write(LoadCellSample(t_ns, float(force_n), 0.0))
    return folder


@pytest.fixture
def estimates() -> Estimates:
    """Estimates of eight test sets: plain networks have an error of 0.4 N, others of 0.2 N, plus noise."""
    rng = np.random.default_rng(1)

    def noise_n(count: int) -> np.ndarray:
        drawn: np.ndarray = rng.normal(0, 0.05, count)
        drawn -= drawn.mean()
        return drawn

    frames = np.full((FRAMES, 32, 32), 100, np.uint8)
    clips = [
        Clip(frames, forces_n(), np.ones(FRAMES, np.bool_), f"{name}-{i}", name, f"{name}-{i}")
        for name in PAPER_OBJECTS
        for i in range(2)
    ]
    measured_n = np.concatenate([clip.forces_n for clip in clips]).astype(np.float64)
    return Estimates(
        scale=Scale(seeds=SEEDS),
        clips=clips,
        measured_n=measured_n,
        clip=np.repeat(np.arange(len(clips)), FRAMES),
        object=np.repeat([clip.object for clip in clips], FRAMES),
        estimates_n={
            (net, seed): measured_n + (0.4 if net == "plain" else 0.2) + noise_n(len(measured_n))
            for net in networks(MODELS)
            for seed in range(SEEDS)
        },
    )
