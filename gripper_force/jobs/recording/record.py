"""Recording of sets of touches from a press rig: servo, camera and load cell, real or simulated.

A *set* is several touches with random peaks in one log (Shin et al. 2019, section IV-A). It begins with open
jaws at rest, for the reference frames of the network. Frames keep the camera's timestamps, and forces are
interpolated at these; `gripper_force.jobs.recording.summary` measures how well the two clocks agree.

The controller and its limits are those of a grasp, on motor current alone. The recording ends with an error
if the camera or the load cell gives no more data, or if the load cell does not measure a touch.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import BaseModel

from gripper_force.config import Config, config_from_text
from gripper_force.control.limits import largest_target_n, rounded_down
from gripper_force.control.state_machine import Decision
from gripper_force.control.transmission import force_bound
from gripper_force.errors import ConfigError, DataError, DeviceError
from gripper_force.files import unfinished
from gripper_force.interfaces import Devices
from gripper_force.jobs.dataset import CONTACT_N
from gripper_force.jobs.recording.touches import touch
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.resolve import ResolvedConfig, resolve
from gripper_force.runtime.session import Session, open_session
from gripper_force.types import (
    NS_PER_MS,
    NS_PER_S,
    GraspStatus,
    LoadCellSample,
    Outcome,
    Phase,
    Request,
    RequestKind,
)

DEFAULT_PEAK_N: Final = 12.0
"""Largest force of a touch if the plan names none: that of the paper's touches."""

TEST_EVERY: Final = 5
"""Every fifth set is for test: 3 of 15, as in the paper."""

_MIN_PEAK_N: Final = 1.0
_HOLD_S: Final = (0.25, 0.5)
"""Range of the hold at the peak. The start of the release is then visible, and the lag is measured there."""

_REST_NS: Final = 400 * NS_PER_MS
_REST_FRAMES: Final = 10
_REST_SAMPLES: Final = 8
"""Duration, frames and load-cell samples of the rest before the first touch, at least."""

FREE_N: Final = 0.1
"""Largest load-cell force of a free object above the force at rest."""

_SILENT_NS: Final = 2 * NS_PER_S
FIRST_SAMPLE_NS: Final = 5 * NS_PER_S
"""A camera or load cell without data for this long has failed. The slowest samples take 1.3 s. The first one may take
longer: a board that resets when its port is opened is silent for about 2 s."""

_SAME: Final = ("object", "seed", "target_n", "camera", "sim")
"""Keys that all sets of a recording share, apart from the set's number in the seed. Others may change."""

_MAX_SATURATED: Final = 5
"""Saturated samples that are still taken for a glitch."""

_PROGRESS_NS: Final = 200 * NS_PER_MS
_NAME: Final = re.compile(r"\w[\w .+-]{0,99}")


@dataclass(frozen=True, slots=True)
class RecordingPlan:
    """Sets to record.

    Attributes:
        sets: Number of sets.
        touches: Touches in each set.
        peak_n: Largest force of a touch; None for `DEFAULT_PEAK_N`, or less if the force limit requires it.
        degrees: Angle of the press, noted in names and metadata; None: not noted.
        lux: Light level, noted likewise.
        test_every: Every n-th set is for test; None for no split into training and test sets.
    """

    sets: int
    touches: int = 4
    peak_n: float | None = None
    degrees: float | None = None
    lux: float | None = None
    test_every: int | None = TEST_EVERY

    def paths(self, config: Config, out: Path) -> list[Path]:
        """Returns the paths of the logs, in order, in the folders ``train`` and ``test``."""
        parts = [config.object]
        parts += [] if self.degrees is None else [f"{self.degrees:g}deg"]
        parts += [] if self.lux is None else [f"{self.lux:g}lux"]
        stem = "-".join(parts)
        return [out / self.split(n) / f"{stem}-{n:02d}.mcap" for n in range(1, self.sets + 1)]

    def split(self, number: int) -> str:
        """Returns the side of the split that a set is on: ``train``, ``test``, or empty without a split."""
        if self.test_every is None:
            return ""
        return "train" if number % self.test_every else "test"


