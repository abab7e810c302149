"""Fit of a servo's torque, friction and jaw geometry to presses against a load cell and to free travel."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from gripper_force.errors import DataError
from gripper_force.profiles.rig_profile import CalibratedValue

MIN_PRESSES: Final = 5
MIN_PASSES: Final = 8
SLID_N: Final = 0.4
"""Change of force after a reversal of the current at which the jaws slide."""

MIN_FORCE_N: Final = 0.3
"""Smaller forces may be drift of the load cell."""

_MIN_ROWS: Final = 10
_OUTLIER_STDS: Final = 6.0
_MAX_OUTLIERS: Final = 0.1
_MAX_HALF_WIDTH: Final = 0.25
"""Largest half interval of the torque constant and the pinion radius, as a share of the value."""
_MAX_RESIDUAL: Final = 0.15
_MAX_VALUE: Final = 1e6
_WINDOWS: Final = 4
"""Parts of a pass. The jaws accelerate in the first one, which separates inertia from friction."""

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ServoPress:
    """One press on a gauge, with a current that rises and falls steadily. Positive values close.

    Attributes:
        gauge_m: Width of the gauge.
        t_s: Times, (N,).
        current_a: Measured current, (N,).
        force_n: Load-cell force at these times, (N,).
        closing_rad: Angle of the horn in the closing direction, (N,).
        turn: Index of the first sample with falling current.
    """

    gauge_m: float
    t_s: Floats
    current_a: Floats
    force_n: Floats
    closing_rad: Floats
    turn: int


@dataclass(frozen=True, slots=True)
class FreePass:
    """Free travel under a constant current. Positive values close.

    Attributes:
        t_s: Times, (N,).
        current_a: Measured current, (N,).
        closing_rad: Angle of the horn in the closing direction, (N,).
        closing_rad_s: Angular velocity in the closing direction, (N,).
    """

    t_s: Floats
    current_a: Floats
    closing_rad: Floats
    closing_rad_s: Floats


@dataclass(frozen=True, slots=True)
class Nominal:
    """Given values.

    Attributes:
        pinion_radius_m: Pitch radius of the pinion; with gauges of two widths it is measured instead.
        open_width_m: Distance between the jaws at the angle that is defined as open.
        scale_share: Relative uncertainty of the load cell's scale, common to all forces.
    """

    pinion_radius_m: float
    open_width_m: float
    scale_share: float = 0.0


@dataclass(frozen=True, slots=True)
class Regression:
    """Data of a linear regression with clustered errors.

    Attributes:
        columns: Regressors, (N, K).
        target: Dependent variable, (N,).
        cluster: Number of the press or pass of each row, (N,).
    """

    columns: Floats
    target: Floats
    cluster: Floats


@dataclass(frozen=True, slots=True)
class ServoFit:
    """Fitted values and the data they come from. Forces and friction are those at one jaw.

    Attributes:
        n_per_a: Force at each jaw per ampere.
        nm_per_a: Torque constant at the horn.
        friction_n: Coulomb friction under load, at the mean force.
        friction_share: Growth of this friction per newton of force.
        offset_a: Current reading without motor force.
        lag_s: Lag of the force behind the current; includes viscous friction under load.
        free_friction_n: Coulomb friction in free travel.
        damping_n_s_m: Viscous friction in free travel.
        pinion_radius_m: Pitch radius of the pinion.
        open_position_rad: Angle in the closing direction at `Nominal.open_width_m`, on the closing flank.
        force_n: Smallest and largest force in the presses.
        speed_m_s: Smallest and largest speed of a jaw in free travel.
        residual_n: Root mean square residual.
        outliers: Number of rejected samples.
        pressed: Force, current, residual in N, and side (1 rising, -1 falling) of each used sample, (N, 4).
        travelled: Speed in m/s, and motor force in N without the part of inertia, of each part of a pass, (M, 2).
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


class _Statics(NamedTuple):
    """Fit of the presses.

    Attributes:
        values: Force per ampere, friction at the mean force, its growth, current offset, and lag, (5,).
        half: Half of their confidence intervals, (5,).
        used: The samples without outliers, N of them.
        force_n: Their forces, (N,).
        residual_n: Their residuals, (N,).
        rms_n: Root mean square of these.
    """

    values: Floats
    half: Floats
    used: Regression
    force_n: Floats
    residual_n: Floats
    rms_n: float


