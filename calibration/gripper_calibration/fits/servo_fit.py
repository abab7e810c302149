"""Torque, friction and jaw geometry of a servo from presses against a load cell and from free travel."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import stats

from gripper_force.errors import DataError
from gripper_force.profiles.rig_profile import CalibratedValue

LEAST_PRESSES: Final = 5
LEAST_PASSES: Final = 8
SLID_N: Final = 0.4
"""Change of force after a turn that shows that friction has let go."""

LEAST_N: Final = 0.3
"""Forces below this may be a load cell's drift."""

_LEAST_ROWS: Final = 10
_OUTLIER: Final = 6.0
_MOST_OUTLIERS: Final = 0.1
_MOST_UNKNOWN: Final = 0.25
_MOST_RESIDUAL: Final = 0.15
_LARGEST: Final = 1e6
_WINDOWS: Final = 4
"""Parts of a pass: the jaws gather speed in the first, which tells inertia from friction."""

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ServoPress:
    """The jaws press a gauge with a current that rises steadily and falls steadily. Positive closes.

    Attributes:
        gauge_m: Width of the gauge.
        t_s: Times, (N,).
        current_a: Measured current, (N,).
        force_n: What the load cell reads at these times, (N,).
        closing_rad: Angle of the horn in the closing direction, (N,).
        turn: Index of the first reading of the falling current.
    """

    gauge_m: float
    t_s: Floats
    current_a: Floats
    force_n: Floats
    closing_rad: Floats
    turn: int


@dataclass(frozen=True, slots=True)
class FreePass:
    """Free travel under a constant current. Positive closes.

    Attributes:
        t_s: Times, (N,).
        current_a: Measured current, (N,).
        closing_rad: Angle of the horn in the closing direction, (N,).
        closing_rad_s: Its speed, (N,).
    """

    t_s: Floats
    current_a: Floats
    closing_rad: Floats
    closing_rad_s: Floats


