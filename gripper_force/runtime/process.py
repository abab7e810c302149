"""Process-wide settings, which belong to the program and are changed only with its permission."""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import struct
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from errno import EIO
from types import FrameType
from typing import Final, NoReturn

PRIORITY: Final = 10
"""Real-time priority of the control loop: above every ordinary thread, below the kernel's own threads."""

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""Signals that end a run: Ctrl-C, a request to end, the loss of the terminal (ssh), and Ctrl-\\."""

SWITCH_INTERVAL_S: Final = 2e-4
"""Python's default lets a computing thread delay the control thread by 5 ms."""

_TOGETHER_S: Final = 1.0
"""Signals that follow each other so soon have one cause. A lost connection sends SIGHUP twice: once from the kernel,
once from the shell."""

_SLICE_NS: Final = 100_000
_SCHED_SETATTR: Final = {"x86_64": 314, "aarch64": 274, "riscv64": 274}
"""The shortest time slice that the kernel accepts, and the system call that sets it, by machine."""


@dataclass(frozen=True, slots=True)
class ProcessOptions:
    """Process-wide settings that gripper-force may change while a gripper is open. See `own_process`."""

    signals: bool = False
    switch_interval: bool = False
    real_time_priority: bool = False
    torch_threads: bool = False


_allowed = ProcessOptions()
_interrupts: list[Callable[[bool], None]] = []  # of the open grippers, the newest last
_earlier_handlers: dict[int, signal._HANDLER] = {}
_switch_intervals: list[float] = []  # before each open gripper, the program's own first
_priorities = threading.local()  # the same for the priority of each thread
# Signals since the first gripper was opened: number, whether one was open, and the monotonic time.
_received: list[tuple[int, bool, float]] = []


def own_process(
    *,
    signals: bool = True,
    switch_interval: bool = True,
    real_time_priority: bool = True,
    torch_threads: bool = True,
) -> None:
    """Allows gripper-force to change process-wide settings. The command line does; a library user may.

    Without this call the library changes none of them. Call it once, before a gripper is opened, in a program
    whose main purpose is the gripper.

    Args:
        signals: Ctrl-C (SIGINT), SIGTERM, the loss of the terminal (SIGHUP) and SIGQUIT end a run
            between two control cycles. A second Ctrl-C ends it at once. Handlers are set only while a gripper
            is open, and only by the main thread. A signal that the program ignores stays ignored.
        switch_interval: Python switches threads every 0.2 ms in real time, so that a computing thread delays
            the control loop less.
        real_time_priority: The thread of the control loop gets real-time priority, if the kernel allows it.
        torch_threads: PyTorch computes with ``vision.threads`` threads in the whole process.
    """
    global _allowed
    _allowed = ProcessOptions(signals, switch_interval, real_time_priority, torch_threads)


def allowed_options() -> ProcessOptions:
    """The settings that the program allows to change."""
    return _allowed


@contextmanager
def real_time_settings() -> Iterator[str]:
    """Applies the allowed thread settings to this process and thread while the control loop runs.

    Yields:
        Reason why real-time priority was refused, and the remedy; empty if it was granted or not allowed.
    """
    with ExitStack() as stack:
        if _allowed.switch_interval:
            _switch_intervals.append(sys.getswitchinterval())
            # In whatever order grippers are closed, the last one brings the program's interval back.
            stack.callback(lambda: sys.setswitchinterval(_switch_intervals.pop()))
            sys.setswitchinterval(SWITCH_INTERVAL_S)
        yield stack.enter_context(real_time_priority()) if _allowed.real_time_priority else ""


