"""The paper's tables, each row with the paper's numbers and the reproduced ones."""

import time
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from gripper_force.jobs.training.recipe import TrainConfig
from gripper_force.progress import Progress
from gripper_force.qualification.paper.experiment import Test
from gripper_force.qualification.paper.models import BASELINE, NETS, PROPOSED, SINGLE_FRAME, TWO_PLAIN
from gripper_force.types import NS_PER_MS
from gripper_force.vision.network import ForceNetwork

Cell = str | float | None

_UNMEASURED: Final = "not measured"
"""Cell of a model whose networks are not trained yet."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table; numbers are shown with three digits, None and NaN as a dash."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """Markdown of the table."""
        head = "| " + " | ".join(self.columns) + " |\n|" + "---|" * len(self.columns) + "\n"
        body = "".join("| " + " | ".join(map(cell_text, row)) + " |\n" for row in self.rows)
        return f"**{self.title}**\n\n{head}{body}" + (f"\n{self.note}\n" if self.note else "")


def cell_text(cell: Cell) -> str:
    """Text of a cell."""
    if cell is None or (isinstance(cell, float) and not np.isfinite(cell)):
        return "–"
    return f"{cell:.3f}" if isinstance(cell, float) else cell


@dataclass(frozen=True, slots=True)
class _Row:
    """A model, its RMSE and MAE in the paper, and its name in the table, if different."""

    model: str
    rmse_n: float | None = None
    mae_n: float | None = None
    name: str = ""


_BASELINE: Final = _Row(BASELINE, 0.10313, 0.04051)
_PROPOSED: Final = _Row(PROPOSED, 0.09356, 0.03183)

COMPARISONS: Final[dict[str, tuple[str, tuple[_Row, ...]]]] = {
    "3": (
        "Table 3: attention over one frame and over several",
        (
            _BASELINE,
            _Row(TWO_PLAIN),
            _Row("single frame, spatial", 0.10057, 0.03700),
            _Row("single frame, channel", 0.10007, 0.03662),
            _Row(SINGLE_FRAME, 0.09738, 0.03400),
            _Row("proposed, spatial", 0.09734, 0.03416),
            _Row("proposed, channel", 0.09572, 0.03320),
            _PROPOSED,
        ),
    ),
    "4": (
        "Table 4: number n of earlier frames in the attention",
        (
            _BASELINE,
            _Row(SINGLE_FRAME, 0.10313, 0.04051, "n = 0, ensemble"),
            _Row(PROPOSED, 0.09356, 0.03183, "n = 1, ensemble"),
            _Row("n = 2, ensemble", 0.09368, 0.03194),
        ),
    ),
    "5": (
        "Table 5: global (GAP) and weighted average pooling",
        (
            _BASELINE,
            _Row("GAP, spatial", 0.09731, 0.03562),
            _Row("GAP, channel", 0.09599, 0.03431),
            _Row("GAP, ensemble", 0.09411, 0.03311),
            _Row("proposed, spatial", 0.09734, 0.03416),
            _Row("proposed, channel", 0.09572, 0.03320),
            _PROPOSED,
        ),
    ),
    "6": (
        "Table 6: backbones",
        (
            _BASELINE,
            _PROPOSED,
            _Row("ResNet, baseline"),
            _Row("ResNet, ensemble", 0.09549, 0.03122),
            _Row("mobile, ensemble"),
        ),
    ),
    "8": (
        "Table 8: other attention modules",
        (
            _BASELINE,
            _Row("SE", 0.09838, 0.03769),
            _Row("CBAM", 0.09974, 0.03745),
            _Row("proposed, spatial"),
            _Row("proposed, channel"),
            _Row(PROPOSED, 0.09549, 0.03122),
        ),
    ),
}
"""Title and rows of the tables that compare errors over all test sets."""

OBJECTS: Final[dict[str, tuple[float, float, float]]] = {
    "sponge": (0.02118, 0.01830, 0.01734),
    "paper_cup": (0.02070, 0.01607, 0.01555),
    "tube": (0.06689, 0.06035, 0.05675),
    "stapler": (0.05326, 0.04128, 0.03766),
}
"""Table 9 of the paper: MAE of baseline, single-frame and proposed model by object."""

_TIMES_S: Final = {"plain": 0.308, "ssam-1": 0.342, "scam-1": 0.338}
"""Table 7 of the paper: time of an estimate."""

_RUNS: Final = 128
"""Estimates that are timed; the paper averages the same number."""

_WARM_UP: Final = 8
"""Estimates before the first that is timed."""

_CLAIMS: Final = (
    ("the ensemble beats the baseline", PROPOSED, BASELINE),
    ("spatial: several frames beat one", "proposed, spatial", "single frame, spatial"),
    ("channel: several frames beat one", "proposed, channel", "single frame, channel"),
    ("ensemble: several frames beat one", PROPOSED, SINGLE_FRAME),
    ("the ensemble beats two plain networks", PROPOSED, TWO_PLAIN),
    ("spatial attention beats none", "proposed, spatial", BASELINE),
    ("channel attention beats none", "proposed, channel", BASELINE),
    ("weighted pooling beats global pooling", PROPOSED, "GAP, ensemble"),
)

MODELS_OF: Final[dict[str, tuple[str, ...]]] = {
    **{name: tuple(row.model for row in rows) for name, (_, rows) in COMPARISONS.items()},
    "7": (),
    "9": (BASELINE, SINGLE_FRAME, PROPOSED),
    "fig6": (BASELINE, SINGLE_FRAME, PROPOSED),
    "fig7": (PROPOSED,),
    "fig8": ("proposed, spatial",),
    "fig9": (BASELINE, PROPOSED),
    "claims": tuple(dict.fromkeys(model for _, *pair in _CLAIMS for model in pair)),
}
"""The models that each table or figure needs."""


def comparison(test: Test, name: str) -> Table:
    """A table of `COMPARISONS`: errors over all test sets."""
    title, rows = COMPARISONS[name]
    columns = ("model", "RMSE, paper", "MAE, paper", "ratio, paper", "RMSE N", "MAE N", "seeds", "ratio")
    cells: list[tuple[Cell, ...]] = []
    for row in rows:
        paper = _paper(row.rmse_n), _paper(row.mae_n), _percent(_BASELINE.mae_n, row.mae_n)
        ours: tuple[Cell, ...] = (_UNMEASURED, *(None,) * 5)
        if seeds := test.seeds_of(row.model):
            ours = (
                float(test.rmse_n(row.model).mean()),
                _spread(test.mae_n(row.model)),
                _count(len(seeds), test.scale.seeds),
                *_against_baseline(test, row.model),
            )
        cells.append((row.name or row.model, *paper, *ours))
    return Table(_title(title, test), (*columns, "better", "p"), tuple(cells), _SEEDS_NOTE)


_SEEDS_NOTE: Final = (
    "Seeds: those with which the model was trained. Ratio, better and p: over the seeds that the baseline has too; "
    "better: number of them with a lower MAE than the baseline."
)


def _against_baseline(test: Test, model: str) -> tuple[Cell, ...]:
    """Returns ratio, number of better seeds and p-value."""
    if not test.seeds_of(model, BASELINE):
        return (None,) * 3
    ours_n, theirs_n = test.mae_n(model, BASELINE), test.mae_n(BASELINE, model)
    ratio = _percent(float(theirs_n.mean()), float(ours_n.mean()))
    if model == BASELINE:
        return ratio, None, None
    return ratio, str(int((ours_n < theirs_n).sum())), _p(test.p_value(model, BASELINE))


def objects(test: Test) -> Table:
    """The paper's table 9: MAE by object."""
    rows: list[tuple[Cell, ...]] = []
    for name, paper_n in OBJECTS.items():
        frames = test.object == name
        for model, theirs in zip(MODELS_OF["9"], paper_n, strict=True):
            ours: tuple[Cell, ...] = (_UNMEASURED, None, None)
            if seeds := test.seeds_of(model):
                ratio = None
                if test.seeds_of(model, BASELINE):
                    ours_n, baseline_n = (
                        float(test.absolute_n(*pair)[:, frames].mean())
                        for pair in ((model, BASELINE), (BASELINE, model))
                    )
                    ratio = _percent(baseline_n, ours_n)
                by_seed_n = test.absolute_n(model)[:, frames].mean(1)
                ours = (_spread(by_seed_n), _count(len(seeds), test.scale.seeds), ratio)
            rows.append((name, model, _paper(theirs), _percent(paper_n[0], theirs), *ours))
    columns = ("object", "model", "MAE, paper", "ratio, paper", "MAE N", "seeds", "ratio")
    return Table(_title("Table 9: objects", test), columns, tuple(rows))


