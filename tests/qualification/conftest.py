from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.reduction import ForkingPickler
from typing import Any

import pytest

from gripper_force.jobs.processes import answer


class PicklingPool(ThreadPoolExecutor):
    """Threads that run jobs as `process_pool` does: pickled. A process takes seconds to start."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(_run, bytes(ForkingPickler.dumps((fn, args, kwargs))))


def _run(call: bytes) -> Any:
    succeeded, result = ForkingPickler.loads(answer(call))
    if not succeeded:
        raise result
    return result


@pytest.fixture(scope="session")
def thread_pool() -> type[PicklingPool]:
    """Takes the place of `process_pool`."""
    return PicklingPool
