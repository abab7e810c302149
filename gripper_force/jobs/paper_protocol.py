"""The protocol of Shin et al. 2019 (section IV-A), simulated.

Sets of four touches with random peaks up to 12 N, for four objects, four angles and three light levels, 15
times each, recorded by a camera with 149 frames/s. All light levels of a set share one physics simulation;
the scene is rendered once under each.

In the paper all sets show the same four objects before the same camera. So do the instances ``same``: only the
object's place, the speed and the peaks differ between sets. With ``redrawn``, each set also has an object and a rig
of its own.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np

from gripper_force.config import HARD_FORCE_LIMIT_N, Config, config_from, config_from_text, dump_config
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.files import unfinished
from gripper_force.interfaces import Camera
from gripper_force.jobs.grasp import PAPER_OBJECTS
from gripper_force.jobs.recording.record import FREE_N, check_same
from gripper_force.jobs.recording.touches import touch, wait
from gripper_force.jobs.simulate import SAME
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log_reader import LogReader
from gripper_force.runtime.log_writer import LogWriter
from gripper_force.runtime.resolve import resolve
from gripper_force.runtime.session import Session, open_session
from gripper_force.schema import Tree
from gripper_force.types import Frame, Gray, LoadCellSample

RATE_HZ: Final = 149.0
"""Frame rate of the paper's camera."""

TOUCHES: Final = 4
"""Touches in a set, by table 1 of the paper."""

TEST_SETS: Final = (13, 14, 15)
"""Test sets of the 15 of each environment. The paper does not say which three it tested on."""


Instances = Literal["same", "redrawn"]

INSTANCES: Final[tuple[Instances, ...]] = get_args(Instances)
"""Instances of object and rig: the same in all sets, as in the paper, or redrawn for each set."""


@dataclass(frozen=True, slots=True)
class ProtocolScale:
    """Part of the protocol.

    Attributes:
        degrees: Angles of the object.
        numbers: Numbers of the sets, from 1.
        lux: Light levels.
    """

    degrees: tuple[int, ...]
    numbers: tuple[int, ...]
    lux: tuple[int, ...]


SCALES: Final = {
    "full": ProtocolScale((0, 10, 20, 30), tuple(range(1, 16)), (350, 550, 750)),
    "small": ProtocolScale((0, 30), (1, 2, 3, 4, 5, 6, 7, 8, 14, 15), (550,)),
}
"""Scales by name. A log that is in both is the same in both."""

_FIRST_SEED: Final = 700_000
_PAPER_PEAK_N: Final = 12.0
"""Largest force of the paper's touches."""

_OVERSHOOT_N: Final = 0.75
"""Largest load-cell force above `_PAPER_PEAK_N`. A set with a higher one is drawn again."""

_RAMP_N_S: Final = {"stapler": (30.0, 50.0)}
"""Lowest and highest speed of the ramps of an object, if it differs from `_USUAL_RAMP_N_S`.

The motor's inertia acts on the jaws like 2.5 kg. At 200 N/s they hit the stapler's stop with so much
kinetic energy that a peak of 12 N becomes 16 N.
"""

_USUAL_RAMP_N_S: Final = (100.0, 300.0)

_MAX_DRAWS: Final = 8
_SEED_STEP: Final = 1000
"""A rotated object can catch on the edge of a pad. The set is then drawn again with a seed higher by this."""


