"""Speed and error of the visual estimate: every model, engine, precision and number of threads.

All variants alternate, a few steps each, so that their ratios are valid on a busy machine. They include the
paper's method, which processes the whole window for each frame.
"""

import json
import logging
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, TypedDict, get_args

import numpy as np
import torch

from gripper_force.errors import ConfigError
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.int8_export import export_int8
from gripper_force.progress import Progress
from gripper_force.qualification.bench.roofline import Roofline, measure
from gripper_force.qualification.proc_files import process_text
from gripper_force.types import NS_PER_MS
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines import Engine, Floats, Precision, open_engine
from gripper_force.vision.header import Model, NetworkConfig
from gripper_force.vision.model_files import cache_folder, read_model
from gripper_force.vision.selection import installed
from gripper_force.vision.step_benchmark import EngineCandidate, cache_key, update_cache
from gripper_force.vision.stream_inference import prepared, stream

WINDOW: Final = "torch, window"
"""The paper's method: for each frame, the network processes the whole window before it."""

PLAIN_WINDOW: Final = "torch, window, plain"
"""The same with channels first, PyTorch's default layout; ours is channels last."""

_ROUNDS: Final = 40
"""Rounds in which each variant has its turn."""

_STEPS: Final = 15
"""Steps of each variant in a round."""

_WINDOWS: Final = 2
"""Windows in a round; a window takes a hundred times as long as a step."""

_MEMORY: Final = """
import sys
import numpy as np
from gripper_force.vision.engines import open_engine
from gripper_force.vision.model_files import read_model
source, engine, precision, threads = sys.argv[1:]
opened = open_engine(read_model(source), engine, precision, int(threads))
size = opened.header.preprocess.size
for _ in range(30):
    opened.step(np.zeros((size, size), np.float32))
status = open("/proc/self/status").read()
print(int(status.split("VmHWM:")[1].split()[0]) / 1024)
"""
"""Program that prints the peak memory in MB of a process that only computes estimates."""


@dataclass(frozen=True, slots=True)
class EstimatorCost:
    """Cost and error of one variant.

    Attributes:
        checkpoint: Name or path.
        members: Networks of the ensemble.
        size: Side of the input in pixels.
        engine: As ``vision.engine``, or `WINDOW` or `PLAIN_WINDOW`.
        precision: float32, bfloat16, or int8 (convolutions in int8, the rest in bfloat16).
        threads: CPU threads.
        p50_ms: Median time of a frame.
        p99_ms: 99th percentile of that time.
        frames_s: Frames per second, one after the other.
        least_ms: Roofline of this machine for this network and precision; None for windows.
        memory_mb: Peak memory of a process that computes nothing else; None if not measured.
        mae_n: Mean absolute error on the held-out frames.
        rmse_n: Root mean squared error.
        worst_n: Largest error.
        frames: Number of held-out frames.
        front: True if no other variant is both faster and more accurate.
    """

    checkpoint: str
    members: int
    size: int
    engine: str
    precision: str
    threads: int
    p50_ms: float
    p99_ms: float
    frames_s: float
    least_ms: float | None
    memory_mb: float | None
    mae_n: float
    rmse_n: float
    worst_n: float
    frames: int
    front: bool = False


@dataclass
class _Timed:
    """A variant that alternates with others, and its step times so far."""

    step: Callable[[Floats], object]
    taken_ns: list[int]


