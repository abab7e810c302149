"""Tare and scale of a load cell with a known mass: empty, loaded, empty again."""

from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from gripper_calibration.fits.load_cell_fit import Rest, Weighing, fit_load_cell, level
from gripper_calibration.plots.load_cell_plot import draw
from gripper_force.config import Config
from gripper_force.errors import ConfigError, DataError, DeviceTimeoutError
from gripper_force.interfaces import Clock, LoadCell
from gripper_force.profiles.rig_profile import LoadCellCalibration, read_rig, update_rig
from gripper_force.runtime.backends import LOAD_CELLS, MonotonicClock, load
from gripper_force.types import NS_PER_MS, NS_PER_S, LoadCellSample

STANDARD_GRAVITY_M_S2: Final = 9.80665
NEUTRAL: Final = 1e-9
"""Newtons for a unit of the reading, so few that no threshold in newtons acts: what the driver then rejects
is what the reading itself says, saturation and standstill. The fit tells spikes, once it knows the scale."""

_PERIOD_NS: Final = 50 * NS_PER_MS
_SHAKEN_NS: Final = NS_PER_S
"""A hand has just let go."""
_SILENT_NS: Final = 3 * NS_PER_S
_MOST_N: Final = 1000.0
_AWAY: Final = 10
_STEADY: Final = 0.01
_WEIGHING: Final = {n: path for n, path in LOAD_CELLS.items() if path is not None and n != "simulated"}
_NAMES: Final = ("empty", "loaded", "empty again")

Ask = Callable[[str], None]
"""Says what is to be done, and returns once it may have been."""

Progress = Callable[[str, float], None]
"""Told of the step and the newest reading, a few times a second."""


def calibrate(
    config: Config, force_n: float, rig: Path, *, ask: Ask, seconds: float, progress: Progress
) -> dict[str, Any]:
    """Weighs a known mass, writes the rig profile's section and a picture beside it.

    Args:
        config: The run; of its section ``load_cell``, tare and scale do not count.
        force_n: Weight of the mass.
        rig: The rig profile to write, or to replace the section of.
        ask: Says what is to be done.
        seconds: How long each load is to rest.
        progress: Told of the step and the newest reading.

    Returns:
        The section, what was left out, and the paths.

    Raises:
        ConfigError: There is no load cell to calibrate, or the profile can't be read or written.
        DeviceError: The load cell can't be opened, or gives no reading.
        DataError: The readings give no calibration.
    """
    section = config.load_cell
    if section.backend not in _WEIGHING:
        raise ConfigError(
            f"load_cell.backend={section.backend} has no raw readings that a mass could change; name the "
            "load cell that you have: serial or phidget, or playback for a log of one"
        )
    if not 0 < force_n <= _MOST_N:
        raise ConfigError(f"a mass of {force_n:g} N can't be weighed; take one of up to {_MOST_N:g} N")
    if rig.exists():
        read_rig(rig)  # before anybody has carried masses
    clock = MonotonicClock()
    neutral = section.model_copy(update={"tare_raw": 0.0, "n_per_raw": NEUTRAL})
    cell: LoadCell = load(_WEIGHING[section.backend])(neutral, clock)
    with closing(cell):
        cell.start()
        weighing = weigh(cell, clock, force_n, ask=ask, seconds=seconds, progress=progress)
    found = LoadCellCalibration(
        date=datetime.now(UTC).replace(microsecond=0),
        sensor=section.sensor,
        tare_raw=weighing.tare_raw,
        n_per_raw=weighing.n_per_raw,
        force_n=(0.0, force_n),
        noise_n=weighing.noise_n,
        drift_n_min=weighing.drift_n_min,
    )
    update_rig(rig, found)
    report = rig.with_name(f"{rig.stem}-load-cell.png")
    draw(weighing, report)
    return {
        **found.model_dump(mode="json"),
        "return_n": weighing.return_n,
        "rejected": weighing.rejected,
        "rig": rig,
        "report": report,
    }


