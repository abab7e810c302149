"""What the fits need of logs: touches, and what servo and load cell tell of an object and of the loop."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gripper_calibration.fits.plant_fit import PressSeries
from gripper_calibration.fits.touches import Floats, Touches
from gripper_force.config import Config, config_from_text
from gripper_force.control.transmission import Transmission
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CONTACT_N, load_clip
from gripper_force.jobs.metrics import lag_s
from gripper_force.runtime.log import LogReader
from gripper_force.types import NS_PER_S, Frame, GraspStatus, LoadCellSample, Phase, ServoState
from gripper_force.vision.batch_inference import features
from gripper_force.vision.checkpoint import Checkpoint

_CONTACT_SHARE: Final = 0.05
_FREE_FRAMES: Final = 5
"""So many frames without contact end a touch."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """Some logs of one object.

    Attributes:
        touches: What camera and load cell tell.
        camera: The camera's settings, by key of the configuration.
        presses: What servo and load cell tell of the loop.
        width_m: Distance between the jaws in each press, (N,) each.
        delay_s: From the contact force to an estimate that can be used, the network's time aside.
        source: What the labels come from and of: the object, the load cell and its scale.
    """

    touches: Touches
    camera: dict[str, Any]
    presses: list[PressSeries]
    width_m: list[Floats]
    delay_s: float
    source: dict[str, Any]

    @property
    def has_contact(self) -> bool:
        """Whether anything was touched."""
        return bool((self.touches.force_n > CONTACT_N).any())


def join(recorded: dict[Path, Recorded]) -> Recorded:
    """Recordings, each of a log, as one; touches are numbered on.

    Raises:
        DataError: They are of different objects, cameras or scales of the load cell.
    """
    (known, first), parts = next(iter(recorded.items())), list(recorded.values())
    for path, part in recorded.items():
        ones, others = part.source | part.camera, first.source | first.camera
        for key, value in ones.items():
            if value != others[key]:
                raise DataError(
                    f"{path} was recorded with {key} {value}, and {known} with {others[key]}; calibrate each "
                    "on its own"
                )
    begins = np.cumsum([0, *(len(part.touches.numbers) for part in parts[:-1])])
    touches = [part.touches for part in parts]
    return Recorded(
        touches=Touches(
            np.concatenate([t.features for t in touches]),
            np.concatenate([t.estimate_n for t in touches]),
            np.concatenate([t.force_n for t in touches]),
            np.concatenate([t.touch + begin for t, begin in zip(touches, begins, strict=True)]),
        ),
        camera=first.camera,
        source=first.source,
        presses=[press for part in parts for press in part.presses],
        width_m=[width for part in parts for width in part.width_m],
        delay_s=float(np.median([part.delay_s for part in parts])),
    )


def read_one(path: Path, checkpoint: Checkpoint) -> Recorded:
    """Reads a log. A recording that was imported tells of touches alone.

    Raises:
        DataError: It holds no frames or no labels.
        LogError: It can't be read.
    """
    preprocess = checkpoint.header.preprocess
    clip = load_clip(path, preprocess, None)
    forces_n, read_out = features(checkpoint.networks, preprocess, clip.frames)
    labelled = clip.valid & (np.arange(len(clip.frames)) >= preprocess.lead_in)
    if not labelled.any():
        raise DataError(
            f"{path} has no label behind its first {preprocess.lead_in} frames, which lead in; record longer"
        )
    estimate_n = forces_n.mean(0).astype(np.float64)
    felt_n = clip.forces_n.astype(np.float64)
    numbers = np.unique(touch_of(felt_n)[labelled], return_inverse=True)[1]
    reader = LogReader(path)
    config = config_from_text(reader.config, str(path))
    presses, width_m = _mechanics(reader, config)
    t_ns, late_ns = _frame_times(reader)
    t_s = t_ns[labelled] / NS_PER_S
    seen_s = lag_s(t_s, estimate_n[labelled], t_s, felt_n[labelled])
    return Recorded(
        touches=Touches(read_out[labelled], estimate_n[labelled], felt_n[labelled], numbers),
        camera=config.camera_settings(),
        source=_source(config),
        presses=presses,
        width_m=width_m,
        # A frame is used for as long as the next one takes to come.
        # A force that never changes has no lag: seen_s is NaN then.
        delay_s=late_ns / NS_PER_S + 0.5 / config.camera.rate_hz + (seen_s if seen_s > 0 else 0.0),
    )


def _source(config: Config) -> dict[str, Any]:
    """A tare drifts and is taken anew; another scale would make of the same touch another force."""
    cell = config.load_cell
    return {"object": config.object, "load cell": cell.sensor, "load_cell.n_per_raw": cell.n_per_raw}


def touch_of(force_n: Floats) -> npt.NDArray[np.int64]:
    """Number of each frame's touch, (T,), which goes from the middle of one rest to that of the next."""
    contact = force_n > max(CONTACT_N, _CONTACT_SHARE * float(force_n.max(initial=0.0)))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], contact, [False]]).astype(np.int8)))
    begins, ends = edges[::2], edges[1::2]
    number = np.zeros(len(force_n), np.int64)
    for end, begin in zip(ends[:-1], begins[1:], strict=True):
        if begin - end >= _FREE_FRAMES:
            number[(begin + end) // 2 :] += 1
    return number


def _frame_times(reader: LogReader) -> tuple[npt.NDArray[np.int64], float]:
    """When each frame was taken, (T,), and how late it came, in the median."""
    times = [(frame.t_ns, frame.received_ns - frame.t_ns) for frame in reader.records(Frame)]
    table = np.array(times, np.int64)
    return table[:, 0], float(np.median(table[:, 1]))


def _mechanics(reader: LogReader, config: Config) -> tuple[list[PressSeries], list[Floats]]:
    """Ramps with their holds, and the distance between the jaws in each."""
    gripper = config.gripper
    if gripper.nm_per_a is None:
        return [], []
    transmission = Transmission.from_config(gripper, gripper.nm_per_a)
    states: list[ServoState] = []
    phases: list[str] = []
    cells: list[LoadCellSample] = []
    for record in reader.records(ServoState, GraspStatus, LoadCellSample):
        if isinstance(record, ServoState):
            states.append(record)
        elif isinstance(record, GraspStatus):
            phases.append(record.phase)
        elif isinstance(record, LoadCellSample) and record.valid:
            cells.append(record)
    if not cells:
        return [], []
    cells.sort(key=lambda cell: cell.t_ns)
    count = min(len(states), len(phases))
    pressing = np.isin(phases[:count], (Phase.RAMP, Phase.HOLD))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], pressing, [False]]).astype(np.int8)))
    cell_s = np.array([cell.t_ns for cell in cells]) / NS_PER_S
    cell_n = np.array([cell.force_n for cell in cells])
    presses, widths_m = [], []
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        part = states[begin:end]
        t_s = np.array([state.t_ns for state in part]) / NS_PER_S
        motor_force_n = np.array([transmission.force_n(state.current_a) for state in part])
        widths_m.append(np.array([transmission.width_m(state.position_rad) for state in part]))
        presses.append(
            PressSeries(t_s, motor_force_n - transmission.friction_n, np.interp(t_s, cell_s, cell_n))
        )
    return presses, widths_m
