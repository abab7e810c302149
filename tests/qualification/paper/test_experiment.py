import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gripper_force.errors import DataError
from gripper_force.jobs import dataset
from gripper_force.jobs.dataset import load_clips
from gripper_force.jobs.training import train as module
from gripper_force.jobs.training.train import train
from gripper_force.progress import no_progress
from gripper_force.qualification.paper import experiment
from gripper_force.qualification.paper.experiment import Test as Estimates
from gripper_force.qualification.paper.experiment import checkpoint_path, networks, run
from gripper_force.qualification.paper.models import BASELINE, PROPOSED, TWO_PLAIN, Scale
from gripper_force.qualification.paper.paper_tables import comparison

from .conftest import FRAMES

TINY = Scale(size=32, width=0.25, steps=2, seeds=2)


@pytest.fixture(scope="module", autouse=True)
def _in_threads(thread_pool: object) -> Iterator[None]:
    """Trains in this process, except where an end of the time kills a training."""
    threads, train_all = torch.get_num_threads(), experiment._train_all

    def train_here(*arguments: Any) -> None:
        *_, end_s, _ = arguments
        with pytest.MonkeyPatch.context() as patch:
            if end_s == math.inf:
                patch.setattr(experiment, "process_pool", thread_pool)
            train_all(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "_train_all", train_here)
        yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def ran(touches: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Estimates, Path, list[str]]:
    out = tmp_path_factory.mktemp("networks")
    done: list[str] = []

    def progress(text: str, steps: int = 1) -> None:
        done.append(text)

    (test,) = run([TINY], [BASELINE, TWO_PLAIN], touches, out, 1, math.inf, progress)
    return test, out, done


def again(touches: Path, out: Path, *scales: Scale, end_s: float = math.inf) -> list[Estimates]:
    return run(scales, [BASELINE, TWO_PLAIN], touches, out, 1, end_s, no_progress)


def test_each_network_is_trained_once_with_each_seed(
    ran: tuple[Estimates, Path, list[str]], touches: Path
) -> None:
    test, out, done = ran
    assert [text.split(";")[0] for text in done] == ["plain, seed 0, 2 steps", "plain, seed 1, 2 steps"]
    assert done[0].endswith("h left")
    assert all(checkpoint_path(out, touches, TINY, "plain", seed).exists() for seed in (0, 1))
    lead_in = TINY.recipe("plain", 0).preprocess.lead_in
    assert len(test.measured_n) == 8 * (FRAMES - lead_in)
    assert np.isfinite(test.estimates_n["plain", 0]).all()
    assert (test.estimates_n["plain", 0] != test.estimates_n["plain", 1]).any()


def test_a_gpu_trains_no_more_networks_at_once_than_its_memory_holds(
    touches: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread_pool: object
) -> None:
    started: list[int] = []

    def train_all(tasks: object, files: object, workers: int, end_s: float, progress: object) -> None:
        started.append(workers)

    monkeypatch.setattr(dataset, "process_pool", thread_pool)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(experiment, "_train_all", train_all)
    for free_gib in (0, 15, 80):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda gib=free_gib: (gib * 2**30, 0))
        run([TINY], [BASELINE], touches, tmp_path, 4, math.inf, no_progress)
    assert started == [1, 2, 4]


def test_existing_networks_are_not_trained_again(
    ran: tuple[Estimates, Path, list[str]], touches: Path
) -> None:
    test, out, _ = ran
    path = checkpoint_path(out, touches, TINY, "plain", 0)
    before = path.stat().st_mtime_ns
    path.with_suffix(".npy").unlink()
    (same,) = again(touches, out, TINY)
    assert path.stat().st_mtime_ns == before
    assert same.estimates_n.keys() == test.estimates_n.keys()
    np.testing.assert_array_equal(same.estimates_n["plain", 0], test.estimates_n["plain", 0])


def test_networks_are_not_used_for_another_recipe_or_other_data(
    ran: tuple[Estimates, Path, list[str]], touches: Path, tmp_path: Path
) -> None:
    test, out, _ = ran
    wider = TINY.model_copy(update={"width": 0.5})
    longer = TINY.model_copy(update={"steps": 3})
    untrained = again(touches, out, TINY, longer, end_s=0.0)
    assert [len(one.estimates_n) for one in untrained] == [2, 0]
    assert not again(touches, out, wider, end_s=0.0)[0].estimates_n
    copy = tmp_path / "copy"
    shutil.copytree(touches, copy)
    assert again(copy, out, TINY, end_s=0.0)[0].estimates_n.keys() == test.estimates_n.keys()
    (copy / "train" / "tube-0.mcap").unlink()
    assert not again(copy, out, TINY, end_s=0.0)[0].estimates_n


