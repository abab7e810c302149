"""Step ``load-cell``: tare and scale, with a known mass."""

from typing import Final

from gripper_calibration.procedures.calibrate_load_cell import calibrate_load_cell
from gripper_calibration.setup.step import Found, StepResult, Task
from gripper_force.config import Config
from gripper_force.jobs import doctor
from gripper_force.profiles.rig_profile import CalibratedValue
from gripper_force.types import STANDARD_GRAVITY_M_S2

PROFILE: Final = "measured.yaml"
"""Rig profile in the setup's folder, in which the procedures keep their results."""

_IN_NEWTONS: Final = ("simulated", "playback")
"""Backends without raw readings."""

WITHOUT: Final = (
    "Without a load cell, only what needs a measured force does not work: `calibrate servo`, `calibrate camera`, "
    "`calibrate object`, `record`, `teach` and training. Motor current is then the reference; the next step can "
    "compare it with a known mass, and states its error."
)


def load_cell_uses(config: Config) -> tuple[str, ...]:
    """Returns the names in `Task` of what the step uses: a mass, if the load cell has raw readings."""
    return () if config.load_cell.backend in ("none", *_IN_NEWTONS) else ("mass_kg",)


def load_cell(task: Task) -> StepResult:
    """Calibrates the load cell, or says what is possible without one.

    Raises:
        ConfigError: A script did not give the mass.
        GripperError: See `calibrate_load_cell`.
    """
    backend = task.config.load_cell.backend
    if backend == "none":
        return StepResult("no load cell", remarks=[WITHOUT])
    if backend in _IN_NEWTONS:
        return StepResult(f"the {backend} load cell gives newtons and needs no calibration")
    mass_kg = task.mass_kg
    if mass_kg is None:
        mass_kg = 1e-3 * task.number("Known mass in grams", "--mass-kg KG")
    result = calibrate_load_cell(
        task.config,
        mass_kg * STANDARD_GRAVITY_M_S2,
        task.folder / PROFILE,
        prompt=task.person.do,
        progress=task.progress,
    )
    cell = result.calibration
    origin = f"weighed with {1e3 * mass_kg:g} g, {cell.date.date().isoformat()}"
    config = task.config.with_values(
        load_cell={"tare_raw": cell.tare_raw.value, "n_per_raw": cell.n_per_raw.value}
    )
    remarks = [f"load cell, {one.name}: {one.found}" for one in doctor.check_unit(config, "load cell")]
    return StepResult(
        f"calibrated with {1e3 * mass_kg:g} g; noise {cell.noise_n:.3f} N",
        {
            "load_cell.tare_raw": Found(cell.tare_raw.value, origin),
            "load_cell.n_per_raw": Found(cell.n_per_raw.value, f"{interval(cell.n_per_raw)}, {origin}"),
        },
        remarks,
        {"figure": result.report},
        {"load_cell": cell},
        {"mass_kg": mass_kg},
    )


def interval(value: CalibratedValue) -> str:
    """The 95 % interval of a value, for a comment."""
    return "given" if value.low is None else f"95 %: {value.low:.4g} to {value.high:.4g}"
