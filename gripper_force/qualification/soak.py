"""Grasp after grasp in one process, to see whether anything grows: memory, open files, threads."""

import ctypes
import gc
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from gripper_force.config import Config
from gripper_force.jobs.grasp import TRIAL_OBJECTS, TRIAL_TARGETS_N, grasp
from gripper_force.runtime.log import LogReader
from gripper_force.types import NS_PER_S

WARM_UP: Final = 5
"""Grasps until each kind of object has been held, and all that is made once has been made."""

GROWTH_MB: Final = 20.0
"""Memory that may come on top after the warm-up."""

Advance = Callable[[str, int], None]
"""Told what goes on, and how many simulated seconds more are done."""


@dataclass(frozen=True, slots=True)
class Sample:
    """The process after a grasp.

    Attributes:
        simulated_s: Simulated time so far.
        memory_mb: Memory of its own (RssAnon); pages of files come and go as the machine needs them.
        handles: Open files, sockets and devices.
        threads: Threads, those of libraries among them.
    """

    simulated_s: float
    memory_mb: float
    handles: int
    threads: int


def soak(config: Config, simulated_s: float, advance: Advance = lambda _note, _done: None) -> dict[str, Any]:
    """Grasps the four objects in turn, with rising seeds and drawn targets, for a simulated time.

    Broken off by Ctrl-C, it returns what was seen so far, with ``ok`` False.

    Args:
        config: Everything but object, target, seed and the folder of logs, which are deleted as it goes.
        simulated_s: How long; the warm-up and two more grasps are run in any case.
        advance: Told of progress.

    Returns:
        ``ok``, ``grasps``, ``outcomes``, ``simulated_s``, ``wall_s``, ``growth_mb`` (since the warm-up),
        ``slope_mb_h`` (of a line through all since then, a simulated hour), and ``samples``, the first of
        them from before the first grasp. A grasp that fails counts as the outcome ``error: ...``.
    """
    begin_s = time.monotonic()
    rng = np.random.default_rng([config.seed, 30])
    samples = [_look(0.0)]
    outcomes: Counter[str] = Counter()
    done_s, fewest = 0.0, WARM_UP + 3
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        log = config.log.model_copy(update={"directory": Path(folder), "report": False})
        while done_s < simulated_s or len(samples) < fewest:
            number = len(samples) - 1
            drawn = {
                "object": TRIAL_OBJECTS[number % len(TRIAL_OBJECTS)],
                "target_n": round(float(rng.uniform(*TRIAL_TARGETS_N)), 3),
                "seed": config.seed + number,
            }
            try:
                outcome = str(grasp(config.model_copy(update={"log": log, **drawn}))["result"])
            except KeyboardInterrupt:
                if len(samples) < fewest:
                    raise
                break  # what was seen so far is worth telling
            outcomes[outcome] += 1
            before_s = done_s
            for path in Path(folder).iterdir():
                done_s += LogReader(path).duration_ns / NS_PER_S
                path.unlink()
            samples.append(_look(done_s))
            note = f"{drawn['object']}: {outcome}, {samples[-1].memory_mb:.0f} MB"
            advance(note, int(done_s) - int(before_s))
    flat = judge(samples)
    return {
        **flat,
        "ok": flat["ok"] and done_s >= simulated_s,
        "grasps": len(samples) - 1,
        "outcomes": dict(outcomes),
        "simulated_s": round(done_s, 1),
        "wall_s": round(time.monotonic() - begin_s, 1),
        "samples": samples,
    }


def judge(samples: list[Sample]) -> dict[str, Any]:
    """Whether anything grew after the warm-up: ``ok``, ``growth_mb`` and ``slope_mb_h``."""
    warm = samples[WARM_UP:]
    memory_mb = [sample.memory_mb for sample in warm]
    each = len(TRIAL_OBJECTS)  # one object takes more than another
    growth_mb = float(np.median(memory_mb[-each:]) - np.median(memory_mb[:each]))
    hours = [sample.simulated_s / 3600 for sample in warm]
    slope_mb_h = np.polyfit(hours, memory_mb, 1)[0]
    flat = all(s.handles <= warm[0].handles and s.threads <= warm[0].threads for s in warm)
    return {
        "ok": flat and growth_mb < GROWTH_MB,
        "growth_mb": round(growth_mb, 2),
        "slope_mb_h": round(float(slope_mb_h), 2),
    }


def _look(simulated_s: float) -> Sample:
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what was freed, and is kept to be used again, is no leak
    status = Path("/proc/self/status").read_text(encoding="ascii")
    facts = dict(line.split(":", 1) for line in status.splitlines())
    handles = sum(1 for _ in Path("/proc/self/fd").iterdir())
    return Sample(simulated_s, _mb(facts["RssAnon"]), handles, int(facts["Threads"]))


def _mb(kilobytes: str) -> float:
    return int(kilobytes.split()[0]) / 1024
