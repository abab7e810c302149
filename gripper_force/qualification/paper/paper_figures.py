"""The paper's figures 6 to 9, drawn from the test sets."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gripper_force.jobs.dataset import Clip
from gripper_force.jobs.report.figure import STYLE
from gripper_force.jobs.report.pictures import overlay
from gripper_force.qualification.paper.experiment import Test
from gripper_force.qualification.paper.models import BASELINE, PROPOSED, SINGLE_FRAME
from gripper_force.types import Gray
from gripper_force.vision.batch_inference import normalise
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess, downscale

BINS: Final = 11
"""Force bins of 1 N each in figure 6, which leaves out larger forces."""

_COLOURS: Final = {BASELINE: "#8a9099", SINGLE_FRAME: "#2a9d8f", PROPOSED: "#d1495b"}
_LOADS: Final = (0.0, 0.25, 0.6, 1.0)
"""Shares of a clip's largest force at which attention is shown."""

_SIDE: Final = 192
"""Side of the images in figure 8, in pixels."""


def error_by_force(test: Test) -> Figure:
    """Figure 6: MAE by measured force, in 11 bins of 1 N."""
    level = np.floor(test.measured_n).clip(0).astype(int)
    filled = [n for n in range(BINS) if (level == n).any()]
    with rc_context(STYLE):
        figure = Figure(figsize=(9, 3.4), layout="constrained")
        axes = figure.subplots()
        for i, (model, colour) in enumerate(_COLOURS.items()):
            error_n = test.absolute_n(model)
            by_bin = [error_n[:, level == n].mean(1) for n in filled]  # (bins, seeds)
            where = np.array(filled) + 0.5 + 0.27 * (i - 1)
            one_seed = len(error_n) == 1  # which has no spread
            spread = None if one_seed else [values.std(ddof=1) for values in by_bin]
            axes.bar(
                where,
                [v.mean() for v in by_bin],
                0.25,
                yerr=spread,
                color=colour,
                ecolor="#59606a",
                label=model,
            )
        axes.set_xlabel("measured force, N")
        axes.set_ylabel("MAE, N")
        axes.set_xticks(range(BINS + 1))
        axes.set_title("Error by force, mean ± s.d. over seeds")
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.2)
    return figure


def force_over_time(test: Test, models: Sequence[str], title: str) -> Figure:
    """Figures 7 and 9: estimates and load cell for one test set of each object."""
    with rc_context(STYLE):
        figure = Figure(figsize=(10, 6), layout="constrained")
        figure.suptitle(title, x=0.008, ha="left", fontsize=12, fontweight="bold")
        for axes, number in zip(figure.subplots(2, 2).flat, _one_of_each(test), strict=False):
            frames = test.clip == number
            axes.plot(test.measured_n[frames], color="#22262b", lw=1.6, ls=":", label="load cell")
            for model in models:
                axes.plot(test.estimate_n(model, 0)[frames], color=_COLOURS[model], lw=1.0, label=model)
            axes.set_title(test.clips[number].name)
            axes.set_xlabel("frame")
            axes.set_ylabel("force, N")
        handles = figure.axes[0].get_legend_handles_labels()
        figure.legend(*handles, loc="upper right", ncols=len(handles[0]))
    return figure


def attention(test: Test, network: ForceNetwork, preprocess: Preprocess) -> Figure:
    """Figure 8: spatial attention (SSAM) on frames of each object at rising force."""
    numbers = _one_of_each(test)
    with rc_context({**STYLE, "axes.grid": False}):
        figure = Figure(figsize=(2.1 * len(_LOADS), 2.3 * len(numbers)), layout="constrained")
        grid = figure.subplots(len(numbers), len(_LOADS), squeeze=False)
        for row, number in zip(grid, numbers, strict=True):
            clip = test.clips[number]
            peak = int(clip.forces_n.argmax())
            rise_n = clip.forces_n[: peak + 1]
            for axes, share in zip(row, _LOADS, strict=True):
                index = peak if share == 1 else int(np.abs(rise_n - share * rise_n[-1]).argmin())
                _draw_attention(axes, clip, index, network, preprocess)
    return figure


def _draw_attention(
    axes: Axes, clip: Clip, index: int, network: ForceNetwork, preprocess: Preprocess
) -> None:
    gates = _gates(clip.frames[: index + 1][-network.config.context - 1 :], clip.frames, network, preprocess)
    gray = downscale(clip.frames[index], None, _SIDE)
    axes.imshow(overlay(gray, gates))
    axes.set_axis_off()
    axes.set_title(
        f"{clip.object}, {abs(clip.forces_n[index]):.1f} N", fontsize=8, fontweight="normal", loc="center"
    )


@torch.inference_mode()
def _gates(frames: Gray, clip: Gray, network: ForceNetwork, preprocess: Preprocess) -> np.ndarray:
    """Spatial attention at the last of the frames, (h, w)."""
    leading = torch.from_numpy(clip[None, : preprocess.reference_frames])
    inputs = normalise(torch.from_numpy(frames)[None], leading, preprocess)  # (1, T, 1, S, S)
    state = None
    for i in range(inputs.shape[1]):
        output, state = network.step(inputs[:, i], state)
    assert output.gates is not None
    return np.asarray(output.gates[0, 0].numpy(), np.float32)


def _one_of_each(test: Test) -> list[int]:
    """Number of the first test set of each object."""
    names = [clip.object for clip in test.clips]
    return [names.index(name) for name in sorted(set(names))]
