"""Timing of an engine's step, and the cache of measurements of this machine."""

import hashlib
import json
import os
import platform
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import numpy as np

from gripper_force.plugins import registered
from gripper_force.types import NS_PER_MS
from gripper_force.vision.engines import ENGINES, Engine, Precision
from gripper_force.vision.header import EXPORTED, Model
from gripper_force.vision.model_files import cache_folder

_STEPS: Final = 150
"""Timed steps of a measurement."""

_WARM_UP_STEPS: Final = 20
"""Steps before the timed ones."""


@dataclass(frozen=True, slots=True)
class EngineCandidate:
    """A network, an engine and its settings, with the time measured on this machine, and the network's error.

    Attributes:
        checkpoint: Name or path.
        engine: As ``vision.engine``.
        precision: As ``vision.precision``.
        threads: As ``vision.threads``.
        p50_ms: Median time of an estimate.
        p99_ms: 99th percentile of the time of an estimate.
        error_n: Mean absolute error that the header of the checkpoint or exported file states.
    """

    checkpoint: str
    engine: str
    precision: Precision
    threads: int
    p50_ms: float
    p99_ms: float
    error_n: float

    @property
    def cost_ms(self) -> float:
        """Median time of an estimate, multiplied by the number of threads."""
        return self.p50_ms * self.threads

    def __str__(self) -> str:
        """Returns the settings, time and error, for people."""
        return (
            f"{self.checkpoint} on {self.engine}, {self.precision}, {self.threads} "
            f"thread{'s' if self.threads > 1 else ''}: p99 {self.p99_ms:.2f} ms, {self.error_n:.3f} N"
        )


def step_times_ms(engine: Engine) -> tuple[float, float]:
    """Measures an engine's step on frames of noise.

    Returns:
        Median and 99th percentile of the time of a step.
    """
    size = engine.header.preprocess.size
    frames = np.random.default_rng(0).normal(size=(8, size, size)).astype(np.float32)
    times_ns = []
    for i in range(_STEPS + _WARM_UP_STEPS):
        begin_ns = time.perf_counter_ns()
        engine.step(frames[i % len(frames)])
        times_ns.append(time.perf_counter_ns() - begin_ns)
    p50_ns, p99_ns = np.percentile(times_ns[_WARM_UP_STEPS:], [50, 99])
    return float(p50_ns / NS_PER_MS), float(p99_ns / NS_PER_MS)


@cache
def engine_version(engine: str) -> str:
    """Returns the installed version of the package that an engine needs; empty if none is installed or known.

    Args:
        engine: As ``vision.engine``.
    """
    if engine not in ENGINES and (point := registered("engines").get(engine)) is not None:
        return point.dist.version if point.dist is not None else ""
    try:
        return version(engine.partition(":")[0].partition(".")[0])
    except (PackageNotFoundError, ValueError):  # the latter: an empty name
        return ""


def cache_key(model: Model, engine: str, precision: str, threads: int) -> str:
    """Returns the key of a measurement: file, engine and its version, settings, and machine."""
    digest = model.digest
    if model.path.suffix in EXPORTED:  # int8 and float32 of one checkpoint have its digest, and other times
        digest = hashlib.sha256(model.path.read_bytes()).hexdigest()
    parts = (digest[:16], model.path.suffix, engine, engine_version(engine))
    return " ".join((*parts, precision, str(threads), _machine()))


def read_cache() -> dict[str, EngineCandidate]:
    """Returns the measurements of this machine by `cache_key`; a malformed line of the file is left out."""
    cached = {}
    with suppress(OSError):
        for line in _cache_file().read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError, TypeError):
                key, candidate = json.loads(line)
                cached[key] = EngineCandidate(**candidate)
    return cached


def update_cache(measurements: dict[str, EngineCandidate]) -> None:
    """Adds measurements to the cache, one line each, so that no process replaces another's; nothing if it can't."""
    # An interruption may have cut the last line.
    lines = ["\n" + json.dumps([key, asdict(candidate)]) for key, candidate in measurements.items()]
    with suppress(OSError):
        _cache_file().parent.mkdir(parents=True, exist_ok=True)
        with _cache_file().open("a", encoding="utf-8") as file:
            file.write("".join(lines))
        _cache_file().with_suffix(".json").unlink(missing_ok=True)  # of earlier versions


def _cache_file() -> Path:
    return cache_folder() / "engines.jsonl"


@cache
def _machine() -> str:
    names = (line.partition(":")[2].strip() for line in cpu_info() if line.startswith("model name"))
    return f"{platform.node()} {next(names, platform.processor())} {os.cpu_count()}"


def cpu_info() -> list[str]:
    """Returns the lines of /proc/cpuinfo; none on a system without it."""
    try:
        return Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
