"""Runs the requested reproductions and formats them for docs/paper.md."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from gripper_force.errors import ConfigError
from gripper_force.interfaces import Progress
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
    """Tables and figures by name."""

    tables: dict[str, paper_tables.Table]
    figures: dict[str, Figure]


def expand_name(name: str) -> tuple[str, ...]:
    """Names of the tables and figures of an argument of `NAMES`. Raises `ConfigError` for any other."""
    if name not in NAMES:
        raise ConfigError(f"can't reproduce {name!r}; choose from {', '.join(NAMES)}")
    return tuple(paper_tables.MODELS_OF) if name == "all" else (name,)


def reproduce(
    names: Sequence[str], scale: Scale, data: Path | None, out: Path, jobs: int, bar: ProgressBar
) -> tuple[PaperResult, Test | None]:
    """Makes tables and figures. First simulates the missing logs and trains the missing networks.

    Args:
        names: Keys of `paper_tables.MODELS_OF`.
        scale: Size of the reproduction.
        data: Folder with logs in ``train`` and ``test``; None for simulated ones.
        out: Folder for the networks.
        jobs: Processes.
        bar: Shows progress.

    Returns:
        Tables and figures, and the estimates they are based on; None if they need none.

    Raises:
        DataError: See `experiment.run`.
        CheckpointError: See `experiment.run`.
    """
    models = list(dict.fromkeys(model for name in names for model in paper_tables.MODELS_OF[name]))
    test = None
    if models:
        if data is None:
            data = Path("data/shin2019") / scale.protocol
            missing = experiment.missing_logs(scale, data)
            with bar("simulating", missing) as progress:
                experiment.simulate_missing(scale, data, jobs, progress)
        with bar("training", scale.seeds * len(experiment.networks(models))) as progress:
            test = experiment.run(scale, models, data, out, jobs, progress)
    with bar("timing", paper_tables.TIMED * ("7" in names)) as progress:
        return _make(names, test, scale, out, progress), test


def _make(
    names: Sequence[str], test: Test | None, scale: Scale, out: Path, progress: Progress
) -> PaperResult:
    made: dict[str, paper_tables.Table] = {}
    drawn: dict[str, Figure] = {}
    for name in names:
        if name == "7":
            made[name] = paper_tables.times(progress)
            continue
        assert test is not None
        match name:
            case "9":
                made[name] = paper_tables.objects(test)
            case "claims":
                made[name] = paper_tables.claims(test)
            case "fig6":
                drawn[name] = paper_figures.error_by_force(test)
            case "fig7":
                drawn[name] = paper_figures.force_over_time(test, [PROPOSED], "The proposed ensemble")
            case "fig8":
                network = load_checkpoint(str(checkpoint_path(out, "ssam-1", 0))).force_networks[0]
                drawn[name] = paper_figures.attention(test, network, scale.recipe("ssam-1", 0).preprocess)
            case "fig9":
                drawn[name] = paper_figures.force_over_time(
                    test, [BASELINE, PROPOSED], "Baseline and proposed"
                )
            case _:
                made[name] = paper_tables.comparison(test, name)
    return PaperResult(made, drawn)


def markdown(
    result: PaperResult, scale_name: str, scale: Scale, test: Test | None, pictures: str
) -> dict[str, str]:
    """Markdown by the name of its place in the page. The place of the scale's name describes its networks.

    Args:
        result: Tables and figures.
        scale_name: Key of `models.SCALES`.
        scale: Size of the reproduction.
        test: Estimates, or None.
        pictures: Folder of the figures, relative to the page.
    """
    made = {name: table.markdown() for name, table in result.tables.items()}
    for name in result.figures:
        made[name] = f"![{_CAPTIONS[name]}]({pictures}/{name}.png)\n*{_CAPTIONS[name]}*\n"
    parts = {f"{scale_name} {name}": text for name, text in made.items()}
    if test is not None:
        lines = [
            f"Made by `gripper-force reproduce all --scale {scale_name}`:",
            f"{scale.size}x{scale.size} pixels, width {scale.width:g}, {scale.steps} steps per network,",
            f"{scale.seeds} seeds.",
            f"Tested on {len(test.clips)} sets: {len(test.measured_n)} frames, of which",
            f"{100 * test.contact.mean():.0f} % in contact. MAE: mean ± s.d. over seeds. Ratio: MAE of the",
            "baseline over that of the model. p: Wilcoxon's signed-rank test against the baseline, paired by test set.",
        ]
        parts[scale_name] = " ".join(lines) + "\n"
    return parts


_CAPTIONS: Final = {
    "fig6": f"Figure 6: error by force, of baseline, {SINGLE_FRAME} and {PROPOSED}",
    "fig7": "Figure 7: estimates over time, one test set of each object",
    "fig8": "Figure 8: spatial attention (SSAM) at rising force; brighter means more attention",
    "fig9": "Figure 9: estimates of baseline and proposed model over time",
}