def test_an_interrupted_run_gives_the_same_table(
    ran: tuple[Estimates, Path, list[str]], touches: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    test, *_ = ran
    (nothing,) = again(touches, tmp_path, TINY, end_s=0.0)
    rows = comparison(nothing, "3").rows
    assert [row[4:] for row in rows] == [("not measured", *(None,) * 5)] * len(rows)

    recipe, path = TINY.recipe("plain", 0), checkpoint_path(tmp_path, touches, TINY, "plain", 0)
    reports = 0

    def end_in_step_2(text: str, steps: int = 1) -> None:
        nonlocal reports
        reports += 1
        if reports == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(module, "STATE_EVERY_S", -1.0)
    torch.set_num_threads(1)
    with pytest.raises(KeyboardInterrupt):
        train(recipe, load_clips(touches / "train", recipe.preprocess), path, progress=end_in_step_2)
    assert [state.exists() for state in (*module.state_paths(recipe, path), path)] == [True, False]
    (resumed,) = again(touches, tmp_path, TINY)
    assert comparison(resumed, "3") == comparison(test, "3")
    np.testing.assert_array_equal(resumed.estimates_n["plain", 0], test.estimates_n["plain", 0])


def test_estimates_of_other_test_sets_raise(ran: tuple[Estimates, Path, list[str]], touches: Path) -> None:
    _, out, _ = ran
    path = checkpoint_path(out, touches, TINY, "plain", 1).with_suffix(".npy")
    whole = path.read_bytes()
    np.save(path, np.zeros(3))
    try:
        with pytest.raises(DataError, match="but the test sets have"):
            again(touches, out, TINY)
    finally:
        path.write_bytes(whole)


def test_missing_logs_raise(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no logs in .*train"):
        again(tmp_path, tmp_path / "out", TINY)


def test_missing_logs_of_the_protocol_are_counted(tmp_path: Path) -> None:
    total = experiment.missing_logs(Scale(), tmp_path)
    (tmp_path / "test").mkdir()
    (tmp_path / "test" / "tube-00-14-550.mcap").touch()
    assert experiment.missing_logs(Scale(), tmp_path) == total - 1


def test_an_ensemble_is_the_mean_of_networks_with_different_seeds(estimates: Estimates) -> None:
    plain = estimates.estimates_n
    np.testing.assert_allclose(
        estimates.estimate_n(TWO_PLAIN, 2), (plain["plain", 2] + plain["plain", 0]) / 2
    )
    np.testing.assert_allclose(
        estimates.estimate_n(PROPOSED, 0), (plain["ssam-1", 0] + plain["scam-1", 1]) / 2
    )


def test_errors_of_a_model(estimates: Estimates) -> None:
    assert estimates.mae_n(BASELINE) == pytest.approx([0.4] * 3, abs=0.02)
    assert estimates.rmse_n(BASELINE) == pytest.approx([np.hypot(0.4, 0.05)] * 3, abs=0.02)
    by_set_n = estimates.mae_by_set_n(PROPOSED)
    assert by_set_n.mean() == pytest.approx(estimates.mae_n(PROPOSED).mean())
    assert len(by_set_n) == 8


def test_models_are_compared_with_the_seeds_that_both_have(estimates: Estimates) -> None:
    del estimates.estimates_n["plain", 2]
    assert estimates.seeds_of(BASELINE) == [0, 1]
    assert estimates.seeds_of(TWO_PLAIN) == [0]
    assert estimates.seeds_of(PROPOSED) == [0, 1, 2]
    assert len(estimates.mae_n(PROPOSED)) == 3
    assert len(estimates.mae_n(PROPOSED, BASELINE)) == len(estimates.mae_n(BASELINE, PROPOSED)) == 2


def test_one_network_is_no_ensemble_of_two(estimates: Estimates) -> None:
    one = replace(estimates, scale=Scale(seeds=1))
    assert one.seeds_of(TWO_PLAIN) == []
    assert one.seeds_of(PROPOSED) == [0]


def test_p_value_is_paired_by_test_set(estimates: Estimates) -> None:
    assert estimates.p_value(PROPOSED, BASELINE) == pytest.approx(2 / 2**8)
    assert np.isnan(estimates.p_value(BASELINE, BASELINE))


def test_a_network_of_several_models_is_trained_once() -> None:
    assert networks([BASELINE, TWO_PLAIN, PROPOSED]) == ["plain", "ssam-1", "scam-1"]


def test_logs_of_one_set_under_several_lights_count_once(estimates: Estimates) -> None:
    lit = replace(estimates, clips=[replace(clip, set=clip.object) for clip in estimates.clips])
    by_log_n, by_set_n = estimates.mae_by_set_n(PROPOSED), lit.mae_by_set_n(PROPOSED)
    assert len(by_log_n) == 8
    assert np.sort(by_set_n) == pytest.approx(np.sort(by_log_n.reshape(4, 2).mean(1)))
    assert estimates.p_value(PROPOSED, BASELINE) < 0.05
    assert math.isnan(lit.p_value(PROPOSED, BASELINE))  # four sets are too few
