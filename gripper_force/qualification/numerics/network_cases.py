"""Hard cases for the network: each engine and precision, and the estimator, against float64."""

import math
import resource
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

import numpy as np
import torch

from gripper_force.config import Config, load_config
from gripper_force.control import fusion
from gripper_force.errors import CheckpointError, GripperError, NonFiniteError
from gripper_force.jobs.dataset import Clip, load_clip
from gripper_force.jobs.simulate import Plan, make_log
from gripper_force.qualification.numerics import head_fit_cases as head_fit
from gripper_force.qualification.numerics.adversarial_frames import REFERENCE, spoiled
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
from gripper_force.qualification.numerics.reference import EPS, ROUNDING, WAYS, Exact, Twin, Way
from gripper_force.qualification.numerics.suite import Row
from gripper_force.runtime.perception import Sight
from gripper_force.types import NS_PER_MS, Frame, Gray, VisualForce
from gripper_force.vision.checkpoint import load_checkpoint
from gripper_force.vision.engines import Engine, Floats
from gripper_force.vision.estimator import ForceEstimator
from gripper_force.vision.export import TOLERANCE, inputs_of
from gripper_force.vision.header import RESIDUAL_HALF_N
from gripper_force.vision.model_files import read_model
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import DIFFERENCE_GAIN, FLAT_STD, Preprocess, shrink

STREAMED: Final = 1_000_000
"""Frames of the longest stream, through a small network: 4.6 hours at 60 Hz."""

_LEAK_MB: Final = 1.0
"""A byte a frame of the longest stream."""

LONG: Final = 10_000
"""Frames of a stream through the network that is tested."""

_COMPARED: Final = 40
"""Frames of a grasp that are run in float64, which is slow: two windows, with the first contact in them."""

_PREPARED: Final = 8 * EPS
"""What preparing a frame rounds away of its largest number: mean, deviation, quotient and difference of two,
and the gain."""


def cases(
    config: Config, _maps: Path | None, streamed: int = STREAMED, long: int = LONG, ways: Sequence[Way] = WAYS
) -> Iterator[Row]:
    """Rows of the network.

    Args:
        config: Whose checkpoint is tested, and from which claimed error on estimates do not count.
        streamed: Frames through a small network.
        long: Frames through that of the checkpoint.
        ways: Engines and precisions; what is not installed is left out.

    Raises:
        CheckpointError: ``vision.checkpoint`` is none, or was exported.
    """
    ways = [way for way in ways if find_spec(way.engine)]
    with TemporaryDirectory() as name:
        folder = Path(name)
        twin = Twin(read_model(config.vision.checkpoint), folder)
        press, grasp = _recordings(folder, twin.model.header.preprocess, config.seed)
        yield from _engines(twin, ways, press, grasp)
        yield from _weights(folder, ways, grasp)
        yield from _refused(folder, ways, grasp)
        yield from _outlier_in_int8(folder, ways, press, grasp)
        yield _half(folder)
        yield from _not_finite(folder, ways, grasp)
        yield from _frames(twin, grasp, config)
        yield _range(folder, grasp, config)
        yield from _streams(folder, twin, ways, press, streamed, long)
        yield from head_fit.cases()


# What goes in.


def _recordings(folder: Path, preprocess: Preprocess, seed: int) -> tuple[Clip, Clip]:
    """A press and a grasp in the simulated rig."""
    tree = load_config(None, ["sim.detail=coarse"]).model_dump(mode="json")
    press, grasp = (
        load_clip(make_log(Plan(kind, "sponge", 990_001 + seed), folder, tree), preprocess, None)
        for kind in ("press", "grasp")
    )
    return press, grasp


def _contact(grasp: Clip, size: int) -> Gray:
    """The frames of no contact that a run begins with, and those in which contact begins."""
    first = int(np.argmax(grasp.forces_n > 2.0)) - _COMPARED // 3
    frames = np.concatenate([grasp.frames[:REFERENCE], grasp.frames[first : first + _COMPARED - REFERENCE]])
    return np.stack([shrink(frame, None, size) for frame in frames])


