"""Hard cases for the network: each engine and precision, and the estimator, compared with float64."""

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

import numpy as np
import torch

from gripper_force.config import Config, load_config
from gripper_force.control.object_gain import GATE
from gripper_force.errors import CheckpointError, GripperError, NonFiniteError
from gripper_force.jobs.dataset import Clip, load_clip
from gripper_force.jobs.simulate import SimulationPlan, make_log
from gripper_force.qualification.numerics import head_fit_cases
from gripper_force.qualification.numerics.adversarial_frames import REFERENCE, disturbed
from gripper_force.qualification.numerics.adversarial_networks import (
    HARD,
    KNOWN_N,
    STEEP,
    drawn,
    faint,
    outlier,
    overflow,
    saved,
    scaled,
)
from gripper_force.qualification.numerics.numerical_case import NumericalCase
from gripper_force.qualification.numerics.reference import (
    ENGINE_VARIANTS,
    EPS,
    ROUNDING,
    EngineVariant,
    Float64Result,
    ReferenceEnsemble,
)
from gripper_force.qualification.proc_files import memory_bytes
from gripper_force.runtime.perception import FrameProcessor
from gripper_force.types import NS_PER_MS, Frame, Gray, VisualForce
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines import Engine, Floats
from gripper_force.vision.estimator import ForceEstimator
from gripper_force.vision.export import TOLERANCE
from gripper_force.vision.header import RESIDUAL_HALF_N
from gripper_force.vision.model_files import read_model
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import DIFFERENCE_GAIN, FLAT_STD, Preprocess, downscale
from gripper_force.vision.stream_inference import prepared

STREAMED: Final = 1_000_000
"""Frames of the longest stream, through a small network: 4.6 hours at 60 Hz."""

_LEAK_MB: Final = 1.0
"""Allowed growth: one byte per frame of the longest stream."""

LONG: Final = 10_000
"""Frames of a stream through the configured network."""

_COMPARED: Final = 40
"""Frames of a grasp that are run in float64, which is slow: two windows, which include first contact."""

_PREPARED: Final = 8 * EPS
"""Rounding error of frame preparation, relative to the largest number: mean, deviation, quotient and
difference of two, and the gain."""


def cases(
    config: Config,
    _maps: Path | None,
    streamed: int = STREAMED,
    long: int = LONG,
    variants: Sequence[EngineVariant] = ENGINE_VARIANTS,
) -> Iterator[NumericalCase]:
    """Yields the cases of the network.

    Args:
        config: Checkpoint under test, and the claimed error above which estimates are rejected.
        streamed: Frames through a small network.
        long: Frames through the network of the checkpoint.
        variants: Engines and precisions; engines that are not installed are left out.

    Raises:
        CheckpointError: ``vision.checkpoint`` is none, or was exported.
    """
    variants = [variant for variant in variants if find_spec(variant.engine)]
    with TemporaryDirectory() as name:
        folder = Path(name)
        reference = ReferenceEnsemble(read_model(config.vision.checkpoint), folder)
        press, grasp = _recordings(folder, reference.model.header.preprocess, config.seed)
        yield from _engines(reference, variants, press, grasp)
        yield from _weights(folder, variants, grasp)
        yield from _refused(folder, variants, grasp)
        yield from _outlier_in_int8(folder, variants, press, grasp)
        yield _half(folder)
        yield from _not_finite(folder, variants, grasp)
        yield from _frames(reference, grasp, config)
        yield _range(folder, grasp, config)
        yield from _streams(folder, reference, variants, press, streamed, long)
        yield from head_fit_cases.cases()


# Inputs.


def _recordings(folder: Path, preprocess: Preprocess, seed: int) -> tuple[Clip, Clip]:
    """Returns a press and a grasp in the simulated rig."""
    tree = load_config(None, ["sim.detail=coarse"]).model_dump(mode="json")
    press, grasp = (
        load_clip(make_log(SimulationPlan(kind, "sponge", 990_001 + seed), folder, tree), preprocess, None)
        for kind in ("press", "grasp")
    )
    return press, grasp


def _contact(grasp: Clip, size: int) -> Gray:
    """Frames without contact at the start of a run, and those around first contact, (T, S, S)."""
    first = int(np.argmax(grasp.forces_n > 2.0)) - _COMPARED // 3
    frames = np.concatenate([grasp.frames[:REFERENCE], grasp.frames[first : first + _COMPARED - REFERENCE]])
    return np.stack([downscale(frame, None, size) for frame in frames])


