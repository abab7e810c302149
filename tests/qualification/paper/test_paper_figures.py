import io
from dataclasses import replace

import numpy as np
import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from gripper_force.qualification.paper import paper_figures as figures
from gripper_force.qualification.paper.experiment import Test as Estimates
from gripper_force.qualification.paper.models import BASELINE, PROPOSED, Scale
from gripper_force.vision.header import NetworkConfig
from gripper_force.vision.network import ForceNetwork
from gripper_force.vision.preprocess import Preprocess


def drawn(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer)
    return buffer.getvalue()


def test_error_by_force_has_a_bar_for_each_model_and_newton(estimates: Estimates) -> None:
    figure = figures.error_by_force(estimates)
    assert len(figure.axes[0].patches) == 3 * len(np.unique(np.floor(estimates.measured_n)))
    assert drawn(figure)


def test_error_bars_are_the_spread_of_a_sample_of_seeds(estimates: Estimates) -> None:
    for seed in range(3):
        estimates.estimates_n["plain", seed] = estimates.measured_n + 0.4 + 0.1 * seed
    bar, *_ = figures.error_by_force(estimates).axes[0].collections
    assert isinstance(bar, LineCollection)
    low_n, high_n = bar.get_segments()[0][:, 1]
    assert np.allclose((low_n, high_n), (0.4, 0.6))
    one = replace(estimates, scale=Scale(seeds=1))
    assert not figures.error_by_force(one).axes[0].collections


def test_force_over_time_shows_each_object(estimates: Estimates) -> None:
    figure = figures.force_over_time(estimates, [BASELINE, PROPOSED], "Both")
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "paper_cup-0",
        "sponge-0",
        "stapler-0",
        "tube-0",
    ]
    assert all(len(axes.get_lines()) == 3 for axes in figure.axes)
    assert drawn(figure)


def test_attention_is_laid_over_frames_of_rising_force(estimates: Estimates) -> None:
    torch.manual_seed(0)
    network = ForceNetwork(NetworkConfig(attention="ssam", size=32, width=0.25)).eval()
    figure = figures.attention(estimates, network, Preprocess(size=32))
    titles = [axes.get_title() for axes in figure.axes]
    assert len(titles) == 16
    assert titles[0] == "paper_cup, 0.0 N"
    force_n = [float(title.split()[1]) for title in titles[:4]]
    assert force_n == sorted(force_n)
    assert np.isclose(force_n[-1], 10.0, atol=0.1)
    assert drawn(figure)
