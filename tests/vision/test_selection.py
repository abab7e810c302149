from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import BudgetConfig, VisionConfig
from gripper_force.errors import ConfigError
from gripper_force.vision import selection as choice
from gripper_force.vision.selection import Way, choose, pareto, settled, ways

AUTO = VisionConfig(checkpoint="auto", engine="auto")
SLOW = Way("default", "torch", "float32", 1, 6.0, 8.0, 0.18)
FAST = Way("default", "openvino", "bfloat16", 2, 1.0, 1.5, 0.19)
LEAN = Way("default", "openvino", "bfloat16", 1, 1.4, 2.0, 0.19)
SMALL = Way("small", "openvino", "float32", 1, 0.2, 0.3, 0.23)
ALL = [SLOW, FAST, LEAN, SMALL]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(choice, "_STEPS", 5)
    settled.cache_clear()
    return tmp_path / "gripper-force" / "engines.json"


@pytest.mark.parametrize(
    ("latency_ms", "error_n", "taken"),
    [
        (None, None, SLOW),  # the most exact
        (7.0, None, SMALL),
        (7.0, 0.2, LEAN),  # one thread for 1.4 ms costs less than two for 1 ms
        (1.8, 0.2, FAST),
        (None, 0.18, SLOW),
    ],
)
def test_takes_the_cheapest_that_keeps_the_budget(
    latency_ms: float | None, error_n: float | None, taken: Way
) -> None:
    vision, why = choose(ALL, AUTO, BudgetConfig(latency_ms=latency_ms, error_n=error_n))
    assert (vision.checkpoint, vision.engine, vision.precision, vision.threads) == (
        taken.checkpoint,
        taken.engine,
        taken.precision,
        taken.threads,
    )
    assert str(taken) in why
    assert "of 4 ways" in why


def test_a_budget_that_nothing_keeps_names_what_there_is() -> None:
    with pytest.raises(ConfigError, match=r"budget\.latency_ms=0\.1.*small on openvino.*0\.230 N"):
        choose(ALL, AUTO, BudgetConfig(latency_ms=0.1))


@given(st.lists(st.tuples(st.floats(0.1, 10), st.floats(0.1, 1)), min_size=1, max_size=20))
def test_the_front_holds_what_nothing_beats(figures: list[tuple[float, float]]) -> None:
    tried = [Way("x", "torch", "float32", 1, ms, ms, error_n) for ms, error_n in figures]
    front = pareto(tried)
    for way in tried:
        assert any(f.p50_ms <= way.p50_ms and f.error_n <= way.error_n for f in front)
    for way in front:
        assert not any(f.p50_ms < way.p50_ms and f.error_n < way.error_n for f in tried)


def test_what_is_named_is_left_alone(cache: Path) -> None:
    named = VisionConfig(checkpoint="default", engine="torch")
    assert settled(named, BudgetConfig()) == (named, "")
    assert not cache.exists()


def test_measures_once_and_remembers(
    cache: Path, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vision = VisionConfig(checkpoint=str(tiny_checkpoint), engine="auto")
    monkeypatch.setattr(choice, "installed", lambda: ["torch"])
    first = ways(vision)
    assert {way.engine for way in first} == {"torch"}
    assert len({way.threads for way in first}) == len(first)
    assert cache.exists()
    monkeypatch.setattr(choice, "open_engine", None)  # a second measurement would call it
    assert ways(vision) == first
    taken, why = settled(vision, BudgetConfig())
    assert taken.engine == "torch"
    assert why.startswith("took ")


@pytest.mark.parametrize("text", ["", "[]", '{"a": {"b": 1}}'])
def test_a_damaged_memory_is_measured_anew(
    cache: Path, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    cache.parent.mkdir(parents=True)
    cache.write_text(text, encoding="utf-8")
    monkeypatch.setattr(choice, "installed", lambda: ["torch"])
    assert ways(VisionConfig(checkpoint=str(tiny_checkpoint), engine="auto"))


def test_precision_is_only_chosen_where_the_checkpoint_is(monkeypatch: pytest.MonkeyPatch) -> None:
    if find_spec("openvino") is None:
        pytest.skip("openvino is not installed: pip install 'gripper-force[engines]'")
    monkeypatch.setattr(choice, "SHIPPED", {"default": choice.SHIPPED["default"]})

    def precisions(vision: VisionConfig) -> set[str]:
        return {precision for _, (_, _, precision, _) in choice._candidates(vision)}

    assert precisions(VisionConfig(engine="auto")) == {"float32"}
    assert precisions(AUTO) == {"float32", "bfloat16"}
