"""Camera frames over a grasp, and where the network looked."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib import colormaps

from gripper_force.errors import CheckpointError, DataError
from gripper_force.jobs.report.data import Run
from gripper_force.runtime.log import LogReader
from gripper_force.types import NS_PER_S, Frame, Gray, Phase
from gripper_force.vision.preprocess import downscale

if TYPE_CHECKING:
    from gripper_force.vision.estimator import ForceEstimator

COUNT: Final = 6
_SIDE: Final = 256
_LEAD_S: Final = 0.3
_OPACITY: Final = 0.5
_TOUCHED: Final = 0.05
"""Share of the largest force that shows where a recording without phases grips."""

Colour = npt.NDArray[np.uint8]
"""An RGB image, (H, W, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One frame of a run, (S, S, 3) uint8, with the forces at that time (None: not known)."""

    t_s: float
    image: Colour
    vision_n: float | None
    load_cell_n: float | None

    @property
    def caption(self) -> str:
        """Time and forces, a line each."""
        lines = [f"{self.t_s:.2f} s"]
        if self.load_cell_n is not None:
            lines.append(f"load cell {_newtons(self.load_cell_n)}")
        if self.vision_n is not None:
            lines.append(f"vision {_newtons(self.vision_n)}")
        return "\n".join(lines)


def take_pictures(path: Path, run: Run, *, recover: bool = False) -> tuple[list[Picture], str]:
    """Frames over the grasp as the network sees them, with its attention laid over where the run used it.

    Returns:
        The pictures, and a sentence on what is laid over them or why nothing is.

    Raises:
        LogError: The log can't be read.
    """
    log = LogReader(path, recover=recover)
    wanted = _choose([frame.t_ns for frame in log.records(Frame)], run)
    if not wanted:
        return [], ""
    estimator, note = _estimator(run)
    pictures = []
    for frame in log.records(Frame):
        if estimator is not None:
            with suppress(DataError):  # the run went on without this frame as well
                estimator.update(frame.gray)
        if frame.t_ns in wanted:
            attention = estimator.attention_map() if estimator is not None else None
            pictures.append(_picture(frame, run, attention))
        if frame.t_ns >= max(wanted):
            break
    return pictures, note


def _choose(times_ns: list[int], run: Run) -> set[int]:
    """Capture times, evenly spread from just before contact to just after release."""
    if not times_ns:
        return set()
    t_s = (np.array(times_ns) - run.zero_ns) / NS_PER_S
    begin_s, end_s = _grip(run)
    spread = np.linspace(max(begin_s - _LEAD_S, t_s[0]), min(end_s + _LEAD_S, t_s[-1]), COUNT)
    return {times_ns[int(np.abs(t_s - t).argmin())] for t in spread}


def _grip(run: Run) -> tuple[float, float]:
    """When the grip begins and ends: by the phases, else by the load cell, else the whole log."""
    phases = [span for span in run.phases if span.phase in {Phase.CONTACT, Phase.RAMP, Phase.HOLD}]
    if phases:
        return phases[0].start_s, phases[-1].end_s
    cell = run.forces.get("load_cell")
    if cell is not None and (touched := cell.value_n > _TOUCHED * cell.value_n.max()).any():
        return float(cell.t_s[touched][0]), float(cell.t_s[touched][-1])
    return run.begin_s, run.end_s


def _estimator(run: Run) -> "tuple[ForceEstimator | None, str]":
    if "vision" not in run.forces:
        return None, ""
    # Loaded here, as a recording without estimates needs no network and its libraries are slow to import.
    from gripper_force.vision.estimator import open_estimator
    from gripper_force.vision.model_files import read_model

    try:
        checkpoint = read_model(run.config.vision.checkpoint)
    except CheckpointError as error:
        return None, f"Attention is not shown: {error}."
    if checkpoint.digest != run.metadata.get("checkpoint"):
        return None, f"Attention is not shown: {run.config.vision.checkpoint!r} is not the run's checkpoint."
    estimator = open_estimator(checkpoint, run.config.vision)
    return estimator, "Laid over: where the network looks (spatial attention), from dark to bright."


def _picture(frame: Frame, run: Run, attention: npt.NDArray[np.float32] | None) -> Picture:
    gray = downscale(frame.gray, run.config.vision.region, _SIDE)
    t_s = (frame.t_ns - run.zero_ns) / NS_PER_S
    image = np.repeat(gray[:, :, None], 3, axis=2) if attention is None else overlay(gray, attention)
    return Picture(t_s, image, _at(run, "vision", t_s), _at(run, "load_cell", t_s))


def overlay(gray: Gray, attention: npt.NDArray[np.float32]) -> Colour:
    """A frame, (S, S), with a map, (h, w) in 0..1, in colour over it; the weight follows the map."""
    spread = cv2.resize(attention, gray.shape[::-1], interpolation=cv2.INTER_CUBIC).clip(0, 1)  # (S, S)
    spread = (spread - spread.min()) / max(float(np.ptp(spread)), 1e-6)
    heat = colormaps["inferno"](spread)[:, :, :3] * 255  # (S, S, 3)
    weight = _OPACITY * spread[:, :, None]
    return np.asarray((1 - weight) * gray[:, :, None] + weight * heat, np.uint8)


def _at(run: Run, source: str, t_s: float) -> float | None:
    series = run.forces.get(source)
    if series is None or not series.t_s[0] <= t_s <= series.t_s[-1]:
        return None
    return float(np.interp(t_s, series.t_s, series.value_n))


def _newtons(force_n: float) -> str:
    return f"{round(force_n, 2) + 0.0:.2f} N"  # adding 0 turns -0.0 into 0.0