def bench(
    sources: Sequence[str],
    held_out: Callable[[Model], Sequence[Clip]],
    scaling: Callable[[Model], Sequence[Clip]],
    threads: Sequence[int],
    progress: Progress,
) -> list[EstimatorCost]:
    """Measures every variant of each checkpoint that this machine can run.

    Args:
        sources: Checkpoints, by name or path.
        held_out: Loads recordings that were not in the training data, at the model's size.
        scaling: Loads other recordings, to calibrate int8 on.
        threads: Numbers of CPU threads.
        progress: Called after each of `count_steps` measurements.

    Raises:
        ConfigError: A package is not installed, or an engine fails in a separate process.
        CheckpointError: A checkpoint can't be read.
        DataError: There are too few recordings.
    """
    logging.getLogger("nncf").setLevel(logging.ERROR)
    roofs = {(p, t): measure(p, t) for p in ("float32", "bfloat16", "int8") for t in threads}
    progress("roofline")
    rows: list[EstimatorCost] = []
    for source in sources:
        model = read_model(source)
        clips = held_out(model)
        int8_path = cache_folder() / f"{model.digest[:32]}-int8.xml"
        export_int8(model, int8_path, [clip.frames for clip in scaling(model)])
        progress(f"{source}: int8")
        variants = [(model, *variant) for variant in _variants()]
        variants += [(read_model(int8_path), "openvino", "int8", "bfloat16")]
        for each in _measure(source, model, variants, clips, threads, roofs, progress):
            rows.append(each)
    return _with_front(rows)


def count_steps(sources: Sequence[str], threads: Sequence[int]) -> int:
    """Number of measurements of `bench`, for its progress."""
    return 1 + len(sources) * (1 + len(_variants()) + 1 + len(threads))  # rooflines, int8, errors, times


def _variants() -> list[tuple[str, str, Precision]]:
    """Engine, name of the precision, and precision setting of each variant."""
    variants: list[tuple[str, str, Precision]] = []
    for engine in installed():
        for precision in get_args(Precision):
            if precision == "float32" or engine == "openvino":
                variants.append((engine, precision, precision))
    return variants


def _measure(
    source: str,
    model: Model,
    variants: Sequence[tuple[Model, str, str, Precision]],
    clips: Sequence[Clip],
    threads: Sequence[int],
    roofs: dict[tuple[str, int], Roofline],
    progress: Progress,
) -> Iterator[EstimatorCost]:
    errors: dict[tuple[str, str], dict[str, float]] = {}
    frames = list(prepared(clips[0].frames, model.header.preprocess))
    networks = [member for member in model.header.members if isinstance(member, NetworkConfig)]
    for count in threads:
        engines = {}
        for file, engine, name, precision in variants:
            engines[engine, name] = open_engine(file, engine, precision, count)
            if (engine, name) not in errors:
                errors[engine, name] = _errors(engines[engine, name], model, clips)
                progress(f"{source}: {engine}, {name}: {errors[engine, name]['mae_n']:.3f} N")
        for window in (WINDOW, PLAIN_WINDOW):
            errors[window, "float32"] = errors["torch", "float32"]
        taken = _in_turns(
            {variant: _Timed(engine.step, []) for variant, engine in engines.items()}, model, frames
        )
        progress(f"{source}: {count} threads")
        for (engine, name), taken_ns in taken.items():
            p50_ms, p99_ms = np.percentile(taken_ns, [50, 99]) / NS_PER_MS
            row = EstimatorCost(
                checkpoint=source,
                members=len(model.header.members),
                size=model.header.preprocess.size,
                engine=engine,
                precision=name,
                threads=count,
                p50_ms=float(p50_ms),
                p99_ms=float(p99_ms),
                frames_s=1e9 / float(np.mean(taken_ns)),
                least_ms=None,
                memory_mb=None,
                mae_n=errors[engine, name]["mae_n"],
                rmse_n=errors[engine, name]["rmse_n"],
                worst_n=errors[engine, name]["worst_n"],
                frames=int(errors[engine, name]["frames"]),
            )
            if not engine.startswith(WINDOW):
                file, precision = next((f, p) for f, e, n, p in variants if (e, n) == (engine, name))
                least_ms = roofs[name, count].least_ms(networks)
                row = replace(row, least_ms=least_ms, memory_mb=_memory_mb(file, engine, precision, count))
                candidate = EngineCandidate(
                    source, engine, precision, count, row.p50_ms, row.p99_ms, row.mae_n
                )
                if file is model:
                    update_cache({cache_key(model, engine, precision, count): candidate})
            yield row