@dataclass(frozen=True, slots=True)
class SetPlan:
    """One set of the protocol.

    Attributes:
        object: The simulated object.
        degrees: Angle of the object.
        number: Number of the set among those of its object and angle, from 1.
        seed: Seed of the first draw of scene and peaks, the same for all light levels.
        lux: Light levels; each gives one log.
        instance_seed: Seed of object and rig; None: ``seed``.
    """

    object: str
    degrees: int
    number: int
    seed: int
    lux: tuple[int, ...]
    instance_seed: int | None = None

    @property
    def split(self) -> str:
        """Side of the split that the set is on: ``train`` or ``test``."""
        return split_of(self.number)

    @property
    def names(self) -> tuple[str, ...]:
        """File names of the logs, one for each light level."""
        stem = f"{self.split}/{self.object}-{self.degrees:02d}-{self.number:02d}"
        return tuple(f"{stem}-{lux}.mcap" for lux in self.lux)

    def check(self, out: Path, config: Tree) -> None:
        """Raises `DataError` if the existing logs were made with another configuration."""
        for lux, name in zip(self.lux, self.names, strict=True):
            if not (path := out / name).exists():
                continue
            seed = config_from_text(LogReader(path).config, str(path)).seed  # of the draw that succeeded
            drawn = _set_config(
                config_from(config, "simulate"), self, seed, lux, np.random.default_rng([seed, 11])
            )
            check_same(path, resolve(drawn, vision=False).config, SAME)

    def make(self, out: Path, config: Tree) -> list[Path]:
        """Makes the logs that do not exist yet; see `make_set`."""
        return make_set(self, out, config)


def split_of(number: int) -> str:
    """Returns the side of the paper's split for a set's number, from 1: ``train`` or ``test``."""
    return "test" if number in TEST_SETS else "train"


def plan_protocol(scale: str, instances: str) -> list[SetPlan]:
    """Plans the sets of the protocol.

    Args:
        scale: A name of `SCALES`.
        instances: One of `INSTANCES`.

    Raises:
        ConfigError: The scale or the instances do not exist.
    """
    if instances not in INSTANCES:
        raise ConfigError(f"no instances {instances!r} of the protocol; use one of {', '.join(INSTANCES)}")
    if scale not in SCALES:
        raise ConfigError(f"no scale {scale!r} of the protocol; use one of {', '.join(SCALES)}")
    full, part = SCALES["full"], SCALES[scale]
    # Objects change fastest, so that an interrupted simulation has made sets of all of them.
    return [
        SetPlan(
            name,
            degrees,
            number,
            _FIRST_SEED
            + (i * len(full.degrees) + full.degrees.index(degrees)) * len(full.numbers)
            + number
            - 1,
            part.lux,
            _FIRST_SEED if instances == "same" else None,
        )
        for number in part.numbers
        for degrees in part.degrees
        for i, name in enumerate(PAPER_OBJECTS)
    ]


def make_set(task: SetPlan, out: Path, config: Tree) -> list[Path]:
    """Makes the logs of a set that do not exist yet. Each log gets its name once it is complete.

    Args:
        task: The set.
        out: Output folder.
        config: Configuration as plain data.

    Returns:
        The logs made.

    Raises:
        ConfigError: The camera or the load cell is not simulated.
        SimulationError: Every draw of the scene failed, reached no force, overshot the peaks, or caught the
            object on a pad.
    """
    paths = {lux: out / name for lux, name in zip(task.lux, task.names, strict=True)}
    paths = {lux: path for lux, path in paths.items() if not path.exists()}
    with ExitStack() as stack:
        parts = {lux: stack.enter_context(unfinished(path)) for lux, path in paths.items()}
        for draw in range(_MAX_DRAWS):
            seed = task.seed + draw * _SEED_STEP
            try:
                _run_set(config_from(config, "simulate"), task, seed, parts)
                break
            except SimulationError:
                for part in parts.values():
                    part.unlink(missing_ok=True)
                if draw == _MAX_DRAWS - 1:
                    raise
    return list(paths.values())


