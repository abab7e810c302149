"""Camera frames over a grasp, with the network's spatial attention over them."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib import colormaps

from gripper_force.config import config_from_text
from gripper_force.errors import CheckpointError, DataError, NonFiniteError, UnfamiliarFrameError
from gripper_force.jobs.renewals import RenewalFinder
from gripper_force.jobs.report.run import Run
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import GRIPPING, NS_PER_S, Frame, Gray, Record
from gripper_force.vision.preprocess import downscale

if TYPE_CHECKING:
    from gripper_force.config import Config
    from gripper_force.vision.estimator import ForceEstimator

COUNT: Final = 6
"""Frames shown."""

_SIDE_PX: Final = 256
_KEPT: Final = 512
"""Frames kept while the log is read, 32 MiB at most. Logs with no more frames lose none."""

_LEAD_S: Final = 0.3
"""Time shown before contact and after release."""

ATTENTION_MAP: Final = "inferno"
"""Matplotlib's name of the colours of the attention."""

_KNOWN_S: Final = 0.05
"""A force is known at a time if there is a value within this time of it."""

_OPACITY: Final = 0.5
_TOUCH_SHARE: Final = 0.05
"""Share of the largest force above which a recording without phases counts as in contact."""

Colour = npt.NDArray[np.uint8]
"""An RGB image, (H, W, 3)."""