def _errors(engine: Engine, model: Model, clips: Sequence[Clip]) -> dict[str, float]:
    """Errors over all labelled frames, streamed as in a run."""
    estimates, measured = [], []
    for clip in clips:
        engine.reset()
        forces_n = np.array([step.forces_n.mean() for step in stream(engine, clip.frames)])
        use = clip.labelled(model.header.preprocess.lead_in)
        estimates.append(forces_n[use])
        measured.append(clip.forces_n[use])
    engine.reset()
    estimated_n, measured_n = np.concatenate(estimates), np.concatenate(measured)
    return {
        "mae_n": metrics.mae(estimated_n, measured_n),
        "rmse_n": metrics.rmse(estimated_n, measured_n),
        "worst_n": float(np.abs(estimated_n - measured_n).max()),
        "frames": len(measured_n),
    }


@torch.inference_mode()
def _in_turns(
    timed: dict[tuple[str, str], _Timed], model: Model, frames: Sequence[Floats]
) -> dict[tuple[str, str], list[int]]:
    networks = load_checkpoint(model.path).force_networks
    context = max(member.context for member in model.header.members)
    clip = torch.from_numpy(np.stack(frames[: context + 1]))[None, :, None]  # (1, T, 1, S, S)
    plain = [
        deepcopy(network).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        for network in networks
    ]
    windows = {
        WINDOW: _Timed(lambda _: [network(clip, clip.shape[1] - 1) for network in networks], []),
        PLAIN_WINDOW: _Timed(lambda _: [network(clip, clip.shape[1] - 1) for network in plain], []),
    }
    for turn in range(_ROUNDS + 1):
        for variant in timed.values():
            _time_steps(variant, frames, _STEPS, keep=turn > 0)
        if turn % 4 == 0:
            for window in windows.values():
                _time_steps(window, frames, _WINDOWS, keep=turn > 0)
    taken_ns = {(name, "float32"): window.taken_ns for name, window in windows.items()}
    return taken_ns | {name: variant.taken_ns for name, variant in timed.items()}


def _time_steps(variant: _Timed, frames: Sequence[Floats], steps: int, *, keep: bool) -> None:
    for i in range(steps):
        begin_ns = time.perf_counter_ns()
        variant.step(frames[i % len(frames)])
        taken_ns = time.perf_counter_ns() - begin_ns
        if keep:
            variant.taken_ns.append(taken_ns)


