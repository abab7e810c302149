"""Sets of touches from a press rig: a servo stage, a camera and a load cell, real or simulated alike.

A *set* is the paper's (section IV-A): some touches with random peaks, one log. Each begins with open jaws at
rest, for the frames of the network's reference. Frames keep the camera's timestamps, and forces are found at
these; `gripper_force.jobs.recording.summary` tells how far the two clocks agree.

The run is a grasp's: the same controller on motor current alone, with its limits. A set whose camera or load
cell falls silent, or whose touches are not felt, is of no use, and ends the recording with a sentence.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import BaseModel

from gripper_force.config import Config, config_from_text
from gripper_force.control.limits import largest_target_n
from gripper_force.control.state_machine import Decision
from gripper_force.errors import ConfigError, DataError, DeviceError
from gripper_force.interfaces import Devices
from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.jobs.recording.touches import touch
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log import LogReader
from gripper_force.runtime.resolve import ResolvedConfig, resolve
from gripper_force.runtime.session import Session, open_session
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    GraspStatus,
    LoadCellSample,
    Phase,
    RequestKind,
)

PEAK_N: Final = 12.0
"""Largest force of the paper's touches."""

TEST_EVERY: Final = 5
"""Of so many sets the last is for test; of the paper's 15 that makes 3."""

_LEAST_PEAK_N: Final = 1.0
_HOLD_S: Final = (0.25, 0.5)
"""At rest for so long the beginning of the way back shows, which tells the lag."""

_REST_NS: Final = 400 * NS_PER_MS
_REST_FRAMES: Final = 10
_REST_SAMPLES: Final = 8
_FREE_N: Final = 0.1
"""What may be felt of an object that is free, over what is felt at rest."""

_PATIENCE_S: Final = 5.0
_SILENT_NS: Final = 2 * NS_PER_S
"""A camera or load cell that says nothing for so long has failed. The slowest samples take 1.3 s."""

_SAME: Final = ("object", "seed", "target_n", "camera", "sim")
"""What the sets of one recording share, the seed counting on; the rest may be set right meanwhile."""

_SATURATED: Final = 5
"""More saturated samples than this are no glitch."""

_TELL_NS: Final = 200 * NS_PER_MS
_NAME: Final = re.compile(r"\w[\w .+-]{0,99}")

Progress = Callable[[int, int, float], None]
"""Told of the set, the touch (0: at rest) and the force in newtons, a few times a second."""


@dataclass(frozen=True, slots=True)
class RecordingPlan:
    """What to record.

    Attributes:
        sets: Number of sets.
        touches: Of each set.
        peak_n: The most that a touch presses with; None for `PEAK_N`, or what the force limit leaves.
        degrees: Angle of the press, if it is to be noted.
        lux: Light level, if it is to be noted.
        test_every: Of so many sets the last is for test, in a folder of its own; None: none is.
    """

    sets: int
    touches: int = 4
    peak_n: float | None = None
    degrees: float | None = None
    lux: float | None = None
    test_every: int | None = TEST_EVERY

    def paths(self, config: Config, out: Path) -> list[Path]:
        """The logs, in order: those for test in the folder ``test``, the others in ``train``."""
        parts = [config.object]
        parts += [] if self.degrees is None else [f"{self.degrees:g}deg"]
        parts += [] if self.lux is None else [f"{self.lux:g}lux"]
        stem = "-".join(parts)
        return [out / self.split(n) / f"{stem}-{n:02d}.mcap" for n in range(1, self.sets + 1)]

    def split(self, number: int) -> str:
        """What a set is for: ``train`` or ``test``, or an empty text."""
        if self.test_every is None:
            return ""
        return "train" if number % self.test_every else "test"


