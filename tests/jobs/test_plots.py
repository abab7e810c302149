from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from gripper_force.config import config_from
from gripper_force.errors import DataError
from gripper_force.jobs.evaluate import evaluate
from gripper_force.jobs.grasp import GraspSummary
from gripper_force.jobs.report import plots
from gripper_force.jobs.report.plots import draw_estimates, draw_grasps, draw_training
from gripper_force.jobs.trials import summarise_trials, write_figure


def summary(
    target_n: float, error_n: float | None, result: str = "held", *, fell_back: bool = False
) -> GraspSummary:
    return {
        "result": result,
        "reason": "",
        "object": "sponge",
        "target_n": target_n,
        "seed": 1,
        "feedback": "fused",
        "vision_share": 1.0,
        "vision_losses": [],
        "object_gain": None,
        "object_gain_std": None,
        "object_gain_true": None,
        "fell_back": fell_back,
        "load_cell_mean_n": None if error_n is None else target_n + error_n,
        "steady_error_n": error_n,
        "overshoot_n": None if error_n is None else 0.1,
        "settle_s": None,
        "peak_n": None if error_n is None else target_n + 0.2,
        "estimator_p50_ms": None,
        "estimator_p99_ms": None,
        "loop_hz": None,
        "camera_hz": None,
        "samples_rejected": None,
        "estimate_mae_n": {},
        "taken": [],
        "log": "",
        "report": None,
    }


def colours(path: Path) -> int:
    """The number of distinct colours in a picture: a drawn figure has many, an empty one has few."""
    image = cv2.imread(str(path))
    assert image is not None
    return len(np.unique(image.astype(np.int64) @ [1 << 16, 1 << 8, 1]))


def test_estimates_of_each_object_are_drawn(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    measured_n = rng.uniform(0, 8, 20000)
    objects = np.where(rng.uniform(size=20000) < 0.5, "sponge", "tube")
    draw_estimates(
        measured_n, measured_n + rng.normal(0, 0.2, 20000), objects, "a title", tmp_path / "new" / "a.png"
    )
    assert colours(tmp_path / "new" / "a.png") > 200


def test_grasps_are_drawn_also_those_that_were_not_held(tmp_path: Path) -> None:
    results = [
        summary(4.0, 0.1),
        summary(2.0, -0.1, fell_back=True),
        summary(3.0, 0.4, "slip"),
        summary(5.0, None),
    ]
    draw_grasps(results, "a title", tmp_path / "grasps.png")
    assert colours(tmp_path / "grasps.png") > 100


def test_trials_leave_a_figure_beside_their_logs(tmp_path: Path) -> None:
    config = config_from({"log": {"directory": str(tmp_path)}}, "the test")
    results = [summary(4.0, 0.1), summary(2.0, -0.1)]
    figure = write_figure(config, results, summarise_trials(results, 10.0))
    assert figure is not None
    assert Path(figure).parent == tmp_path
    quiet = config.with_values(log={"report": False})
    assert write_figure(quiet, results, summarise_trials(results, 10.0)) is None
    without_cell = [summary(4.0, None)]
    assert write_figure(config, without_cell, summarise_trials(without_cell, 10.0)) is None


def test_training_is_drawn_also_with_few_steps(tmp_path: Path) -> None:
    force_n = np.linspace(0, 8, 50)
    losses = {"ssam": np.array([[0.0, 3.0], [10.0, 2.0]]), "scam": np.zeros((0, 2))}
    draw_training(losses, force_n, force_n, np.full(50, "egg"), 2.5, "a title", tmp_path / "training.png")
    assert colours(tmp_path / "training.png") > 100


def test_a_training_of_one_point_is_a_dot(tmp_path: Path) -> None:
    force_n, path = np.linspace(0, 8, 50), tmp_path / "training.png"
    draw_training(
        {"ssam": np.array([[0.0, 3.0]])}, force_n, force_n, np.full(50, "egg"), 2.5, "a title", path
    )
    image = cv2.imread(str(path))
    assert image is not None
    left = image[:, : image.shape[1] // 2, ::-1].astype(int)
    colour = np.rint(255 * np.array(to_rgb(plots._COLOURS[0])))
    drawn = np.count_nonzero(np.abs(left - colour).max(2) < 8)
    assert drawn > 200, "more than the line in the legend"


def test_a_figure_of_an_unknown_kind_is_refused_before_the_work(tmp_path: Path) -> None:
    logs = tmp_path / "no logs yet"
    with pytest.raises(DataError, match=r"a figure can't be a \.foo file"):
        evaluate(logs, "small", plot=tmp_path / "e.foo")


def test_an_objects_name_is_no_formula(tmp_path: Path) -> None:
    force_n = np.linspace(0, 5, 50)
    draw_estimates(force_n, force_n, np.full(50, "a$_$b"), "a title of a$_$b", tmp_path / "names.png")
    assert colours(tmp_path / "names.png") > 100


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a device that is always full")
def test_a_full_disk_is_named_without_its_number(tmp_path: Path) -> None:
    (tmp_path / "a.png").symlink_to("/dev/full")
    with pytest.raises(DataError, match=r"a\.png: No space left on device; check its folder$"):
        draw_grasps([summary(4.0, 0.1)], "a title", tmp_path / "a.png")
