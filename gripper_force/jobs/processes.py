"""Pools for independent jobs: processes of this machine, which end at once on an interrupt, or a Ray cluster."""

import atexit
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor, Future, as_completed
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Final, TypeVar

from gripper_force.errors import ConfigError, DataError, GripperError
from gripper_force.progress import Progress
from gripper_force.runtime.process import ProcessOptions, allowed_options, own_process

_TERMINAL_SIGNALS: Final = (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
"""A terminal sends these to every process. The parent handles them, and then kills its children."""

_THREAD_S: Final = 1.0
"""Longest wait for a thread whose process was killed: an interrupt can leave a future locked."""

_GUARD: Final = (
    "a program that uses several processes needs `if __name__ == '__main__':` before its calls, because each process "
    "imports it"
)

T = TypeVar("T")
R = TypeVar("R")

_Job = tuple[Future[Any], Callable[..., Any], tuple[Any, ...], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Workers:
    """Processes that independent jobs run in.

    Attributes:
        count: Processes of this machine; 1: this process.
        ray: Address of a Ray cluster, whose processes are used instead; None for none.

    Raises:
        ConfigError: The number is none of processes.
    """

    count: int = 1
    ray: str | None = None

    def __post_init__(self) -> None:
        if type(self.count) is not int or self.count < 1:
            raise ConfigError(f"workers of {self.count!r} is not a whole number from 1 on; pass an int")

    @contextmanager
    def pool(self) -> Iterator[Executor]:
        """Opens the pool. If the block ends with an exception, its jobs are ended."""
        if self.ray is None:
            with process_pool(self.count) as pool:
                yield pool
            return
        from gripper_force.jobs.ray_pool import ray_pool

        with ray_pool(self.ray) as pool:
            yield pool

    def read_logs(
        self, function: Callable[[Path], R], logs: Sequence[Path], verb: str, progress: Progress
    ) -> tuple[dict[int, R], dict[int, GripperError]]:
        """Runs a function on each log. One that fails, in a way foreseen or not, does not stop the others.

        Args:
            function: A function that another process can import, or a `functools.partial` of one.
            logs: Its arguments.
            verb: What is done, in the past tense, for ``progress``.
            progress: Called after each log.

        Returns:
            The results and the errors by the number of the log, in the order of the logs.

        Raises:
            GripperError: All logs failed; the error of the first. That of an unforeseen exception has it as its cause,
                or in another process as its note.
        """
        results: dict[int, R] = {}
        failed: dict[int, GripperError] = {}
        with closing(self._run_each(partial(_run_named, function), logs)) as answers:
            for number, result in answers:
                if isinstance(result, GripperError):
                    failed[number] = result
                else:
                    results[number] = result
                progress(f"{'failed:' if number in failed else verb} {logs[number].name}")
        if failed and not results:
            raise failed[min(failed)]
        return dict(sorted(results.items())), dict(sorted(failed.items()))

    def _run_each(
        self, function: Callable[[Path], R], logs: Sequence[Path]
    ) -> Generator[tuple[int, R | GripperError], None, None]:
        """Yields the number of each log and its result or error, as they come. Closing it ends the remaining jobs."""
        if self.ray is None and (self.count == 1 or len(logs) < 2):  # starting a process takes seconds
            for number, log in enumerate(logs):
                try:
                    yield number, function(log)
                except GripperError as error:
                    yield number, error
            return
        with self.pool() as pool:
            number_of = {pool.submit(function, log): number for number, log in enumerate(logs)}
            for future in as_completed(number_of):
                number = number_of.pop(future)
                try:
                    result: R | GripperError = future.result()
                except Exception as error:  # also of the way to the process and back
                    result = _with_log_name(logs[number], error)
                yield number, result


def _run_named(function: Callable[[Path], R], log: Path) -> R:
    """Runs a function on a log, where an unforeseen exception still has its traceback."""
    try:
        return function(log)
    except Exception as error:
        named_error = _with_log_name(log, error)
        if named_error is error:
            raise
        raise named_error from error


def _with_log_name(log: Path, error: Exception) -> GripperError:
    """Returns an error itself if it was foreseen, or one that names the log, the exception and its place."""
    if isinstance(error, GripperError):
        return error
    calls = traceback.extract_tb(error.__traceback__)
    # The first call is `_run_named`.
    own_calls = [call for call in calls[1:] if "gripper_" in call.filename] or calls
    location = f" at {Path(own_calls[-1].filename).name}:{own_calls[-1].lineno}" if own_calls else ""
    reason = (str(error) or "no reason").splitlines()[0][:200]
    return DataError(
        f"{log} failed with {type(error).__name__}{location}: {reason}; leave this log out, and report it as a fault "
        "of gripper-force"
    )


@contextmanager
def process_pool(count: int) -> Iterator[Executor]:
    """Opens a pool of processes. If the block ends with an exception, running jobs are killed.

    The processes may change the same process-wide settings as this one (see `own_process`). They ignore the
    terminal's signals, and end when this process does, even if it is killed.

    Args:
        count: Largest number of processes. Each is started when a job first needs it.

    Yields:
        An executor. If a process dies, the result of its job raises `GripperError`.
    """
    pool = _ProcessPool(count)
    try:
        yield pool
        pool.shutdown()
    finally:
        pool.end()


class _ProcessPool(Executor):
    """One thread for each process starts it, sends it jobs and receives their results.

    `concurrent.futures.ProcessPoolExecutor` starts processes in the thread that submits. There, Ctrl-C can
    interrupt the start, and a process that is killed while it sends a result blocks the pool forever. Here,
    Ctrl-C can't interrupt a thread, and no two processes share a pipe. The threads are daemons: none delays
    the end of the program. docs/decisions/0022 has the libraries that were tried.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._jobs: SimpleQueue[_Job | None] = SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._processes: list[SpawnProcess] = []
        self._is_closed = False
        atexit.register(
            self._kill
        )  # for a pool that was never closed, such as that of an unfinished generator

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queues a job, and returns its future."""
        future: Future[Any] = Future()
        self._jobs.put((future, fn, args, kwargs))
        if len(self._threads) < self._count:
            thread = threading.Thread(target=self._run_jobs, name="process-pool", daemon=True)
            self._threads.append(thread)
            thread.start()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Lets each process end after the jobs that were submitted."""
        for _ in self._threads:
            self._jobs.put(None)
        for thread in self._threads:
            thread.join()

    def end(self) -> None:
        """Kills all processes that still run. A further interrupt does not prevent this."""
        if self._is_closed:  # also while Python ends, when no thread can start
            return
        thread = threading.Thread(target=self._kill, name="process-pool-end")
        thread.start()
        thread.join()

    def _kill(self) -> None:
        atexit.unregister(self._kill)
        with self._lock:  # no process is half-started
            self._is_closed = True
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.join()
        with suppress(Empty):
            while True:
                if (job := self._jobs.get_nowait()) is not None:
                    job[0].cancel()
        for _ in self._threads:
            self._jobs.put(None)
        for thread in self._threads:
            thread.join(_THREAD_S)

    def _run_jobs(self) -> None:
        process, connection = None, None
        while (job := self._jobs.get()) is not None:
            future, *call = job
            if not future.set_running_or_notify_cancel():
                continue
            try:
                if connection is None:
                    process, connection = self._start()
                connection.send_bytes(ForkingPickler.dumps(call))
                succeeded, result = connection.recv()
            except (EOFError, OSError):  # the latter if it died in the middle of a message
                code = None
                if process is not None:
                    process.join()
                    code = process.exitcode
                connection = None
                reason = "was killed, perhaps for lack of memory; use fewer --jobs"
                if code != -signal.SIGKILL:
                    reason = f"ended with code {code}; {_GUARD if code == 1 else 'run it again'}"
                future.set_exception(GripperError(f"a worker process {reason}"))
            except Exception as error:
                future.set_exception(error)
            else:
                if succeeded:
                    future.set_result(result)
                else:
                    future.set_exception(result)
            del job, future, call
        if process is not None and connection is not None:
            connection.close()
            process.join()

    def _start(self) -> tuple[SpawnProcess, Connection]:
        """Starts a process that the terminal's signals do not reach, from its first instruction on."""
        resource_tracker.ensure_running()  # the first call unblocks SIGINT
        signal.pthread_sigmask(
            signal.SIG_BLOCK, _TERMINAL_SIGNALS
        )  # of this thread, inherited by the process
        context = get_context("spawn")
        try:
            connection, worker_connection = context.Pipe()
            process = context.Process(target=_serve, args=(worker_connection, allowed_options()))
            with self._lock:
                if self._is_closed:
                    raise EOFError
                process.start()
                self._processes.append(process)
        except OSError as error:  # too many processes or files
            raise GripperError(
                f"a worker process can't be started: {error.strerror}; use fewer --jobs"
            ) from error
        except RuntimeError as error:  # in a process that imports the program
            raise GripperError(f"a worker process can't be started by another one; {_GUARD}") from error
        worker_connection.close()
        return process, connection


def _serve(connection: Connection, options: ProcessOptions) -> None:
    """Runs jobs in a process of the pool, until the parent closes the connection."""
    use_settings(options)
    for number in _TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _TERMINAL_SIGNALS)
    threading.Thread(target=_end_with_parent, name="end-with-parent", daemon=True).start()
    while True:
        try:
            data = connection.recv_bytes()
        except (EOFError, ConnectionError):
            return
        connection.send_bytes(answer(data))


def use_settings(options: ProcessOptions) -> None:
    """Allows this worker the same settings as the process that sends it jobs, but for the signals."""
    own_process(**{**asdict(options), "signals": False})


def answer(data: bytes) -> Any:
    """Runs a pickled job. Returns the pickled pair of success and result, or of failure and exception."""
    try:
        function, args, kwargs = ForkingPickler.loads(data)
        return ForkingPickler.dumps((True, function(*args, **kwargs)))
    except Exception as error:
        error.add_note(f"in a worker process:\n{traceback.format_exc()}")
        return ForkingPickler.dumps((False, error))


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