def record(
    config: Config,
    plan: RecordingPlan,
    out: Path,
    progress: Progress,
    ask: Callable[[int], None] = lambda _set: None,
) -> Iterator[Path]:
    """Records the sets that are not there yet, and yields each log once it is there.

    A log appears under its name once it is whole. Set n has the seed ``config.seed + n - 1``, for its peaks
    and for what a simulated rig draws.

    Args:
        config: The run.
        plan: What to record.
        out: Where the logs are.
        progress: Told of what is done, a few times a second.
        ask: Told of the number of a set before it is recorded; returns once it may be.

    Raises:
        ConfigError: There is no camera or no load cell, the object's name is no file's name, or the peak is
            not within the force limit.
        DataError: The load cell reads a force at rest, a touch came to none, or a set that is there was
            recorded otherwise.
        GripperError: A device failed. The servo was stopped as configured, and whole sets stay.
    """
    config, peak_n = _ready(config, plan)
    for number, path in enumerate(plan.paths(config, out), start=1):
        one = config.model_copy(update={"seed": config.seed + number - 1, "target_n": peak_n})
        if path.exists():
            _check_same(path, one)
            yield path
            continue
        ask(number)
        unfinished = path.with_name(f".{path.name}.part")
        unfinished.unlink(missing_ok=True)
        notes = {"set": path.stem}
        notes |= {"split": split} if (split := plan.split(number)) else {}
        notes |= {} if plan.degrees is None else {"degrees": f"{plan.degrees:g}"}
        notes |= {} if plan.lux is None else {"lux": f"{plan.lux:g}"}
        run = resolve(one, vision=False)
        with open_devices(run.config) as devices:
            devices.notes.update(notes)
            _open_jaws(run, devices)
            with open_session(run, devices, unfinished) as session:
                _touch_all(_Rig(session, devices, one, number, progress), plan.touches)
                session.release()
        yield unfinished.rename(path)


def _check_same(path: Path, config: Config) -> None:
    """Raises `DataError` where the log is of another object, light, camera or peak than the run's."""
    there = config_from_text(LogReader(path).config, str(path))
    for key in _SAME:
        section, run = getattr(there, key), getattr(config, key)
        if section != run:
            if isinstance(run, BaseModel):
                name = next(n for n in type(run).model_fields if getattr(section, n) != getattr(run, n))
                key, section, run = f"{key}.{name}", getattr(section, name), getattr(run, name)
            raise DataError(
                f"{path} is there already and was recorded with {key} {section}, not {run}; take another "
                f"folder, set {key} as it was, or move that log away"
            )


def _open_jaws(run: ResolvedConfig, devices: Devices) -> None:
    """Opens the jaws in a session without a log, because the log of a set must begin with open jaws."""
    with open_session(run, devices, None) as session:
        session.release()
    devices.servo.close()  # the set's own session opens it again


def _ready(config: Config, plan: RecordingPlan) -> tuple[Config, float]:
    for unit, backend in (("camera", config.camera.backend), ("load_cell", config.load_cell.backend)):
        if backend == "none":
            name = unit.replace("_", " ")
            raise ConfigError(f"record needs a {name}, and {unit}.backend is none; name the one you have")
    if not _NAME.fullmatch(config.object):
        raise ConfigError(
            f"object {config.object!r} is no name for a log; take letters, digits, spaces and _ . + -"
        )
    limit_n = config.control.force_limit_n
    most_n = largest_target_n(limit_n)
    peak_n = min(PEAK_N, most_n) if plan.peak_n is None else plan.peak_n
    if not _LEAST_PEAK_N < peak_n <= most_n:
        raise ConfigError(
            f"peaks of up to {peak_n:g} N are not within {_LEAST_PEAK_N:g} to {most_n:g} N, which "
            f"control.force_limit_n {limit_n:g} N leaves; ask for another --peak-n, or change the limit"
        )
    control = config.control.model_copy(update={"feedback": "current"})
    vision = config.vision.model_copy(update={"checkpoint": "none"})
    return config.model_copy(update={"control": control, "vision": vision}), peak_n


