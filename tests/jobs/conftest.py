"""Fixtures of the tests of jobs."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import nullcontext
from multiprocessing.reduction import ForkingPickler
from typing import Any

import pytest

from gripper_force.jobs import processes


class _PoolHere(Executor):
    """Runs each job in this process, but sends it and its result as bytes, as to another process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        sent = processes.answer(bytes(ForkingPickler.dumps((fn, args, kwargs))))
        succeeded, result = ForkingPickler.loads(sent)
        if succeeded:
            future.set_result(result)
        else:
            future.set_exception(result)
        return future


@pytest.fixture
def pool_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces the processes of jobs, which take seconds to start; `test_processes` has those."""
    monkeypatch.setattr(processes, "process_pool", lambda _: nullcontext(_PoolHere()))