@contextmanager
def real_time_priority() -> Iterator[str]:
    """Gives this thread real-time priority, so that it runs as soon as it wakes. Threads it starts have none.

    Without it, a thread that wakes on a core that computes an estimate may wait for 3 ms (Linux 6.18), or less with
    the shortest time slice, which needs no privilege.
    See sched(7), https://man7.org/linux/man-pages/man7/sched.7.html.

    Yields:
        Reason for a refusal, and the remedy; empty if granted.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield "the control loop has no real-time priority, so cycles may start late; use Linux for a real gripper"
        return
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except PermissionError:
        is_ordinary = policy & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER  # another one is the user's choice
        if is_ordinary:
            _set_time_slice(_SLICE_NS)
        try:
            yield (
                "the control loop has no real-time priority, so cycles may start 3 ms late; allow it with "
                f"'@dialout - rtprio {PRIORITY}' in /etc/security/limits.conf, and log in again"
            )
        finally:
            if is_ordinary:
                _set_time_slice(0)
        return
    saved_settings: list[tuple[int, os.sched_param]] = _priorities.__dict__.setdefault("earlier", [])
    saved_settings.append((policy, parameter))
    try:
        yield ""
    finally:
        # In whatever order the grippers of a thread are closed, the last one brings the thread's priority back.
        policy, parameter = saved_settings.pop()
        # An unprivileged process cannot clear this flag once it is set.
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameter)


def _set_time_slice(slice_ns: int) -> None:
    """Sets the time slice of this thread; 0 is the default. Linux before 6.12 ignores it.

    A waking thread interrupts one with a longer slice. See https://man7.org/linux/man-pages/man2/sched_setattr.2.html.
    """
    call = _SCHED_SETATTR.get(platform.machine())
    if call is None or sys.maxsize < 2**32:  # 32-bit programs on such a kernel have other numbers
        return
    nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    attributes = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, 1, nice, 0, slice_ns, 0, 0)
    ctypes.CDLL(None).syscall(call, 0, attributes, 0)


@contextmanager
def deferred_signals(interrupt: Callable[[bool], None]) -> Iterator[None]:
    """Calls ``interrupt`` on a signal of `SIGNALS` instead of raising at once, if the program allows it.

    An exception in the middle of a bus transaction would leave the transaction incomplete. Of several open
    grippers, the newest is interrupted. Its argument is True for Ctrl-C, which also interrupts a run that is ending.
    """
    if not _allowed.signals or threading.current_thread() is not threading.main_thread():
        yield  # only the main thread can set handlers
        return
    if not _interrupts:
        _received.clear()
    _interrupts.append(interrupt)  # first: the end of another gripper would restore the handlers
    for number in SIGNALS:
        if signal.getsignal(number) not in (_handle_signal, signal.SIG_IGN):
            _earlier_handlers[number] = signal.signal(number, _handle_signal)
    try:
        yield
    finally:
        _interrupts.remove(interrupt)
        if not _interrupts and threading.current_thread() is threading.main_thread():
            _restore_handlers()


def keep_in_forks(stack: ExitStack) -> None:
    """Lets a stack do nothing at its end in a forked process: the devices and files are those of its parent."""
    process = os.getpid()
    stack.callback(lambda: os.getpid() == process or stack.pop_all())


def raise_interrupt(number: int, _frame: FrameType | None) -> NoReturn:
    """Handles a signal of `SIGNALS` while no gripper is open.

    Raises:
        KeyboardInterrupt: Always.
    """
    _receive(number)
    raise KeyboardInterrupt


def interrupt_exit_code() -> int:
    """Returns 128 plus the number of the first signal that ended the run, as shells do; 130 for Ctrl-C."""
    return 128 + (_received[0][0] if _received else signal.SIGINT)


def is_interrupted() -> bool:
    """Returns True if a signal of `SIGNALS` has been received, so that a run ends."""
    return bool(_received)


def has_stopped_run() -> bool:
    """Returns True if a signal of `SIGNALS` has come while a gripper was open."""
    return any(in_run for _, in_run, _ in _received)


def _handle_signal(number: int, frame: FrameType | None) -> None:
    newest = _interrupts[-1:]  # a copy, because another thread may close the gripper now
    if newest:
        is_alone = not _received or time.monotonic() - _received[-1][2] > _TOGETHER_S
        _receive(number)
        if is_alone or number == signal.SIGINT:
            newest[0](number == signal.SIGINT)
        return
    # The last gripper was closed in another thread, which could not restore the handlers.
    _restore_handlers()
    handler = _earlier_handlers[number]
    if callable(handler):
        handler(number, frame)
    elif handler == signal.SIG_DFL:
        signal.signal(number, handler)
        signal.raise_signal(number)


def _restore_handlers() -> None:
    for number in SIGNALS:
        if signal.getsignal(number) is _handle_signal:
            signal.signal(number, _earlier_handlers[number])


def _receive(number: int) -> None:
    _received.append((number, bool(_interrupts), time.monotonic()))
    if number == signal.SIGHUP:
        _discard_output_to_lost_terminal()


def _discard_output_to_lost_terminal() -> None:
    """Connects standard streams whose terminal is gone to ``/dev/null``: otherwise every output would raise."""
    for stream in range(3):
        try:
            termios.tcgetattr(stream)
        except termios.error as error:
            if error.args[0] == EIO:
                null = os.open(os.devnull, os.O_RDWR)
                os.dup2(null, stream)
                os.close(null)
