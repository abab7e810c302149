"""Logs of imported recordings."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gripper_force.config import Config, dump_config
from gripper_force.errors import LogError
from gripper_force.files import unfinished
from gripper_force.jobs.dataset import label_frames, starts_in_contact
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.spikes import find_spikes
from gripper_force.types import Frame, LoadCellSample
from gripper_force.vision.preprocess import Preprocess


def load_cell_samples(
    t_ns: Sequence[int], raw_n: npt.NDArray[np.float64], tare_n: float = 0.0
) -> list[LoadCellSample]:
    """Returns samples with the tare subtracted and spikes marked as not valid.

    Args:
        t_ns: Times, (N,).
        raw_n: Forces as measured, (N,).
        tare_n: Offset to subtract.
    """
    force_n = raw_n - tare_n
    return [
        LoadCellSample(t, float(force), float(raw), not bad)
        for t, force, raw, bad in zip(t_ns, force_n, raw_n, find_spikes(force_n), strict=True)
    ]


def write_recording(
    out: Path,
    config: Config,
    metadata: dict[str, str],
    frames: list[Frame],
    samples: list[LoadCellSample],
    table: Path | None = None,
) -> tuple[int, bool]:
    """Writes an imported recording as a log, which gets its name once it is complete.

    Args:
        out: The log to write.
        config: Known configuration of the recording.
        metadata: Metadata of the log.
        frames: The frames.
        samples: The forces.
        table: File of the forces, to attach; None without one.

    Returns:
        Number of samples that are not valid, and True if the recording starts in contact. Both are also noted
        in the log's metadata.

    Raises:
        LogError: The log exists already or can't be written.
    """
    if out.exists():
        raise LogError(f"can't write the log {out}: it exists already; move it away, or use another folder")
    spikes = sum(not sample.valid for sample in samples)
    records: list[Frame | LoadCellSample] = [*frames, *samples]
    forces_n, _ = label_frames(np.array([frame.t_ns for frame in frames], np.int64), samples, 0)
    in_contact = starts_in_contact(forces_n, Preprocess())
    metadata = {**metadata, "spikes_rejected": str(spikes), "starts_in_contact": str(in_contact).lower()}
    with unfinished(out) as part, LogWriter(part, config=dump_config(config), metadata=metadata) as log:
        if table is not None:
            log.attach(table.name, table.read_bytes(), "text/csv")
        for record in sorted(records, key=lambda record: record.t_ns):
            log.write(record)
    return spikes, in_contact