def _inputs(twin: Twin, grasp: Clip) -> Floats:
    return np.stack(list(inputs_of(twin.model, _contact(grasp, twin.model.header.preprocess.size))))


def _run(engine: Engine, inputs: Floats) -> Exact:
    """Each member's forces over a stream, (M, T)."""
    engine.reset()
    return np.stack([engine.step(frame).forces_n for frame in inputs], axis=1).astype(np.float64)


def _row(case: str, detail: str, off_n: Exact, bound_n: Exact) -> Row:
    """The member that comes nearest to its bound, or is farthest beyond."""
    worst = int(np.argmax(np.nan_to_num(off_n / bound_n, nan=np.inf)))
    return Row(case, f"{detail}; against float64", float(off_n[worst]), float(bound_n[worst]), "N")


# The network that is tested.


def _engines(twin: Twin, ways: Sequence[Way], press: Clip, grasp: Clip) -> Iterator[Row]:
    inputs = _inputs(twin, grasp)
    true_n = twin.forces_n(inputs)
    bounds_n = {
        name: twin.bound_n(inputs, ROUNDING[name]) for name in dict.fromkeys(way.precision for way in ways)
    }
    for way in ways:
        found_n = _run(twin.open(way, [press.frames]), inputs)
        off_n = np.abs(found_n - true_n).max(1)
        yield _row(way.name, "a simulated grasp, the network as it is", off_n, bounds_n[way.precision])
        if way.precision == "int8":
            yield _as_said("int8, what its export says", twin, found_n, true_n)


def _as_said(case: str, twin: Twin, found_n: Exact, true_n: Exact) -> Row:
    off_n = np.abs(found_n.mean(0) - true_n.mean(0)).mean()
    detail = "mean error in a grasp; the largest that the export said, of the press that it was scaled on"
    return Row(case, detail, float(off_n), twin.said_n, "N")


# Weights.


def _weights(folder: Path, ways: Sequence[Way], grasp: Clip) -> Iterator[Row]:
    torch.manual_seed(0)
    # All in one ensemble: one export serves them all.
    kinds = [(name, kind) for name in HARD for kind in (("ssam", "scam") if "gates" in name else ("ssam",))]
    networks = [drawn(HARD[name], kind) for name, kind in kinds]
    twin = Twin(saved(folder / "hard.safetensors", *networks), folder)
    inputs = _inputs(twin, grasp)
    true_n = twin.forces_n(inputs)
    found_n: dict[str, list[Exact]] = {}
    for way in ways:
        if way.precision != "int8":
            found_n.setdefault(way.precision, []).append(_run(twin.open(way), inputs))
    for precision, forces_n in found_n.items():
        off_n = np.max([np.abs(one_n - true_n).max(1) for one_n in forces_n], axis=0)
        bound_n = twin.bound_n(inputs, ROUNDING[precision])
        for name in HARD:
            own = [name == other for other, _ in kinds]
            if precision == "float32" or name not in STEEP:
                yield _row(
                    f"{name}: {precision}", "a small network, the worst engine", off_n[own], bound_n[own]
                )
        if precision != "float32":
            reach_n = np.array([_reach_n(network) for network in twin.networks])
            share = np.max([np.abs(one_n).max(1) / reach_n for one_n in forces_n])
            detail = "no digit is left; of the most that the last layers can say"
            yield Row(f"all others: {precision}", detail, float(share), 1 + 2 * ROUNDING[precision].numbers)


def _reach_n(network: ForceNetwork) -> float:
    """The most that a last layer can say: what goes into it lies in -1..1."""
    total = network.out.weight.abs().sum() + network.out.bias.abs().sum()
    return float(total) * network.config.label_scale_n


