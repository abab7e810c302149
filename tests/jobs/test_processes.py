import os
import signal
import time
from concurrent.futures import Future
from multiprocessing import active_children

import pytest

from gripper_force.jobs.processes import process_pool


def interrupted_itself() -> int:
    os.kill(os.getpid(), signal.SIGINT)
    return 7


def test_ctrl_c_is_the_parents_affair() -> None:
    with process_pool(1) as pool:
        assert pool.submit(interrupted_itself).result() == 7


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
