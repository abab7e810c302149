import os
import signal
import threading
from contextlib import ExitStack
from pathlib import Path
from types import FrameType

import pytest

from gripper_force.runtime.process import PRIORITY, deferred_signals, interrupt_exit_code, real_time_priority


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


def test_the_last_of_two_grippers_in_one_thread_brings_its_priority_back() -> None:
    before = policy()
    first, second = real_time_priority(), real_time_priority()
    if first.__enter__():
        pytest.skip("real-time priority is not allowed")
    second.__enter__()
    first.__exit__(None, None, None)
    assert policy() == os.SCHED_FIFO
    second.__exit__(None, None, None)
    assert policy() == before


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)


@pytest.mark.usefixtures("refused")
def test_where_it_is_not_allowed_it_says_what_to_do() -> None:
    with real_time_priority() as refusal:
        assert "limits.conf" in refusal
    assert policy() == os.SCHED_OTHER


def slice_ns() -> int:
    """Reads the time slice of this thread; 0 where the kernel does not show it."""
    path = Path(f"/proc/self/task/{threading.get_native_id()}/sched")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((int(line.split()[-1]) for line in lines if line.startswith("se.slice")), 0)


@pytest.mark.usefixtures("refused")
def test_where_it_is_not_allowed_this_thread_alone_gets_a_short_time_slice() -> None:
    if not (before_ns := slice_ns()):
        pytest.skip(
            "the kernel does not show the time slice (Linux before 6.12, or without CONFIG_SCHED_DEBUG)"
        )
    nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    others_ns: list[int] = []
    with real_time_priority():
        assert slice_ns() == 100_000
        assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == nice
        thread = threading.Thread(target=lambda: others_ns.append(slice_ns()))
        thread.start()
        thread.join()
    assert [slice_ns(), *others_ns] == [before_ns, before_ns]


@pytest.mark.usefixtures("refused")
def test_after_an_error_the_time_slice_is_the_default() -> None:
    before_ns = slice_ns()
    with pytest.raises(RuntimeError), real_time_priority():
        raise RuntimeError
    assert slice_ns() == before_ns


def test_a_policy_that_the_user_chose_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    found: list[int] = []

    def run() -> None:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        with monkeypatch.context() as patch:
            patch.setattr(os, "sched_setscheduler", refuse)
            with real_time_priority():
                found.append(policy())
        found.append(policy())

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [os.SCHED_BATCH, os.SCHED_BATCH]


def in_another_thread(stack: ExitStack) -> None:
    thread = threading.Thread(target=stack.close)
    thread.start()
    thread.join()


@pytest.mark.usefixtures("own_process")
def test_the_handlers_return_when_the_next_gripper_is_closed() -> None:
    before = signal.getsignal(signal.SIGTERM)
    stack = ExitStack()
    stack.enter_context(deferred_signals(lambda _: None))
    in_another_thread(stack)
    calls: list[str] = []
    with deferred_signals(lambda _: calls.append("next")):
        signal.raise_signal(signal.SIGTERM)
    assert calls == ["next"]
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.usefixtures("own_process")
def test_grippers_may_close_in_any_order() -> None:
    before, calls = signal.getsignal(signal.SIGINT), list[str]()
    first, second = ExitStack(), ExitStack()
    first.enter_context(deferred_signals(lambda _: calls.append("first")))
    second.enter_context(deferred_signals(lambda _: calls.append("second")))
    first.close()
    signal.raise_signal(signal.SIGINT)
    second.close()
    assert calls == ["second"]
    assert signal.getsignal(signal.SIGINT) == before


@pytest.mark.usefixtures("own_process")
def test_a_handler_that_the_program_sets_meanwhile_stays() -> None:
    before, calls = signal.getsignal(signal.SIGINT), list[int]()
    stack = ExitStack()
    stack.enter_context(deferred_signals(lambda _: None))
    ours = signal.getsignal(signal.SIGINT)
    assert callable(ours)

    def handle(number: int, frame: FrameType | None) -> None:
        calls.append(number)
        ours(number, frame)

    try:
        signal.signal(signal.SIGINT, handle)
        stack.close()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert calls == [signal.SIGINT]
        assert signal.getsignal(signal.SIGINT) == handle
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("own_process")
def test_only_a_second_ctrl_c_interrupts_again() -> None:
    calls: list[str] = []
    with deferred_signals(lambda _: calls.append("interrupt")):
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGTERM, signal.SIGQUIT):
            signal.raise_signal(number)
        assert len(calls) == 1
        signal.raise_signal(signal.SIGINT)
    assert len(calls) == 2
    assert interrupt_exit_code() == 128 + signal.SIGHUP


@pytest.mark.usefixtures("own_process")
def test_an_ignored_signal_stays_ignored() -> None:
    before, calls = signal.signal(signal.SIGHUP, signal.SIG_IGN), list[str]()
    try:
        with deferred_signals(lambda _: calls.append("interrupt")):
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert calls == []
