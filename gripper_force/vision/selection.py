"""``auto``: what this machine measured of engines, threads and members, once, and what it takes of them."""

import json
import os
import platform
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final, get_args

import numpy as np

from gripper_force.config import BudgetConfig, VisionConfig
from gripper_force.errors import ConfigError
from gripper_force.types import NS_PER_MS
from gripper_force.vision.engines import Engine, Precision, open_engine
from gripper_force.vision.header import EXPORTED, SHIPPED, Model
from gripper_force.vision.model_files import cache_folder, read_model

ENGINE_PACKAGES: Final = {
    "torch": "torch",
    "openvino": "openvino",
    "onnxruntime": "onnxruntime",
}
"""What each engine needs."""

_STEPS: Final = 150
_WARM: Final = 20


@dataclass(frozen=True, slots=True)
class Candidate:
    """One candidate to compute an estimate, and what it takes on this machine.

    Attributes:
        checkpoint: Name or path.
        engine: As ``vision.engine``.
        precision: As ``vision.precision``.
        threads: As ``vision.threads``.
        p50_ms: Median time of an estimate.
        p99_ms: 99th percentile of it.
        error_n: Mean absolute error: on held-out logs where `gripper-force bench` measured it, else on the
            validation data of the training, as the checkpoint says.
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
        """Time of all its threads together."""
        return self.p50_ms * self.threads

    def __str__(self) -> str:
        """In words."""
        return (
            f"{self.checkpoint} on {self.engine}, {self.precision}, {self.threads} "
            f"thread{'s' if self.threads > 1 else ''}: p99 {self.p99_ms:.2f} ms, {self.error_n:.3f} N"
        )


@lru_cache
def resolve_auto(vision: VisionConfig, budget: BudgetConfig) -> tuple[VisionConfig, str]:
    """Puts names in place of ``auto``, and says why.

    Args:
        vision: What is asked for.
        budget: What the choice has to keep.

    Returns:
        The section with nothing left to select, and a sentence; empty where there was nothing to select.

    Raises:
        ConfigError: No candidate keeps the budget.
    """
    if vision.checkpoint == "none" or "auto" not in (vision.checkpoint, vision.engine):
        return vision, ""
    return select(candidates(vision), vision, budget)


def select(
    tested: Sequence[Candidate], vision: VisionConfig, budget: BudgetConfig
) -> tuple[VisionConfig, str]:
    """Selects the cheapest candidate within the budget; without one, the fastest of the most accurate."""
    named = f"budget.latency_ms={budget.latency_ms}, budget.error_n={budget.error_n}"
    fits = [
        candidate
        for candidate in tested
        if (budget.latency_ms is None or candidate.p99_ms <= budget.latency_ms)
        and (budget.error_n is None or candidate.error_n <= budget.error_n)
    ]
    if not fits:
        nearest = "; ".join(str(candidate) for candidate in pareto(tested))
        raise ConfigError(f"no candidate to compute the force keeps {named}; there are {nearest}")
    if budget.latency_ms is None and budget.error_n is None:
        least_n = min(candidate.error_n for candidate in fits)
        chosen = min(
            (candidate for candidate in fits if candidate.error_n == least_n),
            key=lambda candidate: candidate.p50_ms,
        )
        why = "the fastest of the most exact"
    else:
        chosen, why = min(fits, key=lambda candidate: candidate.cost_ms), f"the cheapest that keeps {named}"
    update = {name: getattr(chosen, name) for name in ("checkpoint", "engine", "precision", "threads")}
    return vision.model_copy(update=update), f"took {chosen} ({why} of {len(tested)} candidates)"


def pareto(tested: Sequence[Candidate]) -> list[Candidate]:
    """The candidates that no other beats in both time and error, by rising time."""
    front: list[Candidate] = []
    for candidate in sorted(tested, key=lambda candidate: (candidate.p50_ms, candidate.error_n)):
        if not front or candidate.error_n < front[-1].error_n:
            front.append(candidate)
    return front


def candidates(vision: VisionConfig) -> list[Candidate]:
    """What there is to select from, measured now where this machine has not measured it before."""
    known = _remembered()
    found = []
    for key, (model, engine, precision, threads) in _candidates(vision):
        if key not in known:
            opened = open_engine(model, engine, precision, threads)
            p50_ms, p99_ms = timed_ms(opened)
            mae_n = model.header.metrics.get("mae_n", float("inf"))
            known[key] = Candidate(_name(model), engine, precision, threads, p50_ms, p99_ms, mae_n)
            remember({key: known[key]})
        found.append(known[key])
    return found


def timed_ms(engine: Engine) -> tuple[float, float]:
    """Median and 99th percentile of an engine's step, on frames of noise, in ms."""
    size = engine.header.preprocess.size
    frames = np.random.default_rng(0).normal(size=(8, size, size)).astype(np.float32)
    taken_ns = []
    for i in range(_STEPS + _WARM):
        begin_ns = time.perf_counter_ns()
        engine.step(frames[i % len(frames)])
        taken_ns.append(time.perf_counter_ns() - begin_ns)
    p50_ns, p99_ns = np.percentile(taken_ns[_WARM:], [50, 99])
    return float(p50_ns / NS_PER_MS), float(p99_ns / NS_PER_MS)


