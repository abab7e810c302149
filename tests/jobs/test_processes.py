import os
import signal
import time
from concurrent.futures import Future
from multiprocessing import active_children

import pytest

from gripper_force.jobs.processes import process_pool


def interrupted_itself(number: signal.Signals) -> int:
    os.kill(os.getpid(), number)
    return 7


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP, signal.SIGQUIT])
def test_signals_of_the_terminal_are_the_parents_affair(number: signal.Signals) -> None:
    with process_pool(1) as pool:
        assert pool.submit(interrupted_itself, number).result() == 7


def test_an_interruption_breaks_off_what_runs_and_what_waits() -> None:
    waiting: list[Future[None]] = []

    def interrupted() -> None:
        with process_pool(1) as pool:
            assert pool.submit(os.getpid).result() != os.getpid()
            waiting.extend(pool.submit(time.sleep, 3600) for _ in range(3))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(waiting) == 3
    assert all(future.done() for future in waiting)
    assert active_children() == []