def _inputs(reference: ReferenceEnsemble, grasp: Clip) -> Floats:
    preprocess = reference.model.header.preprocess
    return np.stack(list(prepared(_contact(grasp, preprocess.size), preprocess)))


def _run(engine: Engine, inputs: Floats) -> Float64Result:
    """Forces of each member over a stream in N, (M, T)."""
    engine.reset()
    return np.stack([engine.step(frame).forces_n for frame in inputs], axis=1).astype(np.float64)


def _row(case: str, detail: str, off_n: Float64Result, bound_n: Float64Result) -> NumericalCase:
    """Case of the member with the largest error relative to its bound."""
    worst = int(np.argmax(np.nan_to_num(off_n / bound_n, nan=np.inf)))
    return NumericalCase(case, f"{detail}; against float64", float(off_n[worst]), float(bound_n[worst]), "N")


# The configured network.


def _engines(
    reference: ReferenceEnsemble, variants: Sequence[EngineVariant], press: Clip, grasp: Clip
) -> Iterator[NumericalCase]:
    inputs = _inputs(reference, grasp)
    true_n = reference.forces_n(inputs)
    bounds_n = {
        name: reference.bound_n(inputs, ROUNDING[name])
        for name in dict.fromkeys(variant.precision for variant in variants)
    }
    for variant in variants:
        found_n = _run(reference.open(variant, [press.frames]), inputs)
        off_n = np.abs(found_n - true_n).max(1)
        yield _row(variant.name, "simulated grasp, configured network", off_n, bounds_n[variant.precision])
        if variant.precision == "int8":
            yield _export_error("int8, error that its export reports", reference, found_n, true_n)


def _export_error(
    case: str, reference: ReferenceEnsemble, found_n: Float64Result, true_n: Float64Result
) -> NumericalCase:
    off_n = np.abs(found_n.mean(0) - true_n.mean(0)).mean()
    detail = "mean error in a grasp; bound: largest error that the export reports for its calibration press"
    return NumericalCase(case, detail, float(off_n), reference.reported_n, "N")


# Weights.


def _weights(folder: Path, variants: Sequence[EngineVariant], grasp: Clip) -> Iterator[NumericalCase]:
    torch.manual_seed(0)
    # One ensemble of all networks needs only one export.
    kinds = [(name, kind) for name in HARD for kind in (("ssam", "scam") if "gates" in name else ("ssam",))]
    networks = [drawn(HARD[name], kind) for name, kind in kinds]
    reference = ReferenceEnsemble(saved(folder / "hard.safetensors", *networks), folder)
    inputs = _inputs(reference, grasp)
    true_n = reference.forces_n(inputs)
    found_n: dict[str, list[Float64Result]] = {}
    for variant in variants:
        if variant.precision != "int8":
            found_n.setdefault(variant.precision, []).append(_run(reference.open(variant), inputs))
    for precision, forces_n in found_n.items():
        off_n = np.max([np.abs(one_n - true_n).max(1) for one_n in forces_n], axis=0)
        bound_n = reference.bound_n(inputs, ROUNDING[precision])
        for name in HARD:
            own = [name == other for other, _ in kinds]
            if precision == "float32" or name not in STEEP:
                yield _row(f"{name}: {precision}", "small network, worst engine", off_n[own], bound_n[own])
        if precision != "float32":
            limit_n = np.array([_limit_n(network) for network in reference.networks])
            share = np.max([np.abs(one_n).max(1) / limit_n for one_n in forces_n])
            detail = "no correct digit left; largest output over the largest possible output"
            yield NumericalCase(
                f"all others: {precision}", detail, float(share), 1 + 2 * ROUNDING[precision].numbers
            )


def _limit_n(network: ForceNetwork) -> float:
    """Largest possible output of a network in N: the inputs of its last layer lie in -1..1."""
    total = network.out.weight.abs().sum() + network.out.bias.abs().sum()
    return float(total) * network.config.label_scale_n