def key_of(model: Model, engine: str, precision: str, threads: int) -> str:
    """What a measurement holds for: the file, the engine's version, how it runs, and the machine."""
    parts = (model.digest[:16], model.path.suffix, engine, _version(ENGINE_PACKAGES[engine]))
    return " ".join((*parts, precision, str(threads), _machine()))


def remember(measured: dict[str, Candidate]) -> None:
    """Keeps measurements for the next time; where the folder can't be written, nothing is kept."""
    path = _memory()
    known = {key: asdict(candidate) for key, candidate in (_remembered() | measured).items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(f".{os.getpid()}")
        partial.write_text(json.dumps(known, indent=1), encoding="utf-8")
        partial.replace(path)
    except OSError:
        return


def installed() -> list[str]:
    """Returns the engines whose packages are installed."""
    return [engine for engine, package in ENGINE_PACKAGES.items() if _version(package)]


def _candidates(vision: VisionConfig) -> Iterator[tuple[str, tuple[Model, str, Precision, int]]]:
    sources = list(SHIPPED) if vision.checkpoint == "auto" else [vision.checkpoint]
    cores = os.cpu_count() or 1
    for source in sources:
        model = read_model(source)
        for engine in installed() if vision.engine == "auto" else [vision.engine]:
            if model.path.suffix in EXPORTED and engine != EXPORTED[model.path.suffix]:
                continue
            threads = [t for t in (1, 2, 4, 8) if t <= cores] if vision.engine == "auto" else [vision.threads]
            both = vision.checkpoint == "auto" and engine == "openvino"
            for precision in get_args(Precision) if both else [vision.precision]:
                if precision != "float32" and engine != "openvino":
                    continue
                for count in threads:
                    yield key_of(model, engine, precision, count), (model, engine, precision, count)


def _name(model: Model) -> str:
    return next((name for name, path in SHIPPED.items() if path == model.path), str(model.path))


def _memory() -> Path:
    return cache_folder() / "engines.json"


def _remembered() -> dict[str, Candidate]:
    try:
        return {
            key: Candidate(**candidate)
            for key, candidate in json.loads(_memory().read_text(encoding="utf-8")).items()
        }
    except (OSError, ValueError, TypeError, AttributeError):
        return {}  # nothing there yet, or of another version: it is measured again


@cache
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


@cache
def _machine() -> str:
    cpu = next(
        (line.split(":", 1)[1].strip() for line in _cpu_info() if line.startswith("model name")),
        platform.processor(),
    )
    return f"{platform.node()} {cpu} {os.cpu_count()}"


def _cpu_info() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
