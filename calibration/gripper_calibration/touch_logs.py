"""Data of the fits from logs: touches, presses for the loop's plant, and the settings they belong to."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_calibration.fits.plant_fit import PressSeries
from gripper_calibration.fits.touches import Floats, Touches
from gripper_force.config import Config, config_from_text
from gripper_force.control.transmission import Transmission
from gripper_force.errors import DataError
from gripper_force.jobs.dataset import CLIP_RECORDS, CONTACT_N, Clip, known_rig, read_clip, starts_in_contact
from gripper_force.jobs.metrics import lag_s
from gripper_force.runtime.log_reader import LogReader
from gripper_force.schema import Tree
from gripper_force.types import NS_PER_S, Frame, GraspStatus, Gray, LoadCellSample, Phase, Record, ServoState
from gripper_force.vision.engines import Floats as Singles
from gripper_force.vision.preprocess import Preprocess

_CONTACT_SHARE: Final = 0.05
_FREE_FRAMES: Final = 5
"""This many frames without contact end a touch."""


@dataclass(frozen=True, eq=False)
class TouchRecording:
    """Data of one or more logs of one object.

    Attributes:
        touches: Labelled frames.
        camera: Camera settings, by key of the configuration; empty if unknown.
        presses: Motor and contact force of each press.
        width_m: Distance between the jaws in each press, (N,) each.
        delay_s: Delay from the contact force to a usable estimate, without the network's computing time.
        source: Origin of the labels: the object, the load cell and its scale.
        starts_in_contact: True if a log begins in contact, so that its first frames are no reference.
    """

    touches: Touches
    camera: Tree
    presses: list[PressSeries]
    width_m: list[Floats]
    delay_s: float
    source: dict[str, str | float | None]
    starts_in_contact: bool

    @property
    def has_contact(self) -> bool:
        """True if a frame shows contact."""
        return bool((self.touches.force_n > CONTACT_N).any())


def started_ns(path: Path) -> int:
    """Returns the time at which a log began, for the order of touches; the same for all logs in simulated time."""
    reader = LogReader(path)
    return reader.utc_offset_ns + reader.start_ns if reader.utc_offset_ns else 0


def join(recordings: dict[Path, TouchRecording]) -> TouchRecording:
    """Joins the recordings of several logs and renumbers their touches.

    Args:
        recordings: One or more recordings, by the path of their log.

    Raises:
        DataError: They are of different objects, cameras, or scales of the load cell.
    """
    parts = list(recordings.values())
    of_known_rigs = {path: part for path, part in recordings.items() if part.camera}
    first_path, first = next(iter((of_known_rigs or recordings).items()))
    expected = first.source | first.camera
    for path, part in recordings.items():
        for key, value in (part.source | part.camera).items():
            if value != expected[key]:
                raise DataError(
                    f"{path} was recorded with {key} {value}, and {first_path} with {expected[key]}; calibrate "
                    "them separately"
                )
    begins = np.cumsum([0, *(len(part.touches.numbers) for part in parts[:-1])])
    touches = [part.touches for part in parts]
    return TouchRecording(
        touches=Touches(
            np.concatenate([t.features for t in touches]),
            np.concatenate([t.estimate_n for t in touches]),
            np.concatenate([t.force_n for t in touches]),
            np.concatenate([t.touch + begin for t, begin in zip(touches, begins, strict=True)]),
        ),
        camera=first.camera,
        source=first.source,
        starts_in_contact=any(part.starts_in_contact for part in parts),
        presses=[press for part in parts for press in part.presses],
        width_m=[width for part in parts for width in part.width_m],
        delay_s=float(np.median([part.delay_s for part in parts])),
    )


def read_log(
    path: Path, preprocess: Preprocess, features: Callable[[Gray], tuple[Singles, Singles]]
) -> TouchRecording:
    """Reads a log, once, and runs the networks on its frames. An imported recording has no presses.

    Args:
        path: The log.
        preprocess: Preparation of the frames.
        features: Returns the networks' forces and features for a recording, as `stream_inference.features` does.

    Raises:
        DataError: The log contains no frames or no labels.
        LogError: The log can't be read.
    """
    reader = LogReader(path)
    config = config_from_text(reader.config, str(path))
    records = _RecordCollector()
    clip = read_clip(reader, config, records.tee(reader.records(*CLIP_RECORDS, GraspStatus)), preprocess)
    labelled = clip.labelled(preprocess.lead_in)
    if not labelled.any():
        raise DataError(
            f"{path} has no label after its first {preprocess.lead_in} frames, which the network needs as "
            "lead-in; record longer"
        )
    forces_n, read_out = _by_reference(features, clip, preprocess)
    estimate_n = forces_n.mean(0).astype(np.float64)
    force_n = clip.forces_n.astype(np.float64)
    numbers = np.unique(touch_numbers(force_n)[labelled], return_inverse=True)[1]
    presses, width_m = _presses(records, config)
    t_s = np.array(records.frame_t_ns, np.int64)[labelled] / NS_PER_S
    transport_ns = float(np.median(np.array(records.transport_ns, np.int64)))
    estimate_lag_s = lag_s(t_s, estimate_n[labelled], t_s, force_n[labelled])
    return TouchRecording(
        touches=Touches(read_out[labelled], estimate_n[labelled], force_n[labelled], numbers),
        camera=known_rig(config),
        source=_label_source(config),
        presses=presses,
        width_m=width_m,
        # A frame is used until the next one comes. The lag is NaN if the force never changes.
        delay_s=transport_ns / NS_PER_S
        + 0.5 / config.camera.rate_hz
        + (estimate_lag_s if estimate_lag_s > 0 else 0.0),
        starts_in_contact=starts_in_contact(clip.forces_n, preprocess),
    )


def _by_reference(
    features: Callable[[Gray], tuple[Singles, Singles]], clip: Clip, preprocess: Preprocess
) -> tuple[Singles, Singles]:
    """Returns the networks' forces, (M, T), and features, (T, F), of a clip, each part with its own reference."""
    outputs = [features(part.frames) for part in clip.parts(preprocess)]
    counts = np.diff((0, *clip.renewals, len(clip.frames)))  # a part begins with frames of the one before
    return (
        np.concatenate([forces_n[:, -n:] for (forces_n, _), n in zip(outputs, counts, strict=True)], axis=1),
        np.concatenate([read_out[-n:] for (_, read_out), n in zip(outputs, counts, strict=True)]),
    )