def _refused(folder: Path, variants: Sequence[EngineVariant], grasp: Clip) -> Iterator[NumericalCase]:
    """Cases of networks beyond float32: an exported engine must refuse them, or compute them correctly."""
    extreme = {
        "recurrent weights x 100: rounding errors double with each frame": scaled(1e2, 1e2),
        "activations below 1e-38, then scaled up": faint,
        "weights that overflow": overflow,
    }
    for number, (name, change) in enumerate(extreme.items()):
        torch.manual_seed(0)
        network = drawn(change, "scam")
        reference = ReferenceEnsemble(saved(folder / f"extreme-{number}.safetensors", network), folder)
        inputs = _inputs(reference, grasp)
        true_n = reference.forces_n(inputs)
        worst_n, refusals = 0.0, 0
        others = [
            variant for variant in variants if variant.precision == "float32" and variant.engine != "torch"
        ]
        for variant in others:
            try:
                engine = reference.open(variant)
            except CheckpointError:
                refusals += 1
            else:
                worst_n = max(worst_n, float(np.abs(_run(engine, inputs) - true_n).max()))
        detail = f"refused by {refusals} of {len(others)} exports; error of the others, against float64"
        yield NumericalCase(
            name, detail, worst_n, TOLERANCE * reference.networks[0].config.label_scale_n, "N"
        )
        if change is overflow:
            yield NumericalCase(
                f"{name}: torch", "number of estimates", float(_estimates(reference, grasp)), 0.0
            )


def _estimates(reference: ReferenceEnsemble, grasp: Clip) -> int:
    """Number of estimates by PyTorch in a grasp."""
    estimator = ForceEstimator(reference.open(ENGINE_VARIANTS[0]))
    made = 0
    for frame in _contact(grasp, reference.model.header.preprocess.size):
        with suppress(NonFiniteError):
            made += estimator.update(frame) is not None
    return made


def _outlier_in_int8(
    folder: Path, variants: Sequence[EngineVariant], press: Clip, grasp: Clip
) -> Iterator[NumericalCase]:
    for variant in variants:
        if variant.precision == "int8":
            torch.manual_seed(0)
            reference = ReferenceEnsemble(saved(folder / "outlier.safetensors", drawn(outlier)), folder)
            inputs = _inputs(reference, grasp)
            clip = np.stack([downscale(frame, None, inputs.shape[1]) for frame in press.frames])
            found_n = _run(reference.open(variant, [clip]), inputs)
            yield _export_error("one channel x 1000: int8", reference, found_n, reference.forces_n(inputs))


def _half(folder: Path) -> NumericalCase:
    """Case of weights outside the range of half precision in a checkpoint."""
    worst = 0.0
    for factor in (1e7, 1e-7, 1e-38):
        network = drawn(scaled(factor))
        saved(folder / "half.safetensors", network)
        loaded = load_checkpoint(folder / "half.safetensors").networks[0].state_dict()
        for name, tensor in network.state_dict().items():
            if tensor.is_floating_point():
                off = (loaded[name].double() - tensor.double()).abs().max() / tensor.double().abs().max()
                worst = max(worst, float(off.nan_to_num(0.0)))
    detail = "saved and loaded; largest weight error over the largest weight of its layer"
    return NumericalCase("weights x 10^7, 10^-7 and 10^-38 in a checkpoint", detail, worst, 2.0**-11)


# Frames.


def _not_finite(folder: Path, variants: Sequence[EngineVariant], grasp: Clip) -> Iterator[NumericalCase]:
    torch.manual_seed(0)
    reference = ReferenceEnsemble(saved(folder / "drawn.safetensors", drawn(HARD["random weights"])), folder)
    inputs = _inputs(reference, grasp)
    bad_frames = [np.array(inputs[0]) for _ in range(3)]
    for frame, value in zip(bad_frames, (math.nan, math.inf, -math.inf), strict=True):
        frame[3, 4] = value
    accepted, changed, longest = 0, 0.0, 0
    for variant in variants:
        if variant.precision == "int8":
            continue
        engine = reference.open(variant)
        expected_n = _run(engine, inputs)
        engine.reset()
        found_n = []
        for number, frame in enumerate(inputs):
            accepted += _accepts(engine, bad_frames[number % 3])
            found_n.append(engine.step(frame).forces_n)
        changed = max(changed, float(np.abs(np.stack(found_n, axis=1) - expected_n).max()))
        engine.reset()
        engine.step(np.full_like(inputs[0], 3e38))
        after_n = np.stack([engine.step(frame).forces_n for frame in inputs], axis=1)
        longest = max(longest, int(np.flatnonzero((after_n != expected_n).any(0)).max(initial=-1)) + 1)
    yield NumericalCase(
        "frames of NaN and infinity",
        "one before each frame, all engines; number accepted",
        float(accepted),
        0.0,
    )
    yield NumericalCase(
        "estimates after frames of NaN and infinity", "difference to a stream without them", changed, 0.0, "N"
    )
    context = float(reference.networks[0].config.context)
    detail = "all engines; frames until the estimates equal those without it"
    yield NumericalCase("a frame of 3e38, which overflows", detail, float(longest), context, "frames")


