"""An episode by LeRobot's own command, read back and compared with the log of gripper-force."""

import os
import subprocess
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest

import gripper_force as gf

FPS, FRAMES = 30, 40
KEEPS_PIXELS = not version("lerobot").startswith("0.4") if find_spec("lerobot") else True
"""LeRobot 0.4 records no images without ``--dataset.video``, and a video loses detail."""

IMAGE = "observation.images.gripper.frame"


class Recording(NamedTuple):
    """A dataset, and the log that was written beside it."""

    dataset: Any
    log: Path


@pytest.fixture(scope="module")
def recording(robots: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """An episode of `lerobot-record` with simulated time. Its length depends on the speed of the machine."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder = tmp_path_factory.mktemp("record")
    log, root = folder / "run.mcap", folder / "dataset"
    command = [
        *(sys.executable, "-m", "lerobot.scripts.lerobot_record"),
        "--robot.type=gripper_force",
        f"--robot.log={log}",
        f"--robot.lockstep_fps={FPS}",
        "--robot.overrides=[object=stapler, sim.detail=coarse, vision.checkpoint=none, control.feedback=current]",
        "--teleop.type=gripper_force_targets",
        "--teleop.targets=[3.0, 0.0]",
        f"--teleop.frames={FRAMES}",
        f"--dataset.root={root}",
        "--dataset.repo_id=me/grasps",
        "--dataset.single_task=grasp the stapler",
        f"--dataset.fps={FPS}",
        "--dataset.num_episodes=1",
        "--dataset.episode_time_s=20",
        f"--dataset.video={str(not KEEPS_PIXELS).lower()}",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    ]
    environment = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(folder / "hf"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return Recording(LeRobotDataset("me/grasps", root=root, video_backend="pyav"), log)


def test_the_dataset_has_the_values_of_the_log(recording: Recording) -> None:
    dataset, log = recording
    names = dataset.features["observation.state"]["names"]
    assert names == ["gripper.force_n", "gripper.std_n", "gripper.width_m", "gripper.current_a"]
    cycles, states, frames = [], [], []
    servo, force, frame = None, None, None
    for record in gf.LogReader(log).records():
        match record:
            case gf.ServoState():
                servo = record
            case gf.FusedForce():
                force = record
            case gf.Frame():
                frame = record
            case gf.GraspStatus():
                assert servo is not None
                assert force is not None
                cycles.append(record.t_ns)
                states.append((force.force_n, force.std_n, record.width_m, servo.current_a))
                frames.append(None if frame is None else frame.gray)
    logged = np.array(states, np.float32)
    rows = np.stack([np.asarray(row) for row in dataset.hf_dataset["observation.state"]])
    assert len(rows) > 10
    # The last row is the newest cycle: from one row to the next simulated time advances by 1 / FPS seconds.
    step = next(i for i, t_ns in enumerate(cycles) if t_ns - cycles[0] >= 1e9 / FPS)
    at = np.arange(len(rows)) * step
    (first,) = (i for i in range(len(logged) - at[-1]) if np.array_equal(logged[i + at], rows))
    assert (rows[:, 0] > 0).any()
    for k in (0, len(rows) // 2, len(rows) - 1):
        error = 255 * np.asarray(dataset[k][IMAGE]) - frames[first + at[k]]  # (3, H, W)
        assert np.abs(error).mean() < (1e-3 if KEEPS_PIXELS else 4)


def test_actions_and_task_are_those_of_the_teleoperator(recording: Recording) -> None:
    dataset, log = recording
    actions = [float(action[0]) for action in np.asarray(dataset.hf_dataset["action"]).reshape(-1, 1)]
    assert dataset.features["action"]["names"] == ["gripper.force_n"]
    expected = [3.0 if k // FRAMES % 2 == 0 else 0.0 for k in range(len(actions))]
    assert actions == expected
    assert dataset[0]["task"] == "grasp the stapler"
    first = next(gf.LogReader(log).records(gf.Request))
    assert (first.kind, first.target_n) == ("grasp", 3.0)


def test_robot_and_rate_are_in_the_dataset(recording: Recording) -> None:
    assert recording.dataset.meta.robot_type == "gripper_force"
    assert recording.dataset.fps == FPS
    assert recording.dataset.num_episodes == 1
