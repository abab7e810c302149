"""Rates of `replay` and `evaluate` over many logs: one process, several, and a Ray cluster on this machine."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any, Final

from gripper_force.errors import GripperError
from gripper_force.jobs.cpu import bfloat16_instructions
from gripper_force.jobs.dataset import find_logs
from gripper_force.runtime.log_reader import LogReader
from gripper_force.types import NS_PER_S

COMMANDS: Final = ("replay", "evaluate", "evaluate --set vision.precision=bfloat16")
"""The last one only where the CPU computes in bfloat16: elsewhere it takes many times longer."""


@dataclass(frozen=True, slots=True)
class ReplayRate:
    """Rate of a command.

    Attributes:
        command: One of `COMMANDS`.
        checkpoint: The network.
        where: ``1 process``, ``N processes`` or ``Ray, N workers``.
        rates: Seconds of log for each second of the command, its start included; one for each round.
        mae_n: Mean absolute error of vision that `evaluate` found; None for a replay.
    """

    command: str
    checkpoint: str
    where: str
    rates: list[float]
    mae_n: float | None = None


def bench(
    folder: Path,
    checkpoints: Sequence[str],
    processes: int,
    rounds: int,
    progress: Callable[[str], None],
) -> list[ReplayRate]:
    """Measures rates, each way once in each round, and checks that all ways give the same results.

    Args:
        folder: Folder with the logs.
        checkpoints: Networks, by name or path.
        processes: Processes of the second way, and workers of the third one.
        rounds: Rounds; within one, the ways follow one another.
        progress: Called with each rate.

    Raises:
        GripperError: A command failed, or two ways gave different results.
    """
    log_s = sum(LogReader(path).duration_ns for path in find_logs(folder)) / NS_PER_S
    rows: dict[tuple[str, str, str], list[float]] = {}
    expected: dict[tuple[str, str], Any] = {}
    with _ray_cluster(processes) as address:
        ways = {"1 process": ["--jobs", "1"], f"{processes} processes": ["--jobs", str(processes)]}
        if address is not None:
            ways[f"Ray, {processes} workers"] = ["--ray", address]
        commands = [one for one in COMMANDS if "bfloat16" not in one or bfloat16_instructions()]
        runs = product(range(rounds), checkpoints, commands, ways.items())
        for _, checkpoint, command, (where, options) in runs:
            begin_s = time.monotonic()
            result = _run([*command.split(), str(folder), "--checkpoint", checkpoint, *options, "--json"])
            rate = log_s / (time.monotonic() - begin_s)
            rows.setdefault((command, checkpoint, where), []).append(rate)
            progress(f"{command}, {checkpoint}, {where}: {rate:.1f} times real time")
            if result != expected.setdefault((command, checkpoint), result):
                raise GripperError(f"{command} with {checkpoint} in {where} gave another result")
    return [
        ReplayRate(*key, rates, expected[key[:2]]["mae_n"] if key[0].startswith("evaluate") else None)
        for key, rates in rows.items()
    ]


def markdown(rows: Sequence[ReplayRate], about: str) -> str:
    """Returns the table of the rates, with a sentence about the measurement."""
    lines = ["| command | network | where | times real time | MAE, N |", "|---|---|---|---|---|"]
    for row in rows:
        spread = f" ({min(row.rates):.1f} to {max(row.rates):.1f})" if len(row.rates) > 1 else ""
        mae = "" if row.mae_n is None else f"{row.mae_n:.4f}"
        lines.append(
            f"| `{row.command}` | {row.checkpoint} | {row.where} | {median(row.rates):.1f}{spread} | {mae} |"
        )
    return "\n".join([*lines, "", about, ""])


def _run(arguments: Sequence[str]) -> Any:
    call = [sys.executable, "-m", "gripper_force", *arguments]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode:
        raise GripperError(f"gripper-force {arguments[0]} failed: {done.stderr.strip()[-500:]}")
    return json.loads(done.stdout)


@contextmanager
def _ray_cluster(workers: int) -> Iterator[str | None]:
    """Starts a cluster of machines with one CPU each, all of them this one; gives None without Ray."""
    try:
        from ray.cluster_utils import Cluster
    except ImportError:
        yield None
        return
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        for _ in range(workers - 1):
            cluster.add_node(num_cpus=1)
        yield str(cluster.address)
    finally:
        cluster.shutdown()