def fit_servo(presses: Sequence[ServoPress], passes: Sequence[FreePass], nominal: Nominal) -> ServoFit:
    """Fits statics to presses, friction in free travel to passes, and geometry to the angles of presses.

    While the jaws slide, the motor force equals the contact force plus friction, rising or falling::

        current = offset + (force + side * (friction + share * force) + lag * rate of force) / n_per_a
        current = offset + (side * friction + damping * speed + mass * acceleration) / n_per_a

    The regression explains the current, not the force, because the noise is in the current.

    Args:
        presses: Presses on one gauge, or on gauges of two widths.
        passes: Free travel in both directions, at several speeds.
        nominal: Given values.

    Raises:
        DataError: There are too few presses or passes, they contradict each other, or they do not determine
            the parameters.
    """
    if len(presses) < MIN_PRESSES:
        raise DataError(
            f"only {len(presses)} presses slid in both directions, and {MIN_PRESSES} are needed; press more often"
        )
    rows = _sliding_rows(presses)
    statics = _fit_statics(rows, nominal)
    n_per_a, friction_n, share, offset_a, lag_s = statics.values
    half, used, force_n = statics.half, statics.used, statics.force_n
    free, free_half, travelled = _fit_travel(passes, n_per_a, half[0], nominal.pinion_radius_m)
    radius, opening, is_radius_given = _fit_geometry(rows, nominal)
    nm = n_per_a * 2 * radius[0]
    nm_half = float(np.hypot(half[0] * 2 * radius[0], n_per_a * 2 * radius[1]))
    # The passes were converted to metres with the nominal radius; damping is force over speed.
    scale = nominal.pinion_radius_m / radius[0]
    travelled = travelled / np.array([scale, 1.0])
    damping, damping_half = free[1] * scale, free_half[1] * scale
    sides = used.columns[:, 2]
    return ServoFit(
        n_per_a=_estimate(n_per_a, half[0]),
        nm_per_a=_estimate(nm, nm_half),
        friction_n=_estimate(friction_n, half[1]),
        friction_share=_estimate(share, half[2]),
        offset_a=_estimate(offset_a, half[3]),
        lag_s=_estimate(lag_s, half[4]),
        free_friction_n=_estimate(free[0], free_half[0]),
        damping_n_s_m=_estimate(damping, damping_half),
        pinion_radius_m=CalibratedValue(value=radius[0]) if is_radius_given else _estimate(*radius),
        open_position_rad=_estimate(*opening),
        force_n=(float(force_n.min()), float(force_n.max())),
        speed_m_s=(
            float(np.abs(travelled[:, 0]).min()),
            float(np.abs(travelled[:, 0]).max()),
        ),
        residual_n=statics.rms_n,
        outliers=len(rows) - len(force_n),
        pressed=np.column_stack([force_n, used.target, statics.residual_n, sides]),
        travelled=travelled,
    )


def _fit_statics(rows: Floats, nominal: Nominal) -> _Statics:
    """Fits force and friction under load to the samples of `_sliding_rows`."""
    force, current, _, side, rate, _, number = rows.T
    columns = np.column_stack([np.ones(len(rows)), force, side, side * force, rate])
    beta, used, kept = _robust_fit(Regression(columns, current, number), "presses")
    force_n = force[kept]
    mean_n = float(force_n.mean())
    _require(
        beta[1] > 0, "the force does not grow with the current; check gripper.closing_sign and the load cell"
    )

    def values_of(b: Floats) -> Floats:
        n_per_a = 1 / b[1]
        return np.array([n_per_a, (b[2] + b[3] * mean_n) * n_per_a, b[3] * n_per_a, b[0], b[4] * n_per_a])

    values, half = _jackknife(used, values_of, between=2)
    half[:2] = np.hypot(half[:2], nominal.scale_share * values[:2])
    n_per_a, friction_n = values[:2]
    residual_n = (used.target - used.columns @ beta) * n_per_a
    rms_n = float(np.sqrt(np.mean(residual_n**2)))
    span_n = float(np.ptp(force_n))
    _require(
        half[0] < _MAX_HALF_WIDTH * n_per_a,
        f"the torque constant is only known to within {100 * half[0] / abs(n_per_a):.0f} %; press harder and "
        "more often, and check that the load cell is straight between the jaws",
    )
    _require(
        rms_n < _MAX_RESIDUAL * span_n and friction_n + half[1] > 0,
        f"the presses contradict each other: the fit has a residual of {rms_n:.2f} N and a friction of "
        f"{friction_n:.2f} N; check that the load cell is firm between the jaws and touches nothing else",
    )
    return _Statics(values, half, used, force_n, residual_n, rms_n)


