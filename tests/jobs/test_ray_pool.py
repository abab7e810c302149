import os
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gripper_force import cli
from gripper_force.config import Config
from gripper_force.errors import ConfigError, GripperError, LogError
from gripper_force.jobs.evaluate import evaluate
from gripper_force.jobs.processes import Workers
from gripper_force.jobs.replay import replay_each
from gripper_force.jobs.simulate import plan, simulate
from gripper_force.progress import no_progress

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'gripper-force[ray]'")


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Two workers with one CPU each."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    yield str(cluster.address)
    cluster.shutdown()


@pytest.mark.filterwarnings("default")
def test_a_cluster_gives_the_results_of_one_process(
    address: str, fused_log: Path, few_logs: Path, tiny_checkpoint: Path, tmp_path: Path
) -> None:
    logs = [fused_log, tmp_path / "missing.mcap", fused_log]
    here, there = replay_each(logs, "small"), replay_each(logs, "small", ray=address)
    assert there.results == here.results
    assert isinstance(there.failed[str(logs[1])], LogError)
    found = evaluate(few_logs, tiny_checkpoint, ray=address)
    assert repr(found) == repr(evaluate(few_logs, tiny_checkpoint))  # NaN does not equal itself
    made = [
        next(simulate(plan("tap", 1, 5, ("sponge",)), tmp_path / str(cluster), Config(), 1, cluster))
        for cluster in (None, address)
    ]
    assert made[0].read_bytes() == made[1].read_bytes()


@pytest.mark.filterwarnings("default")
def test_a_job_that_the_cluster_loses_is_one_error(address: str) -> None:
    with pytest.raises(GripperError, match="Ray lost a job"), Workers(1, address).pool() as pool:
        pool.submit(os._exit, 1).result()


@pytest.mark.filterwarnings("default")
def test_a_log_that_fails_unforeseen_is_named_and_the_others_are_read(address: str) -> None:
    logs = [Path("a.mcap"), Path("b.mcap")]
    found, failed = Workers(1, address).read_logs(fail_at_b, logs, "read", no_progress)
    assert found == {0: "a"}
    assert str(failed[1]).startswith("b.mcap failed with KeyError at test_ray_pool.py:")
    assert "in fail_at_b" in failed[1].__notes__[0]


def fail_at_b(log: Path) -> str:
    return {"a": "a"}[log.stem]


@pytest.mark.filterwarnings("default")
def test_an_interrupt_ends_the_jobs(address: str, tmp_path: Path) -> None:
    def interrupted() -> None:
        with Workers(1, address).pool() as pool:
            for name in ("a", "b", "c"):
                pool.submit(mark_and_wait, tmp_path / name)
            while len(list(tmp_path.iterdir())) < 2:  # both workers are busy
                time.sleep(0.1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with Workers(1, address).pool() as pool:  # they are free again
        assert list(pool.map(abs, [-1, -2])) == [1, 2]


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("fails", [False, True])
def test_the_connection_of_the_program_stays(address: str, fails: bool) -> None:
    ray.init(address, log_to_driver=False, logging_level="error")
    try:
        kept = ray.put(7)
        with suppress(ZeroDivisionError), Workers(1, "auto").pool() as pool:
            assert pool.submit(abs, -3).result() == 3
            assert 1 / (not fails)
        assert ray.is_initialized()
        assert ray.get(kept) == 7
    finally:
        ray.shutdown()


def mark_and_wait(path: Path) -> None:
    path.touch()
    time.sleep(3600)


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ("nonsense", "--ray nonsense is no address; give HOST:PORT"),
        ("ray://127.0.0.1:10001", "is no address"),
        ("127.0.0.1:PORT", "no Ray cluster answers at 127.0.0.1"),
    ],
)
def test_a_wrong_address_is_one_sentence(wrong: str, problem: str, fused_log: Path) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        address = wrong.replace("PORT", str(closed.getsockname()[1]))
    done = CliRunner().invoke(cli.app, ["replay", str(fused_log), "--ray", address])
    assert isinstance(done.exception, ConfigError), done.stderr
    assert problem in str(done.exception)
    assert "\n" not in str(done.exception)
