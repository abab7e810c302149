import os
import threading

import pytest

from gripper_force.runtime.process import PRIORITY, real_time_priority


def policy() -> int:
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK


def test_is_this_threads_alone_and_for_as_long_as_asked() -> None:
    others: list[int] = []
    before = policy()
    with real_time_priority() as refusal:
        if refusal:
            pytest.skip(refusal)
        assert policy() == os.SCHED_FIFO
        assert os.sched_getparam(0).sched_priority == PRIORITY
        thread = threading.Thread(target=lambda: others.append(policy()))
        thread.start()
        thread.join()
    assert others == [os.SCHED_OTHER]
    assert policy() == before


def test_where_it_is_not_allowed_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with real_time_priority() as refusal:
        assert "limits.conf" in refusal
    assert policy() == os.SCHED_OTHER