def record(
    config: Config,
    plan: RecordingPlan,
    out: Path,
    progress: Progress = no_progress,
    prompt: Prompt | None = None,
) -> Iterator[Path]:
    """Records the sets that do not exist yet.

    A log gets its name once it is complete, so an interrupted recording can be continued. Set n has the seed
    ``config.seed + n - 1``, for its peaks and for the draws of a simulated rig.

    Args:
        config: The configuration.
        plan: Sets to record.
        out: Folder of the logs.
        progress: Called a few times per second with the touch and the force, and 0 steps.
        prompt: Called before each new set; None for no pause.

    Yields:
        The log of each set, also of those that existed before.

    Raises:
        ConfigError: There is no camera or load cell, the object's name is not usable as a file name, or the
            peak is not within the force limit.
        DataError: The load cell reads a force at rest, a touch reached no force, or an existing set was
            recorded with another configuration.
        GripperError: A device failed. The servo was stopped as configured, and completed sets are kept.
    """
    config, peak_n = _checked(config, plan)
    objects: dict[str, tuple[Path, str]] = {}
    for number, path in enumerate(plan.paths(config, out), start=1):
        one = config.with_values(seed=config.seed + number - 1, target_n=peak_n)
        resolved = resolve(one, vision=False)
        if path.exists():
            check_same(path, resolved.config, _SAME)
            _check_touches(path, plan.touches)
            check_object_file(path, objects)
            yield path
            continue
        if prompt is not None:
            prompt(f"Put the object between the jaws for {'touch' if plan.touches == 1 else 'set'} {number}")
        notes = {"set": path.stem}
        notes |= {"split": split} if (split := plan.split(number)) else {}
        notes |= {} if plan.degrees is None else {"degrees": f"{plan.degrees:g}"}
        notes |= {} if plan.lux is None else {"lux": f"{plan.lux:g}"}
        with unfinished(path) as part, open_devices(resolved.config) as devices:
            devices.notes.update(notes)
            _open_jaws(resolved, devices)
            with open_session(resolved, devices, part) as session:
                _touch_all(_MonitoredSession(session, devices, one, plan, number, progress), plan.touches)
                session.release()
        check_object_file(path, objects)
        yield path


def check_name(name: str) -> None:
    """Raises `ConfigError` if the name of an object can't be part of a file name."""
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"object {name!r} can't be part of a file name; use letters, digits, spaces and _ . + -"
        )


def check_object_file(path: Path, seen: dict[str, tuple[Path, str]]) -> None:
    """Raises `DataError` if the file of a log's simulated object was another one in an earlier log.

    Args:
        path: The log.
        seen: The first log and the digest of each object's file, to which those of this log are added.
    """
    notes = LogReader(path).metadata
    digest = notes.get("object file sha256", "")
    first, first_digest = seen.setdefault(notes.get("object file", ""), (path, digest))
    if digest != first_digest:
        raise DataError(
            f"the object's file has changed between {first} and {path}; move the logs of the old one away, or use "
            "another folder"
        )


def check_same(path: Path, config: Config, keys: Sequence[str]) -> None:
    """Raises `DataError` if the log was recorded with other values of these keys or sections than the configuration."""
    recorded = config_from_text(LogReader(path).config, str(path))
    for key in keys:
        old, new = getattr(recorded, key), getattr(config, key)
        if old != new:
            if isinstance(new, BaseModel):
                name = next(n for n in type(new).model_fields if getattr(old, n) != getattr(new, n))
                key, old, new = f"{key}.{name}", getattr(old, name), getattr(new, name)
            remedy = f"pass --peak-n {old:g}" if key == "target_n" else f"set {key} to {old}"
            raise DataError(
                f"{path} exists already and was recorded with {key} {old}, not {new}; use another folder, "
                f"{remedy}, or move that log away"
            )


def _check_touches(path: Path, touches: int) -> None:
    recorded = sum(request.kind == RequestKind.GRASP for request in LogReader(path).records(Request))
    if recorded != touches:
        raise DataError(
            f"{path} exists already and was recorded with {recorded} touches, not {touches}; use another folder, "
            f"pass --touches {recorded}, or move that log away"
        )


def _open_jaws(resolved: ResolvedConfig, devices: Devices) -> None:
    """Opens the jaws in a session without a log, because the log of a set must begin with open jaws."""
    with open_session(resolved, devices, None) as session:
        status = session.release()
    if status.outcome == Outcome.BLOCKED:
        raise DeviceError(status.reason)
    devices.servo.close()  # the set's own session opens it again


def _checked(config: Config, plan: RecordingPlan) -> tuple[Config, float]:
    for unit, backend in (("camera", config.camera.backend), ("load_cell", config.load_cell.backend)):
        if backend == "none":
            name = unit.replace("_", " ")
            raise ConfigError(f"record needs a {name}, but {unit}.backend is none; set {unit}.backend")
    check_name(config.object)
    limit_n = config.control.force_limit_n
    max_n = largest_target_n(limit_n, force_bound(config.gripper))
    peak_n = min(DEFAULT_PEAK_N, max_n) if plan.peak_n is None else plan.peak_n
    if not _MIN_PEAK_N < peak_n <= max_n:
        raise ConfigError(
            f"peaks of up to {peak_n:g} N are not within {_MIN_PEAK_N:g} to {rounded_down(max_n)} N, the range for "
            f"control.force_limit_n {limit_n:g} N; set another --peak-n or limit, or run calibrate jaws and servo first"
        )
    return config.with_values(control={"feedback": "current"}, vision={"checkpoint": "none"}), peak_n