def _run_set(config: Config, task: SetPlan, seed: int, logs: dict[int, Path]) -> None:
    first, *others = logs
    rng = np.random.default_rng([seed, 11])
    resolved = resolve(_set_config(config, task, seed, first, rng), vision=False)
    config = resolved.config
    with open_devices(config) as devices:
        if (
            (config.camera.backend, config.load_cell.backend) != ("simulated", "simulated")
            or devices.camera is None
            or devices.load_cell is None
            or devices.render_under_light is None
        ):
            raise ConfigError(
                f"the protocol needs a simulated camera and load cell, but camera.backend is "
                f"{config.camera.backend!r} and load_cell.backend {config.load_cell.backend!r}; set both to "
                "simulated"
            )
        rendered = [devices.render_under_light(lux) for lux in others]
        devices.camera = cameras = _MultiLightCamera(devices.camera, [camera for camera, _ in rendered])
        devices.notes.update(protocol="shin2019", degrees=str(task.degrees), split=task.split, lux=str(first))
        with open_session(resolved, devices, logs[first]) as session:
            _touch_all(session, task, rng, config.control.timeout_s)
    peak_n = max(sample.force_n for sample in LogReader(logs[first]).records(LoadCellSample))
    if peak_n > _PAPER_PEAK_N + _OVERSHOOT_N:
        raise SimulationError(
            f"a touch of {task.object!r} at {task.degrees} degrees reached {peak_n:.1f} N; use another seed"
        )
    for lux, (_, notes), grays in zip(others, rendered, cameras.grays, strict=True):
        _copy_under_light(logs[first], logs[lux], lux, {**notes, "lux": str(lux)}, grays)


class _MultiLightCamera:
    """A camera that also collects the images of cameras under other lights.

    Attributes:
        grays: Images of each other camera by frame number.
    """

    def __init__(self, first: Camera, others: Sequence[Camera]) -> None:
        self._first, self._others = first, others
        self.grays: list[dict[int, Gray]] = [{} for _ in others]

    def start(self) -> None:
        for camera in (self._first, *self._others):
            camera.start()

    def newest(self) -> Frame | None:
        for camera, grays in zip(self._others, self.grays, strict=True):
            if (frame := camera.newest()) is not None:
                grays[frame.seq] = frame.gray
        return self._first.newest()

    def counts(self) -> dict[str, int]:
        return self._first.counts()

    def close(self) -> None:
        for camera in (self._first, *self._others):
            camera.close()


def _copy_under_light(
    source: Path, path: Path, lux: int, notes: dict[str, str], grays: dict[int, Gray]
) -> None:
    """Copies a log with the images of another light, as if the set had been made under that light."""
    reader = LogReader(source)
    config = config_from_text(reader.config, str(source))
    config = config.with_values(sim={"lux": float(lux)})
    with LogWriter(path, config=dump_config(config), metadata={**reader.metadata, **notes}) as log:
        for record in reader.records():
            log.write(replace(record, gray=grays[record.seq]) if isinstance(record, Frame) else record)


def _set_config(config: Config, task: SetPlan, seed: int, lux: int, rng: np.random.Generator) -> Config:
    return config.with_values(
        object=task.object,
        seed=seed,
        target_n=_PAPER_PEAK_N,
        control={
            "feedback": "current",
            "force_limit_n": HARD_FORCE_LIMIT_N,  # so high that it does not bound the speed
            # Four touches in the paper's 500 frames leave 0.8 s for each.
            "approach_speed_m_s": 0.2,
            "approach_force_n": 1.5,
            "ramp_n_s": float(rng.uniform(*_RAMP_N_S.get(task.object, _USUAL_RAMP_N_S))),
        },
        vision={"checkpoint": "none"},
        sim={
            "lux": float(lux),
            "yaw_deg": float(task.degrees),
            "tool": "rods",  # as the paper's
            "object_seed": task.instance_seed,
            "rig_seed": task.instance_seed,
            # What a camera can't see must not raise the peaks: the controller knows the motor exactly.
            "gain": 1.0,
            "friction": 1.0,
        },
    )


def _touch_all(session: Session, task: SetPlan, rng: np.random.Generator, timeout_s: float) -> None:
    wait(session, 0.1)
    for _ in range(TOUCHES):
        problem = touch(
            session,
            # High forces last only briefly. With the root, more high peaks are drawn than low ones.
            _PAPER_PEAK_N * float(np.sqrt(rng.uniform(0.01, 1.0))),
            float(rng.uniform(0.02, 0.1)),
            free_n=FREE_N,
            timeout_s=timeout_s,
            release_timeout_s=1.0,
        )
        if problem:
            raise SimulationError(
                f"a touch of {task.object!r} at {task.degrees} degrees {problem}; use another seed"
            )
