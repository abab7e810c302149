"""Training data: logs of randomised touches in the simulated rig.

A *press* closes, ramps to one to three random forces in turn, holds each for a while, and opens, as the
paper's collector does (section IV-A). A *tap* is one fast touch, which shows a scene in half of the frames:
to train on, another scene is worth more than another moment. A *grasp* is one touch that ends as
`gripper-force grasp` ends it. All run the controller on motor current alone, so no network is needed to make
the data that one is trained on.

The *protocol* of Shin et al. 2019 (section IV-A): sets of four touches with random peaks to 12 N, for four
objects, four angles, three light levels and 15 times each, seen by a camera of 149 frames a second. All light
levels of a set are one physics, simulated and drawn once.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from gripper_force.config import Config, config_from, config_from_text, dump_config
from gripper_force.errors import ConfigError, SimulationError
from gripper_force.interfaces import Camera
from gripper_force.jobs.processes import process_pool
from gripper_force.jobs.recording.touches import ramp, touch, wait
from gripper_force.runtime.backends import open_devices
from gripper_force.runtime.log import LogReader, LogWriter
from gripper_force.runtime.session import Session, open_session, release, run_grasp
from gripper_force.types import Frame, Gray

Kind = Literal["press", "tap", "grasp"]
OBJECTS = ("sponge", "paper_cup", "tube", "stapler")
PEAK_N = 12.5
_MAX_TARGETS = 3
_TAP_N: Final = 4.0
"""A tap goes at least up to this."""

PROTOCOL_RATE_HZ: Final = 149.0
"""Frame rate of the paper's camera."""

TEST_SETS: Final = (13, 14, 15)
"""Of the 15 sets of each environment; the paper does not say which three it tested on."""

SCALES: Final[dict[str, tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]]] = {
    "full": ((0, 10, 20, 30), tuple(range(1, 16)), (350, 550, 750)),
    "small": ((0, 30), (1, 2, 3, 4, 5, 6, 7, 8, 14, 15), (550,)),
}
"""Angles in degrees, numbers of the sets, and light levels in lux. What is in both has the same logs."""

_PROTOCOL_SEED: Final = 700_000
_TOUCHES: Final = 4
_PROTOCOL_PEAK_N: Final = 12.0
_FREE_N: Final = 0.1
"""What may still be felt between two touches."""

_DRAWS: Final = 8
_NEXT_DRAW: Final = 1000
"""A turned object can catch on an edge of a pad. Then the set is drawn again, from a seed so much higher."""


@dataclass(frozen=True, slots=True)
class SimulationPlan:
    """One log to make."""

    kind: Kind
    object: str
    seed: int

    @property
    def name(self) -> str:
        """The log's file name."""
        return f"{self.kind}-{self.object}-{self.seed:06d}.mcap"

    @property
    def names(self) -> tuple[str, ...]:
        """All file names: one."""
        return (self.name,)


@dataclass(frozen=True, slots=True)
class SetPlan:
    """One set of the paper's protocol.

    Attributes:
        object: What is touched.
        degrees: Turn of the object.
        number: Of the set among those of its object and angle, from 1.
        seed: Of the first draw of scene and peaks, the same for all light levels.
        lux: Light levels; each makes a log.
    """

    object: str
    degrees: int
    number: int
    seed: int
    lux: tuple[int, ...]

    @property
    def split(self) -> str:
        """Which side of the protocol's split the set is on: ``train`` or ``test``."""
        return split_of(self.number)

    @property
    def names(self) -> tuple[str, ...]:
        """The logs' file names, one for each light level."""
        stem = f"{self.split}/{self.object}-{self.degrees:02d}-{self.number:02d}"
        return tuple(f"{stem}-{lux}.mcap" for lux in self.lux)


def split_of(number: int) -> str:
    """Which side of the paper's split a set is on, by its number from 1: ``train`` or ``test``."""
    return "test" if number in TEST_SETS else "train"


def plan(kind: Kind, count: int, first_seed: int, objects: tuple[str, ...] = OBJECTS) -> list[SimulationPlan]:
    """``count`` logs, the objects in turn, each with a seed of its own."""
    return [SimulationPlan(kind, objects[i % len(objects)], first_seed + i) for i in range(count)]