def _refused(folder: Path, ways: Sequence[Way], grasp: Clip) -> Iterator[Row]:
    """Networks that nobody can compute: an engine other than PyTorch refuses them, or computes them."""
    hopeless = {
        "recurrence x 100: each rounding doubles with each frame": scaled(1e2, 1e2),
        "activations below 1e-38, made large again": faint,
        "weights that overflow": overflow,
    }
    for number, (name, change) in enumerate(hopeless.items()):
        torch.manual_seed(0)
        network = drawn(change, "scam")
        twin = Twin(saved(folder / f"hopeless-{number}.safetensors", network), folder)
        inputs = _inputs(twin, grasp)
        true_n = twin.forces_n(inputs)
        worst_n, refusals = 0.0, 0
        others = [way for way in ways if way.precision == "float32" and way.engine != "torch"]
        for way in others:
            try:
                engine = twin.open(way)
            except CheckpointError:
                refusals += 1
            else:
                worst_n = max(worst_n, float(np.abs(_run(engine, inputs) - true_n).max()))
        detail = f"refused by {refusals} of {len(others)} exports; error of the others, against float64"
        yield Row(name, detail, worst_n, TOLERANCE * twin.networks[0].config.label_scale_n, "N")
        if change is overflow:
            yield Row(f"{name}: torch", "estimates that came out", float(_estimates(twin, grasp)), 0.0)


def _estimates(twin: Twin, grasp: Clip) -> int:
    """How many estimates PyTorch makes of a grasp."""
    estimator = ForceEstimator(twin.open(WAYS[0]))
    made = 0
    for frame in _contact(grasp, twin.model.header.preprocess.size):
        with suppress(NonFiniteError):
            made += estimator.update(frame) is not None
    return made


def _outlier_in_int8(folder: Path, ways: Sequence[Way], press: Clip, grasp: Clip) -> Iterator[Row]:
    for way in ways:
        if way.precision == "int8":
            torch.manual_seed(0)
            twin = Twin(saved(folder / "outlier.safetensors", drawn(outlier)), folder)
            inputs = _inputs(twin, grasp)
            clip = np.stack([shrink(frame, None, inputs.shape[1]) for frame in press.frames])
            found_n = _run(twin.open(way, [clip]), inputs)
            yield _as_said("one channel x 1000: int8", twin, found_n, twin.forces_n(inputs))


def _half(folder: Path) -> Row:
    """Weights that half precision can't hold, in a checkpoint."""
    worst = 0.0
    for factor in (1e7, 1e-7, 1e-38):
        network = drawn(scaled(factor))
        saved(folder / "half.safetensors", network)
        loaded = load_checkpoint(folder / "half.safetensors").networks[0].state_dict()
        for name, tensor in network.state_dict().items():
            if tensor.is_floating_point():
                off = (loaded[name].double() - tensor.double()).abs().max() / tensor.double().abs().max()
                worst = max(worst, float(off.nan_to_num(0.0)))
    detail = "saved and loaded; the worst weight is off by this share of its layer's largest"
    return Row("weights x 10^7, 10^-7 and 10^-38 in a file", detail, worst, 2.0**-11)


# Frames.


def _not_finite(folder: Path, ways: Sequence[Way], grasp: Clip) -> Iterator[Row]:
    torch.manual_seed(0)
    twin = Twin(saved(folder / "drawn.safetensors", drawn(HARD["weights as drawn"])), folder)
    inputs = _inputs(twin, grasp)
    wilds = [np.array(inputs[0]) for _ in range(3)]
    for frame, wild in zip(wilds, (math.nan, math.inf, -math.inf), strict=True):
        frame[3, 4] = wild
    taken, changed, longest = 0, 0.0, 0
    for way in ways:
        if way.precision == "int8":
            continue
        engine = twin.open(way)
        expected_n = _run(engine, inputs)
        engine.reset()
        found_n = []
        for number, frame in enumerate(inputs):
            taken += _takes(engine, wilds[number % 3])
            found_n.append(engine.step(frame).forces_n)
        changed = max(changed, float(np.abs(np.stack(found_n, axis=1) - expected_n).max()))
        engine.reset()
        engine.step(np.full_like(inputs[0], 3e38))
        after_n = np.stack([engine.step(frame).forces_n for frame in inputs], axis=1)
        longest = max(longest, int(np.flatnonzero((after_n != expected_n).any(0)).max(initial=-1)) + 1)
    yield Row("frames of NaN and infinity", "before each frame, all engines; taken in", float(taken), 0.0)
    yield Row("what is seen after them", "off from a stream without them", changed, 0.0, "N")
    context = float(twin.networks[0].config.context)
    detail = "all engines; until all is as if it had not been"
    yield Row("a frame of 3e38, which overflows", detail, float(longest), context, "frames")