@dataclass(frozen=True, slots=True)
class Nominal:
    """What is taken as given.

    Attributes:
        pinion_radius_m: Pitch radius of the pinion; measured instead where there are gauges of two widths.
        open_width_m: Distance between the jaws at the angle that is to be called open.
        scale_share: Share by which the load cell's scale may be off: all forces are off by the same.
    """

    pinion_radius_m: float
    open_width_m: float
    scale_share: float = 0.0


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of a regression.

    Attributes:
        columns: Regressors, (N, K).
        target: What they explain, (N,).
        cluster: Which press or pass each row is of, (N,).
    """

    columns: Floats
    target: Floats
    cluster: Floats


@dataclass(frozen=True, slots=True)
class ServoFit:
    """What was found, and what it rests on. Forces and friction are those at one jaw.

    Attributes:
        n_per_a: Push at each jaw per ampere.
        nm_per_a: Torque constant at the horn.
        friction_n: Coulomb friction under load, at the mean force.
        friction_share: How it grows with the force.
        offset_a: Current that is read without any push.
        lag_s: What the force lags behind the current, viscous friction under load included.
        free_friction_n: Coulomb friction in free travel.
        damping_n_s_m: Viscous friction in free travel.
        pinion_radius_m: Pitch radius of the pinion.
        open_position_rad: Angle in the closing direction at `Nominal.open_width_m`, on the closing flank.
        force_n: Least and greatest force that was pressed with.
        speed_m_s: Least and greatest speed of a jaw in free travel.
        residual_n: Root mean square of what the fit leaves.
        outliers: Rows left out.
        pressed: Force, current and residual in newtons, up and down: (N, 4) with the side last.
        travelled: Speed in m/s, push in newtons without inertia's part, of each part of a pass: (M, 2).
    """

    n_per_a: CalibratedValue
    nm_per_a: CalibratedValue
    friction_n: CalibratedValue
    friction_share: CalibratedValue
    offset_a: CalibratedValue
    lag_s: CalibratedValue
    free_friction_n: CalibratedValue
    damping_n_s_m: CalibratedValue
    pinion_radius_m: CalibratedValue
    open_position_rad: CalibratedValue
    force_n: tuple[float, float]
    speed_m_s: tuple[float, float]
    residual_n: float
    outliers: int
    pressed: Floats
    travelled: Floats


def fit_servo(presses: Sequence[ServoPress], passes: Sequence[FreePass], nominal: Nominal) -> ServoFit:
    """Fits statics to presses, viscous friction to passes, geometry to where presses begin.

    While the jaws slide, the motor's push is the force and what friction takes, up or down::

        current = offset + (force + side * (friction + share * force) + lag * rate of force) / n_per_a
        current = offset + (side * friction + damping * speed + mass * acceleration) / n_per_a

    The current is explained and not the force, as of the two it is the one with the noise.

    Raises:
        DataError: There are too few presses or passes, they contradict each other, or nothing follows.
    """
    if len(presses) < LEAST_PRESSES:
        raise DataError(
            f"{len(presses)} presses slid both ways, and {LEAST_PRESSES} are needed; press more often"
        )
    rows = _press_rows(presses)
    force, current, _, side, rate, _, number = rows.T
    columns = np.column_stack([np.ones(len(rows)), force, side, side * force, rate])
    beta, table, kept = _robust(Table(columns, current, number), "presses")
    force_n = force[kept]
    mean_n = float(force_n.mean())
    _require(
        beta[1] > 0, "more current does not mean more force; see to gripper.closing_sign and the load cell"
    )

    def statics(b: Floats) -> Floats:
        n_per_a = 1 / b[1]
        return np.array([n_per_a, (b[2] + b[3] * mean_n) * n_per_a, b[3] * n_per_a, b[0], b[4] * n_per_a])

    values, half = _jackknife(table, statics, between=2)
    half[:2] = np.hypot(half[:2], nominal.scale_share * values[:2])
    n_per_a, friction_n, share, offset_a, lag_s = values
    residual_n = (table.target - table.columns @ beta) * n_per_a
    rms_n = float(np.sqrt(np.mean(residual_n**2)))
    span_n = float(np.ptp(force_n))
    _require(
        half[0] < _MOST_UNKNOWN * n_per_a,
        f"the torque constant is only known within {100 * half[0] / abs(n_per_a):.0f} %; press harder and "
        "more often, and see that the load cell lies straight between the jaws",
    )
    _require(
        rms_n < _MOST_RESIDUAL * span_n and friction_n + half[1] > 0,
        f"the presses contradict each other: a fit leaves {rms_n:.2f} N, and friction of {friction_n:.2f} N; "
        "see that the load cell is firm between the jaws, and that nothing else touches it",
    )
    free, free_half, travelled = _travel(passes, n_per_a, half[0], nominal.pinion_radius_m)
    radius, opening, given = _geometry(rows, nominal)
    nm = n_per_a * 2 * radius[0]
    nm_half = float(np.hypot(half[0] * 2 * radius[0], n_per_a * 2 * radius[1]))
    # Travel was told in metres by the nominal radius, and damping is force by speed.
    scale = nominal.pinion_radius_m / radius[0]
    damping, damping_half = free[1] * scale, free_half[1] * scale
    sides = table.columns[:, 2]
    return ServoFit(
        n_per_a=_estimate(n_per_a, half[0]),
        nm_per_a=_estimate(nm, nm_half),
        friction_n=_estimate(friction_n, half[1]),
        friction_share=_estimate(share, half[2]),
        offset_a=_estimate(offset_a, half[3]),
        lag_s=_estimate(lag_s, half[4]),
        free_friction_n=_estimate(free[0], free_half[0]),
        damping_n_s_m=_estimate(damping, damping_half),
        pinion_radius_m=CalibratedValue(value=radius[0]) if given else _estimate(*radius),
        open_position_rad=_estimate(*opening),
        force_n=(float(force_n.min()), float(force_n.max())),
        speed_m_s=(
            float(np.abs(travelled[:, 0]).min()) / scale,
            float(np.abs(travelled[:, 0]).max()) / scale,
        ),
        residual_n=rms_n,
        outliers=len(rows) - len(force_n),
        pressed=np.column_stack([force_n, table.target, residual_n, sides]),
        travelled=travelled,
    )


def _press_rows(presses: Sequence[ServoPress]) -> Floats:
    """The readings in which the jaws slide, (N, 7): force, current, angle, side, rate, gauge, number."""
    rows = []
    for number, press in enumerate(presses):
        sane = _sane(press.current_a) & _sane(press.force_n) & _sane(press.closing_rad) & _sane(press.t_s)
        for side, part in ((1.0, slice(0, press.turn)), (-1.0, slice(press.turn, None))):
            slid = sane[part] & _slides(press.force_n[part], side)
            if slid.sum() < _LEAST_ROWS:
                raise DataError(
                    f"in press {number + 1} the force does not {'rise' if side > 0 else 'fall'} with the "
                    "current; see that the load cell lies between the jaws and is not at its limit"
                )
            force, t_s = press.force_n[part][slid], press.t_s[part][slid]
            rate, one = _slope(t_s, force), np.ones(len(force))
            read = (force, press.current_a[part][slid], press.closing_rad[part][slid])
            rows.append(np.column_stack([*read, side * one, rate * one, press.gauge_m * one, number * one]))
    return np.concatenate(rows)


def _slides(force_n: Floats, side: float) -> Bools:
    """From where the force has left its value at the turn, as before that friction holds the jaws."""
    sane = _sane(force_n)
    if not sane.any():
        return np.zeros(len(force_n), np.bool_)
    known_n = np.where(sane, force_n, force_n[sane][0])
    begun = np.flatnonzero(side * (known_n - known_n[0]) > SLID_N)
    slides = np.zeros(len(force_n), np.bool_)
    if len(begun):
        slides[begun[0] :] = True
    return slides & (known_n > LEAST_N)


def _travel(
    passes: Sequence[FreePass], n_per_a: float, half_n_per_a: float, radius_m: float
) -> tuple[Floats, Floats, Floats]:
    """Free friction and damping with half intervals; speed and push of each part."""
    if len(passes) < LEAST_PASSES:
        raise DataError(
            f"the jaws travelled freely {len(passes)} times, and {LEAST_PASSES} are needed; see that nothing "
            "is in their way but the gauge"
        )
    rows, clusters = [], []
    for number, one in enumerate(passes):
        sane = _sane(one.t_s) & _sane(one.current_a) & _sane(one.closing_rad) & _sane(one.closing_rad_s)
        for part in np.array_split(np.flatnonzero(sane), _WINDOWS):
            if len(part) < 2 or not (span_s := one.t_s[part[-1]] - one.t_s[part[0]]) > 0:
                continue
            speed = (one.closing_rad[part[-1]] - one.closing_rad[part[0]]) / span_s
            change = (one.closing_rad_s[part[-1]] - one.closing_rad_s[part[0]]) / span_s
            rows.append((float(one.current_a[part].mean()), speed * radius_m, change * radius_m))
            clusters.append(number)
    data = np.array(rows).reshape(-1, 3)
    columns = np.column_stack([np.ones(len(data)), np.sign(data[:, 1]), data[:, 1:]])
    table = Table(columns, data[:, 0], np.array(clusters, np.float64))
    beta, table, kept = _robust(table, "free travel")
    values, half = _jackknife(table, lambda b: np.asarray(b[1:3] * n_per_a, np.float64), between=3)
    half = np.hypot(half, values * half_n_per_a / n_per_a)
    motor_force_n = (data[kept, 0] - beta[0] - beta[3] * data[kept, 2]) * n_per_a
    return values, half, np.column_stack([data[kept, 1], motor_force_n])


def _geometry(rows: Floats, nominal: Nominal) -> tuple[tuple[float, float], tuple[float, float], bool]:
    """Pinion radius and angle of the open jaws with half intervals, and whether the radius was given.

    Jaws and gauge give way, and late, so the angle is drawn back to no force and to a force that rests. Where
    the force begins to rise, the jaws have just been thrown against the gauge, which does not count.
    """
    force, _, closing, side, rate, gauge, number = rows.T
    rests = (side < 0) | (force > force.max() / 3)
    closed_m = nominal.open_width_m - gauge  # the jaws have closed by so much where they touch
    yields = np.column_stack([np.ones(len(rows)), force, force**2, force**3, rate])[rests]
    given = len(np.unique(gauge)) == 1
    if given:
        target = closing - closed_m / (2 * nominal.pinion_radius_m)
        _, table, _ = _robust(Table(yields, target[rests], number[rests]), "jaws' angle")
        values, half = _jackknife(table, lambda b: b[:1], between=1)
        return (nominal.pinion_radius_m, 0.0), (float(values[0]), float(half[0])), True
    columns = np.column_stack([yields, closed_m[rests]])
    _, table, _ = _robust(Table(columns, closing[rests], number[rests]), "jaws' angle")
    values, half = _jackknife(table, lambda b: np.array([b[0], 0.5 / b[-1]]), between=2)
    _require(
        half[1] < _MOST_UNKNOWN * values[1],
        "the gauges are not met at the angles that their widths make expect; see that --gauge-mm names them "
        "in the order in which they were put between the jaws",
    )
    return (float(values[1]), float(half[1])), (float(values[0]), float(half[0])), False


def _robust(table: Table, what: str) -> tuple[Floats, Table, Bools]:
    """Least squares without rows that stick out by `_OUTLIER` robust standard deviations."""
    beta = _least_squares(table)
    residual = table.target - table.columns @ beta
    spread = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
    kept = np.abs(residual - np.median(residual)) <= _OUTLIER * spread + 1e-12
    _require(
        np.mean(~kept) < _MOST_OUTLIERS,
        f"{100 * np.mean(~kept):.0f} % of the readings of the {what} stick out from the rest; look for play, "
        "a loose load cell, or a bad cable",
    )
    kept_table = Table(table.columns[kept], table.target[kept], table.cluster[kept])
    return _least_squares(kept_table), kept_table, kept


def _jackknife(table: Table, of: Callable[[Floats], Floats], between: int) -> tuple[Floats, Floats]:
    """Values and half of their 95 % confidence intervals, leaving out one press or pass after the other.

    Readings of one press share their errors, so it is the presses that count: the cluster jackknife CV3 of
    MacKinnon, Nielsen and Webb, "Cluster-robust inference: a guide to empirical practice", Journal of
    Econometrics 232 (2023) 272, doi:10.1016/j.jeconom.2022.04.001.

    Args:
        table: The regression.
        of: Makes what is asked for of its coefficients.
        between: Coefficients that only differences between clusters can tell; they take degrees of freedom.
    """
    values = of(_least_squares(table))
    clusters = np.unique(table.cluster)
    without = []
    for cluster in clusters:
        rest = table.cluster != cluster
        without.append(
            of(_least_squares(Table(table.columns[rest], table.target[rest], table.cluster[rest])))
        )
    count = len(clusters)
    error = np.sqrt((count - 1) / count * np.sum((np.array(without) - values) ** 2, axis=0))
    return values, np.asarray(error * stats.t.ppf(0.975, max(count - between, 1)), np.float64)


def _least_squares(table: Table) -> Floats:
    """Coefficients. Raises `DataError` where the columns do not tell them apart."""
    scale = np.sqrt(np.mean(table.columns**2, axis=0)) if len(table.columns) else np.zeros(1)
    if len(table.columns) < table.columns.shape[1] or not (scale > 0).all() or not np.isfinite(scale).all():
        raise DataError("the readings are too few or all alike, so that nothing can be fitted to them")
    beta, _, rank, singular = np.linalg.lstsq(table.columns / scale, table.target, rcond=None)
    if rank < len(scale) or singular[-1] < 1e-4 * singular[0]:
        raise DataError(
            "presses or passes are too much alike to tell friction from force and speed; vary rates and peaks"
        )
    return np.asarray(beta / scale, np.float64)


def _sane(values: Floats) -> Bools:
    """Not NaN, not infinite, and no number that only damage makes."""
    return np.asarray(np.abs(values) < _LARGEST, np.bool_)


def _slope(x: Floats, y: Floats) -> float:
    x = x - x.mean()
    square = float(x @ x)
    return float(x @ y) / square if square else 0.0


def _estimate(value: float, half: float) -> CalibratedValue:
    _require(
        abs(value) + half < _LARGEST, "the readings contradict each other, and nothing follows from them"
    )
    return CalibratedValue(value=float(value), low=float(value - half), high=float(value + half))


def _require(holds: bool | np.bool_, sentence: str) -> None:
    if not holds:
        raise DataError(sentence)
