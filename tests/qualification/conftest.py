from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager

import pytest


@pytest.fixture(scope="session")
def thread_pool() -> Callable[[int], AbstractContextManager[Executor]]:
    """Takes the place of `process_pool`: a process takes seconds to start, and does not see what a test replaced."""

    @contextmanager
    def pool(count: int) -> Iterator[Executor]:
        with ThreadPoolExecutor(count) as threads:
            yield threads

    return pool