def _takes(engine: Engine, frame: Floats) -> bool:
    try:
        engine.step(frame)
    except NonFiniteError:
        return False
    return True


def _frames(twin: Twin, grasp: Clip, config: Config) -> Iterator[Row]:
    """The estimator, as a run uses it: flagged, or as near to float64 as rounding allows."""
    preprocess = twin.model.header.preprocess
    clip = _contact(grasp, preprocess.size)
    inputs = _exactly(clip, preprocess)
    off = _PREPARED * float(np.abs(inputs).max())
    bound_n = float(twin.bound_n(inputs, ROUNDING["float32"], off).mean())
    engine = twin.open(WAYS[0])
    forces_n: dict[bytes, Exact] = {}
    calm: list[_Seen] = []
    farthest, where = 0.0, ""
    for name, frames in spoiled(clip, config.seed).items():
        seen = _see(engine, frames, config.control.vision_std_n)
        # Most cases leave the same frames, and float64 is slow.
        taken = np.stack([frame for frame, one in zip(frames, seen, strict=True) if one.taken])
        if taken.tobytes() not in forces_n:
            forces_n[taken.tobytes()] = twin.forces_n(_exactly(taken, preprocess)).mean(0)
        true_n = forces_n[taken.tobytes()]
        found = zip((one.visual for one in seen if one.taken), true_n.tolist(), strict=True)
        worst_n = max((abs(one.force_n - force_n) for one, force_n in found if one), default=0.0)
        flagged = len(frames) - preprocess.lead_in - sum(one.visual is not None for one in seen)
        detail = f"{flagged} of {len(frames)} flagged; error of the others, against float64"
        yield Row(name, detail, worst_n, bound_n, "N")
        calm = calm or seen
        for one, before in zip(seen, calm, strict=False):
            if len(seen) == len(calm) and one.visual and before.visual:
                off = abs(one.visual.force_n - before.visual.force_n) / one.visual.std_n
                farthest, where = max((farthest, where), (off, name))
    detail = f"most that one of these is off from the undisturbed grasp ({where}), in claimed errors"
    yield Row("what disturbed frames do to a grasp", detail, farthest, fusion._GATE)
    begun = sum(_begins(engine, np.full_like(clip, level)) for level in (0, 128, 255))
    yield Row("black, gray or white from the first", "runs that begin", float(begun), 0.0)


class _Seen(NamedTuple):
    """Whether the network took a frame in, and the estimate that counts."""

    taken: bool
    visual: VisualForce | None


def _see(engine: Engine, frames: Sequence[Gray], limit_n: float) -> list[_Seen]:
    """What becomes of frames, one every 16 ms, where estimates with a larger claimed error do not count."""
    sight = Sight(ForceEstimator(engine))
    result = []
    for number, gray in enumerate(frames):
        t_ns = number * 16 * NS_PER_MS
        seen = sight.see(Frame(t_ns, t_ns, number, gray))
        counts = seen.visual is not None and seen.visual.std_n <= limit_n
        result.append(_Seen(not seen.problem, seen.visual if counts else None))
    return result


def _begins(engine: Engine, frames: Gray) -> bool:
    try:
        _see(engine, list(frames), math.inf)
    except GripperError:
        return False
    return True


def _exactly(clip: Gray, preprocess: Preprocess) -> Exact:
    """What `inputs_of` makes of a recording, in float64."""
    frames = clip.astype(np.float64)
    deviation = np.maximum(frames.std((1, 2), keepdims=True), FLAT_STD)
    standard: Exact = (frames - frames.mean((1, 2), keepdims=True)) / deviation
    if preprocess.reference:
        standard = DIFFERENCE_GAIN * (standard - standard[: preprocess.reference_frames].mean(0))
    return np.abs(standard) if preprocess.magnitude else standard


