import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shutil import copy
from typing import Any

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.errors import GripperError
from gripper_force.jobs.ray_pool import ray_pool
from gripper_force.qualification.bench import replay_bench
from gripper_force.qualification.bench.replay_bench import ReplayRate


@pytest.fixture
def logs(fused_log: Path, tmp_path: Path) -> Path:
    """A folder with two logs."""
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in ("a", "b"):
        copy(fused_log, folder / f"{name}.mcap")
    return folder


@contextmanager
def no_cluster(workers: int) -> Iterator[str]:
    """Takes the place of a Ray cluster, which takes seconds to start."""
    yield f"cluster of {workers}"


def run_here(arguments: Sequence[str]) -> Any:
    """Runs a command in this process."""
    done = CliRunner().invoke(cli.app, list(arguments), catch_exceptions=False)
    assert done.exit_code == 0, done.stderr
    return json.loads(done.stdout)


def test_the_commands_run_in_every_way(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread_pool: Any
) -> None:
    addresses: list[str] = []

    def connect(address: str) -> Any:
        addresses.append(address)
        return thread_pool(1)

    monkeypatch.setattr("gripper_force.jobs.ray_pool.ray_pool", connect)
    monkeypatch.setattr("gripper_force.jobs.processes.process_pool", thread_pool)
    monkeypatch.setattr(replay_bench, "_ray_cluster", no_cluster)
    monkeypatch.setattr(replay_bench, "_run", run_here)
    monkeypatch.setattr(replay_bench, "COMMANDS", ("replay", "evaluate --set vision.threads=1"))
    page = tmp_path / "page.md"
    page.write_text("<!-- rates -->\n<!-- end of rates -->\n")
    call = ["bench", "replay", "--logs", str(logs), "--checkpoint", "small", "--rounds", "1", "--jobs", "2"]
    done = CliRunner().invoke(cli.app, [*call, "--write", str(page), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    rows = json.loads(done.stdout)["replay"]
    assert [row["where"] for row in rows] == 2 * ["1 process", "2 processes", "Ray, 2 workers"]
    assert addresses == 2 * ["cluster of 2"]
    assert all(row["rates"][0] > 0 for row in rows)
    assert {row["command"]: row["mae_n"] is None for row in rows} == {
        "replay": True,
        "evaluate --set vision.threads=1": False,
    }
    assert "| `replay` | small | 2 processes |" in page.read_text()
    assert "2 logs, one round, " in page.read_text()


@pytest.mark.filterwarnings("default")  # of Ray
def test_a_cluster_has_a_cpu_for_each_worker() -> None:
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'gripper-force[ray]'")
    with replay_bench._ray_cluster(2) as address, ray_pool(str(address)):
        assert ray.cluster_resources()["CPU"] == 2


def test_the_table_has_the_median_and_the_range_of_the_rounds() -> None:
    rows = [
        ReplayRate("replay", "small", "1 process", [2.0, 3.06, 2.5]),
        ReplayRate("evaluate", "small", "1 process", [4.0], 0.12345),
    ]
    assert replay_bench.markdown(rows, "About it.").splitlines()[2:] == [
        "| `replay` | small | 1 process | 2.5 (2.0 to 3.1) |  |",
        "| `evaluate` | small | 1 process | 4.0 | 0.1235 |",
        "",
        "About it.",
    ]


@pytest.mark.parametrize("instructions", ["", "avx512_bf16"])
def test_bfloat16_is_measured_where_the_cpu_computes_in_it(
    instructions: str, logs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay_bench, "bfloat16_instructions", lambda: instructions)
    monkeypatch.setattr(replay_bench, "_run", lambda arguments: {"mae_n": 0.1})
    rows = replay_bench.bench(logs, ["small"], 2, 1, lambda _: None)
    expected = replay_bench.COMMANDS if instructions else replay_bench.COMMANDS[:2]
    assert tuple(dict.fromkeys(row.command for row in rows)) == expected


def test_ways_that_disagree_are_an_error(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(arguments: Sequence[str]) -> Any:
        return {"mae_n": 0.1 if "1" in arguments else 0.2}

    monkeypatch.setattr(replay_bench, "_run", run)
    with pytest.raises(GripperError, match=r"^replay with small in 2 processes gave another result"):
        replay_bench.bench(logs, ["small"], 2, 1, lambda _: None)


def test_a_command_that_fails_is_an_error(logs: Path) -> None:
    with pytest.raises(GripperError, match=r"(?s)gripper-force replay failed: .*no checkpoint at missing"):
        replay_bench.bench(logs, ["missing.safetensors"], 2, 1, lambda _: None)
