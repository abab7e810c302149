"""Fuzzer: random and damaged input for all readers of external bytes or text.

An input must give a result or a `GripperError`. Any other exception is a finding, and so are a crash, a hang,
and an allocation beyond `MEMORY_BYTES`. Input ``i`` of a target is a function of the seed, the target's name
and ``i``, so a finding is reproduced by its number.
"""

import os
import random
import re
import resource
import signal
import struct
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import connection, get_context
from pathlib import Path
from typing import Any, Final, TypedDict

from gripper_force.errors import ConfigError, GripperError
from gripper_force.progress import Progress, no_progress
from gripper_force.qualification.fuzz.target import Target
from gripper_force.qualification.proc_files import memory_bytes
from gripper_force.types import NS_PER_S

HANG_S: Final = 30.0
"""Time limit of an input. The slowest takes under a second; the rest is for a busy machine."""

MEMORY_BYTES: Final = 512 * 2**20
"""Memory that inputs may take in addition to that of the readers themselves."""

_POLL_S: Final = 0.25
_LONGEST: Final = 1 << 18
"""Largest input, in bytes."""

_PACKAGES: Final = ("gripper_force", "gripper_hw", "gripper_calibration")
"""Packages whose lines name the place of a finding."""

_INTEGERS: Final = (
    *(0, 1, 2, 3, 7, 16, 127, 128, 255, 256, 1023, 1024, 0x7FFF, 0x8000, 0xFFFF, 1 << 20, 1 << 28),
    *(0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1),
)
_FLOATS: Final = (float("nan"), float("inf"), -float("inf"), -0.0, -1.0, 1e-320, 1e19, 1e300, -1e300)
_WORDS: Final = (
    *(
        b"nan",
        b".nan",
        b"-.inf",
        b"inf",
        b"1e400",
        b"-1",
        b"0",
        b"1e-320",
        b"1e300",
        b"0x_",
        b"0b",
        b"9" * 30,
    ),
    *(b"\x00", b"\xff", b"\n", b"\r\n", b" ", b",", b"[", b"]", b"{", b"}", b'"', b":", b"'", b"-", b"\t"),
    *(b"null", b"true", b"2001-99-99", b"\xd9\xa3", b"\xf0\x9f\xa6\xbe", b"[" * 2000, b"x" * 300),
)
_DIGITS: Final = re.compile(rb"[+-]?\d+(?:\.\d*)?")


@dataclass(frozen=True, slots=True)
class Finding:
    """An input that gave neither a result nor a typed error.

    Attributes:
        target: Name of the target.
        index: Number of the input.
        error: Exception, crash or hang, with its place in the code.
        file: File that holds the input.
    """

    target: str
    index: int
    error: str
    file: str


class TargetCounts(TypedDict):
    """Number of inputs of a target, in total and by outcome."""

    inputs: int
    results: int
    typed_errors: int
    findings: int


class FuzzReport(TypedDict):
    """Result of `fuzz`.

    Attributes:
        ok: True if there are no findings.
        targets: Counts by target.
        findings: One finding of each kind.
        inputs: Number of inputs.
        seed: Seed of the inputs.
        wall_s: Duration.
    """

    ok: bool
    targets: dict[str, TargetCounts]
    findings: list[Finding]
    inputs: int
    seed: int
    wall_s: float


def all_targets() -> list[Target]:
    """All targets of the project."""
    # A process starts again after each crash; with other targets it does not need the readers, which take seconds.
    from gripper_force.qualification.fuzz import bus_targets, core_targets, load_cell_targets

    return [*core_targets.TARGETS, *bus_targets.TARGETS, *load_cell_targets.TARGETS]


def fuzz(
    count: int,
    seed: int,
    workers: int,
    out: Path,
    progress: Progress = no_progress,
    *,
    only: str | None = None,
) -> FuzzReport:
    """Feeds ``count`` inputs to all targets, in several processes.

    Args:
        count: Inputs over all targets; each target gets at least one.
        seed: Seed of all inputs.
        workers: Processes.
        out: Folder for the inputs of findings.
        progress: Called several times a second; a step is an input.
        only: A target's name, which then gets all inputs, or ``<name>:<number>`` for that input alone.

    Raises:
        ConfigError: ``only`` names no target.
        GripperError: A process died before its first input.
    """
    begin_s = time.monotonic()
    memory_bytes()  # which each process reads
    targets = all_targets()
    plan = _plan(targets, count, only)
    findings: dict[tuple[str, str], Finding] = {}
    done = 0
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        pool = [_Worker(seed, plan, k, workers, Path(folder)) for k in range(workers)]
        try:
            while any(worker.busy for worker in pool):
                connection.wait([w.process.sentinel for w in pool if w.busy], _POLL_S)
                for t, index, error in [found for worker in pool for found in worker.poll()]:
                    target = targets[t]
                    if (key := (target.name, _kind(error))) not in findings:
                        file = _save_input(out, target, seed, index)
                        findings[key] = Finding(target.name, index, error, str(file))
                now = sum(sum(worker.counts(t)) for worker in pool for t in range(len(targets)))
                progress(f"{len(findings)} findings", now - done)
                done = now
        finally:
            for worker in pool:
                worker.kill()
    counts = {
        target.name: [sum(row) for row in zip(*(worker.counts(t) for worker in pool), strict=True)]
        for t, target in enumerate(targets)
        if plan[t]
    }
    return {
        "ok": not findings,
        "targets": {
            name: {"inputs": sum(row), "results": row[0], "typed_errors": row[1], "findings": row[2]}
            for name, row in counts.items()
        },
        "findings": list(findings.values()),
        "inputs": done,
        "seed": seed,
        "wall_s": round(time.monotonic() - begin_s, 1),
    }