def claims(test: Test) -> Table:
    """The paper's claims, each with a paired test over the test sets."""
    rows: list[tuple[Cell, ...]] = []
    for text, better, worse in _CLAIMS:
        if not test.seeds_of(better, worse):
            rows.append((text, _UNMEASURED, None, None, None))
            continue
        a, b = test.mae_by_set_n(better, worse), test.mae_by_set_n(worse, better)
        won = test.mae_n(better, worse) < test.mae_n(worse, better)
        rows.append(
            (
                text,
                f"{100 * (1 - a.mean() / b.mean()):+.1f} %",
                f"{int((a < b).sum())} of {len(a)}",
                f"{int(won.sum())} of {len(won)}",
                _p(test.p_value(better, worse)),
            )
        )
    columns = ("claim", "MAE reduction", "test sets", "seeds", "p")
    return Table(_title("Claims", test), columns, tuple(rows))


def _title(text: str, test: Test) -> str:
    return f"{text} ({test.scale.steps:,} steps)"


def _count(seeds: int, planned: int) -> str:
    return str(seeds) if seeds == planned else f"{seeds} of {planned}"


def times(progress: Progress) -> Table:
    """The paper's table 7: time of an estimate, with the whole window for each frame, and streamed."""
    networks = {net: ForceNetwork(TrainConfig(**NETS[net]).network(0)).eval() for net in _TIMES_S}
    window = networks["plain"].config.window
    frame = torch.zeros(1, 1, 128, 128)
    clip = frame[:, None].expand(-1, window, -1, -1, -1)
    ms: dict[tuple[str, str], list[float]] = {}
    with torch.inference_mode():
        states = {net: network.step(frame, None)[1] for net, network in networks.items()}
        for run in range(_RUNS + _WARM_UP):  # in turns, so that other load affects all alike
            for net, network in networks.items():
                begin_ns = time.perf_counter_ns()
                network(clip, window - 1)
                middle_ns = time.perf_counter_ns()
                states[net] = network.step(frame, states[net])[1]
                end_ns = time.perf_counter_ns()
                if run >= _WARM_UP:
                    ms.setdefault((net, "window"), []).append((middle_ns - begin_ns) / NS_PER_MS)
                    ms.setdefault((net, "stream"), []).append((end_ns - middle_ns) / NS_PER_MS)
            progress("timing")
    plain = {method: float(np.median(ms["plain", method])) for method in ("window", "stream")}
    rows = []
    for net, paper_s in _TIMES_S.items():
        row: list[Cell] = [net, f"{1e3 * paper_s:.0f}", f"{paper_s / _TIMES_S['plain']:.2f}"]
        for method in ("window", "stream"):
            p50, p99 = np.percentile(ms[net, method], [50, 99])
            row += [f"{p50:.1f}, {p99:.1f}", f"{p50 / plain[method]:.2f}"]
        rows.append(tuple(row))
    columns = (
        "network",
        "paper ms",
        "ratio",
        "window, ms p50, p99",
        "ratio",
        "streamed, ms p50, p99",
        "ratio",
    )
    return Table("Table 7: time of an estimate", columns, tuple(rows))


TIMED: Final = _RUNS + _WARM_UP
"""Number of calls of ``progress`` by `times`."""


def _paper(value: float | None) -> str:
    return "–" if value is None else f"{value:.5f}"


def _percent(baseline_n: float | None, mae_n: float | None) -> str:
    return "–" if baseline_n is None or mae_n is None else f"{100 * baseline_n / mae_n:.0f} %"


def _spread(values_n: np.ndarray) -> str:
    """Text of the mean and the spread over seeds. One seed has no spread."""
    mean = f"{values_n.mean():.3f}"
    return mean if len(values_n) == 1 else f"{mean} ± {values_n.std(ddof=1):.3f}"


def _p(value: float) -> str:
    return "–" if np.isnan(value) else (f"{value:.3f}" if value >= 0.001 else "< 0.001")