def plan_protocol(scale: str) -> list[SetPlan]:
    """The sets of the paper's protocol, on one of `SCALES`. Raises `ConfigError` for another one."""
    if scale not in SCALES:
        raise ConfigError(f"no scale {scale!r} of the protocol; there are {', '.join(SCALES)}")
    angles, numbers, lux = SCALES[scale]
    every_angle, every_number, _ = SCALES["full"]
    # Objects change fastest, so that what is made of a run that was broken off holds all of them.
    return [
        SetPlan(
            name,
            degrees,
            number,
            _PROTOCOL_SEED
            + (i * len(every_angle) + every_angle.index(degrees)) * len(every_number)
            + number
            - 1,
            lux,
        )
        for number in numbers
        for degrees in angles
        for i, name in enumerate(OBJECTS)
    ]


def simulate(
    plans: Sequence[SimulationPlan | SetPlan], out: Path, config: Config, jobs: int
) -> Iterator[Path]:
    """Makes the logs that are not there yet, in several processes, and yields each as it is done.

    Raises:
        GripperError: A scene failed; the logs made so far stay.
    """
    out.mkdir(parents=True, exist_ok=True)
    missing = [p for p in plans if not all((out / name).exists() for name in p.names)]
    with process_pool(jobs) as pool:
        futures = [pool.submit(_make, p, out, config.model_dump(mode="json")) for p in missing]
        for future in as_completed(futures):
            yield from future.result()


def _make(task: SimulationPlan | SetPlan, out: Path, tree: dict[str, object]) -> list[Path]:
    return [make_log(task, out, tree)] if isinstance(task, SimulationPlan) else make_set(task, out, tree)


def make_log(task: SimulationPlan, out: Path, tree: dict[str, object]) -> Path:
    """Makes one log. It appears under its name only once it is whole, so an interrupted run can go on."""
    rng = np.random.default_rng([task.seed, 10])
    config = _randomised(config_from(tree, "simulate"), task, rng)
    path, unfinished = out / task.name, out / f".{task.name}.part"
    unfinished.unlink(missing_ok=True)
    if task.kind == "grasp":
        run_grasp(config, unfinished)
    else:
        (_tap if task.kind == "tap" else _press)(config, unfinished, rng)
    return unfinished.rename(path)


def make_set(task: SetPlan, out: Path, tree: dict[str, object]) -> list[Path]:
    """Makes the logs of a set that are not there yet; like `make_log`'s, they appear once they are whole.

    Raises:
        ConfigError: Camera or load cell are not the simulated ones.
        SimulationError: Each draw of the scene broke, came to no force, or had the object caught on a pad.
    """
    lights = {lux: out / name for lux, name in zip(task.lux, task.names, strict=True)}
    lights = {lux: path for lux, path in lights.items() if not path.exists()}
    unfinished = {lux: path.with_name(f".{path.name}.part") for lux, path in lights.items()}
    for path in unfinished.values():
        path.unlink(missing_ok=True)
    for draw in range(_DRAWS):
        seed = task.seed + draw * _NEXT_DRAW
        try:
            _run_set(config_from(tree, "simulate"), task, seed, unfinished)
            break
        except SimulationError:
            for path in unfinished.values():
                path.unlink(missing_ok=True)
            if draw == _DRAWS - 1:
                raise
    return [unfinished[lux].rename(path) for lux, path in lights.items()]


def _run_set(config: Config, task: SetPlan, seed: int, logs: dict[int, Path]) -> None:
    first, *others = logs
    rng = np.random.default_rng([seed, 11])
    config = _set_config(config, task, seed, first, rng)
    with open_devices(config) as devices:
        if (
            (config.camera.backend, config.load_cell.backend) != ("simulated", "simulated")
            or devices.camera is None
            or devices.load_cell is None
            or devices.render_under_light is None
        ):
            raise ConfigError(
                f"the protocol needs camera.backend and load_cell.backend simulated, got "
                f"{config.camera.backend!r} and {config.load_cell.backend!r}"
            )
        relit = [devices.render_under_light(lux) for lux in others]
        devices.camera = lit = _LitCamera(devices.camera, [camera for camera, _ in relit])
        devices.notes.update(protocol="shin2019", degrees=str(task.degrees), split=task.split, lux=str(first))
        with open_session(config, devices, logs[first], None) as session:
            _touch_four_times(session, task, rng, config.control.timeout_s)
    for lux, (_, notes), grays in zip(others, relit, lit.grays, strict=True):
        _relight(logs[first], logs[lux], lux, {**notes, "lux": str(lux)}, grays)


