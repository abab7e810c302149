"""Runs the steps of a setup: those that are not finished, or that rest on values which have changed."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal

from gripper_calibration.setup.camera import camera
from gripper_calibration.setup.jaws import jaws
from gripper_calibration.setup.load_cell import load_cell, load_cell_uses
from gripper_calibration.setup.rig_file import RigFile, flat
from gripper_calibration.setup.scan import scan
from gripper_calibration.setup.servo import servo
from gripper_calibration.setup.step import Person, StepResult, Task, is_answer
from gripper_calibration.setup.torque import torque, torque_uses
from gripper_force.config import Config, load_config
from gripper_force.errors import ConfigError
from gripper_force.progress import Progress, no_progress


@dataclass(frozen=True, slots=True)
class Step:
    """A step of the setup.

    Attributes:
        title: What it does, for a person.
        run: Its function.
        rests_on: Sections and keys of the configuration; if one changes, the step runs again.
        set_keys: Keys among them that the step sets itself.
        uses: Returns which of mass and width the step uses with a configuration; another one makes it run again.
    """

    title: str
    run: Callable[[Task], StepResult]
    rests_on: tuple[str, ...] = ()
    set_keys: tuple[str, ...] = ()
    uses: Callable[[Config], tuple[str, ...]] = lambda config: ()


_SERVO: Final = (
    "servo.backend",
    "servo.port",
    "servo.id",
    "servo.second",
    "servo.model",
    "servo.homing_offset",
)
_GEOMETRY: Final = ("gripper.linkage", "gripper.pinion_radius_m")

STEPS: Final = {
    "scan": Step("servo, camera and load cell are looked for", scan),
    "servo": Step(
        "the servo is checked and set up",
        servo,
        ("servo.backend", "servo.port", "servo.id", "servo.second", "servo.model", "servo.current_limit_a"),
    ),
    "jaws": Step(
        "the empty jaws move to both ends",
        jaws,
        (*_SERVO, *_GEOMETRY),
        ("gripper.pinion_radius_m",),
    ),
    "camera": Step(
        "a picture is taken and judged", camera, ("camera",), ("camera.exposure_us", "camera.timeout_ms")
    ),
    "load-cell": Step(
        "the load cell weighs a known mass",
        load_cell,
        ("load_cell",),
        ("load_cell.tare_raw", "load_cell.n_per_raw", "load_cell.rate_hz"),
        load_cell_uses,
    ),
    "torque": Step(
        "motor current is compared with newtons",
        torque,
        (*_SERVO, "load_cell", *_GEOMETRY, "gripper.closing_sign"),
        uses=torque_uses,
    ),
}
"""The steps by name, in their order."""

_OPTIONS: Final = {
    "mass_kg": ("--mass-kg", "weighs or hangs up a known mass"),
    "gauge_mm": ("--gauge-mm", "presses a load cell"),
}
"""Mass and width by their names in `Task`: the option, and what a step that uses it does."""


@dataclass(frozen=True, slots=True)
class StepReport:
    """Report of a step.

    Attributes:
        name: Its name.
        result: done: it ran now; kept: it was finished before.
        summary: One sentence.
        remarks: What a person should know.
        values: Keys that it set.
        files: Pictures, by what they show.
        details: Anything else for scripts.
    """

    name: str
    result: Literal["done", "kept"]
    summary: str
    remarks: Sequence[str]
    values: dict[str, Any]
    files: dict[str, str]
    details: dict[str, Any]


class Setup:
    """A setup of one rig.

    Attributes:
        rig: The rig file and the state.
    """

    def __init__(
        self,
        path: Path,
        overrides: list[str] | None = None,
        *,
        only: str | Sequence[str] | None = None,
        fresh: bool = False,
        mass_kg: float | None = None,
        gauge_mm: float | None = None,
    ) -> None:
        """Reads the rig file, which need not exist.

        Args:
            path: The rig file.
            overrides: Assignments ``key.path=value``; they go into the file.
            only: Name of the only step to run, even if it is finished, or names of several, which run in the order of
                `STEPS`; None: all that are not finished.
            fresh: Forgets what earlier steps found. `run` first copies the rig file into the setup's folder.
            mass_kg: Known mass for the load cell, or without one for a jaw; None: asked for.
            gauge_mm: Width of the load cell between the jaws; None: asked for.

        Raises:
            ConfigError: A file, key, value, step, mass or width is wrong.
        """
        steps = [only] if isinstance(only, str) else list(only or ())
        check_steps(steps)
        if fresh and steps:
            raise ConfigError(
                f"--fresh forgets what all steps found, but --step {steps[0]} does not run the others; leave out "
                "--fresh to run the step again, or --step to start over"
            )
        self._options = {
            name: value for name, value in (("mass_kg", mass_kg), ("gauge_mm", gauge_mm)) if value is not None
        }
        for name, value in self._options.items():
            text, _ = _OPTIONS[name]
            if not is_answer(value, None):
                raise ConfigError(f"{text} is {value:g}; pass a positive number, or leave {text} out")
        load_config(path if path.exists() else None, overrides)  # its messages name the file
        self.rig = RigFile.load(path, overrides, fresh=fresh)
        self._has_overrides, self._fresh = bool(overrides), fresh
        self._only = steps

    @property
    def config(self) -> Config:
        """The configuration so far."""
        return load_config(None, self.rig.tree())

    @property
    def pending(self) -> list[str]:
        """Names of the steps that are not finished, or rest on values which have changed since."""
        return [
            name for name, step in STEPS.items() if name not in self.rig.steps or self._changed(name, step)
        ]

    def run(self, person: Person, progress: Progress = no_progress) -> Iterator[StepReport]:
        """Runs the steps and writes the rig file after each.

        Args:
            person: Answers questions.
            progress: Called with what the devices do.

        Raises:
            GripperError: A step failed. What earlier steps found is in the rig file.
        """
        if self._fresh and (copy := self.rig.copy_before_fresh()) is not None:
            person.tell(f"the earlier rig file is kept as {copy}")
        for number, (name, step) in enumerate(STEPS.items(), 1):
            if self._only and name not in self._only:
                continue
            if not self._only and name in self.rig.steps:
                changed = [*self._changed(name, step), *self._changed_options(name, step)]
                if not changed:
                    yield self._kept(name)
                    continue
                person.tell(f"{name} runs again, because these changed: {', '.join(changed)}")
            self.rig.check_writable()  # before the step writes to the servo
            person.tell(f"[{number} of {len(STEPS)}] {name}: {step.title}")
            self.rig.forget(name)
            task = Task(
                config=self.config,
                given={key: one.value for key, one in self.rig.given.items()},
                folder=self.rig.folder,
                person=person,
                progress=progress,
                mass_kg=self._options.get("mass_kg"),
                gauge_mm=self._options.get("gauge_mm"),
                keep=self.rig.keep,
            )
            result = step.run(task)
            report = self._finish(name, step, result)
            outdated = [one for one in self.rig.outdate(name) if one not in self._only]
            if self._only and outdated:
                person.tell(f"{', '.join(outdated)} rests on what {name} found: run setup without --step")
            yield report
        self._tell_unused(person)
        if self._has_overrides:  # also if no step had to run
            self.rig.write()

    def _finish(self, name: str, step: Step, result: StepResult) -> StepReport:
        files = {what: str(path) for what, path in result.files.items()}
        self.rig.take(result.values)
        self.rig.finish(
            name,
            {
                "date": datetime.now(UTC).replace(microsecond=0).isoformat(),
                "summary": result.summary,
                "remarks": list(result.remarks),
                "files": files,
                "rests_on": self._inputs(step),
                "values": result.values,
                "used": result.used,
            },
            STEPS,
        )
        values = {key: found.value for key, found in result.values.items()}
        return StepReport(name, "done", result.summary, result.remarks, values, files, dict(result.details))

    def _kept(self, name: str) -> StepReport:
        state = self.rig.steps[name]
        summary = f"{state['summary']} ({state['date'][:10]})"
        return StepReport(name, "kept", summary, state["remarks"], {}, state["files"], {})

    def _inputs(self, step: Step) -> dict[str, Any]:
        """The values that a step rests on, as in JSON."""
        leaves = flat(self.config.model_dump(mode="json"))
        return {
            key: value
            for key, value in leaves.items()
            if key not in step.set_keys
            and any(key == one or key.startswith(f"{one}.") for one in step.rests_on)
        }

    def _changed(self, name: str, step: Step) -> list[str]:
        """Keys whose values differ from those that a finished step rested on."""
        if outdated_by := self.rig.steps[name].get("outdated_by"):
            return [f"what {outdated_by} found"]
        old, new = self.rig.steps[name].get("rests_on", {}), self._inputs(step)
        return [key for key in new if new[key] != old.get(key)]

    def _changed_options(self, name: str, step: Step) -> list[str]:
        """Mass or width, if another one is given than the one that a finished step used."""
        return [
            f"{_OPTIONS[one][0]}, now {self._options[one]:g}"
            for one in step.uses(self.config)
            if one in self._options and not self._has_used(name, one)
        ]

    def _has_used(self, name: str, option: str) -> bool:
        used = self.rig.steps.get(name, {}).get("used", {}).get(option)
        return used is not None and math.isclose(used, self._options[option])

    def _tell_unused(self, person: Person) -> None:
        for option, value in self._options.items():
            if not any(self._has_used(name, option) for name in self._only or STEPS):
                text, does = _OPTIONS[option]
                person.tell(f"{text} {value:g} was not used: with this rig, no step of this run {does}")


def check_steps(names: Sequence[str]) -> None:
    """Raises `ConfigError` if there is no step of one of these names."""
    for name in names:
        if name not in STEPS:
            raise ConfigError(f"there is no step {name!r}; use one of {', '.join(STEPS)}")
