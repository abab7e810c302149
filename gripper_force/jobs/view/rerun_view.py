"""Rerun (https://rerun.io): the place of each record of a log in the viewer, and the blueprint that arranges them."""

import os
import sys
from collections import defaultdict
from pathlib import Path
from typing import Final
from uuid import NAMESPACE_URL, uuid5

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from gripper_force.errors import DataError
from gripper_force.jobs.report.figure import WIDTH_COLOURS
from gripper_force.jobs.report.run import SOURCES, request_text
from gripper_force.runtime.log_codecs import INTERVAL_STD
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import available_ns
from gripper_force.types import (
    NS_PER_MS,
    AttentionMap,
    Event,
    Frame,
    FusedForce,
    GraspStatus,
    LoadCellSample,
    Phase,
    Record,
    Request,
    ServoCommand,
    ServoState,
    VisualForce,
)

TIMELINE: Final = "run"
"""Seconds since the log's first record. The timeline ``utc`` exists for real time only."""

_BATCH_NS: Final = 100 * NS_PER_MS
_PICTURE_NS: Final = 30 * NS_PER_MS
"""Frames closer than this are not drawn: a screen shows no more, and a camera's are many megabytes."""

_SOFT: Final = "#8a9099"
_INTERVAL: Final = "#8ab4d3"
_LOAD_CELL: Final = "#cc79a7"
_LINES: Final = {
    "force/interval_low": ("claimed 90 % interval, low", _INTERVAL, 1.0),
    "force/interval_high": ("claimed 90 % interval, high", _INTERVAL, 1.0),
    "force/target": ("target", _SOFT, 2.0),
    "force/current": (SOURCES["current"].label, SOURCES["current"].light, 1.0),
    "force/vision": (SOURCES["vision"].label, SOURCES["vision"].light, 1.0),
    "force/load_cell": (SOURCES["load_cell"].label, _LOAD_CELL, 1.5),
    "force/estimate": ("estimate (fusion)", SOURCES["fused"].light, 2.5),
    "motor/width_mm": ("width, mm", WIDTH_COLOURS["light"], 1.5),
    "motor/goal_current_ma": ("largest allowed current, mA", _SOFT, 1.0),
    "motor/current_ma": ("current, mA", SOURCES["current"].light, 1.5),
}
"""Label, colour and width of each curve, by entity. The colours show on light and dark backgrounds."""

_PHASES: Final = {
    Phase.OPEN: "#4a5059",
    Phase.APPROACH: "#7a5195",
    Phase.CONTACT: "#bc5090",
    Phase.RAMP: "#ef8a3c",
    Phase.HOLD: "#2e9d6f",
    Phase.RELEASE: "#3b7fb8",
    Phase.MOVE: "#8a6d3b",
    Phase.FAULT: "#d03a2f",
}


def blueprint(*, live: bool) -> rrb.Blueprint:
    """Returns the arrangement: pictures and events above, forces, phases and motor below, on one time axis.

    Args:
        live: True to follow the newest data; False to play from the beginning.
    """
    legend = rrb.Corner2D.LeftTop
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin="/camera", name="Camera"),
                rrb.Spatial2DView(origin="/attention", name="Attention of the network"),
                rrb.TextLogView(
                    origin="/events", name="Events", columns=rrb.TextLogColumns(text_log_columns=["Body"])
                ),
                column_shares=[2, 2, 5],
            ),
            rrb.TimeSeriesView(origin="/force", name="Force in N", plot_legend=legend),
            rrb.StateTimelineView(origin="/state", name="Phases"),
            rrb.TimeSeriesView(origin="/motor", name="Motor", plot_legend=legend),
            row_shares=[5, 7, 5, 4],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following" if live else "playing"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


