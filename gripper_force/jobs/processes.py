"""Process pools for independent jobs, which end at once and quietly on an interrupt."""

import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from multiprocessing import active_children, get_context

from gripper_force.runtime.process import ProcessOptions, allowed, own_process


@contextmanager
def process_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Opens a pool of processes. If the block ends with an exception, running jobs are terminated.

    The processes may change the same process-wide settings as this one (see `own_process`).
    """
    others = set(active_children())
    pool = ProcessPoolExecutor(count, get_context("spawn"), _start_process, (allowed(),))
    try:
        yield pool
    except BaseException:
        for child in set(active_children()) - others:
            child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _start_process(options: ProcessOptions) -> None:
    own_process(**{**asdict(options), "signals": False})
    # A terminal sends these to every process; the parent handles them, and then terminates its children.
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)