def _sliding_rows(presses: Sequence[ServoPress]) -> Floats:
    """Samples in which the jaws slide, (N, 7): force, current, angle, side, rate, gauge, number of the press."""
    rows = []
    for number, press in enumerate(presses):
        plausible = _plausible(press.current_a, press.force_n, press.closing_rad, press.t_s)
        for side, part in ((1.0, slice(0, press.turn)), (-1.0, slice(press.turn, None))):
            slid = plausible[part] & _slides(press.force_n[part], side)
            if slid.sum() < _MIN_ROWS:
                raise DataError(
                    f"in press {number + 1} the force does not {'rise' if side > 0 else 'fall'} with the "
                    "current; check that the load cell is between the jaws and not at its limit"
                )
            force, t_s = press.force_n[part][slid], press.t_s[part][slid]
            rate, one = _slope(t_s, force), np.ones(len(force))
            measured = (force, press.current_a[part][slid], press.closing_rad[part][slid])
            rows.append(
                np.column_stack([*measured, side * one, rate * one, press.gauge_m * one, number * one])
            )
    return np.concatenate(rows)


def _slides(force_n: Floats, side: float) -> Bools:
    """True for samples after the force has left its value at the reversal. Before that, friction holds the jaws."""
    plausible = _plausible(force_n)
    if not plausible.any():
        return np.zeros(len(force_n), np.bool_)
    known_n = np.where(plausible, force_n, force_n[plausible][0])
    changed = np.flatnonzero(side * (known_n - known_n[0]) > SLID_N)
    slides = np.zeros(len(force_n), np.bool_)
    if len(changed):
        slides[changed[0] :] = True
    return slides & (known_n > MIN_FORCE_N)


def _fit_travel(
    passes: Sequence[FreePass], n_per_a: float, half_n_per_a: float, radius_m: float
) -> tuple[Floats, Floats, Floats]:
    """Coulomb and viscous friction with their half intervals, (2,) each; `ServoFit.travelled`."""
    if len(passes) < MIN_PASSES:
        raise DataError(
            f"the jaws travelled freely only {len(passes)} times, and {MIN_PASSES} are needed; use a thinner gauge, "
            "and remove everything else from their way"
        )
    rows, clusters = [], []
    for number, one in enumerate(passes):
        plausible = _plausible(one.t_s, one.current_a, one.closing_rad, one.closing_rad_s)
        for part in np.array_split(np.flatnonzero(plausible), _WINDOWS):
            if len(part) < 2 or not (span_s := one.t_s[part[-1]] - one.t_s[part[0]]) > 0:
                continue
            speed = (one.closing_rad[part[-1]] - one.closing_rad[part[0]]) / span_s
            change = (one.closing_rad_s[part[-1]] - one.closing_rad_s[part[0]]) / span_s
            rows.append((float(one.current_a[part].mean()), speed * radius_m, change * radius_m))
            clusters.append(number)
    data = np.array(rows).reshape(-1, 3)
    columns = np.column_stack([np.ones(len(data)), np.sign(data[:, 1]), data[:, 1:]])
    regression = Regression(columns, data[:, 0], np.array(clusters, np.float64))
    beta, regression, kept = _robust_fit(regression, "free travel")
    values, half = _jackknife(regression, lambda b: np.asarray(b[1:3] * n_per_a, np.float64), between=3)
    half = np.hypot(half, values * half_n_per_a / n_per_a)
    motor_force_n = (data[kept, 0] - beta[0] - beta[3] * data[kept, 2]) * n_per_a
    return values, half, np.column_stack([data[kept, 1], motor_force_n])


def _fit_geometry(rows: Floats, nominal: Nominal) -> tuple[tuple[float, float], tuple[float, float], bool]:
    """Pinion radius and angle of the open jaws, each with its half interval; True if the radius was given.

    Jaws and gauge are elastic and viscous, so the angle is extrapolated to zero force and zero force rate. The
    beginning of the rise is not used: it follows the impact on the gauge.
    """
    force, _, closing, side, rate, gauge, number = rows.T
    used = (side < 0) | (force > force.max() / 3)
    closed_m = nominal.open_width_m - gauge  # closing travel at contact
    elastic = np.column_stack([np.ones(len(rows)), force, force**2, force**3, rate])[used]
    is_radius_given = len(np.unique(gauge)) == 1
    if is_radius_given:
        target = closing - closed_m / (2 * nominal.pinion_radius_m)
        _, regression, _ = _robust_fit(Regression(elastic, target[used], number[used]), "jaws' angle")
        values, half = _jackknife(regression, lambda b: b[:1], between=1)
        return (nominal.pinion_radius_m, 0.0), (float(values[0]), float(half[0])), True
    columns = np.column_stack([elastic, closed_m[used]])
    _, regression, _ = _robust_fit(Regression(columns, closing[used], number[used]), "jaws' angle")
    values, half = _jackknife(regression, lambda b: np.array([b[0], 0.5 / b[-1]]), between=2)
    _require(
        half[1] < _MAX_HALF_WIDTH * values[1],
        "the angles at the gauges do not match their widths; check that --gauge-mm names the gauges in the "
        "order in which they were placed between the jaws",
    )
    return (float(values[1]), float(half[1])), (float(values[0]), float(half[0])), False


