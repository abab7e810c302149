"""Soak test: many grasps in one process, to find growth of memory, open files or threads."""

import ctypes
import gc
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypedDict

import numpy as np

from gripper_force.config import Config
from gripper_force.jobs.grasp import PAPER_OBJECTS, grasp
from gripper_force.jobs.trials import TRIAL_TARGETS_N
from gripper_force.progress import Progress, no_progress
from gripper_force.qualification.proc_files import process_text
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import NS_PER_S

WARM_UP: Final = 5
"""Grasps before growth counts: each kind of object was held, and everything made only once exists."""

GROWTH_MB: Final = 20.0
"""Allowed growth of memory after the warm-up."""


@dataclass(frozen=True, slots=True)
class Sample:
    """State of the process after a grasp.

    Attributes:
        simulated_s: Simulated time so far.
        memory_mb: Anonymous resident memory (RssAnon). It excludes file pages, which the kernel loads and
            drops as it needs.
        handles: Open files, sockets and devices.
        threads: Threads, including those of libraries.
    """

    simulated_s: float
    memory_mb: float
    handles: int
    threads: int


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth after the warm-up.

    Attributes:
        ok: True if neither files nor threads grew, and memory by less than `GROWTH_MB`.
        growth_mb: Memory at the end minus memory after the warm-up.
        slope_mb_h: Slope of a line through all samples, per simulated hour.
    """

    ok: bool
    growth_mb: float
    slope_mb_h: float


class SoakReport(TypedDict):
    """Result of `soak`.

    Attributes:
        ok: True if nothing grew and the simulated time was reached.
        growth_mb: See `Growth`.
        slope_mb_h: See `Growth`.
        grasps: Grasps run.
        outcomes: Count by result of a grasp.
        simulated_s: Simulated time.
        wall_s: Real time.
        samples: State of the process before the first grasp and after each.
    """

    ok: bool
    growth_mb: float
    slope_mb_h: float
    grasps: int
    outcomes: dict[str, int]
    simulated_s: float
    wall_s: float
    samples: list[Sample]


def soak(config: Config, simulated_s: float, progress: Progress = no_progress) -> SoakReport:
    """Grasps the four objects in turn, with rising seeds and drawn targets, for a simulated time.

    Interrupted by Ctrl-C after the warm-up, it returns the results so far, with ``ok`` False.

    Args:
        config: Configuration; object, target, seed and log folder are replaced, and the logs deleted.
        simulated_s: Simulated duration; at least the warm-up and two rounds of all objects are run.
        progress: Called after each grasp; a step is a simulated second.
    """
    begin_s = time.monotonic()
    rng = np.random.default_rng([config.seed, 30])
    samples = [_sample(0.0)]
    outcomes: Counter[str] = Counter()
    done_s, fewest = 0.0, WARM_UP + 2 * len(PAPER_OBJECTS)  # the first and the last round are compared
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        quiet = config.with_values(log={"directory": Path(folder), "report": False})
        while done_s < simulated_s or len(samples) < fewest:
            number = len(samples) - 1
            drawn = quiet.with_values(
                object=PAPER_OBJECTS[number % len(PAPER_OBJECTS)],
                target_n=round(float(rng.uniform(*TRIAL_TARGETS_N)), 3),
                seed=config.seed + number,
            )
            try:
                outcome = str(grasp(drawn)["result"])
            except KeyboardInterrupt:
                if len(samples) < fewest:
                    raise
                break
            outcomes[outcome] += 1
            before_s = done_s
            for path in Path(folder).iterdir():
                done_s += LogReader(path).duration_ns / NS_PER_S
                path.unlink()
            samples.append(_sample(done_s))
            text = f"{drawn.object}: {outcome}, {samples[-1].memory_mb:.0f} MB"
            progress(text, int(done_s) - int(before_s))
    growth = measure_growth(samples)
    return {
        "ok": growth.ok and done_s >= simulated_s,
        "growth_mb": growth.growth_mb,
        "slope_mb_h": growth.slope_mb_h,
        "grasps": len(samples) - 1,
        "outcomes": dict(outcomes),
        "simulated_s": round(done_s, 1),
        "wall_s": round(time.monotonic() - begin_s, 1),
        "samples": samples,
    }


def measure_growth(samples: list[Sample]) -> Growth:
    """Growth of memory, files and threads after the warm-up."""
    warm = samples[WARM_UP:]
    memory_mb = [sample.memory_mb for sample in warm]
    each = len(PAPER_OBJECTS)  # objects take different amounts, so compare medians over one round of all
    growth_mb = float(np.median(memory_mb[-each:]) - np.median(memory_mb[:each]))
    hours = [sample.simulated_s / 3600 for sample in warm]
    slope_mb_h = np.polyfit(hours, memory_mb, 1)[0]
    flat = all(s.handles <= warm[0].handles and s.threads <= warm[0].threads for s in warm)
    return Growth(
        ok=flat and growth_mb < GROWTH_MB,
        growth_mb=round(growth_mb, 2),
        slope_mb_h=round(float(slope_mb_h), 2),
    )


def _sample(simulated_s: float) -> Sample:
    gc.collect()
    process_text("statm")  # without Linux there is no malloc_trim either
    ctypes.CDLL(None).malloc_trim(0)  # memory that was freed but kept for reuse is not a leak
    facts = dict(line.split(":", 1) for line in process_text("status").splitlines())
    handles = sum(1 for _ in Path("/proc/self/fd").iterdir())
    return Sample(simulated_s, _kilobytes_to_mb(facts["RssAnon"]), handles, int(facts["Threads"]))


def _kilobytes_to_mb(kilobytes: str) -> float:
    return int(kilobytes.split()[0]) / 1024