def _range(folder: Path, grasp: Clip, config: Config) -> Row:
    """Last layers that say far too much: what may count beyond the forces that validation knew."""
    limit_n = config.control.vision_std_n
    total, counted, beyond_n = 0, 0, 0.0
    for factor in (1.0, 10.0, 1e3, 1e6):
        for sign in (-1.0, 1.0):
            torch.manual_seed(0)
            network = drawn(HARD["weights as drawn"])
            network.out.weight.mul_(sign * factor)
            network.out.bias.zero_()
            twin = Twin(saved(folder / "range.safetensors", network), folder)
            frames = list(_contact(grasp, network.config.size))
            forces_n = [one.visual.force_n for one in _see(twin.open(WAYS[0]), frames, limit_n) if one.visual]
            total += len(frames) - twin.model.header.preprocess.lead_in
            counted += len(forces_n)
            least_n, most_n = KNOWN_N[0] - RESIDUAL_HALF_N, KNOWN_N[1] + RESIDUAL_HALF_N
            beyond_n = max([beyond_n, *(max(least_n - f, f - most_n) for f in forces_n)])
    detail = f"{total - counted} of {total} estimates flagged; the others beyond what validation knew"
    return Row("last layers x 1 to 10^6", detail, beyond_n, limit_n, "N")


# Streams.


def _streams(
    folder: Path, twin: Twin, ways: Sequence[Way], press: Clip, streamed: int, long: int
) -> Iterator[Row]:
    # The fastest in float32 that is there.
    names = {way.engine: way for way in ways if way.precision == "float32"}
    way = names.get("openvino", WAYS[0])
    torch.manual_seed(0)
    small = Twin(saved(folder / "small.safetensors", drawn(HARD["weights as drawn"], size=16)), folder)
    noise = np.random.default_rng(0).standard_normal((997, 16, 16)).astype(np.float32)
    detail = f"{way.name}; off from a stream that begins a window before, ten times"
    drift_n, grown_mb, last_n, last = _stream(small, way, noise, streamed)
    bound_n = small.bound_n(last, ROUNDING["float32"])
    yield Row(f"{streamed} frames, a small network", detail, drift_n, float(bound_n.max()), "N")
    off_n = np.abs(last_n - small.forces_n(last)[:, -1])
    yield _row(f"the last of {streamed} frames", way.name, off_n, bound_n)
    yield Row(f"memory over {streamed} frames", "growth after a tenth of them", grown_mb, _LEAK_MB, "MB")
    drift_n, _, _, last = _stream(twin, way, np.stack(list(inputs_of(twin.model, press.frames))), long)
    bound_n = twin.bound_n(last, ROUNDING["float32"])
    yield Row(f"{long} frames, the network as it is", detail, drift_n, float(bound_n.max()), "N")


def _stream(twin: Twin, way: Way, pool: Floats, frames: int) -> tuple[float, float, Exact, Floats]:
    """Streams frames of a pool, again and again.

    Returns:
        The most that it was off from a stream that begins a window before, in N; growth of memory in MB; the
        last forces, (M,); and the inputs that these depend on.
    """
    engine, fresh = twin.open(way), twin.open(way)
    context = max(network.config.context for network in twin.networks)
    drift_n, begin_mb = 0.0, 0.0
    for number in range(frames):
        forces_n = engine.step(pool[number % len(pool)]).forces_n
        if (number + 1) % (frames // 10) == 0 and number >= context:
            window = pool[np.arange(number - context, number + 1) % len(pool)]
            anew_n = _run(fresh, window)[:, -1]
            drift_n = max(drift_n, float(np.abs(forces_n - anew_n).max()))
            begin_mb = begin_mb or _resident_mb()
    return drift_n, max(_resident_mb() - begin_mb, 0.0), forces_n.astype(np.float64), window


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 2**20
