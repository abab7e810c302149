"""Calibration of a load cell with a known mass: empty, loaded, empty again."""

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from gripper_calibration.fits.load_cell_fit import LoadCellFit, Rest, fit_load_cell, rest_statistics
from gripper_calibration.plots.load_cell_plot import draw
from gripper_force.config import Config
from gripper_force.errors import ConfigError, DataError, DeviceTimeoutError
from gripper_force.interfaces import Clock, LoadCell
from gripper_force.jobs.checks import open_load_cell
from gripper_force.jobs.profile_files import rig_to_update, update_rig
from gripper_force.profiles.rig_profile import LoadCellCalibration
from gripper_force.progress import Progress, Prompt, no_progress
from gripper_force.runtime.backends import MonotonicClock
from gripper_force.types import NS_PER_MS, NS_PER_S, STANDARD_GRAVITY_M_S2, LoadCellSample

NEUTRAL_N_PER_RAW: Final = 1e-9
"""A scale so small that no threshold in newtons acts: the driver then only rejects saturated and
stuck readings. The fit rejects spikes, because it knows the scale."""

_PERIOD_NS: Final = 50 * NS_PER_MS
_SETTLE_NS: Final = NS_PER_S
"""Time for the load to settle after a person has let go."""
_SILENT_NS: Final = 3 * NS_PER_S
_MAX_FORCE_N: Final = 1000.0
_MIN_CHANGE: Final = 10
_MAX_RANGE: Final = 0.01
"""A load is accepted if its change is this many times its uncertainty and its range this share of the change."""


@dataclass(frozen=True, slots=True)
class LoadCellResult:
    """Result of `calibrate_load_cell`.

    Attributes:
        calibration: The section of the rig profile.
        return_n: Difference of the two empty readings.
        rejected: Number of readings that were not used.
        rig: The rig profile.
        report: The figure, PNG.
    """

    calibration: LoadCellCalibration
    return_n: float
    rejected: int
    rig: Path
    report: Path


def calibrate_load_cell(
    config: Config,
    force_n: float,
    rig: Path,
    *,
    prompt: Prompt,
    seconds: float = 10.0,
    progress: Progress = no_progress,
) -> LoadCellResult:
    """Weighs a known mass, and writes the rig profile's section and a figure beside it.

    Args:
        config: The configuration. Tare and scale in its section ``load_cell`` are not used.
        force_n: Weight of the mass, in newtons.
        rig: Rig profile to write; an existing one keeps its other sections.
        prompt: Called when a person has to change the load.
        seconds: Duration of the readings of each load.
        progress: Called with the newest reading a few times per second.

    Raises:
        ConfigError: There is no load cell to calibrate, or the profile can't be read or written.
        DeviceError: The load cell can't be opened, or gives no readings.
        DataError: The readings are not sufficient for a calibration.
    """
    section = config.load_cell
    if section.backend in ("none", "simulated"):
        raise ConfigError(
            f"load_cell.backend={section.backend} has no raw readings that a mass could change; set the "
            "backend of your load cell: serial or phidget, or playback for a log of one"
        )
    if not 0 < force_n <= _MAX_FORCE_N:
        raise ConfigError(f"a mass of {force_n:g} N can't be weighed; use one of up to {_MAX_FORCE_N:g} N")
    rig_to_update(rig)  # raises if it can't be read or written
    clock = MonotonicClock()
    neutral = config.with_values(load_cell={"tare_raw": 0.0, "n_per_raw": NEUTRAL_N_PER_RAW})
    cell: LoadCell = open_load_cell(neutral, clock)
    with closing(cell):
        cell.start()
        fit = weigh(cell, clock, force_n, prompt=prompt, seconds=seconds, progress=progress)
    calibration = LoadCellCalibration(
        date=datetime.now(UTC).replace(microsecond=0),
        sensor=section.sensor,
        tare_raw=fit.tare_raw,
        n_per_raw=fit.n_per_raw,
        force_n=(0.0, force_n),
        noise_n=fit.noise_n,
        drift_n_min=fit.drift_n_min,
    )
    update_rig(rig, calibration)
    report = rig.with_name(f"{rig.stem}-load-cell.png")
    draw(fit, report)
    return LoadCellResult(calibration, fit.return_n, fit.rejected, rig, report)