class _LitCamera:
    """A camera, and with it the pictures of others that see the same under another light."""

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


def _relight(source: Path, path: Path, lux: int, notes: dict[str, str], grays: dict[int, Gray]) -> None:
    """Copies a log, as the same set would have made it under another light."""
    reader = LogReader(source)
    config = config_from_text(reader.config, str(source))
    config = config.model_copy(update={"sim": config.sim.model_copy(update={"lux": float(lux)})})
    with LogWriter(path, config=dump_config(config), metadata={**reader.metadata, **notes}) as log:
        for record in reader.records():
            log.write(replace(record, gray=grays[record.seq]) if isinstance(record, Frame) else record)


def _set_config(config: Config, task: SetPlan, seed: int, lux: int, rng: np.random.Generator) -> Config:
    control = config.control.model_copy(
        update={
            "feedback": "current",
            "force_limit_n": 1.2 * PEAK_N,
            # Four touches in the paper's 500 frames leave 0.8 s for each.
            "approach_speed_m_s": 0.2,
            "approach_force_n": 1.5,
            "ramp_n_s": float(rng.uniform(100.0, 300.0)),
        }
    )
    return config.model_copy(
        update={
            "object": task.object,
            "seed": seed,
            "target_n": _PROTOCOL_PEAK_N,
            "control": control,
            "vision": config.vision.model_copy(update={"checkpoint": "none"}),
            "sim": config.sim.model_copy(
                update={"lux": float(lux), "yaw_deg": float(task.degrees), "tool": "rods"}  # as the paper's
            ),
        }
    )


def _touch_four_times(session: Session, task: SetPlan, rng: np.random.Generator, timeout_s: float) -> None:
    wait(session, 0.1)
    for _ in range(_TOUCHES):
        problem = touch(
            session,
            # High peaks are passed through quickly; the root has more of them drawn than low ones.
            _PROTOCOL_PEAK_N * float(np.sqrt(rng.uniform(0.01, 1.0))),
            float(rng.uniform(0.02, 0.1)),
            free_n=_FREE_N,
            timeout_s=timeout_s,
            patience_s=1.0,
        )
        if problem:
            raise SimulationError(
                f"a touch of {task.object!r} at {task.degrees} degrees {problem}; take another seed"
            )


def _randomised(config: Config, task: SimulationPlan, rng: np.random.Generator) -> Config:
    control = config.control.model_copy(
        update={
            "feedback": "current",
            "force_limit_n": 1.2 * PEAK_N,
            "approach_speed_m_s": float(rng.uniform(0.02, 0.05)),
            "ramp_n_s": float(np.exp(rng.uniform(np.log(3.0), np.log(25.0)))),
            "hold_s": float(rng.uniform(0.3, 1.0)),
        }
    )
    return config.model_copy(
        update={
            "object": task.object,
            "seed": task.seed,
            "target_n": _target_n(rng),
            "control": control,
            "vision": config.vision.model_copy(update={"checkpoint": "none"}),
        }
    )


def _target_n(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.5, PEAK_N))


def _press(config: Config, path: Path, rng: np.random.Generator) -> None:
    with open_devices(config) as devices, open_session(config, devices, path, None) as session:
        wait(session, 0.2)
        for _ in range(int(rng.integers(_MAX_TARGETS)) + 1):
            ramp(session, _target_n(rng), config.control.timeout_s)
            wait(session, float(rng.uniform(0.05, 0.6)))
        release(session, config)


def _tap(config: Config, path: Path, rng: np.random.Generator) -> None:
    fast = {"approach_speed_m_s": 0.05, "ramp_n_s": float(np.exp(rng.uniform(np.log(10.0), np.log(30.0))))}
    config = config.model_copy(update={"control": config.control.model_copy(update=fast)})
    with open_devices(config) as devices, open_session(config, devices, path, None) as session:
        wait(session, 0.1)
        peak_n = float(rng.uniform(_TAP_N, PEAK_N))
        ramp(session, peak_n, config.control.timeout_s)
        wait(session, float(rng.uniform(0.03, 0.2)))
        if rng.random() < 0.5:
            ramp(session, float(rng.uniform(0.5, peak_n)), config.control.timeout_s)
        release(session, config)