def touch_numbers(force_n: Floats) -> npt.NDArray[np.int64]:
    """Returns the number of the touch of each frame, (T,). Touches are divided in the middle of the rests.

    Args:
        force_n: Load-cell force at each frame, (T,).
    """
    contact = force_n > max(CONTACT_N, _CONTACT_SHARE * float(force_n.max(initial=0.0)))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], contact, [False]]).astype(np.int8)))
    begins, ends = edges[::2], edges[1::2]
    number = np.zeros(len(force_n), np.int64)
    for end, begin in zip(ends[:-1], begins[1:], strict=True):
        if begin - end >= _FREE_FRAMES:
            number[(begin + end) // 2 :] += 1
    return number


@dataclass(slots=True)
class _RecordCollector:
    """Data of a log other than its images: times of the frames, and records of the press."""

    frame_t_ns: list[int] = field(default_factory=list)
    transport_ns: list[int] = field(default_factory=list)
    states: list[ServoState] = field(default_factory=list)
    phases: list[str] = field(default_factory=list)
    samples: list[LoadCellSample] = field(default_factory=list)

    def tee(self, records: Iterable[Record]) -> Iterator[Record]:
        """Collects each record and passes it on."""
        for record in records:
            if isinstance(record, Frame):
                self.frame_t_ns.append(record.t_ns)
                self.transport_ns.append(record.received_ns - record.t_ns)
            elif isinstance(record, ServoState):
                self.states.append(record)
            elif isinstance(record, GraspStatus):
                self.phases.append(record.phase)
            elif isinstance(record, LoadCellSample) and record.valid:
                self.samples.append(record)
            yield record


def _label_source(config: Config) -> dict[str, str | float | None]:
    """Settings that the forces depend on. The tare is not among them: it drifts and is renewed."""
    cell = config.load_cell
    return {"object": config.object, "load cell": cell.sensor, "load_cell.n_per_raw": cell.n_per_raw}


def _presses(records: _RecordCollector, config: Config) -> tuple[list[PressSeries], list[Floats]]:
    """Ramps with their holds, and the distance between the jaws in each, (N,)."""
    gripper = config.gripper
    if gripper.nm_per_a is None or not records.samples:
        return [], []
    transmission = Transmission.from_config(gripper, gripper.nm_per_a)
    samples = sorted(records.samples, key=lambda sample: sample.t_ns)
    count = min(len(records.states), len(records.phases))
    pressing = np.isin(records.phases[:count], (Phase.RAMP, Phase.HOLD))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], pressing, [False]]).astype(np.int8)))
    sample_s = np.array([sample.t_ns for sample in samples]) / NS_PER_S
    sample_n = np.array([sample.force_n for sample in samples])
    presses, widths_m = [], []
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        states = records.states[begin:end]
        t_s = np.array([state.t_ns for state in states]) / NS_PER_S
        motor_force_n = np.array(
            [transmission.force_n(state.current_a, state.position_rad) for state in states]
        )
        widths_m.append(np.array([transmission.width_m(state.position_rad) for state in states]))
        presses.append(
            PressSeries(t_s, motor_force_n - transmission.friction_n, np.interp(t_s, sample_s, sample_n))
        )
    return presses, widths_m