def _accepts(engine: Engine, frame: Floats) -> bool:
    try:
        engine.step(frame)
    except NonFiniteError:
        return False
    return True


def _frames(reference: ReferenceEnsemble, grasp: Clip, config: Config) -> Iterator[NumericalCase]:
    """Cases of disturbed frames: the estimator flags them, or is as close to float64 as rounding allows."""
    preprocess = reference.model.header.preprocess
    clip = _contact(grasp, preprocess.size)
    inputs = _prepare_float64(clip, preprocess)
    off = _PREPARED * float(np.abs(inputs).max())
    bound_n = float(reference.bound_n(inputs, ROUNDING["float32"], off).mean())
    engine = reference.open(ENGINE_VARIANTS[0])
    forces_n: dict[bytes, Float64Result] = {}
    undisturbed: list[_Processed] = []
    largest, largest_case = 0.0, ""
    for name, frames in disturbed(clip, config.seed).items():
        processed = _process(engine, frames, config.control.vision_std_n)
        # Most cases accept the same frames, and float64 is slow.
        accepted = np.stack([frame for frame, one in zip(frames, processed, strict=True) if one.accepted])
        if accepted.tobytes() not in forces_n:
            forces_n[accepted.tobytes()] = reference.forces_n(_prepare_float64(accepted, preprocess)).mean(0)
        true_n = forces_n[accepted.tobytes()]
        found = zip((one.visual for one in processed if one.accepted), true_n.tolist(), strict=True)
        worst_n = max((abs(one.force_n - force_n) for one, force_n in found if one), default=0.0)
        flagged = len(frames) - preprocess.lead_in - sum(one.visual is not None for one in processed)
        detail = f"{flagged} of {len(frames)} flagged; error of the others, against float64"
        yield NumericalCase(name, detail, worst_n, bound_n, "N")
        undisturbed = undisturbed or processed
        for one, before in zip(processed, undisturbed, strict=False):
            if len(processed) == len(undisturbed) and one.visual and before.visual:
                off = abs(one.visual.force_n - before.visual.force_n) / one.visual.std_n
                largest, largest_case = max((largest, largest_case), (off, name))
    detail = f"largest difference to the undisturbed grasp ({largest_case}), over the claimed error"
    yield NumericalCase("effect of disturbed frames on a grasp", detail, largest, GATE)
    started = sum(_starts(engine, np.full_like(clip, level)) for level in (0, 128, 255))
    yield NumericalCase(
        "black, gray or white frames from the start", "number of runs that start", float(started), 0.0
    )


class _Processed(NamedTuple):
    """Result of a frame: accepted by the network or not, and the estimate if it is used."""

    accepted: bool
    visual: VisualForce | None


def _process(engine: Engine, frames: Sequence[Gray], limit_n: float) -> list[_Processed]:
    """Processes frames, one every 16 ms; estimates with a claimed error over ``limit_n`` are not used."""
    processor = FrameProcessor(ForceEstimator(engine))
    result = []
    for number, gray in enumerate(frames):
        t_ns = number * 16 * NS_PER_MS
        processed = processor.process(Frame(t_ns, t_ns, number, gray))
        used = processed.visual is not None and processed.visual.std_n <= limit_n
        result.append(_Processed(not processed.problem, processed.visual if used else None))
    return result


def _starts(engine: Engine, frames: Gray) -> bool:
    try:
        _process(engine, list(frames), math.inf)
    except GripperError:
        return False
    return True


def _prepare_float64(clip: Gray, preprocess: Preprocess) -> Float64Result:
    """Prepared frames as by `stream_inference.prepared`, in float64, (T, S, S)."""
    frames = clip.astype(np.float64)
    deviation = np.maximum(frames.std((1, 2), keepdims=True), FLAT_STD)
    standard: Float64Result = (frames - frames.mean((1, 2), keepdims=True)) / deviation
    if preprocess.reference:
        standard = DIFFERENCE_GAIN * (standard - standard[: preprocess.reference_frames].mean(0))
    return np.abs(standard) if preprocess.magnitude else standard