class _MonitoredSession:
    """A session that raises if its data would be useless: after a fault, or without frames or samples.

    Attributes:
        touch: Number of the touch, from 1; 0 at rest.
        peak_n: Largest load-cell force since the touch began.
    """

    def __init__(
        self,
        session: Session,
        devices: Devices,
        config: Config,
        plan: RecordingPlan,
        number: int,
        progress: Progress,
    ) -> None:
        assert devices.load_cell is not None
        self._session, self._cell, self._progress = session, devices.load_cell, progress
        self._plan = plan
        self.config, self.number = config, number
        self.timeout_s, self.opening_s = session.timeout_s, session.opening_s
        self.touch = 0
        self.peak_n = 0.0
        self._begin_ns = self._progress_ns = self._frame_ns = devices.clock.now_ns()
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
            self._frame_ns = t_ns
        if self.last_load_cell_sample is not None:
            self.peak_n = max(self.peak_n, self.last_load_cell_sample.force_n)
        self._check(decision.status)
        if t_ns - self._progress_ns >= _PROGRESS_NS:
            self._progress_ns = t_ns
            sample = self.last_load_cell_sample
            self._progress(f"{self._place()}: {0.0 if sample is None else sample.force_n:.1f} N", 0)
        return decision

    def _place(self) -> str:
        """Set and touch, for a person."""
        plan, touch = self._plan, f"touch {self.touch} of {self._plan.touches}" if self.touch else "at rest"
        if plan.touches == 1:
            return f"touch {self.number} of {plan.sets}"
        return touch if plan.sets == 1 else f"set {self.number}, {touch}"

    def _check(self, status: GraspStatus) -> None:
        if status.phase == Phase.FAULT:
            raise DeviceError(f"set {self.number} ended with a fault: {status.reason}; remove its cause")
        if self._saturations() - self._saturated > _MAX_SATURATED:
            last = self.last_load_cell_sample
            reading = "no force" if last is None else f"{last.force_n:.1f} N"
            raise DeviceError(
                f"the load cell is saturated in set {self.number}, where it last read {reading}; set a "
                "smaller --peak-n, or check its range and wiring"
            )
        if status.t_ns - self._frame_ns > _SILENT_NS:
            raise DeviceError(
                f"the camera has given no frame for {_SILENT_NS / NS_PER_S:g} s in set {self.number}; check "
                "its cable, and run doctor"
            )
        last = self.last_load_cell_sample
        sample_ns = self._begin_ns if last is None else max(last.t_ns, self._begin_ns)
        silent_ns = FIRST_SAMPLE_NS if last is None else _SILENT_NS
        if status.t_ns - sample_ns > silent_ns:
            counts = ", ".join(f"{n} {name}" for name, n in self._cell.counts().items() if n)
            raise DeviceError(
                f"the load cell has given no valid sample for {silent_ns / NS_PER_S:g} s in set "
                f"{self.number} (rejected: {counts or 'none'}); check its wiring and its section of the "
                "configuration, and run doctor"
            )

    def _saturations(self) -> int:
        return self._cell.counts().get("saturated", 0)


def _touch_all(session: _MonitoredSession, touches: int) -> None:
    rng = np.random.default_rng([session.config.seed, 12])
    rest_n, free_n = _rest(session)
    for session.touch in range(1, touches + 1):
        peak_n = float(rng.uniform(_MIN_PEAK_N, session.config.target_n))
        session.peak_n = rest_n
        problem = touch(
            session,
            peak_n,
            float(rng.uniform(*_HOLD_S)),
            free_n=free_n,
            timeout_s=session.timeout_s(peak_n),
            release_timeout_s=session.opening_s,
        )
        which = f"touch {session.touch} of set {session.number}"
        if problem:
            raise DataError(f"{which} {problem}; check that the object is between the jaws and comes free")
        if session.peak_n - rest_n < CONTACT_N:
            raise DataError(
                f"{which} pressed with {peak_n:.1f} N by motor current, but the load cell measured "
                f"{session.peak_n - rest_n:.2f} N; check that it is in the path of the force, and check "
                "load_cell.n_per_raw and its sign"
            )


def _rest(session: _MonitoredSession) -> tuple[float, float]:
    """Waits for the reference frames. Returns the force at rest, and the largest force of a free object."""
    samples: dict[int, LoadCellSample] = {}
    begin_ns = t_ns = session.cycle().status.t_ns
    while t_ns - begin_ns < _REST_NS or session.frames < _REST_FRAMES or len(samples) < _REST_SAMPLES:
        t_ns = session.cycle().status.t_ns
        if (sample := session.last_load_cell_sample) is not None:
            samples[sample.t_ns] = sample
    forces_n = [sample.force_n for sample in samples.values()]
    rest_n = float(np.median(forces_n))
    if abs(rest_n) >= CONTACT_N:
        raise DataError(
            f"the load cell reads {rest_n:.2f} N with open jaws; unload it, or set "
            f"load_cell.tare_raw={np.median([sample.raw for sample in samples.values()]):.8g}"
        )
    return rest_n, rest_n + max(FREE_N, 4 * float(np.std(forces_n)))
