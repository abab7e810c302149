"""Export of logs to a LeRobot dataset (https://huggingface.co/docs/lerobot/lerobot-dataset-v3), an episode per log.

Names and meaning of the values are those of the robot in ``integrations/lerobot_robot_gripper_force``.
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from gripper_force.config import Config, Overrides, config_from_text
from gripper_force.control.state_machine import refused_ns
from gripper_force.errors import ConfigError, DataError
from gripper_force.progress import Progress, no_progress
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import (
    NS_PER_S,
    Event,
    Frame,
    FusedForce,
    GraspStatus,
    Phase,
    Request,
    RequestKind,
    ServoState,
)

STATE: Final = ("gripper.force_n", "gripper.std_n", "gripper.width_m", "gripper.current_a")
FRAME: Final = "gripper.frame"
ACTIONS: Final = {"force": "gripper.force_n", "width": "gripper.width_m"}
"""Names of the values of an observation, of its image, and of the two kinds of actions."""

Action = Literal["force", "width"]

_WIDTH_TOLERANCE_M: Final = 1e-6


@dataclass(frozen=True, slots=True)
class ExportResult:
    """Result of an export.

    Attributes:
        folder: Folder of the dataset.
        episodes: Number of episodes, one per log.
        frames: Number of rows of all episodes.
        fps: Rows per second.
    """

    folder: Path
    episodes: int
    frames: int
    fps: int


@dataclass(frozen=True, slots=True)
class _Cycle:
    """Values of `STATE` after a control cycle, with the newest image and the action in force."""

    t_ns: int
    state: tuple[float, ...]
    frame: Frame | None
    action: float


def export_lerobot(
    logs: Sequence[Path],
    folder: Path,
    *,
    fps: int = 30,
    action: Action = "force",
    task: str | None = None,
    video: bool = True,
    overrides: Overrides | None = None,
    progress: Progress = no_progress,
) -> ExportResult:
    """Writes logs as a LeRobot dataset. A failed export leaves no dataset.

    Row ``k`` of an episode holds the values of the newest control cycle at ``k / fps`` seconds after the first one
    (with a camera: the first one with a frame), and the action in force one row later, which is the action that
    answers it. An episode ends before a stop or a fault.

    Args:
        logs: Logs of runs.
        folder: Folder of the dataset; it must not exist.
        fps: Rows per second.
        action: ``force``: an action is the target force in newtons, 0 for open jaws. ``width``: it is the target
            width in metres.
        task: Description of the task; None: "grasp the" and the object.
        video: True: images are compressed as video. False: they are stored as PNG, without loss.
        overrides: Configuration keys that replace those of the logs.
        progress: Called after each log.

    Raises:
        ConfigError: LeRobot is not installed, or a key is wrong.
        DataError: The folder exists, a log has no control cycles or another image size than the first one, or its
            requests are none of the chosen kind of action.
        LogError: A log cannot be read.
    """
    dataset_class = _dataset_class()
    if folder.exists():
        raise DataError(f"{folder} exists already; choose another folder with --out")
    if fps < 1:
        raise ConfigError(f"a rate of {fps} rows per second is too low; set --fps to 1 or more")
    shape = _image_shape(logs[0])
    for path in logs[1:]:
        if (_image_shape(path) is None) != (shape is None):
            which = "no images, and the first log has some" if shape else "images, and the first log has none"
            raise DataError(f"{path} has {which}; export them apart")
    frames = 0
    try:
        dataset: Any = dataset_class.create(
            repo_id=f"local/{folder.name}",
            fps=fps,
            features=_features(action, shape, video),
            root=folder,
            robot_type="gripper_force",
            use_videos=video,
            video_backend="pyav",  # nothing is decoded, and to look for another one can print a page of warnings
        )
        for path in logs:
            frames += _add_episode(dataset, path, action, task, overrides, shape)
            progress(path.name)
        dataset.finalize()
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return ExportResult(folder, len(logs), frames, fps)


def _add_episode(
    dataset: Any,
    path: Path,
    action: Action,
    task: str | None,
    overrides: Overrides | None,
    shape: tuple[int, int] | None,
) -> int:
    """Adds a log to the dataset, and returns its number of rows."""
    reader = LogReader(path)
    config = config_from_text(reader.config, str(path), overrides)
    count = 0
    for row in rows(reader, config, dataset.fps, action, shape):
        dataset.add_frame({**row, "task": task or f"grasp the {config.object}"})
        count += 1
    if count == 0:
        raise DataError(
            f"{path} has less than {1 / dataset.fps:.2g} s of control cycles before its end, a stop or a fault; pass "
            "logs of runs"
        )
    dataset.save_episode()
    return count


def _dataset_class() -> Any:
    try:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
    except ImportError as error:
        raise ConfigError(
            f"export lerobot needs {error.name or 'lerobot'}, which is not installed; pip install "
            "'gripper-force[lerobot]'"
        ) from error
    return LeRobotDataset


def _features(action: Action, shape: tuple[int, int] | None, video: bool) -> dict[str, Any]:
    """Returns the columns of the dataset in LeRobot's form."""
    features: dict[str, Any] = {
        "action": {"dtype": "float32", "shape": (1,), "names": [ACTIONS[action]]},
        "observation.state": {"dtype": "float32", "shape": (len(STATE),), "names": list(STATE)},
    }
    if shape is not None:
        features[f"observation.images.{FRAME}"] = {
            "dtype": "video" if video else "image",
            "shape": (*shape, 3),
            "names": ["height", "width", "channels"],
        }
    return features