class RerunViewer:
    """Sends records to the Rerun viewer, or to a file for it.

    Args:
        log: The log; its name is that of the recording.
        save: File (``.rrd``) to write; None: the viewer is started.
        live: True if the log is still being written.

    Raises:
        DataError: The viewer can't start, or the file can't be written.
    """

    def __init__(self, log: Path, save: Path | None = None, *, live: bool = False) -> None:
        name = log.stem
        # Rerun merges recordings with one id: two logs of one name in two folders must have two.
        self._recording = rr.RecordingStream(
            "gripper-force", recording_id=uuid5(NAMESPACE_URL, log.resolve().as_uri())
        )
        self._saves = save is not None
        self._first_ns: int | None = None
        self._sent_ns = 0
        self._next_picture_ns: dict[type, int] = defaultdict(int)
        self._curves: dict[str, list[tuple[int, float]]] = defaultdict(list)
        self._states: dict[str, str] = {}
        self._utc_offset_ns = 0
        try:
            if save is not None:
                save.parent.mkdir(parents=True, exist_ok=True)
                self._recording.save(save, default_blueprint=blueprint(live=live))
            else:
                _require_display()
                self._recording.spawn(default_blueprint=blueprint(live=live), hide_welcome_screen=True)
        except (OSError, RuntimeError) as error:
            raise DataError(f"Rerun can't show {name}: {error}") from error
        self._recording.send_recording_name(name)
        self._recording.set_log_time_enabled(False)
        for entity, (label, colour, width) in _LINES.items():
            self._recording.log(
                entity, rr.SeriesLines(colors=[_rgba(colour)], widths=[width], names=[label]), static=True
            )
        phases = [str(phase) for phase in _PHASES]
        style = rr.StateConfiguration(
            values=phases, labels=phases, colors=[_rgba(c) for c in _PHASES.values()]
        )
        self._recording.log("state/phase", style, static=True)
        self._recording.flush()  # the style before the first data

    def show(self, log: LogReader, record: Record) -> None:
        """Draws the next record of a log."""
        now_ns = available_ns(record)
        if self._first_ns is None:
            self._first_ns, self._utc_offset_ns = now_ns, log.utc_offset_ns
        if now_ns - self._sent_ns >= _BATCH_NS:
            self._send_curves()
            self._sent_ns = now_ns
        curve = self._curves
        match record:
            case FusedForce(t_ns=t_ns):
                half_n = INTERVAL_STD * record.std_n
                curve["force/estimate"].append((t_ns, record.force_n))
                curve["force/interval_low"].append((t_ns, record.force_n - half_n))
                curve["force/interval_high"].append((t_ns, record.force_n + half_n))
                curve["force/current"].append((t_ns, record.current_n))
                self._change(t_ns, "source", record.source)
            case VisualForce(t_ns=t_ns) if record.is_familiar:
                curve["force/vision"].append((t_ns, record.force_n))
            case LoadCellSample(t_ns=t_ns, valid=True):
                curve["force/load_cell"].append((t_ns, record.force_n))
            case GraspStatus(t_ns=t_ns):
                curve["force/target"].append((t_ns, record.reference_n))
                curve["motor/width_mm"].append((t_ns, 1e3 * record.width_m))
                self._change(t_ns, "phase", record.phase)
                if self._change(t_ns, "outcome", record.outcome) and record.outcome:
                    self._tell(t_ns, "outcome", record.outcome)
                if record.reason:
                    self._tell(t_ns, "control", record.reason)
            case ServoState(t_ns=t_ns):
                curve["motor/current_ma"].append((t_ns, 1e3 * abs(record.current_a)))
            case ServoCommand(t_ns=t_ns):
                curve["motor/goal_current_ma"].append((t_ns, 1e3 * record.goal_current_a))
            case Request(t_ns=t_ns):
                self._tell(t_ns, "request", request_text(record))
            case Event(t_ns=t_ns):
                self._tell(t_ns, record.unit, record.text)
            case Frame() | AttentionMap() if now_ns >= self._next_picture_ns[type(record)]:
                self._next_picture_ns[type(record)] = now_ns + _PICTURE_NS
                self._draw(record)

    def close(self) -> None:
        """Sends everything, and ends the connection. The window stays."""
        self._send_curves()
        self._recording.flush()
        self._recording.disconnect()

    def _draw(self, picture: Frame | AttentionMap) -> None:
        self._at(picture.t_ns)
        if isinstance(picture, Frame):
            self._recording.log("camera", rr.Image(picture.gray, "L"))
        else:
            image = rr.DepthImage(
                picture.gray, colormap="inferno", depth_range=[0, 255], magnification_filter="Linear"
            )
            self._recording.log("attention", image)

    def _change(self, t_ns: int, name: str, state: str) -> bool:
        if self._states.get(name, "") == state:
            return False
        self._states[name] = state
        self._at(t_ns)
        # Rerun shows no state as a gap.
        self._recording.log(
            f"state/{name}", rr.StateChange(state=state) if state else rr.Clear(recursive=False)
        )
        return True

    def _tell(self, t_ns: int, unit: str, text: str) -> None:
        self._at(t_ns)
        self._recording.log("events", rr.TextLog(f"{unit}: {text}", level="INFO"))

    def _at(self, t_ns: int) -> None:
        assert self._first_ns is not None
        self._recording.set_time(TIMELINE, duration=np.timedelta64(t_ns - self._first_ns, "ns"))
        if self._utc_offset_ns:
            self._recording.set_time("utc", timestamp=np.datetime64(t_ns + self._utc_offset_ns, "ns"))

    def _send_curves(self) -> None:
        for entity, points in self._curves.items():
            if points:
                t_ns = np.array([t for t, _ in points])
                times = [rr.TimeColumn(TIMELINE, duration=(t_ns - self._first_ns).astype("timedelta64[ns]"))]
                if self._utc_offset_ns:
                    utc = (t_ns + self._utc_offset_ns).astype("datetime64[ns]")
                    times.append(rr.TimeColumn("utc", timestamp=utc))
                values = rr.Scalars.columns(scalars=[value for _, value in points])
                self._recording.send_columns(entity, times, values)
                points.clear()
        if self._saves:  # in a file, what belongs together is close together
            self._recording.flush()


def _rgba(colour: str) -> int:
    """Converts ``#rrggbb``, as Rerun takes colours."""
    return int(colour[1:] + "ff", 16)


def _require_display() -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise DataError(
            "this machine has no display for Rerun; write a file with `gripper-force view LOG --save FILE.rrd` and "
            "open it elsewhere with `rerun FILE.rrd`, or use Foxglove"
        )