def _robust_fit(data: Regression, name: str) -> tuple[Floats, Regression, Bools]:
    """Least squares without rows that deviate by `_OUTLIER_STDS` robust standard deviations.

    Returns:
        Coefficients, the kept rows, and True for each kept row.
    """
    beta = _least_squares(data)
    residual = data.target - data.columns @ beta
    spread = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
    kept = np.abs(residual - np.median(residual)) <= _OUTLIER_STDS * spread + 1e-12
    _require(
        np.mean(~kept) < _MAX_OUTLIERS,
        f"{100 * np.mean(~kept):.0f} % of the samples of the {name} are outliers; check for play, a loose load "
        "cell or a bad cable",
    )
    kept_data = Regression(data.columns[kept], data.target[kept], data.cluster[kept])
    return _least_squares(kept_data), kept_data, kept


def _jackknife(
    data: Regression, parameters: Callable[[Floats], Floats], between: int
) -> tuple[Floats, Floats]:
    """Parameters and half of their 95 % confidence intervals, by leaving out one press or pass at a time.

    The samples of one press have common errors, so the presses count, not the samples: the cluster jackknife
    CV3 of MacKinnon, Nielsen and Webb, "Cluster-robust inference: a guide to empirical practice", Journal of
    Econometrics 232 (2023) 272, doi:10.1016/j.jeconom.2022.04.001.

    Args:
        data: The regression.
        parameters: Computes the parameters from the coefficients.
        between: Number of coefficients that only differences between clusters determine; they reduce the degrees
            of freedom.
    """
    values = parameters(_least_squares(data))
    clusters = np.unique(data.cluster)
    without = []
    for cluster in clusters:
        rest = data.cluster != cluster
        part = Regression(data.columns[rest], data.target[rest], data.cluster[rest])
        without.append(parameters(_least_squares(part)))
    count = len(clusters)
    error = np.sqrt((count - 1) / count * np.sum((np.array(without) - values) ** 2, axis=0))
    return values, np.asarray(error * stdtrit(max(count - between, 1), 0.975), np.float64)


def _least_squares(data: Regression) -> Floats:
    """Coefficients, (K,). Raises `DataError` if the columns do not determine them."""
    scale = np.sqrt(np.mean(data.columns**2, axis=0)) if len(data.columns) else np.zeros(1)
    if len(data.columns) < data.columns.shape[1] or not (scale > 0).all() or not np.isfinite(scale).all():
        raise DataError("the samples are too few or all alike for a fit; vary rates and peaks")
    beta, _, rank, singular = np.linalg.lstsq(data.columns / scale, data.target, rcond=None)
    if rank < len(scale) or singular[-1] < 1e-4 * singular[0]:
        raise DataError(
            "the presses or passes are too much alike to separate friction from force and speed; vary rates and "
            "peaks"
        )
    return np.asarray(beta / scale, np.float64)


def _plausible(*values: Floats) -> Bools:
    """True, (N,), for samples of which all values, (N,) each, are finite and of a plausible size."""
    plausible: Bools = np.all(np.abs(values) < _MAX_VALUE, axis=0)
    return plausible


def _slope(x: Floats, y: Floats) -> float:
    x = x - x.mean()
    square = float(x @ x)
    return float(x @ y) / square if square else 0.0


def _estimate(value: float, half: float) -> CalibratedValue:
    _require(
        abs(value) + half < _MAX_VALUE,
        "the samples contradict each other; check that the load cell is firm between the jaws, and repeat",
    )
    return CalibratedValue(value=float(value), low=float(value - half), high=float(value + half))


def _require(condition: bool | np.bool_, message: str) -> None:
    if not condition:
        raise DataError(message)
