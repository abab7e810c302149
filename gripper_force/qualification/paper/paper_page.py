"""Runs the requested reproductions and formats them for docs/paper.md."""

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from gripper_force.errors import ConfigError
from gripper_force.progress import Progress
from gripper_force.qualification.paper import experiment, paper_figures, paper_tables
from gripper_force.qualification.paper.experiment import Test, checkpoint_path
from gripper_force.qualification.paper.models import BASELINE, PROPOSED, SINGLE_FRAME, Scale
from gripper_force.vision.checkpoint import load_checkpoint

NAMES: Final = (*sorted(paper_tables.MODELS_OF), "all")
"""Arguments of `gripper-force reproduce`."""


ProgressBar = Callable[[str, int], AbstractContextManager[Progress]]
"""Shows a progress bar with a label and a number of steps, and gives its `Progress` callback."""


@dataclass(frozen=True, slots=True)
class PaperResult:
    """Tables and figures by name, and the estimates they are based on.

    Attributes:
        tables: Tables, one for each length of training.
        figures: Figures, of the longest training whose networks exist; None without them.
        tests: Estimates, one for each length of training; empty if none were needed, or while logs are missing.
        missing: What is still missing after the time limit, for a person; empty if all is done.
    """

    tables: dict[str, list[paper_tables.Table]]
    figures: dict[str, Figure | None]
    tests: list[Test]
    missing: str


def expand_name(name: str) -> tuple[str, ...]:
    """Names of the tables and figures of an argument of `NAMES`. Raises `ConfigError` for any other."""
    if name not in NAMES:
        raise ConfigError(f"can't reproduce {name!r}; choose from {', '.join(NAMES)}")
    return tuple(paper_tables.MODELS_OF) if name == "all" else (name,)


def reproduce(
    names: Sequence[str],
    scales: Sequence[Scale],
    data: Path | None,
    out: Path,
    workers: int,
    bar: ProgressBar,
    end_s: float = math.inf,
) -> PaperResult:
    """Makes tables and figures. First simulates the missing logs and trains the missing networks.

    Args:
        names: Keys of `paper_tables.MODELS_OF`.
        scales: Sizes of the reproduction, which differ only in their steps.
        data: Folder with logs in ``train`` and ``test``; None for simulated ones.
        out: Folder for the networks.
        workers: Processes.
        bar: Shows progress.
        end_s: Time of `time.monotonic` at which simulation and training are interrupted.

    Raises:
        DataError: See `experiment.run`.
    """
    models = list(dict.fromkeys(model for name in names for model in paper_tables.MODELS_OF[name]))
    tests: list[Test] = []
    missing = ""
    if models:
        if data is None:
            data = Path("data/shin2019") / scales[0].instances / scales[0].protocol
            logs = experiment.missing_logs(scales[0], data)
            with bar("simulating", logs) as progress:
                experiment.simulate_missing(scales[0], data, workers, end_s, progress)
            if logs := experiment.missing_logs(scales[0], data):
                return PaperResult({}, {}, [], f"{logs} logs are still missing")
        nets = len(experiment.networks(models))
        with bar("training", sum(scale.steps * scale.seeds for scale in scales) * nets) as progress:
            tests = experiment.run(scales, models, data, out, workers, end_s, progress)
        if left := nets * sum(scale.seeds for scale in scales) - sum(len(test.estimates_n) for test in tests):
            missing = f"{left} networks are not trained yet"
    tables = {name: [_MAKERS[name](test) for test in tests] for name in names if name in _MAKERS}
    if "7" in names:
        with bar("timing", paper_tables.TIMED) as progress:
            tables["7"] = [paper_tables.times(progress)]
    figures = {name: _figure(name, tests, data, out) for name in names if name in _CAPTIONS}
    return PaperResult(tables, figures, tests, missing)


_MAKERS: Final[dict[str, Callable[[Test], paper_tables.Table]]] = {
    **{name: partial(paper_tables.comparison, name=name) for name in paper_tables.COMPARISONS},
    "9": paper_tables.objects,
    "claims": paper_tables.claims,
}


def _figure(name: str, tests: Sequence[Test], data: Path | None, out: Path) -> Figure | None:
    models = paper_tables.MODELS_OF[name]
    measured = [test for test in tests if 0 in test.seeds_of(*models)]
    if not measured or data is None:
        return None
    test = max(measured, key=lambda test: test.scale.steps)
    match name:
        case "fig6":
            return paper_figures.error_by_force(test)
        case "fig7":
            return paper_figures.force_over_time(test, [PROPOSED], "The proposed ensemble")
        case "fig9":
            return paper_figures.force_over_time(test, [BASELINE, PROPOSED], "Baseline and proposed")
    network = load_checkpoint(str(checkpoint_path(out, data, test.scale, "ssam-1", 0))).force_networks[0]
    return paper_figures.attention(test, network, test.scale.recipe("ssam-1", 0).preprocess)


def picture_name(scale_name: str, scale: Scale, figure: str) -> str:
    """File name of a figure."""
    return f"{scale.instances}-{scale_name}-{figure}.png"


def markdown(result: PaperResult, scale_name: str, scale: Scale, pictures: str) -> dict[str, str]:
    """Markdown by the name of its place in the page. The place ``INSTANCES SCALE`` describes the networks.

    Args:
        result: Tables and figures.
        scale_name: Key of `models.SCALES`.
        scale: Size of the reproduction.
        pictures: Folder of the figures, relative to the page.
    """
    place = f"{scale.instances} {scale_name}"
    parts = {
        f"{place} {name}": "\n".join(table.markdown() for table in tables)
        for name, tables in result.tables.items()
    }
    for name, figure in result.figures.items():
        caption = f"*{_CAPTIONS[name]}*"
        picture = f"![{_CAPTIONS[name]}]({pictures}/{picture_name(scale_name, scale, name)})"
        parts[f"{place} {name}"] = (
            f"{caption}: not measured.\n" if figure is None else f"{picture}\n{caption}\n"
        )
    if result.tests:
        test = result.tests[0]
        lines = [
            f"Made by `gripper-force reproduce --scale {scale_name} --instances {scale.instances}`:",
            f"{scale.size}x{scale.size} pixels, width {scale.width:g}.",
            f"Tested on {len(np.unique(test.set_of_clip))} sets: {len(test.measured_n)} frames, of which",
            f"{100 * test.contact.mean():.0f} % in contact. MAE: mean ± s.d. over seeds. Ratio: MAE of the",
            "baseline over that of the model. p: Wilcoxon's signed-rank test against the baseline, paired by test set,",
            "of the errors averaged over the seeds.",
        ]
        parts[place] = " ".join(lines) + "\n"
    return parts


_CAPTIONS: Final = {
    "fig6": f"Figure 6: error by force up to {paper_figures.BINS} N, of baseline, {SINGLE_FRAME} and {PROPOSED}",
    "fig7": "Figure 7: estimates over time, one test set of each object",
    "fig8": "Figure 8: spatial attention (SSAM) at rising force; brighter means more attention",
    "fig9": "Figure 9: estimates of baseline and proposed model over time",
}
