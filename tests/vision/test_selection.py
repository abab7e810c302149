import shutil
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.config import BudgetConfig, VisionConfig
from gripper_force.errors import ConfigError
from gripper_force.vision import selection, step_benchmark
from gripper_force.vision.engines import Engine, open_engine
from gripper_force.vision.header import SHIPPED
from gripper_force.vision.model_files import read_model
from gripper_force.vision.selection import candidates, pareto_front, resolve_auto, select
from gripper_force.vision.step_benchmark import EngineCandidate, engine_version

AUTO = VisionConfig(checkpoint="auto", engine="auto")
SLOW = EngineCandidate("default", "torch", "float32", 1, 6.0, 8.0, 0.18)
FAST = EngineCandidate("default", "openvino", "bfloat16", 2, 1.0, 1.5, 0.19)
LEAN = EngineCandidate("default", "openvino", "bfloat16", 1, 1.4, 2.0, 0.19)
SMALL = EngineCandidate("small", "openvino", "float32", 1, 0.2, 0.3, 0.23)
ALL = [SLOW, FAST, LEAN, SMALL]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(step_benchmark, "_STEPS", 5)
    monkeypatch.setattr(step_benchmark, "_WARM_UP_STEPS", 1)
    resolve_auto.cache_clear()
    engine_version.cache_clear()
    return tmp_path / "gripper-force" / "engines.jsonl"


@pytest.fixture
def _stated_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other times for each engine without a measurement: PyTorch's threads wait for each other on a busy machine."""
    times_ms = (float(n) for n in count(1))
    monkeypatch.setattr(selection, "step_times_ms", lambda _: (next(times_ms), next(times_ms)))


@pytest.mark.parametrize(
    ("latency_ms", "error_n", "chosen"),
    [
        (None, None, SLOW),  # the most accurate
        (7.0, None, SMALL),
        (7.0, 0.2, LEAN),  # one thread for 1.4 ms costs less than two for 1 ms
        (1.8, 0.2, FAST),
        (None, 0.18, SLOW),
    ],
)
def test_selects_the_cheapest_within_the_budget(
    latency_ms: float | None, error_n: float | None, chosen: EngineCandidate
) -> None:
    candidate, sentence = select(ALL, BudgetConfig(latency_ms=latency_ms, error_n=error_n))
    assert candidate == chosen
    assert sentence.startswith(f"chose {chosen} (the ")
    assert sentence.endswith(" of 4 candidates)")


def test_budget_that_no_candidate_keeps_is_an_error_with_the_front() -> None:
    with pytest.raises(ConfigError, match=r"budget\.latency_ms=0\.1.*small on openvino.*0\.230 N"):
        select(ALL, BudgetConfig(latency_ms=0.1))


@given(st.lists(st.tuples(st.floats(0.1, 10), st.floats(0.1, 1)), min_size=1, max_size=20))
def test_no_candidate_beats_the_front(figures: list[tuple[float, float]]) -> None:
    tested = [EngineCandidate("x", "torch", "float32", 1, ms, ms, error_n) for ms, error_n in figures]
    front = pareto_front(tested)
    for candidate in tested:
        assert any(f.p50_ms <= candidate.p50_ms and f.error_n <= candidate.error_n for f in front)
    for candidate in front:
        assert not any(f.p50_ms < candidate.p50_ms and f.error_n < candidate.error_n for f in tested)


def test_a_setting_that_no_installed_engine_runs_is_an_error_that_names_it() -> None:
    vision = VisionConfig(checkpoint="auto", engine="onnxruntime", precision="bfloat16")
    with pytest.raises(
        ConfigError, match=r"no installed engine runs .*vision\.precision=bfloat16; pip install"
    ):
        resolve_auto(vision, BudgetConfig())


@pytest.mark.usefixtures("_stated_times")
def test_measurements_are_cached(cache: Path, tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vision = VisionConfig(checkpoint=str(tiny_checkpoint), engine="auto")
    monkeypatch.setattr(selection, "installed", lambda: ["torch"])
    first = candidates(vision, set_threads=True)
    assert {candidate.engine for candidate in first} == {"torch"}
    assert len({candidate.threads for candidate in first}) == len(first)
    assert cache.exists()
    monkeypatch.setattr(selection, "open_engine", None)  # a second measurement would call it
    assert candidates(vision, set_threads=True) == first
    copy = shutil.copy(tiny_checkpoint, tiny_checkpoint.with_name("copy.safetensors"))  # of the same digest
    copied = candidates(VisionConfig(checkpoint=str(copy), engine="auto"), set_threads=True)
    assert {candidate.checkpoint for candidate in copied} == {str(copy)}
    resolved, sentence = resolve_auto(vision, BudgetConfig(), set_threads=True)
    assert (resolved.engine, resolved.checkpoint) == ("torch", str(tiny_checkpoint))
    assert f", {resolved.threads} thread" in sentence
    assert sentence.endswith(f" of {len(first)} candidates)")


@pytest.mark.usefixtures("_stated_times")
@pytest.mark.parametrize("set_threads", [False, True])
def test_torch_threads_are_the_programs_own(
    tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch, set_threads: bool
) -> None:
    monkeypatch.setattr(selection, "installed", lambda: ["torch"])
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    used = []

    def open_and_note(*arguments: Any) -> Engine:
        engine = open_engine(*arguments)
        used.append(torch.get_num_threads())
        return engine

    monkeypatch.setattr(selection, "open_engine", open_and_note)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        found = candidates(
            VisionConfig(checkpoint=str(tiny_checkpoint), engine="auto"), set_threads=set_threads
        )
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert used == [candidate.threads for candidate in found] == ([1, 2, 4] if set_threads else [3])


def test_engine_of_another_package_is_measured_and_not_cached(
    cache: Path, tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "unversioned_engines.py").write_text(
        "from gripper_force.vision.engines.pytorch import TorchEngine as OtherEngine\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(selection, "SHIPPED", {"tiny": tiny_checkpoint})
    monkeypatch.setattr(selection, "read_model", lambda _name: read_model(tiny_checkpoint))
    other = VisionConfig.model_construct(
        **VisionConfig(checkpoint="auto").model_dump() | {"engine": "unversioned_engines:OtherEngine"}
    )
    (candidate,) = candidates(other)
    assert (candidate.checkpoint, candidate.engine) == ("tiny", "unversioned_engines:OtherEngine")
    assert not cache.exists()


def test_precision_is_never_chosen_because_only_float32_has_the_score_of_unfamiliar_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if find_spec("openvino") is None:
        pytest.skip("openvino is not installed: pip install 'gripper-force[engines]'")
    monkeypatch.setattr(selection, "SHIPPED", {"default": SHIPPED["default"]})

    def precisions(vision: VisionConfig) -> set[str]:
        return {precision for _, _, precision, _ in selection._settings(vision, set_threads=True)}

    assert precisions(AUTO) == {"float32"}
    assert precisions(VisionConfig(engine="auto", precision="bfloat16")) == {"bfloat16"}
