"""Error on a validation split against minutes of training, for several ways to train, in turns."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from gripper_force.errors import ConfigError
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import Clip, split_by
from gripper_force.jobs.report.figure import STYLE
from gripper_force.jobs.training.batches import Batches
from gripper_force.jobs.training.parallel import joined
from gripper_force.jobs.training.recipe import RECIPES, TrainConfig
from gripper_force.jobs.training.trainer import Trainer, estimates
from gripper_force.schema import section_from
from gripper_force.vision.preprocess import Preprocess

Load = Callable[[Preprocess], list[Clip]]

PAPER: Final = "paper"

WAYS: Final[dict[str, dict[str, Any]]] = {
    "short clips, a tenth": {},
    "short clips": {},
    "dense windows": {"clips": 3, "clip_frames": 88, "short_share": 0.0},
    "separate windows": {"windows": "separate", "short_share": 0.0},
    PAPER: RECIPES["shin2019"],
}
"""What each sets. The first two are our recipe, once with a tenth of the time. The next two change its clips
alone: as many frames a step in fewer clips, and windows that share nothing. The last is the paper's recipe.
"""

TURNS: Final = 200
POINTS: Final = 12


@dataclass(frozen=True, slots=True)
class Point:
    """What a network does on the validation split after so much training.

    Attributes:
        way: One of `WAYS`.
        minutes: Of its own training; the others' turns and the validation don't count.
        steps: Optimiser steps.
        mae_n: Mean absolute error.
        rmse_n: Root mean squared error.
    """

    way: str
    minutes: float
    steps: int
    mae_n: float
    rmse_n: float


def learn(load: Load, minutes: float, overrides: Sequence[str], out: Path) -> Iterator[Point]:
    """Trains one network each way, in turns, and keeps all points in ``learning.json`` and ``learning.png``.

    Every way gets the same minutes, and its schedule ends with them; the first gets a tenth. A point before
    the end is worse than a training of just so long would be, as the learning rate is still high.

    Args:
        load: Gives the data, reduced to a size; whole sets of them are held out.
        minutes: For each way.
        overrides: Keys of the recipe that are the same for all, as ``key=value``.
        out: Folder for the results. The points are written one by one, the picture at the end, early or not.

    Raises:
        ConfigError: A key is wrong, or more than one network is asked for.
        DataError: The data can't be trained on.
        NonFiniteError: A training diverged.
    """
    budgets = {way: minutes / (10 if i == 0 else 1) for i, way in enumerate(WAYS)}
    configs = {}
    for way, keys in WAYS.items():
        given = {"attentions": ["ssam"], "epochs": None, "minutes": budgets[way]}
        configs[way] = section_from(TrainConfig, list(overrides), {**keys, **given})
    if any(len(config.attentions) > 1 for config in configs.values()):
        raise ConfigError("one network is trained each way: set attentions to one")
    points: list[Point] = []
    _keep(points, configs, out)  # fails now where it would fail later
    with joined(configs[PAPER].device) as ranks:
        if ranks.count > 1:
            raise ConfigError("ways of training are compared in one process; start it without torchrun")
        clips: dict[int, list[Clip]] = {}
        trainers, held_out = {}, {}
        for way, config in configs.items():
            size = config.preprocess.size
            if size not in clips:
                clips[size] = load(config.preprocess)
            training, held_out[way] = split_by(clips[size], "set", config.validation, config.seed)
            trainers[way] = Trainer(config, 0, Batches(training, config, ranks), ranks)
        try:
            for way in _in_turns(trainers, minutes, budgets):
                trainer, preprocess = trainers[way], configs[way].preprocess
                forces = estimates(held_out[way], [trainer.network], preprocess, ranks.device)
                spent = trainer.done * budgets[way]
                points.append(Point(way, spent, trainer.step, metrics.mae(*forces), metrics.rmse(*forces)))
                _keep(points, configs, out)
                yield points[-1]
        finally:
            if points:
                draw(points).savefig(out / "learning.png")


def _in_turns(trainers: dict[str, Trainer], minutes: float, budgets: dict[str, float]) -> Iterator[str]:
    """Trains each way for a short while, and again; stops where one is to be looked at."""
    marks = set(np.geomspace(2, TURNS, POINTS).round().astype(int).tolist())
    for turn in range(1, TURNS + 1):
        for way, trainer in trainers.items():
            before = trainer.step
            for _ in trainer.steps(min(1.0, minutes * turn / TURNS / budgets[way])):
                pass
            if trainer.step > before and (turn in marks or trainer.done >= 1):
                yield way


def reached(points: Sequence[Point]) -> dict[str, float | None]:
    """Minutes after which each way was as good as the paper's recipe at its end; None if it never was."""
    goal_n = [point.mae_n for point in points if point.way == PAPER][-1]
    return {
        way: min((p.minutes for p in points if p.way == way and p.mae_n <= goal_n), default=None)
        for way in WAYS
    }


def _keep(points: Sequence[Point], configs: dict[str, TrainConfig], out: Path) -> None:
    recipes = {way: config.model_dump(mode="json") for way, config in configs.items()}
    kept = {"recipes": recipes, "points": [asdict(point) for point in points]}
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "learning.json").write_text(json.dumps(kept, indent=1), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"can't keep results in {out}: {error.strerror}; name another folder") from error


def draw(points: Sequence[Point]) -> Figure:
    """Error against minutes, a line for each way."""
    with rc_context(STYLE):
        figure = Figure(figsize=(7, 4), layout="constrained")
        axes = figure.add_subplot()
        for way in WAYS:
            own = [point for point in points if point.way == way]
            axes.plot([p.minutes for p in own], [p.mae_n for p in own], "o-", markersize=3, label=way)
        axes.set(xscale="log", xlabel="minutes of training", ylabel="validation MAE, N")
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter("{x:g}")
        axes.legend()
    return figure
