from pathlib import Path

import numpy as np
import pytest

from gripper_force.errors import DataError
from gripper_force.interfaces import no_progress
from gripper_force.qualification.paper import experiment
from gripper_force.qualification.paper.experiment import Test as Estimates
from gripper_force.qualification.paper.experiment import checkpoint_path, networks, run
from gripper_force.qualification.paper.models import BASELINE, PROPOSED, TWO_PLAIN, Scale

from .conftest import FRAMES

TINY = Scale(size=32, width=0.25, steps=2, seeds=2)


@pytest.fixture(scope="module")
def ran(touches: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Estimates, Path, list[str]]:
    out = tmp_path_factory.mktemp("networks")
    done: list[str] = []

    def progress(text: str, steps: int = 1) -> None:
        done.append(text)

    return run(TINY, [BASELINE, TWO_PLAIN], touches, out, 1, progress), out, done


def test_each_network_is_trained_once_with_each_seed(ran: tuple[Estimates, Path, list[str]]) -> None:
    test, out, done = ran
    assert done == ["plain, seed 0", "plain, seed 1"]
    assert all(checkpoint_path(out, "plain", seed).exists() for seed in (0, 1))
    lead_in = TINY.recipe("plain", 0).preprocess.lead_in
    assert len(test.measured_n) == 8 * (FRAMES - lead_in)
    assert np.isfinite(test.estimates_n["plain", 0]).all()
    assert (test.estimates_n["plain", 0] != test.estimates_n["plain", 1]).any()


def test_existing_networks_are_not_trained_again(
    ran: tuple[Estimates, Path, list[str]], touches: Path
) -> None:
    test, out, _ = ran
    before = checkpoint_path(out, "plain", 0).read_bytes()
    (out / "plain-0.npy").unlink()
    again = run(TINY, [BASELINE], touches, out, 1, no_progress)
    assert checkpoint_path(out, "plain", 0).read_bytes() == before
    np.testing.assert_array_equal(again.estimates_n["plain", 0], test.estimates_n["plain", 0])


def test_networks_of_another_scale_or_data_raise(
    ran: tuple[Estimates, Path, list[str]], touches: Path
) -> None:
    other = TINY.model_copy(update={"steps": 3})
    with pytest.raises(DataError, match="another scale or other data; give another folder"):
        run(other, [BASELINE], touches, ran[1], 1, no_progress)
    with pytest.raises(DataError, match="another scale or other data; give another folder"):
        run(TINY, [BASELINE], touches / "train", ran[1], 1, no_progress)


def test_estimates_of_other_test_sets_raise(ran: tuple[Estimates, Path, list[str]], touches: Path) -> None:
    _, out, _ = ran
    path = out / "plain-1.npy"
    whole = path.read_bytes()
    np.save(path, np.zeros(3))
    try:
        with pytest.raises(DataError, match="but the test sets have"):
            run(TINY, [BASELINE], touches, out, 1, no_progress)
    finally:
        path.write_bytes(whole)


def test_missing_logs_raise(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no logs in .*train"):
        run(TINY, [BASELINE], tmp_path, tmp_path / "out", 1, no_progress)


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


def test_p_value_is_paired_by_test_set(estimates: Estimates) -> None:
    assert estimates.p_value(PROPOSED, BASELINE) == pytest.approx(2 / 2**8)
    assert np.isnan(estimates.p_value(BASELINE, BASELINE))


def test_models_share_networks() -> None:
    assert networks([BASELINE, TWO_PLAIN, PROPOSED]) == ["plain", "ssam-1", "scam-1"]