Attention = npt.NDArray[np.float32]
"""Spatial attention, (h, w), in 0..1."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One frame of a run.

    Attributes:
        t_s: Time of the frame.
        image: The frame in gray, (S, S, 3) uint8.
        overlay: The same with the network's attention; None without any.
        vision_n: Visual estimate at that time; None if it is not known.
        load_cell_n: Force of the load cell at that time; None if it is not known.
    """

    t_s: float
    image: Colour
    overlay: Colour | None
    vision_n: float | None
    load_cell_n: float | None

    @property
    def caption(self) -> str:
        """Time and forces, one per line."""
        lines = [f"{self.t_s:.2f} s"]
        if self.load_cell_n is not None:
            lines.append(f"load cell {_newtons(self.load_cell_n)}")
        if self.vision_n is not None:
            lines.append(f"vision {_newtons(self.vision_n)}")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A downscaled frame, (S, S), and the attention on it."""

    t_ns: int
    gray: Gray
    attention: Attention | None


class FrameSampler:
    """Samples frames while a log is read, and then picks those to show.

    The frames to show depend on when the grip ends, which is only known at the log's end. So evenly spaced
    frames are kept, at most 512: whenever there are more, every second one is dropped.

    Args:
        log: The log. The run's checkpoint is loaded to compute the attention, if the log names one.
        replay_config: Configuration of a replay, whose checkpoint is loaded instead; None for the log's own.

    Raises:
        ConfigError: The log holds a configuration that this version does not understand.
    """

    def __init__(self, log: LogReader, replay_config: "Config | None" = None) -> None:
        config = replay_config or config_from_text(log.config, str(log.path))
        self._region = config.vision.region
        digest = log.metadata.get("checkpoint", "")
        self._estimator, self._note = _open_estimator(
            config, digest, any_checkpoint=replay_config is not None
        )
        self._renewals = RenewalFinder()
        self._candidates: list[_Candidate] = []
        self._step = 1
        self._count = 0

    def add(self, record: Record) -> None:
        """Takes the log's next record.

        Raises:
            ConfigError: The region of interest reaches beyond the frame.
        """
        is_renewed = self._renewals.is_renewed(record)
        if isinstance(record, Frame):
            self._add_frame(record, is_renewed=is_renewed)

    def _add_frame(self, frame: Frame, *, is_renewed: bool) -> None:
        attention = None
        if self._estimator is not None:
            # The run continued without an estimate for such a frame, too. If the checks rejected it, the network did
            # not see it, and the newest attention is that of an earlier frame.
            has_attention = True
            try:
                if is_renewed:
                    self._estimator.renew_reference()
                self._estimator.update(frame.gray)
            except UnfamiliarFrameError as error:
                has_attention = math.isfinite(error.force_n)
            except (DataError, NonFiniteError):
                has_attention = False
            attention = self._estimator.attention_map() if has_attention else None
        if self._count % self._step == 0:
            gray = downscale(frame.gray, self._region, _SIDE_PX)
            attention_copy = None if attention is None else attention.copy()
            self._candidates.append(_Candidate(frame.t_ns, gray, attention_copy))
        if len(self._candidates) > _KEPT:
            self._candidates = self._candidates[::2]
            self._step *= 2
        self._count += 1

    def pictures(self, run: Run) -> tuple[list[Picture], str]:
        """Picks frames spread evenly from just before contact to just after release.

        Args:
            run: The run whose frames were added.

        Returns:
            The pictures in order, and a note on the attention: what is shown, or why it is not.
        """
        if not self._candidates:
            return [], ""
        t_s = (np.array([candidate.t_ns for candidate in self._candidates]) - run.zero_ns) / NS_PER_S
        begin_s, end_s = _grip(run)
        spread_s = np.linspace(max(begin_s - _LEAD_S, t_s[0]), min(end_s + _LEAD_S, t_s[-1]), COUNT)
        indices = sorted({int(np.abs(t_s - t).argmin()) for t in spread_s})
        pictures = [_picture(self._candidates[i], float(t_s[i]), run) for i in indices]
        return pictures, self._note if "vision" in run.forces else ""


def _grip(run: Run) -> tuple[float, float]:
    """Start and end of the grip: by the phases, else by the load cell, else the whole log."""
    phases = [span for span in run.phases if span.phase in GRIPPING]
    if phases:
        return phases[0].start_s, phases[-1].end_s
    cell = run.forces.get("load_cell")
    if cell is not None and (in_contact := cell.value > _TOUCH_SHARE * cell.value.max()).any():
        return float(cell.t_s[in_contact][0]), float(cell.t_s[in_contact][-1])
    return run.begin_s, run.end_s


def _open_estimator(
    config: "Config", digest: str, *, any_checkpoint: bool
) -> "tuple[ForceEstimator | None, str]":
    if not digest or config.vision.checkpoint == "none":
        return None, ""
    # Imported here: a recording without estimates needs no network, and these imports are slow.
    from gripper_force.vision.estimator import open_estimator
    from gripper_force.vision.model_files import read_model

    try:
        checkpoint = read_model(config.vision.checkpoint)
    except CheckpointError as error:
        return None, f"Attention is not shown: {error}."
    if checkpoint.digest != digest and not any_checkpoint:
        return None, f"Attention is not shown: {config.vision.checkpoint!r} is not the run's checkpoint."
    return open_estimator(
        checkpoint, config.vision
    ), "Second row: spatial attention over the same frames, each scaled to its own range."


def _picture(frame: _Candidate, t_s: float, run: Run) -> Picture:
    attention = frame.attention if "vision" in run.forces else None
    gray = frame.gray
    image = np.repeat(gray[:, :, None], 3, axis=2)
    overlaid = None if attention is None else overlay(gray, attention)
    return Picture(t_s, image, overlaid, _at(run, "vision", t_s), _at(run, "load_cell", t_s))


def overlay(gray: Gray, attention: Attention) -> Colour:
    """Returns a frame, (S, S), in colour with attention over it, whose opacity follows the attention."""
    spread = cv2.resize(attention, gray.shape[::-1], interpolation=cv2.INTER_CUBIC).clip(0, 1)  # (S, S)
    spread = (spread - spread.min()) / max(float(np.ptp(spread)), 1e-6)
    heat = colormaps[ATTENTION_MAP](spread)[:, :, :3] * 255  # (S, S, 3)
    weight = _OPACITY * spread[:, :, None]
    return np.asarray((1 - weight) * gray[:, :, None] + weight * heat, np.uint8)


def _at(run: Run, source: str, t_s: float) -> float | None:
    series = run.forces.get(source)
    if series is None or not series.t_s[0] <= t_s <= series.t_s[-1]:
        return None
    if np.abs(series.t_s - t_s).min() > _KNOWN_S:
        return None
    return float(np.interp(t_s, series.t_s, series.value))


def _newtons(force_n: float) -> str:
    return f"{round(force_n, 2) + 0.0:.2f} N"  # adding 0 turns -0.0 into 0.0