class _Rig:
    """A session that is watched: it raises where the data to come would be of no use."""

    def __init__(
        self, session: Session, devices: Devices, config: Config, number: int, progress: Progress
    ) -> None:
        assert devices.load_cell is not None
        self._session, self._cell, self._progress = session, devices.load_cell, progress
        self.config, self.number = config, number
        self.touch = 0
        self.most_n = 0.0
        self._begin_ns = self._told_ns = self._seen_ns = devices.clock.now_ns()
        self._saturated = self._saturations()

    @property
    def last_load_cell_sample(self) -> LoadCellSample | None:
        return self._session.last_load_cell_sample

    @property
    def frames(self) -> int:
        return self._session.frames

    def cycle(self, kind: RequestKind | None = None, target_n: float = 0.0) -> Decision:
        frames = self.frames
        decision = self._session.cycle(kind, target_n)
        t_ns = decision.status.t_ns
        if self.frames > frames:
            self._seen_ns = t_ns
        if self.last_load_cell_sample is not None:
            self.most_n = max(self.most_n, self.last_load_cell_sample.force_n)
        self._check(decision.status)
        if t_ns - self._told_ns >= _TELL_NS:
            self._told_ns = t_ns
            self._progress(
                self.number,
                self.touch,
                0.0 if self.last_load_cell_sample is None else self.last_load_cell_sample.force_n,
            )
        return decision

    def _check(self, status: GraspStatus) -> None:
        if status.phase == Phase.FAULT:
            if self.config.control.on_fault == "open":
                self._session.wait_until_open(status)
            raise DeviceError(f"set {self.number} ended at a fault: {status.reason}; see what caused it")
        if self._saturations() - self._saturated > _SATURATED:
            felt_n = (
                f"{self.last_load_cell_sample.force_n:.1f} N"
                if self.last_load_cell_sample is not None
                else "no force"
            )
            raise DeviceError(
                f"the load cell is saturated in set {self.number}, where it last read {felt_n}; ask for a "
                "smaller --peak-n, or see to its range and wiring"
            )
        if status.t_ns - self._seen_ns > _SILENT_NS:
            raise DeviceError(
                f"the camera has given no frame for {_SILENT_NS / NS_PER_S:g} s in set {self.number}; check "
                "its cable, and see what doctor says"
            )
        heard_ns = (
            self._begin_ns
            if self.last_load_cell_sample is None
            else max(self.last_load_cell_sample.t_ns, self._begin_ns)
        )
        if status.t_ns - heard_ns > _SILENT_NS:
            counts = ", ".join(f"{n} {name}" for name, n in self._cell.counts().items() if n)
            raise DeviceError(
                f"the load cell has given no valid sample for {_SILENT_NS / NS_PER_S:g} s in set "
                f"{self.number} (rejected: {counts or 'none'}); check its wiring and its section of the "
                "configuration, and see what doctor says"
            )

    def _saturations(self) -> int:
        return self._cell.counts().get("saturated", 0)


def _touch_all(rig: _Rig, touches: int) -> None:
    rng = np.random.default_rng([rig.config.seed, 12])
    rest_n, free_n = _rest(rig)
    for rig.touch in range(1, touches + 1):
        peak_n = float(rng.uniform(_LEAST_PEAK_N, rig.config.target_n))
        rig.most_n = rest_n
        problem = touch(
            rig,
            peak_n,
            float(rng.uniform(*_HOLD_S)),
            free_n=free_n,
            timeout_s=rig.config.control.timeout_s,
            patience_s=_PATIENCE_S,
        )
        which = f"touch {rig.touch} of set {rig.number}"
        if problem:
            raise DataError(f"{which} {problem}; see that the object is between the jaws and comes free")
        if rig.most_n - rest_n < CONTACT_N:
            raise DataError(
                f"{which} pressed with {peak_n:.1f} N by motor current, and the load cell felt "
                f"{rig.most_n - rest_n:.2f} N; see that it lies in the way of the force, and to "
                "load_cell.n_per_raw and its sign"
            )


def _rest(rig: _Rig) -> tuple[float, float]:
    """Waits for the reference frames. Returns what is felt at rest, and at most of a free object."""
    felt: dict[int, LoadCellSample] = {}
    begin_ns = t_ns = rig.cycle().status.t_ns
    while t_ns - begin_ns < _REST_NS or rig.frames < _REST_FRAMES or len(felt) < _REST_SAMPLES:
        t_ns = rig.cycle().status.t_ns
        if rig.last_load_cell_sample is not None:
            felt[rig.last_load_cell_sample.t_ns] = rig.last_load_cell_sample
    forces_n = [sample.force_n for sample in felt.values()]
    rest_n = float(np.median(forces_n))
    if abs(rest_n) >= CONTACT_N:
        raise DataError(
            f"the load cell reads {rest_n:.2f} N with open jaws; take away what presses on it, or set "
            f"load_cell.tare_raw={np.median([sample.raw for sample in felt.values()]):.8g}"
        )
    return rest_n, rest_n + max(_FREE_N, 4 * float(np.std(forces_n)))
