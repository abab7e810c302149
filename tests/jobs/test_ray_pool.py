from collections.abc import Iterator
from pathlib import Path

import pytest

from gripper_force.config import Config
from gripper_force.errors import ConfigError, LogError
from gripper_force.jobs.evaluate import evaluate
from gripper_force.jobs.processes import Workers
from gripper_force.jobs.replay import replay_each
from gripper_force.jobs.simulate import plan, simulate

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


def test_no_cluster_is_one_sentence() -> None:
    with (
        pytest.raises(ConfigError, match="no Ray cluster answers at nonsense"),
        Workers(1, "nonsense").pool(),
    ):
        pass
