"""Validation error over minutes of training, for several recipes in turns."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from gripper_force.errors import ConfigError
from gripper_force.jobs import metrics
from gripper_force.jobs.dataset import Clip, split_by
from gripper_force.jobs.report.figure import STYLE
from gripper_force.jobs.training.batches import Batches
from gripper_force.jobs.training.parallel import join_training_processes
from gripper_force.jobs.training.recipe import RECIPES, TrainConfig, section_from
from gripper_force.jobs.training.stated_errors import labelled_estimates
from gripper_force.jobs.training.trainer import Trainer
from gripper_force.progress import Progress, no_progress
from gripper_force.schema import Tree
from gripper_force.vision.preprocess import Preprocess

Load = Callable[[Preprocess], list[Clip]]

PAPER: Final = "paper"

COMPARED: Final[dict[str, Tree]] = {
    "short clips, a tenth": {},
    "short clips": {},
    "dense windows": {"clips": 3, "clip_frames": 88, "short_share": 0.0},
    "separate windows": {"windows": "separate", "short_share": 0.0},
    PAPER: RECIPES["shin2019"],
}
"""Recipe keys by name. The first two are our recipe, once with a tenth of the time. The next two change only
its clips: the same number of frames per step in fewer clips, and windows computed separately. The last is the
paper's recipe.
"""

TURNS: Final = 200
"""Turns of each recipe."""

POINTS: Final = 12
"""Evaluations of each recipe, at logarithmic intervals."""


@dataclass(frozen=True, slots=True)
class Point:
    """Validation error of a network after some training.

    Attributes:
        way: Name of the recipe in `COMPARED`.
        minutes: Time of its own training, without the others' turns and without validation.
        steps: Optimiser steps.
        mae_n: Mean absolute error.
        rmse_n: Root mean squared error.
    """

    way: str
    minutes: float
    steps: int
    mae_n: float
    rmse_n: float


def learn(
    load: Load, minutes: float, overrides: Sequence[str], out: Path, progress: Progress = no_progress
) -> Iterator[Point]:
    """Trains one network with each recipe, in turns; writes ``learning.json`` and ``learning.png``.

    Each recipe gets the same minutes, and its schedule ends with them; the first gets a tenth. A point before
    the end is worse than the result of a training of that length, as the learning rate is still high.

    Args:
        load: Loads the data at the size of a `Preprocess`; whole sets of it are held out for validation.
        minutes: Training time of each recipe.
        overrides: Keys of all recipes, as ``key=value``.
        out: Folder for the results. Points are written one by one, the figure at the end or at an interrupt.
        progress: Called after each of `TURNS` turns.

    Yields:
        The points, as they are measured.

    Raises:
        ConfigError: A key is wrong, more than one network is requested, or the folder can't be written to.
        DataError: The data can't be used for training.
        NonFiniteError: A training diverged.
    """
    budgets = {recipe: minutes / (10 if i == 0 else 1) for i, recipe in enumerate(COMPARED)}
    configs = {}
    for recipe, keys in COMPARED.items():
        given = {"attentions": ["ssam"], "epochs": None, "minutes": budgets[recipe]}
        configs[recipe] = section_from(TrainConfig, list(overrides), {**keys, **given})
    if any(len(config.attentions) > 1 for config in configs.values()):
        raise ConfigError("bench training trains one network with each recipe; set attentions to one module")
    points: list[Point] = []
    _save(points, configs, out)  # an unwritable folder must fail before the training
    with join_training_processes(configs[PAPER].device) as process:
        if process.world_size > 1:
            raise ConfigError("bench training runs in one process; start it without torchrun")
        clips: dict[int, list[Clip]] = {}
        trainers, held_out = {}, {}
        for recipe, config in configs.items():
            size = config.preprocess.size
            if size not in clips:
                clips[size] = load(config.preprocess)
            training, held_out[recipe] = split_by(clips[size], "set", config.validation, config.seed)
            trainers[recipe] = Trainer(config, 0, Batches(training, config, process), process)
        try:
            for recipe in _in_turns(trainers, minutes, budgets, progress):
                trainer, preprocess = trainers[recipe], configs[recipe].preprocess
                forces = labelled_estimates(held_out[recipe], [trainer.network], preprocess, process.device)
                spent = trainer.done * budgets[recipe]
                points.append(Point(recipe, spent, trainer.step, metrics.mae(*forces), metrics.rmse(*forces)))
                _save(points, configs, out)
                yield points[-1]
        finally:
            if points:
                draw(points).savefig(out / "learning.png")


def _in_turns(
    trainers: dict[str, Trainer], minutes: float, budgets: dict[str, float], progress: Progress
) -> Iterator[str]:
    """Trains the recipes alternately; yields the name of a recipe when it is due for evaluation."""
    marks = set(np.geomspace(2, TURNS, POINTS).round().astype(int).tolist())
    for turn in range(1, TURNS + 1):
        for recipe, trainer in trainers.items():
            before = trainer.step
            for _ in trainer.steps(min(1.0, minutes * turn / TURNS / budgets[recipe])):
                pass
            if trainer.step > before and (turn in marks or trainer.done >= 1):
                yield recipe
        progress(f"turn {turn}")


def reached(points: Sequence[Point]) -> dict[str, float | None]:
    """Minutes after which each recipe was as good as the paper's recipe at its end; None if it never was."""
    goal_n = [point.mae_n for point in points if point.way == PAPER][-1]
    return {
        recipe: min((p.minutes for p in points if p.way == recipe and p.mae_n <= goal_n), default=None)
        for recipe in COMPARED
    }


def _save(points: Sequence[Point], configs: dict[str, TrainConfig], out: Path) -> None:
    recipes = {recipe: config.model_dump(mode="json") for recipe, config in configs.items()}
    contents = {"recipes": recipes, "points": [asdict(point) for point in points]}
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "learning.json").write_text(json.dumps(contents, indent=1), encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"can't write results to {out}: {error.strerror}; give another folder with --out"
        ) from error


def draw(points: Sequence[Point]) -> Figure:
    """Plots validation error over minutes, with a line for each recipe."""
    with rc_context(STYLE):
        figure = Figure(figsize=(7, 4), layout="constrained")
        axes = figure.add_subplot()
        for recipe in COMPARED:
            own = [point for point in points if point.way == recipe]
            axes.plot([p.minutes for p in own], [p.mae_n for p in own], "o-", markersize=3, label=recipe)
        axes.set(xscale="log", xlabel="minutes of training", ylabel="validation MAE, N")
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter("{x:g}")
        axes.legend()
    return figure