def input_of(target: Target, examples: Sequence[bytes], seed: int, index: int) -> bytes:
    """Input ``index`` of a target."""
    rng = random.Random(f"{seed}/{target.name}/{index}")
    data = mutate(rng, examples, (*_WORDS, *target.words))
    return target.repair(data) if target.repair is not None and rng.random() < 0.5 else data


def mutate(rng: random.Random, examples: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """Damages one of the examples in one to eight ways; one input in 50 is random bytes only."""
    if rng.random() < 0.02:
        return rng.randbytes(int(rng.expovariate(1 / 100)))
    data = bytearray(rng.choice(examples))
    for _ in range(min(8, 1 + int(rng.expovariate(1.0)))):
        damage = rng.choice(_DAMAGES)
        damage(rng, data, examples, words)
    return bytes(data[:_LONGEST])


_Damage = Callable[[random.Random, bytearray, Sequence[bytes], Sequence[bytes]], None]


def _flip(rng: random.Random, data: bytearray, *_: object) -> None:
    for _bit in range(rng.randint(1, 4) if data else 0):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _noise(rng: random.Random, data: bytearray, *_: object) -> None:
    at = _span(rng, data)
    data[at] = rng.randbytes(at.stop - at.start)


def _insert(rng: random.Random, data: bytearray, *_: object) -> None:
    at = _span(rng, data).start
    data[at:at] = rng.randbytes(rng.randint(1, 16))


def _delete(rng: random.Random, data: bytearray, *_: object) -> None:
    del data[_span(rng, data)]


def _cut(rng: random.Random, data: bytearray, *_: object) -> None:
    del data[rng.randint(0, len(data)) :]


def _repeat(rng: random.Random, data: bytearray, *_: object) -> None:
    at = _span(rng, data)
    data[at.stop : at.stop] = data[at] * rng.choice((1, 2, 7, 60))


def _splice(rng: random.Random, data: bytearray, examples: Sequence[bytes], _words: object) -> None:
    other = rng.choice(examples)
    data[rng.randint(0, len(data)) :] = other[rng.randint(0, len(other)) :]


def _integer(rng: random.Random, data: bytearray, *_: object) -> None:
    """Overwrites bytes by an extreme integer, as a length, a count, an address or a time may stand there."""
    size = rng.choice((1, 2, 4, 8))
    number = rng.choice(_INTEGERS) % (1 << 8 * size)
    at = rng.randint(0, len(data))
    data[at : at + size] = number.to_bytes(size, rng.choice(("little", "big")))


def _float(rng: random.Random, data: bytearray, *_: object) -> None:
    at = rng.randint(0, len(data))
    data[at : at + 8] = struct.pack("<d", rng.choice(_FLOATS))


def _word(rng: random.Random, data: bytearray, _examples: object, words: Sequence[bytes]) -> None:
    at = _span(rng, data)
    data[at if rng.random() < 0.5 else slice(at.start, at.start)] = rng.choice(words)


def _digits(rng: random.Random, data: bytearray, _examples: object, words: Sequence[bytes]) -> None:
    """Replaces a decimal number by another number or by a word."""
    found = _DIGITS.search(data, rng.randint(0, len(data)))
    if found is not None:
        number = str(rng.choice((-1, 1)) * rng.choice(_INTEGERS)).encode()
        data[found.start() : found.end()] = rng.choice((number, rng.choice(words)))


_DAMAGES: Final[tuple[_Damage, ...]] = (
    *(_flip, _noise, _insert, _delete, _cut, _repeat, _splice, _integer, _float, _word, _digits),
)


def _span(rng: random.Random, data: bytearray) -> slice:
    """Random slice of the data, mostly short."""
    start = rng.randint(0, len(data))
    return slice(start, min(len(data), start + int(rng.expovariate(1 / 6))))


def _plan(targets: Sequence[Target], count: int, only: str | None) -> list[range]:
    """Numbers of the inputs of each target."""
    if only is None:
        total = sum(target.weight for target in targets)
        return [range(max(1, round(count * target.weight / total))) for target in targets]
    name, colon, number = only.partition(":")
    if name not in {target.name for target in targets} or (colon and not number.isdecimal()):
        known = ", ".join(target.name for target in targets)
        raise ConfigError(
            f"no fuzz input {only!r}; give <target> or <target>:<number>, with a target of {known}"
        )
    wanted = range(int(number), int(number) + 1) if colon else range(count)
    return [wanted if target.name == name else range(0) for target in targets]


class _Worker:
    """A process that feeds its share of the inputs; it is replaced when it dies or hangs."""

    def __init__(self, seed: int, plan: Sequence[range], number: int, workers: int, folder: Path) -> None:
        self._context = get_context("spawn")
        self._shares = [numbers[number::workers] for numbers in plan]
        # Target, place in its share, start of the input in ns (0: none yet); then three counts per target.
        self._shared = self._context.RawArray("q", 3 + 3 * len(plan))
        self._task = (all_targets, seed, self._shares, folder / str(number), self._shared)
        self.busy = True
        self._begin(0, 0)

    def _begin(self, target: int, place: int) -> None:
        self._shared[2] = 0
        self._pipe, theirs = self._context.Pipe(duplex=False)
        self.process = self._context.Process(
            target=_work, args=(*self._task, target, place, theirs), daemon=True
        )
        self.process.start()
        theirs.close()

    def counts(self, target: int) -> tuple[int, int, int]:
        """Returns results, typed errors and findings of a target so far."""
        a, b, c = self._shared[3 + 3 * target : 6 + 3 * target]
        return a, b, c

    def poll(self) -> list[tuple[int, int, str]]:
        """Returns the findings since the last call: target, number, error."""
        if not self.busy:
            return []
        ended = not self.process.is_alive()
        found = self._received()
        target, place, begin_ns = self._shared[:3]
        hangs = begin_ns and time.monotonic_ns() - begin_ns > HANG_S * NS_PER_S
        if hangs and not ended:
            self.kill()
        elif not ended:
            return found
        code = self.process.exitcode
        if code == 0:
            self.busy = False
        elif not begin_ns:
            raise GripperError(f"a fuzzing process ended with code {code} before its first input")
        else:
            error = (
                f"Hang: not finished after {HANG_S:.0f} s"
                if hangs
                else f"Crash: the process ended with code {code}"
            )
            found.append((target, self._shares[target][place], error))
            self._shared[5 + 3 * target] += 1
            self.busy = place + 1 < len(self._shares[target]) or any(self._shares[target + 1 :])
            if self.busy:
                self._begin(target, place + 1)
        return found

    def kill(self) -> None:
        """Kills the process."""
        self.process.kill()
        self.process.join()

    def _received(self) -> list[tuple[int, int, str]]:
        found = []
        try:
            while self._pipe.poll():
                found.append(self._pipe.recv())
        except EOFError:
            pass
        return found


def _work(
    make_targets: Callable[[], list[Target]],
    seed: int,
    shares: Sequence[range],
    scratch: Path,
    shared: Any,
    first_target: int,
    first_place: int,
    pipe: connection.Connection,
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent, which reads the pipe, ends this process
    warnings.simplefilter("ignore")
    targets = make_targets()
    examples = [target.examples() if share else () for target, share in zip(targets, shares, strict=True)]
    limit = memory_bytes()[0] + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    reported = set()
    for t, target in list(enumerate(targets))[first_target:]:
        for place in range(first_place if t == first_target else 0, len(shares[t])):
            index = shares[t][place]
            data = input_of(target, examples[t], seed, index)
            shared[0], shared[1], shared[2] = t, place, time.monotonic_ns()
            error = _outcome(target, data, scratch)
            shared[3 + 3 * t + _COLUMNS.get(error, 2)] += 1
            if error not in _COLUMNS and (kind := (t, _kind(error))) not in reported:
                reported.add(kind)
                pipe.send((t, index, error))
    # The shutdown of the readers' libraries takes time, which would count as that of the last input.
    os._exit(0)


_RESULT, _TYPED = "result", "typed error"
_COLUMNS: Final = {_RESULT: 0, _TYPED: 1}


def _outcome(target: Target, data: bytes, scratch: Path) -> str:
    try:
        target.feed(data, scratch)
    except GripperError:
        return _TYPED
    except BaseException as error:  # panics of Rust libraries do not derive from Exception
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames if any(package in frame.filename for package in _PACKAGES)]
        where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "unknown"
        message = " ".join(str(error)[:200].split())
        return f"{type(error).__name__} at {where}: {message}"
    return _RESULT


def _kind(error: str) -> str:
    return error.partition(": ")[0]


def _save_input(out: Path, target: Target, seed: int, index: int) -> Path:
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{target.name}-{seed}-{index}.bin"
    path.write_bytes(input_of(target, target.examples(), seed, index))
    return path
