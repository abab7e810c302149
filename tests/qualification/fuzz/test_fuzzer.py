import json
import random
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import ConfigError
from gripper_force.qualification.fuzz import fuzzer as fuzzing
from gripper_force.qualification.fuzz.fuzzer import all_targets, fuzz, input_of, mutate
from gripper_force.qualification.fuzz.target import Target

PLANTED = """
import os, time, zlib
from gripper_force.errors import DataError
from gripper_force.qualification.fuzz.target import Target

def read(data, path):
    path.write_bytes(data)
    if not data.startswith(b"GF"):
        raise DataError("not our format")
    {"": 0}[data[2:4].decode("ascii", "ignore").strip("0123456789")]

def rare(data):
    return zlib.crc32(data) % 40 == 0

def crash(data, path):
    if rare(data):
        os.abort()

def allocate(data, path):
    bytearray(1 << 34 if rare(data) else 1)

def hang(data, path):
    if rare(data):
        time.sleep(600)

def all_targets():
    return [
        Target("reader", lambda: [b"GF00", b"GF99 and more"], read),
        Target("crash", lambda: [b"calm"], crash),
        Target("memory", lambda: [b"calm"], allocate),
        Target("hang", lambda: [b"calm"], hang, 0.5),
    ]
"""


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Replaces the targets by readers with every kind of defect. Returns a folder for findings."""
    (tmp_path / "planted_readers.py").write_text(PLANTED)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(fuzzing, "all_targets", import_module("planted_readers").all_targets)
    monkeypatch.setattr(fuzzing, "HANG_S", 2.0)
    yield tmp_path / "findings"
    sys.modules.pop("planted_readers", None)


def planted_targets() -> list[Target]:
    targets: list[Target] = fuzzing.all_targets()
    return targets


def test_every_reader_gives_a_result_or_a_typed_error(tmp_path: Path) -> None:
    done: list[int] = []

    def progress(text: str, steps: int = 1) -> None:
        done.append(steps)

    report = fuzz(600, 1, 1, tmp_path, progress)
    assert report["findings"] == []
    assert sum(done) == report["inputs"] >= 590
    targets = report["targets"]
    assert {"log", "config", "checkpoint", "servo driver", "virtual servo", "readings"} <= set(targets)
    assert all(t["inputs"] == t["results"] + t["typed_errors"] > 0 for t in targets.values())
    assert not list(tmp_path.iterdir())


def test_undamaged_examples_are_read(tmp_path: Path) -> None:
    for target in all_targets():
        results = [fuzzing._outcome(target, data, tmp_path / "input") for data in target.examples()]
        assert "result" in results, f"{target.name}: {results}"


def test_every_kind_of_defect_is_found_and_reproduced_by_its_number(planted: Path) -> None:
    report = fuzz(
        100, 29, 2, planted
    )  # one crash, one hang and one allocation: each costs a process, or its time
    findings = {found.target: found for found in report["findings"]}
    assert findings["reader"].error.startswith("KeyError at ")
    assert "Crash: the process ended with code -6" in findings["crash"].error
    assert findings["memory"].error.startswith("MemoryError at ")
    assert findings["hang"].error == "Hang: not finished after 2 s"
    assert report["inputs"] >= 100  # one whose process is killed just as it ends counts twice
    assert 0 < report["targets"]["reader"]["findings"] < 25
    assert report["targets"]["reader"]["typed_errors"] > 0
    for target in planted_targets():
        found = findings[target.name]
        assert Path(found.file).read_bytes() == input_of(target, target.examples(), 29, found.index)
        again = fuzz(1, 29, 1, planted, only=f"{target.name}:{found.index}")
        assert again["findings"] == [found]
        assert list(again["targets"]) == [target.name]


def test_stability_fuzz_exits_with_1_on_findings(planted: Path) -> None:
    def run(*arguments: object) -> tuple[int, dict[str, Any]]:
        call = ["stability", "fuzz", "--cases", "60", "--jobs", "1", "--out", planted, "--json", *arguments]
        done = CliRunner().invoke(cli.app, [*map(str, call)])
        (line,) = done.stdout.splitlines()
        return done.exit_code, json.loads(line)

    code, report = run("--only", "reader")
    assert code == 1
    assert report["findings"][0]["target"] == "reader"
    assert report["targets"]["reader"]["inputs"] == 60
    sound = next(i for i in range(60) if _is_sound(i))
    code, report = run("--only", f"reader:{sound}")
    assert (code, report["findings"]) == (0, [])


def _is_sound(index: int) -> bool:
    (reader, *_) = planted_targets()
    return not input_of(reader, reader.examples(), 0, index).startswith(b"GF")


def test_unknown_input_raises(planted: Path) -> None:
    for only in ("nothing", "reader:x", "reader:"):
        with pytest.raises(ConfigError, match=f"no fuzz input '{only}'.*reader, crash, memory, hang"):
            fuzz(1, 0, 1, planted, only=only)


@given(st.integers(0, 2**32), st.lists(st.binary(), min_size=1), st.lists(st.binary(), min_size=1))
def test_damage_is_a_function_of_the_seed_for_any_examples(
    seed: int, examples: list[bytes], words: list[bytes]
) -> None:
    data = mutate(random.Random(seed), examples, words)
    assert data == mutate(random.Random(seed), examples, words)
    assert len(data) <= 1 << 18