def _image_shape(path: Path) -> tuple[int, int] | None:
    first = next(LogReader(path).records(Frame), None)
    return None if first is None else (first.gray.shape[0], first.gray.shape[1])


def rows(
    reader: LogReader, config: Config, fps: int, action: Action, shape: tuple[int, int] | None
) -> Iterator[dict[str, Any]]:
    """Yields the rows of a log as LeRobot takes them, without their task; see `export_lerobot`.

    Args:
        reader: The log.
        config: Its configuration.
        fps: Rows per second.
        action: Kind of the actions.
        shape: Height and width of the images; None: rows have none.

    Raises:
        DataError: Images have another size, or a request is none of this kind of action.
    """
    for cycle, after in pairwise(
        _sampled(_cycles(reader, config, action), fps, with_frame=shape is not None)
    ):
        row = {
            "action": np.array([after.action], np.float32),
            "observation.state": np.array(cycle.state, np.float32),
        }
        if shape is not None:
            assert cycle.frame is not None  # `_sampled` waits for one
            gray = cycle.frame.gray
            if gray.shape != shape:
                raise DataError(
                    f"{reader.path} has images of {gray.shape[1]}x{gray.shape[0]} pixels, and the first log of "
                    f"{shape[1]}x{shape[0]}; export them apart"
                )
            row[f"observation.images.{FRAME}"] = np.repeat(gray[:, :, None], 3, axis=2)  # (H, W, 3)
        yield row


def _sampled(cycles: Iterator[_Cycle], fps: int, *, with_frame: bool) -> Iterator[_Cycle]:
    """Yields the newest cycle at each time of a regular grid."""
    start_ns, count, newest = 0, 0, None
    for cycle in cycles:
        if newest is None:
            if with_frame and cycle.frame is None:
                continue
            start_ns = cycle.t_ns
        while newest is not None and start_ns + count * NS_PER_S // fps < cycle.t_ns:
            yield newest
            count += 1
        newest = cycle
    if newest is not None:
        yield newest


def _cycles(reader: LogReader, config: Config, action: Action) -> Iterator[_Cycle]:
    """Yields the control cycles of a log up to a stop or a fault."""
    target_of = _target_reader(reader.path, config.gripper.open_width_m, action)
    frame: Frame | None = None
    servo: ServoState | None = None
    force: FusedForce | None = None
    target: float | None = None
    refused = refused_ns(reader.records(Event))
    for record in reader.records(Frame, Request, ServoState, FusedForce, GraspStatus):
        if isinstance(record, Frame):
            frame = record
        elif isinstance(record, Request):
            if record.kind == RequestKind.STOP:
                return
            if record.t_ns not in refused:
                target = target_of(record)
        elif isinstance(record, ServoState):
            servo = record
        elif isinstance(record, FusedForce):
            force = record
        elif isinstance(record, GraspStatus):  # the end of a cycle
            if record.phase == Phase.FAULT:
                return
            if target is None:
                target = 0.0 if action == "force" else record.width_m
            if servo is not None and force is not None:
                state = (force.force_n, force.std_n, record.width_m, servo.current_a)
                yield _Cycle(record.t_ns, state, frame, target)


def _target_reader(path: Path, open_width_m: float, action: Action) -> Callable[[Request], float]:
    """Returns the function that reads the action of a request, as the robot would have sent it."""

    def force_n(request: Request) -> float:
        if request.kind == RequestKind.GRASP:
            return request.target_n
        if request.kind == RequestKind.RELEASE or request.width_m >= open_width_m - _WIDTH_TOLERANCE_M:
            return 0.0
        raise DataError(
            f"{path} has a move to {1e3 * request.width_m:.1f} mm, which is no force; use --action width"
        )

    def width_m(request: Request) -> float:
        if request.kind == RequestKind.GRASP:
            raise DataError(
                f"{path} has a grasp with {request.target_n:g} N, which is no width; use --action force"
            )
        return open_width_m if request.kind == RequestKind.RELEASE else request.width_m

    return force_n if action == "force" else width_m
