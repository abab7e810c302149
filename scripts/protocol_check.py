"""Force error of regressors with less input than an image sequence, on the sets of the paper's protocol.

Each is fitted in closed form on train/ (ridge regression on random Fourier features) and evaluated on test/,
with the penalty that is best there: the printed error is a lower bound.

    gripper-force simulate --protocol shin2019 --scale small --out data/paper
    python scripts/protocol_check.py data/paper
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from gripper_force.jobs.dataset import CONTACT_N, load_clip
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import NS_PER_S, Frame, ServoState
from gripper_force.vision.preprocess import Preprocess

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.float32]

SIZE: Final = 32
COMPONENTS: Final = 40
HISTORY_S: Final = np.arange(20) / 149.0
"""Times of the paper's window of 20 frames."""

SET_FRAMES: Final = 500
ROWS: Final = 20_000
FEATURES: Final = 1000
PENALTIES: Final = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)


@dataclass(frozen=True)
class Samples:
    """Frames of several sets.

    Attributes:
        force_n: Load-cell force, (N,).
        position_rad: Servo position at the last 20 frames, newest first, (N, 20).
        image: Frames of 32x32 pixels, divided by 255, (N, 1024).
        change: The same minus the first frame of each log.
        environment: Object and angle, (N,).
    """

    force_n: Array
    position_rad: Array
    image: Pixels
    change: Pixels
    environment: npt.NDArray[np.str_]


def load(folder: Path) -> Samples:
    """Reads all logs of a folder and keeps an equal share of the frames of each."""
    paths = sorted(folder.glob("*.mcap"))
    if not paths:
        sys.exit(f"{folder} contains no logs; make them with gripper-force simulate --protocol shin2019")
    step = -(-len(paths) * SET_FRAMES // ROWS)
    logs = [_read(path, step) for path in paths]
    columns = [field.name for field in fields(Samples)]
    return Samples(**{name: np.concatenate([getattr(log, name) for log in logs]) for name in columns})


def _read(path: Path, step: int) -> Samples:
    clip, reader = load_clip(path, Preprocess(size=SIZE), None), LogReader(path)
    t_ns = np.array([frame.t_ns for frame in reader.records(Frame)])
    states = list(reader.records(ServoState))
    position_rad = np.interp(
        t_ns[:, None] - HISTORY_S * NS_PER_S, [s.t_ns for s in states], [s.position_rad for s in states]
    )
    image: Pixels = np.divide(clip.frames.reshape(len(clip.frames), -1), 255, dtype=np.float32)
    change: Pixels = image - image[0]
    good = np.flatnonzero(clip.valid)[::step]
    return Samples(
        clip.forces_n[good].astype(np.float64),
        position_rad[good],
        image[good],
        change[good],
        np.full(len(good), f"{clip.object} {reader.metadata['degrees']}"),
    )


def regress(x: Array, y: Array, x_test: Array, y_test: Array) -> Array:
    """Returns predictions of ridge regression on the standardised inputs and their random Fourier features.

    Of several penalties, the one with the smallest error on ``y_test`` is used.
    """
    mean, scale = x.mean(0), x.std(0) + 1e-9
    rng = np.random.default_rng(0)
    # Frequencies of several scales, so that no scale has to be chosen for each input.
    spread = np.exp(rng.uniform(np.log(0.1), np.log(3.0), FEATURES)) / np.sqrt(x.shape[1])
    weights = rng.standard_normal((x.shape[1], FEATURES)) * spread
    phases = rng.uniform(0, 2 * np.pi, FEATURES)

    def features(inputs: Array) -> Array:
        z = (inputs - mean) / scale
        return np.column_stack([np.ones(len(z)), z, np.cos(z @ weights + phases)])

    f = features(x)
    normal, right, f_test = f.T @ f / len(f), f.T @ y / len(f), features(x_test)
    predictions: list[Array] = [
        f_test @ np.linalg.solve(normal + penalty * np.eye(len(normal)), right) for penalty in PENALTIES
    ]
    errors = [float(np.abs(prediction - y_test).mean()) for prediction in predictions]
    return predictions[int(np.argmin(errors))]


def components(images: Pixels) -> tuple[Array, Array]:
    """Returns mean and principal axes of images, (1024,) and (1024, 40)."""
    centre: Array = images.mean(0, dtype=np.float64)
    axes: Array = np.linalg.eigh(np.cov(images, rowvar=False))[1]
    return centre, axes[:, -COMPONENTS:]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    train, test = (load(data / split) for split in ("train", "test"))

    def position(samples: Samples) -> Array:
        return samples.position_rad[:, :1]

    def history(samples: Samples) -> Array:
        now = samples.position_rad[:, :1]
        return np.column_stack([now, now - samples.position_rad[:, 1:]])

    def brightness(samples: Samples) -> Array:
        return np.asarray(samples.image.mean(1), np.float64)[:, None]

    def across_environments(inputs_of: Callable[[Samples], Array]) -> Array:
        return regress(inputs_of(train), train.force_n, inputs_of(test), test.force_n)

    def per_environment(inputs_of: Callable[[Samples], Array]) -> Array:
        prediction: Array = np.empty_like(test.force_n)
        for name in np.unique(test.environment):
            fit, evaluate = train.environment == name, test.environment == name
            prediction[evaluate] = regress(
                inputs_of(train)[fit], train.force_n[fit], inputs_of(test)[evaluate], test.force_n[evaluate]
            )
        return prediction

    def principal(pixels: Callable[[Samples], Pixels]) -> Callable[[Samples], Array]:
        centre, axes = components(pixels(train))

        def scores(samples: Samples) -> Array:
            projected: Array = (pixels(samples) - centre) @ axes
            return projected

        return scores

    rows = {
        "nothing: the mean of train/": np.full_like(test.force_n, train.force_n.mean()),
        "mean brightness of the frame": across_environments(brightness),
        "servo position": across_environments(position),
        "servo position, object and angle known": per_environment(position),
        "servo position over 20 frames": across_environments(history),
        "servo position over 20 frames, object and angle known": per_environment(history),
        "one frame (40 components)": across_environments(principal(lambda samples: samples.image)),
        "one frame minus the first (40 components)": across_environments(
            principal(lambda samples: samples.change)
        ),
    }
    contact = test.force_n > CONTACT_N
    print("| input of the regressor | MAE, N | MAE in contact, N |\n|---|---|---|")
    for name, prediction in rows.items():
        error_n = np.abs(prediction - test.force_n)
        print(f"| {name} | {error_n.mean():.2f} | {error_n[contact].mean():.2f} |")


if __name__ == "__main__":
    main()
