from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import BudgetConfig, VisionConfig
from gripper_force.errors import ConfigError
from gripper_force.vision import selection
from gripper_force.vision.selection import Candidate, candidates, pareto, resolve_auto, select

AUTO = VisionConfig(checkpoint="auto", engine="auto")
SLOW = Candidate("default", "torch", "float32", 1, 6.0, 8.0, 0.18)
FAST = Candidate("default", "openvino", "bfloat16", 2, 1.0, 1.5, 0.19)
LEAN = Candidate("default", "openvino", "bfloat16", 1, 1.4, 2.0, 0.19)
SMALL = Candidate("small", "openvino", "float32", 1, 0.2, 0.3, 0.23)
ALL = [SLOW, FAST, LEAN, SMALL]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(selection, "_STEPS", 5)
    resolve_auto.cache_clear()
    return tmp_path / "gripper-force" / "engines.json"


@pytest.mark.parametrize(
    ("latency_ms", "error_n", "chosen"),
    [
        (None, None, SLOW),  # the most exact
        (7.0, None, SMALL),
        (7.0, 0.2, LEAN),  # one thread for 1.4 ms costs less than two for 1 ms
        (1.8, 0.2, FAST),
        (None, 0.18, SLOW),
    ],
)
def test_takes_the_cheapest_that_keeps_the_budget(
    latency_ms: float | None, error_n: float | None, chosen: Candidate
) -> None:
    vision, why = select(ALL, AUTO, BudgetConfig(latency_ms=latency_ms, error_n=error_n))
    assert (vision.checkpoint, vision.engine, vision.precision, vision.threads) == (
        chosen.checkpoint,
        chosen.engine,
        chosen.precision,
        chosen.threads,
    )
    assert str(chosen) in why
    assert "of 4 candidates" in why


def test_a_budget_that_nothing_keeps_names_what_there_is() -> None:
    with pytest.raises(ConfigError, match=r"budget\.latency_ms=0\.1.*small on openvino.*0\.230 N"):
        select(ALL, AUTO, BudgetConfig(latency_ms=0.1))


@given(st.lists(st.tuples(st.floats(0.1, 10), st.floats(0.1, 1)), min_size=1, max_size=20))
def test_the_front_holds_what_nothing_beats(figures: list[tuple[float, float]]) -> None:
    tested = [Candidate("x", "torch", "float32", 1, ms, ms, error_n) for ms, error_n in figures]
    front = pareto(tested)
    for candidate in tested:
        assert any(f.p50_ms <= candidate.p50_ms and f.error_n <= candidate.error_n for f in front)
    for candidate in front:
        assert not any(f.p50_ms < candidate.p50_ms and f.error_n < candidate.error_n for f in tested)


def test_what_is_named_is_left_alone(cache: Path) -> None:
    named = VisionConfig(checkpoint="default", engine="torch")
    assert resolve_auto(named, BudgetConfig()) == (named, "")
    assert not cache.exists()


def test_measures_once_and_remembers(
    cache: Path, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vision = VisionConfig(checkpoint=str(tiny_checkpoint), engine="auto")
    monkeypatch.setattr(selection, "installed", lambda: ["torch"])
    first = candidates(vision)
    assert {candidate.engine for candidate in first} == {"torch"}
    assert len({candidate.threads for candidate in first}) == len(first)
    assert cache.exists()
    monkeypatch.setattr(selection, "open_engine", None)  # a second measurement would call it
    assert candidates(vision) == first
    chosen, why = resolve_auto(vision, BudgetConfig())
    assert chosen.engine == "torch"
    assert why.startswith("took ")


@pytest.mark.parametrize("text", ["", "[]", '{"a": {"b": 1}}'])
def test_a_damaged_memory_is_measured_anew(
    cache: Path, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    cache.parent.mkdir(parents=True)
    cache.write_text(text, encoding="utf-8")
    monkeypatch.setattr(selection, "installed", lambda: ["torch"])
    assert candidates(VisionConfig(checkpoint=str(tiny_checkpoint), engine="auto"))


def test_precision_is_only_chosen_where_the_checkpoint_is(monkeypatch: pytest.MonkeyPatch) -> None:
    if find_spec("openvino") is None:
        pytest.skip("openvino is not installed: pip install 'gripper-force[engines]'")
    monkeypatch.setattr(selection, "SHIPPED", {"default": selection.SHIPPED["default"]})

    def precisions(vision: VisionConfig) -> set[str]:
        return {precision for _, (_, _, precision, _) in selection._candidates(vision)}

    assert precisions(VisionConfig(engine="auto")) == {"float32"}
    assert precisions(AUTO) == {"float32", "bfloat16"}