def weigh(
    cell: LoadCell,
    clock: Clock,
    force_n: float,
    *,
    ask: Ask,
    seconds: float = 10.0,
    patience_s: float = 60.0,
    progress: Progress = lambda _step, _raw: None,
) -> Weighing:
    """Asks for the three loads in turn, and reads each until it has rested for some time.

    Args:
        cell: A load cell that was started; with a scale of `NEUTRAL`, no threshold in newtons acts.
        clock: Its time.
        force_n: Weight of the known mass.
        ask: Says what is to be done.
        seconds: How long each load is to rest.
        patience_s: How long to wait for that, beyond `seconds`.
        progress: Told of the newest reading.

    Raises:
        DeviceTimeoutError: The cell gives no reading.
        DataError: A reading does not rest, hardly changes with the load, or does not come back.
    """
    scale = _Scale(cell, clock, round(seconds * NS_PER_S), round(patience_s * NS_PER_S), progress)
    ask("Take everything off the load cell")
    empty = scale.read(_NAMES[0], lambda _: True)
    tare = level(empty, 0.0, "without load")
    ask(f"Put the mass of {force_n / STANDARD_GRAVITY_M_S2:.4g} kg ({force_n:.4g} N) on it and let it rest")

    def rests(rest: Rest) -> bool:
        try:
            now = level(rest, 0.0, "under load")
        except DataError:
            return False
        change = abs(now.raw - tare.raw)
        return change > _AWAY * (now.half_raw + tare.half_raw) and now.moved_raw < _STEADY * change

    loaded = scale.read(_NAMES[1], rests)
    under = level(loaded, 0.0, "under load")

    def is_back(rest: Rest) -> bool:
        try:
            now = level(rest, 0.0, "after the load was taken off")
        except DataError:
            return False
        change = abs(under.raw - tare.raw)
        return abs(now.raw - tare.raw) < _STEADY * change and now.moved_raw < _STEADY * change

    ask("Take the mass off again")
    again = scale.read(_NAMES[2], is_back)
    return fit_load_cell(empty, loaded, again, force_n)


class _Scale:
    """Reads a load cell until a span of readings is as it should be, or patience ends."""

    def __init__(
        self, cell: LoadCell, clock: Clock, span_ns: int, patience_ns: int, progress: Progress
    ) -> None:
        self._cell, self._clock, self._progress = cell, clock, progress
        self._span_ns, self._patience_ns = span_ns, patience_ns

    def read(self, step: str, is_good: Callable[[Rest], bool]) -> Rest:
        """The last span of readings; where patience ends, as it is."""
        begin_ns = heard_ns = self._clock.now_ns() + _SHAKEN_NS
        end_ns = begin_ns + self._span_ns + self._patience_ns
        self._cell.drain()
        samples: list[LoadCellSample] = []
        judge_ns = begin_ns + self._span_ns
        while True:
            now_ns = self._clock.now_ns() + _PERIOD_NS
            self._clock.sleep_until_ns(now_ns)
            samples += [sample for sample in self._cell.drain() if sample.t_ns >= begin_ns]
            if samples:
                heard_ns = max(heard_ns, samples[-1].t_ns)
                self._progress(step, samples[-1].raw)
            if now_ns - heard_ns > _SILENT_NS:
                counts = ", ".join(f"{n} {name}" for name, n in self._cell.counts().items() if n)
                raise DeviceTimeoutError(
                    f"the load cell gives no reading (counted: {counts or 'nothing'}); check its cable and "
                    "its section of the configuration, and see what doctor says"
                )
            if heard_ns < judge_ns:
                continue
            judge_ns = heard_ns + self._span_ns // 10
            samples = [sample for sample in samples if sample.t_ns > heard_ns - self._span_ns]
            rest = _rest(samples)
            if is_good(rest) or now_ns > end_ns:
                return rest


def _rest(samples: list[LoadCellSample]) -> Rest:
    return Rest(
        np.array([sample.t_ns / NS_PER_S for sample in samples]),
        np.array([sample.raw for sample in samples]),
        np.array([sample.valid for sample in samples], np.bool_),
    )