def _range(folder: Path, grasp: Clip, config: Config) -> NumericalCase:
    """Case of far too large outputs: estimates used beyond the validated range of forces."""
    limit_n = config.control.vision_std_n
    total, used, beyond_n = 0, 0, 0.0
    for factor in (1.0, 10.0, 1e3, 1e6):
        for sign in (-1.0, 1.0):
            torch.manual_seed(0)
            network = drawn(HARD["random weights"])
            network.out.weight.mul_(sign * factor)
            network.out.bias.zero_()
            reference = ReferenceEnsemble(saved(folder / "range.safetensors", network), folder)
            frames = list(_contact(grasp, network.config.size))
            forces_n = [
                one.visual.force_n
                for one in _process(reference.open(ENGINE_VARIANTS[0]), frames, limit_n)
                if one.visual
            ]
            total += len(frames) - reference.model.header.preprocess.lead_in
            used += len(forces_n)
            min_n, max_n = KNOWN_N[0] - RESIDUAL_HALF_N, KNOWN_N[1] + RESIDUAL_HALF_N
            beyond_n = max([beyond_n, *(max(min_n - f, f - max_n) for f in forces_n)])
    detail = (
        f"{total - used} of {total} estimates flagged; largest excess of the others over the validated range"
    )
    return NumericalCase("last layers x 1 to 10^6", detail, beyond_n, limit_n, "N")


# Streams.


def _streams(
    folder: Path,
    reference: ReferenceEnsemble,
    variants: Sequence[EngineVariant],
    press: Clip,
    streamed: int,
    long: int,
) -> Iterator[NumericalCase]:
    # The fastest installed engine in float32.
    names = {variant.engine: variant for variant in variants if variant.precision == "float32"}
    variant = names.get("openvino", ENGINE_VARIANTS[0])
    torch.manual_seed(0)
    small = ReferenceEnsemble(
        saved(folder / "small.safetensors", drawn(HARD["random weights"], size=16)), folder
    )
    noise = np.random.default_rng(0).standard_normal((997, 16, 16)).astype(np.float32)
    detail = f"{variant.name}; difference to a stream started one window earlier, checked ten times"
    drift_n, grown_mb, last_n, last = _stream(small, variant, noise, streamed)
    bound_n = small.bound_n(last, ROUNDING["float32"])
    yield NumericalCase(f"{streamed} frames, small network", detail, drift_n, float(bound_n.max()), "N")
    off_n = np.abs(last_n - small.forces_n(last)[:, -1])
    yield _row(f"last of {streamed} frames", variant.name, off_n, bound_n)
    yield NumericalCase(
        f"memory over {streamed} frames", "growth after the first tenth", grown_mb, _LEAK_MB, "MB"
    )
    drift_n, _, _, last = _stream(
        reference, variant, np.stack(list(prepared(press.frames, reference.model.header.preprocess))), long
    )
    bound_n = reference.bound_n(last, ROUNDING["float32"])
    yield NumericalCase(f"{long} frames, configured network", detail, drift_n, float(bound_n.max()), "N")


def _stream(
    reference: ReferenceEnsemble, variant: EngineVariant, pool: Floats, frames: int
) -> tuple[float, float, Float64Result, Floats]:
    """Streams the frames of a pool repeatedly.

    Returns:
        Largest difference to a stream started one window earlier, in N; growth of memory in MB; last forces,
        (M,); and the inputs that these depend on, (T, S, S).
    """
    engine, fresh = reference.open(variant), reference.open(variant)
    context = max(network.config.context for network in reference.networks)
    drift_n, begin_mb = 0.0, 0.0
    for number in range(frames):
        forces_n = engine.step(pool[number % len(pool)]).forces_n
        if (number + 1) % (frames // 10) == 0 and number >= context:
            window = pool[np.arange(number - context, number + 1) % len(pool)]
            fresh_n = _run(fresh, window)[:, -1]
            drift_n = max(drift_n, float(np.abs(forces_n - fresh_n).max()))
            begin_mb = begin_mb or _resident_mb()
    return drift_n, max(_resident_mb() - begin_mb, 0.0), forces_n.astype(np.float64), window


def _resident_mb() -> float:
    return memory_bytes()[1] / 2**20
