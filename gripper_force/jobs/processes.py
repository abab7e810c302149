"""Processes for independent jobs, which end at once and quietly when the program is interrupted."""

import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context


@contextmanager
def process_pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of so many processes. Where the block is left by an exception, what they do is broken off."""
    others = set(active_children())
    pool = ProcessPoolExecutor(count, get_context("spawn"), _leave_interrupts_to_the_parent)
    try:
        yield pool
    except BaseException:
        for child in set(active_children()) - others:
            child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _leave_interrupts_to_the_parent() -> None:
    """The terminal sends Ctrl-C to each process; a traceback from each would bury what the parent says."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
