from typing import Any, cast

import pytest

from gripper_force.config import Config, load_config
from gripper_force.control.limits import largest_target_n
from gripper_force.errors import ConfigError, DeviceError, RequestError
from gripper_force.jobs import trials as module
from gripper_force.jobs.grasp import GraspSummary
from gripper_force.jobs.trials import summarise_trials, trials
from gripper_force.progress import Progress

REAL = ["clock=realtime", "servo.port=/dev/ttyUSB7", "camera.backend=none", "load_cell.backend=none"]


def result(target_n: float, error_n: float | None, **more: Any) -> GraspSummary:
    some = {
        "result": "held",
        "object": "tube",
        "target_n": target_n,
        "steady_error_n": error_n,
        "overshoot_n": 0.1 * target_n,
        "settle_s": 1.0,
        "peak_n": 1.1 * target_n,
        "estimator_p50_ms": 5.0,
        "estimate_mae_n": {"visual": None, "current": 0.3, "fused": 0.1, "floor": 0.05},
        "feedback": "fused",
        "fell_back": False,
    }
    return cast("GraspSummary", some | more)


def test_trials_are_summed_up_by_their_share_of_the_target() -> None:
    results = [
        result(2.0, 0.2),  # 10 %, and within 0.25 N
        result(5.0, -0.35),  # 7 %
        result(8.0, 0.8, result="timeout", peak_n=12.5),  # 10 %: no good
        result(4.0, None, result="no_object", settle_s=None, estimator_p50_ms=None, peak_n=None),
    ]
    summary = summarise_trials(results, force_limit_n=12.0)
    assert (summary["trials"], summary["held"], summary["over_limit"]) == (4, 2, 1)
    assert summary["good_percent"] == 50
    assert summary["median_error_percent"] == pytest.approx(10.0)
    assert summary["median_error_n"] == pytest.approx(0.35)
    assert summary["max_overshoot_percent"] == pytest.approx(10.0)
    assert summary["peak_n"] == 12.5


def test_trials_that_fell_back_are_not_scored_as_vision() -> None:
    def errors(feedback: str) -> tuple[float | None, float | None, int]:
        results = [
            result(4.0, 0.4, feedback=feedback),
            result(4.0, 0.0, feedback=feedback, fell_back=True, peak_n=13.0),
        ]
        summary = summarise_trials(results, force_limit_n=12.0)
        assert (summary["trials"], summary["held"], summary["over_limit"]) == (2, 2, 1)
        return summary["median_error_percent"], summary["good_percent"], summary["fell_back"]

    assert errors("vision") == pytest.approx((10.0, 0.0, 1))
    assert errors("fused") == pytest.approx((5.0, 50.0, 1))


def test_estimates_are_averaged_by_object() -> None:
    errors = {"visual": None, "current": 0.5, "fused": 0.3, "floor": None}
    results = [result(2.0, 0.1), result(3.0, 0.1, object="sponge", estimate_mae_n=errors)]
    means = summarise_trials(results, force_limit_n=12.0)["estimate_mae_n"]
    assert means["all"] == pytest.approx({"visual": None, "current": 0.4, "fused": 0.2, "floor": 0.05})
    assert means["sponge"] == errors


def test_trials_without_any_figure_still_sum_up() -> None:
    nothing = result(4.0, None, overshoot_n=None, settle_s=None, estimator_p50_ms=None, peak_n=None)
    summary = summarise_trials([nothing], force_limit_n=12.0)
    assert summary["good_percent"] is summary["over_limit"] is None
    assert summary["median_error_percent"] is None
    assert summary["peak_n"] is None


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[Config]:
    """The configurations of grasps, none of which is done. One of the object ``broken`` ends with a fault."""
    configs: list[Config] = []

    def note(config: Config, _progress: Progress) -> dict[str, Any]:
        configs.append(config)
        return {"result": "fault" if config.object == "broken" else "held", "log": "runs/it.mcap"}

    monkeypatch.setattr(module, "grasp", note)
    return configs


def test_trials_are_drawn_from_the_seed(ran: list[Config]) -> None:
    def plan(seed: int) -> list[tuple[str, float, int]]:
        ran.clear()
        list(trials(load_config(None, [f"seed={seed}"]), 6, workers=1))
        return [(c.object, c.target_n, c.seed) for c in ran]

    first = plan(40)
    assert [name for name, _, _ in first] == ["sponge", "paper_cup", "tube", "stapler", "sponge", "paper_cup"]
    assert [seed for _, _, seed in first] == list(range(40, 46))
    assert all(1 <= target_n <= 8 for _, target_n, _ in first)
    assert plan(40) == first
    assert [t for _, t, _ in plan(41)] != [t for _, t, _ in first]


def test_targets_are_within_the_force_limit(ran: list[Config]) -> None:
    list(trials(load_config(None, ["control.force_limit_n=5"]), 40, workers=1))
    largest_n = largest_target_n(5.0, ran[0].gripper.gain_bound)
    assert largest_n / 2 < max(config.target_n for config in ran) <= largest_n
    with pytest.raises(RequestError, match="a target of 1 N is too close to "):
        next(trials(load_config(None, ["control.force_limit_n=1"]), 1, workers=1))


def test_several_processes_are_refused_with_a_real_device() -> None:
    with pytest.raises(ConfigError, match="only one process can open"):
        next(trials(load_config(None, REAL), 2, workers=2))


def test_after_a_fault_of_a_real_gripper_nothing_moves(ran: list[Config]) -> None:
    running = trials(load_config(None, REAL), 3, workers=1, objects=["mug", "broken"])
    assert [next(running)["result"] for _ in range(2)] == ["held", "fault"]
    with pytest.raises(DeviceError, match="trial 2 of 3 ended with a fault"):
        next(running)
    assert len(ran) == 2


def test_grasps_of_the_same_object_pass_on_what_was_learned(
    ran: list[Config], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "learned_ratio", lambda path: (1.0 + 0.1 * len(ran), 0.05))
    list(trials(load_config(overrides={"seed": 7}), 3, 1, objects=("tube",), same_object=True))
    assert [one.seed for one in ran] == [7, 8, 9]
    assert {(one.sim.object_seed, one.sim.rig_seed) for one in ran} == {(7, 7)}
    assert [one.control.object_ratio for one in ran] == [None, (1.1, 0.05), (1.2, 0.05)]


@pytest.mark.parametrize(("workers", "objects"), [(2, ("tube",)), (1, ("tube", "sponge"))])
def test_the_same_object_is_grasped_by_one_process(workers: int, objects: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="follow one another"):
        list(trials(load_config(), 2, workers, objects=objects, same_object=True))
