"""What is asked for, made and put into a page."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from gripper_force.errors import ConfigError
from gripper_force.qualification.paper import experiment, paper_figures, paper_tables
from gripper_force.qualification.paper.experiment import Advance, Test, checkpoint_path
from gripper_force.qualification.paper.models import BASELINE, PROPOSED, SINGLE_FRAME, Scale
from gripper_force.vision.checkpoint import load_checkpoint

WHAT: Final = (*sorted(paper_tables.MODELS_OF), "all")
"""What `gripper-force reproduce` can be asked for."""


Bar = Callable[[str, int], AbstractContextManager[Advance]]


@dataclass(frozen=True, slots=True)
class PaperResult:
    """Tables and figures by name."""

    tables: dict[str, paper_tables.Table]
    figures: dict[str, Figure]


def asked_for(what: str) -> tuple[str, ...]:
    """The tables and figures that ``what`` stands for. Raises `ConfigError` if it stands for none."""
    if what not in WHAT:
        raise ConfigError(f"nothing to reproduce is named {what!r}; there are {', '.join(WHAT)}")
    return tuple(paper_tables.MODELS_OF) if what == "all" else (what,)


def reproduce(
    names: Sequence[str], scale: Scale, data: Path | None, out: Path, jobs: int, bar: Bar
) -> tuple[PaperResult, Test | None]:
    """Makes tables and figures, and first of all the logs and networks they need that are not there yet.

    Args:
        names: Of `paper_tables.MODELS_OF`.
        scale: How much of everything.
        data: Folder with logs in ``train`` and ``test``; None for simulated ones.
        out: Folder for the networks.
        jobs: Processes.
        bar: Shows progress: called with a label and the number of steps.

    Returns:
        What was made, and the estimates it was made of; None where there is no need of any.

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
            with bar("simulating", missing) as advance:
                experiment.simulate_missing(scale, data, jobs, advance)
        with bar("training", scale.seeds * len(experiment.networks(models))) as advance:
            test = experiment.run(scale, models, data, out, jobs, advance)
    with bar("timing", paper_tables.TIMED * ("7" in names)) as advance:
        return _make(names, test, scale, out, advance), test


def _make(names: Sequence[str], test: Test | None, scale: Scale, out: Path, advance: Advance) -> PaperResult:
    made: dict[str, paper_tables.Table] = {}
    drawn: dict[str, Figure] = {}
    for name in names:
        if name == "7":
            made[name] = paper_tables.times(advance)
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
                network = load_checkpoint(str(checkpoint_path(out, "ssam-1", 0))).networks[0]
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
    """What was made, in Markdown, by the name of its place in the page.

    The scale's own name stands for what the networks of its tables are; ``pictures`` is the folder of the
    figures, as the page names it.
    """
    made = {name: table.markdown() for name, table in result.tables.items()}
    for name in result.figures:
        made[name] = f"![{_CAPTIONS[name]}]({pictures}/{name}.png)\n*{_CAPTIONS[name]}*\n"
    parts = {f"{scale_name} {name}": text for name, text in made.items()}
    if test is not None:
        lines = [
            f"Made by `gripper-force reproduce all --scale {scale_name}`:",
            f"{scale.size}x{scale.size} pixels, width {scale.width:g}, {scale.steps} steps a network,",
            f"{scale.seeds} seeds.",
            f"Tested on {len(test.clips)} sets: {len(test.measured_n)} frames, of which",
            f"{100 * test.contact.mean():.0f} % in contact. MAE: mean ± s.d. over seeds. Ratio: that of",
            "the baseline over it. p: Wilcoxon's signed-rank test against the baseline, paired by test set.",
        ]
        parts[scale_name] = " ".join(lines) + "\n"
    return parts


_CAPTIONS: Final = {
    "fig6": f"Figure 6: error by force, of baseline, {SINGLE_FRAME} and {PROPOSED}",
    "fig7": "Figure 7: estimates over time, one test set of each object",
    "fig8": "Figure 8: where SSAM looks, at rising force; brighter is more",
    "fig9": "Figure 9: estimates of baseline and proposed model over time",
}
