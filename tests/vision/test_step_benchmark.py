from collections.abc import Iterator
from dataclasses import asdict, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from gripper_force.vision import step_benchmark
from gripper_force.vision.engines import open_engine
from gripper_force.vision.model_files import read_model
from gripper_force.vision.step_benchmark import (
    EngineCandidate,
    cache_key,
    engine_version,
    read_cache,
    step_times_ms,
    update_cache,
)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    engine_version.cache_clear()
    yield tmp_path / "gripper-force" / "engines.jsonl"
    engine_version.cache_clear()


def test_version_is_of_the_package_that_holds_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    point = metadata.EntryPoint("other", "numpy:ndarray", "gripper_force.engines")
    assert engine_version("torch") == metadata.version("torch")
    assert engine_version("numpy.no_engine:Engine") == metadata.version("numpy")
    assert engine_version("no_such_package:Engine") == engine_version(":Engine") == ""
    monkeypatch.setattr(step_benchmark, "registered", lambda _group: {"other": point})
    assert engine_version("other") == ""  # this entry point belongs to no distribution


def test_exported_files_of_one_checkpoint_have_keys_of_their_own(
    tiny_checkpoint: Path, tmp_path: Path
) -> None:
    """A file in int8 has the digest of the checkpoint, and other times than one in float32."""
    model, keys = read_model(tiny_checkpoint), []
    for text in ("<net/>", "<net int8='yes'/>"):
        path = tmp_path / "force.xml"
        path.write_text(text)
        keys.append(cache_key(replace(model, path=path), "openvino", "float32", 1))
    assert keys[0] != keys[1]


def test_cache_keeps_earlier_measurements(cache: Path) -> None:
    slow = EngineCandidate("default", "torch", "float32", 1, 6.0, 8.0, 0.18)
    fast = EngineCandidate("default", "openvino", "bfloat16", 2, 1.0, 1.5, 0.19)
    assert read_cache() == {}
    update_cache({"a": slow})
    (cache.parent / "engines.json").write_text("{}")  # of an earlier version
    update_cache({"b": fast})
    assert read_cache() == {"a": slow, "b": fast}
    assert [path.name for path in cache.parent.iterdir()] == ["engines.jsonl"]


def test_a_measurement_that_another_process_adds_meanwhile_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one = EngineCandidate("default", "torch", "float32", 1, 6.0, 8.0, 0.18)

    def late(candidate: EngineCandidate) -> dict[str, Any]:
        monkeypatch.setattr(step_benchmark, "asdict", asdict)
        update_cache({"other": one})
        return asdict(candidate)

    monkeypatch.setattr(step_benchmark, "asdict", late)
    update_cache({"one": one})
    assert read_cache() == {"one": one, "other": one}


def test_a_line_that_an_interruption_has_cut_costs_no_other(cache: Path) -> None:
    one = EngineCandidate("default", "torch", "float32", 1, 6.0, 8.0, 0.18)
    update_cache({"one": one})
    cache.write_text(f"null\n[1, {{}}]{cache.read_text()}{cache.read_text()[:40]}")
    assert read_cache() == {"one": one}
    update_cache({"other": one})
    assert read_cache() == {"one": one, "other": one}


def test_a_damaged_byte_costs_only_its_line(cache: Path) -> None:
    """If it cost all lines, each run would measure again, and add its lines to a file that no run can read."""
    one = EngineCandidate("default", "torch", "float32", 1, 6.0, 8.0, 0.18)
    update_cache({"one": one, "two": one})
    cache.write_bytes(cache.read_bytes().replace(b'["two"', b'["t\xff"}'))
    assert read_cache() == {"one": one}


def test_unwritable_cache_is_ignored(cache: Path) -> None:
    cache.parent.write_text("")
    update_cache({"a": EngineCandidate("default", "torch", "float32", 1, 6.0, 8.0, 0.18)})
    assert read_cache() == {}


def test_99th_percentile_is_not_below_the_median(
    tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(step_benchmark, "_STEPS", 5)
    p50_ms, p99_ms = step_times_ms(open_engine(read_model(tiny_checkpoint), "torch", threads=None))
    assert 0 < p50_ms <= p99_ms