def _memory_mb(model: Model, engine: str, precision: str, threads: int) -> float:
    process_text("status")  # which the process reads
    done = subprocess.run(
        [sys.executable, "-c", _MEMORY, str(model.path), engine, precision, str(threads)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise ConfigError(f"{engine} fails in a separate process: {done.stderr.strip()[-300:]}")
    return float(done.stdout.split()[-1])


def _with_front(rows: Sequence[EstimatorCost]) -> list[EstimatorCost]:
    """Marks the Pareto front of time and error."""

    def dominated(row: EstimatorCost) -> bool:
        return any(
            other.p50_ms <= row.p50_ms
            and other.mae_n <= row.mae_n
            and (other.p50_ms, other.mae_n) != (row.p50_ms, row.mae_n)
            for other in rows
        )

    return [replace(row, front=not dominated(row)) for row in rows]


def write_json(path: Path, rows: Sequence[EstimatorCost]) -> None:
    """Writes the results, and the machine they were measured on."""
    machine = {
        "machine": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({**machine, "estimator": [asdict(row) for row in rows]}, indent=1)
    path.write_text(text, encoding="utf-8")


def draw(path: Path, rows: Sequence[EstimatorCost]) -> None:
    """Plots error over time, with the Pareto front."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from gripper_force.jobs.report.figure import STYLE

    path.parent.mkdir(parents=True, exist_ok=True)
    kinds = list(dict.fromkeys((row.engine, row.precision) for row in rows))
    markers = dict(zip(dict.fromkeys(row.checkpoint for row in rows), "osD^vP*X", strict=False))
    with rc_context(STYLE):
        figure = Figure(figsize=(8.0, 4.6), layout="constrained")
        axes = figure.subplots()
        for i, (engine, precision) in enumerate(kinds):
            of_kind = [row for row in rows if (row.engine, row.precision) == (engine, precision)]
            for row in of_kind:
                axes.plot(
                    row.p50_ms,
                    row.mae_n,
                    markers[row.checkpoint],
                    color=f"C{i}",
                    markerfacecolor=f"C{i}" if row.threads > 1 else "white",
                    label=f"{engine}, {precision}" if row is of_kind[0] else None,
                )
        front = sorted((row for row in rows if row.front), key=lambda row: row.p50_ms)
        axes.plot([r.p50_ms for r in front], [r.mae_n for r in front], ":", color="0.4", label="front")
        for name, marker in markers.items():
            axes.plot([], [], marker, color="0.4", label=Path(name).stem)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
        axes.set_xlabel("median time per frame, ms (filled: more than one thread)")
        axes.set_ylabel("mean absolute error, N")
        axes.legend(loc="lower left", bbox_to_anchor=(1.0, 0.0), fontsize=8)
        figure.savefig(path, dpi=130)


def markdown(rows: Sequence[EstimatorCost]) -> str:
    """Markdown table of the results."""
    lines = [
        "| checkpoint | networks, px | engine | precision | threads | p50, p99 ms | over roofline "
        "| MAE, RMSE, worst N | MB | front |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        share = "–" if row.least_ms is None else f"{row.p50_ms / row.least_ms:.1f}"
        memory = "–" if row.memory_mb is None else f"{row.memory_mb:.0f}"
        errors = f"{row.mae_n:.3f}, {row.rmse_n:.3f}, {row.worst_n:.2f}"
        lines.append(
            f"| {Path(row.checkpoint).stem} | {row.members}, {row.size} | {row.engine} | {row.precision} "
            f"| {row.threads} | {row.p50_ms:.2f}, {row.p99_ms:.2f} | {share} "
            f"| {errors} | {memory} | {'x' if row.front else ''} |"
        )
    return "\n".join(lines) + "\n"


class Ratio(TypedDict):
    """The fastest accurate variant of a checkpoint, compared with whole windows.

    Attributes:
        fastest: Engine, precision and threads of the variant.
        p50_ms: Its median time.
        p99_ms: Its 99th percentile.
        times_faster_than_window: Median time of `WINDOW` over that of the variant.
        times_faster_than_plain_window: Median time of `PLAIN_WINDOW` over that of the variant.
        mae_over_float32: Error of the variant over that of float32.
    """

    fastest: str
    p50_ms: float
    p99_ms: float
    times_faster_than_window: float
    times_faster_than_plain_window: float
    mae_over_float32: float


Ratios = dict[str, Ratio]
"""Ratio by checkpoint."""


def ratios(rows: Sequence[EstimatorCost]) -> Ratios:
    """Compares the fastest accurate variant of each checkpoint with whole windows, each at its best threads.

    Accurate means an error of at most 1.02 times that of float32.
    """
    result: Ratios = {}
    for source in dict.fromkeys(row.checkpoint for row in rows):
        own = [row for row in rows if row.checkpoint == source]
        window, plain = (
            min((row for row in own if row.engine == name), key=lambda row: row.p50_ms)
            for name in (WINDOW, PLAIN_WINDOW)
        )
        accurate = [
            row for row in own if not row.engine.startswith(WINDOW) and row.mae_n <= 1.02 * window.mae_n
        ]
        best = min(accurate, key=lambda row: row.p50_ms)
        result[source] = {
            "fastest": f"{best.engine}, {best.precision}, {best.threads} threads",
            "p50_ms": best.p50_ms,
            "p99_ms": best.p99_ms,
            "times_faster_than_window": window.p50_ms / best.p50_ms,
            "times_faster_than_plain_window": plain.p50_ms / best.p50_ms,
            "mae_over_float32": best.mae_n / window.mae_n,
        }
    return result
