"""Resolution of ``auto`` in `vision.engine` and `vision.checkpoint`, by benchmarks cached on each machine."""

import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import lru_cache

from gripper_force.config import BudgetConfig, VisionConfig
from gripper_force.errors import ConfigError
from gripper_force.plugins import importing
from gripper_force.vision.engines import ENGINES, Precision, open_engine
from gripper_force.vision.header import EXPORTED, SHIPPED, Model
from gripper_force.vision.model_files import read_model
from gripper_force.vision.step_benchmark import (
    EngineCandidate,
    cache_key,
    engine_version,
    read_cache,
    step_times_ms,
    update_cache,
)


@lru_cache
def resolve_auto(
    vision: VisionConfig, budget: BudgetConfig, *, set_threads: bool = False
) -> tuple[VisionConfig, str]:
    """Replaces ``auto`` in a configuration. Measures the candidates that this machine has not measured yet.

    Args:
        vision: A configuration with ``auto`` as its checkpoint, its engine or both.
        budget: Limits that the choice must keep.
        set_threads: See `candidates`.

    Returns:
        The configuration without ``auto``, and a sentence about the choice.

    Raises:
        ConfigError: No installed engine can run the network, or no candidate keeps the budget.
    """
    tested = candidates(vision, set_threads=set_threads)
    if not tested:
        raise ConfigError(
            f"no installed engine runs vision.checkpoint={vision.checkpoint} with vision.engine={vision.engine} and "
            f"vision.precision={vision.precision}; pip install 'gripper-force[engines]', or set other values"
        )
    choice, sentence = select(tested, budget)
    keys = ("checkpoint", "engine", "precision", "threads")
    return vision.model_copy(update={key: getattr(choice, key) for key in keys}), sentence


def select(tested: Sequence[EngineCandidate], budget: BudgetConfig) -> tuple[EngineCandidate, str]:
    """Returns the cheapest candidate within the budget, and a sentence about the choice.

    Without a budget it is the fastest of the most accurate.

    Raises:
        ConfigError: No candidate keeps the budget.
    """
    limits = f"budget.latency_ms={budget.latency_ms}, budget.error_n={budget.error_n}"
    allowed = [
        candidate
        for candidate in tested
        if (budget.latency_ms is None or candidate.p99_ms <= budget.latency_ms)
        and (budget.error_n is None or candidate.error_n <= budget.error_n)
    ]
    if not allowed:
        front = "; ".join(str(candidate) for candidate in pareto_front(tested))
        raise ConfigError(f"no network and engine keep {limits}; raise the budget, the best are: {front}")
    if budget.latency_ms is None and budget.error_n is None:
        choice = min(allowed, key=lambda candidate: (candidate.error_n, candidate.p50_ms))
        reason = "the fastest of the most accurate"
    else:
        choice = min(allowed, key=lambda candidate: candidate.cost_ms)
        reason = f"the cheapest that keeps {limits}"
    return choice, f"chose {choice} ({reason} of {len(tested)} candidates)"


def pareto_front(tested: Sequence[EngineCandidate]) -> list[EngineCandidate]:
    """Returns the candidates that no other beats in both time and error, by rising time."""
    front: list[EngineCandidate] = []
    for candidate in sorted(tested, key=lambda candidate: (candidate.p50_ms, candidate.error_n)):
        if not front or candidate.error_n < front[-1].error_n:
            front.append(candidate)
    return front


def candidates(vision: VisionConfig, *, set_threads: bool = False) -> list[EngineCandidate]:
    """Returns all candidates for a configuration with ``auto``, from the cache or measured now.

    Args:
        vision: The configuration.
        set_threads: Measures PyTorch with several thread counts. They are one setting of the whole process,
            which is restored afterwards. Otherwise PyTorch is measured with the present setting only.
    """
    cached = read_cache()
    result = []
    for model, engine, precision, threads in _settings(vision, set_threads):
        key = cache_key(model, engine, precision, threads)
        error_n = model.header.metrics.get("mae_n", float("inf"))
        if key not in cached:
            keeps_threads = engine == "torch" and not set_threads
            with _restored_threads(engine):
                opened = open_engine(model, engine, precision, None if keeps_threads else threads)
                p50_ms, p99_ms = step_times_ms(opened)
            cached[key] = EngineCandidate(_name(model), engine, precision, threads, p50_ms, p99_ms, error_n)
            if engine_version(engine):  # without a version, a measurement could outlive an update
                update_cache({key: cached[key]})
        # The file and its stated error can change without the digest, so they are not taken from the cache.
        result.append(replace(cached[key], checkpoint=_name(model), error_n=error_n))
    return result


def installed() -> list[str]:
    """Returns the built-in engines whose packages are installed."""
    return [engine for engine in ENGINES if engine_version(engine)]


def _settings(vision: VisionConfig, set_threads: bool) -> Iterator[tuple[Model, str, Precision, int]]:
    """Yields network, engine, precision and number of threads of each candidate."""
    sources = list(SHIPPED) if vision.checkpoint == "auto" else [vision.checkpoint]
    cores = os.cpu_count() or 1
    for source in sources:
        model = read_model(source)
        for engine in installed() if vision.engine == "auto" else [vision.engine]:
            if model.path.suffix in EXPORTED and engine != EXPORTED[model.path.suffix]:
                continue
            threads = [t for t in (1, 2, 4, 8) if t <= cores] if vision.engine == "auto" else [vision.threads]
            if engine == "torch" and not set_threads:
                with importing("vision.engine=torch"):
                    import torch
                threads = [torch.get_num_threads()]
            if vision.precision != "float32" and engine in ENGINES and engine != "openvino":
                continue
            for count in threads:
                yield model, engine, vision.precision, count


def _restored_threads(engine: str) -> AbstractContextManager[object]:
    if engine != "torch":
        return nullcontext()
    from gripper_force.vision.engines.pytorch import restored_threads

    return restored_threads()


def _name(model: Model) -> str:
    return next((name for name, path in SHIPPED.items() if path == model.path), str(model.path))