def weigh(
    cell: LoadCell,
    clock: Clock,
    force_n: float,
    *,
    prompt: Prompt,
    seconds: float = 10.0,
    timeout_s: float = 60.0,
    progress: Progress = no_progress,
) -> LoadCellFit:
    """Prompts for the three loads in turn, and reads each until it is at rest.

    Args:
        cell: A started load cell with the scale `NEUTRAL_N_PER_RAW`.
        clock: Its clock.
        force_n: Weight of the known mass, in newtons.
        prompt: Called when a person has to change the load.
        seconds: Duration of the readings of each load.
        timeout_s: Longest wait for a rest, beyond `seconds`.
        progress: Called with the newest reading a few times per second.

    Raises:
        DeviceTimeoutError: The cell gives no readings.
        DataError: A reading does not rest, hardly changes with the load, or does not return.
    """
    reader = _RestReader(cell, clock, round(seconds * NS_PER_S), round(timeout_s * NS_PER_S), progress)
    prompt("Take everything off the load cell")
    empty = reader.read("empty", lambda _: True)
    tare_raw = rest_statistics(empty, 0.0, "without load").raw  # an error comes before anyone carries masses
    prompt(
        f"Put the mass of {force_n / STANDARD_GRAVITY_M_S2:.4g} kg ({force_n:.4g} N) on it and let it rest"
    )

    def is_loaded(rest: Rest) -> bool:
        try:
            tare = rest_statistics(empty, 0.0, "without load", reader.step_raw)
            present = rest_statistics(rest, 0.0, "under load", reader.step_raw)
        except DataError:
            return False
        change = abs(present.raw - tare.raw)
        return bool(
            change > _MIN_CHANGE * (present.half_raw + tare.half_raw)
            and present.range_raw < _MAX_RANGE * change
        )

    loaded = reader.read("loaded", is_loaded)
    change = abs(rest_statistics(loaded, 0.0, "under load").raw - tare_raw)

    def is_unloaded(rest: Rest) -> bool:
        try:
            present = rest_statistics(rest, 0.0, "after unloading")
        except DataError:
            return False
        return bool(
            abs(present.raw - tare_raw) < _MAX_RANGE * change and present.range_raw < _MAX_RANGE * change
        )

    prompt("Take the mass off again")
    empty_again = reader.read("empty again", is_unloaded)
    return fit_load_cell(empty, loaded, empty_again, force_n, reader.step_raw)


class _RestReader:
    """Reads a load cell until a span of readings is good, or a time has passed."""

    def __init__(
        self, cell: LoadCell, clock: Clock, span_ns: int, timeout_ns: int, progress: Progress
    ) -> None:
        self._cell, self._clock, self._progress = cell, clock, progress
        self._span_ns, self._timeout_ns = span_ns, timeout_ns
        self._seen_raw: set[float] = set()

    @property
    def step_raw(self) -> float:
        """Smallest difference of two readings so far."""
        return float(min(np.diff(sorted(self._seen_raw)), default=math.inf))

    def read(self, step: str, is_good: Callable[[Rest], bool]) -> Rest:
        """Returns the first good span of readings, or after the timeout the last one."""
        begin_ns = newest_ns = self._clock.now_ns() + _SETTLE_NS
        end_ns = begin_ns + self._span_ns + self._timeout_ns
        self._drain()  # also what was shown while a person changed the load
        samples: list[LoadCellSample] = []
        check_ns = begin_ns + self._span_ns
        while True:
            now_ns = self._clock.now_ns() + _PERIOD_NS
            self._clock.sleep_until_ns(now_ns)
            samples += [sample for sample in self._drain() if sample.t_ns >= begin_ns]
            if samples:
                newest_ns = max(newest_ns, samples[-1].t_ns)
                self._progress(f"{step}: {samples[-1].raw:.6g}", 0)
            if now_ns - newest_ns > _SILENT_NS:
                counts = ", ".join(f"{n} {name}" for name, n in self._cell.counts().items() if n)
                raise DeviceTimeoutError(
                    f"the load cell gives no readings (counted: {counts or 'nothing'}); check its cable and "
                    "the load_cell keys, and run `gripper-force doctor`"
                )
            if newest_ns < check_ns:
                continue
            check_ns = newest_ns + self._span_ns // 10
            samples = [sample for sample in samples if sample.t_ns > newest_ns - self._span_ns]
            rest = _rest(samples)
            if is_good(rest) or now_ns > end_ns:
                return rest

    def _drain(self) -> list[LoadCellSample]:
        samples = self._cell.drain()
        self._seen_raw |= {sample.raw for sample in samples if sample.valid}
        return samples


def _rest(samples: list[LoadCellSample]) -> Rest:
    return Rest(
        np.array([sample.t_ns / NS_PER_S for sample in samples]),
        np.array([sample.raw for sample in samples]),
        np.array([sample.valid for sample in samples], np.bool_),
    )
