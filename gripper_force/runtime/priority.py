"""The scheduler's real-time priority, for the thread that runs the control loop."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

PRIORITY: Final = 10
"""Above every thread without one, below the kernel's own."""


@contextmanager
def real_time_priority() -> Iterator[str]:
    """Lets this thread run as soon as it wakes, before any that computes; threads that it starts do not.

    Without it, a thread that wakes on a core that computes an estimate may wait for 3 ms (Linux 6.18).
    See sched(7), https://man7.org/linux/man-pages/man7/sched.7.html.

    Yields:
        Why that was not allowed, and what to do; an empty text where it was.
    """
    before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except PermissionError:
        yield (
            "the control loop has no real-time priority, so cycles may come 3 ms late; allow it with "
            f"'@dialout - rtprio {PRIORITY}' in /etc/security/limits.conf, and log in again"
        )
        return
    try:
        yield ""
    finally:
        # Without privileges the flag stays once it is set.
        os.sched_setscheduler(0, before | os.SCHED_RESET_ON_FORK, parameter)
