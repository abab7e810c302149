"""Jobs on a Ray cluster (https://docs.ray.io), as an executor. Needs the extra ``ray``."""

import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from socket import create_connection
from threading import Lock
from typing import Any

from gripper_force.errors import ConfigError, GripperError
from gripper_force.jobs.processes import answer, use_settings
from gripper_force.plugins import importing
from gripper_force.runtime.process import ProcessOptions, allowed_options

_TRIES = 2
"""Further tries of a job whose machine was lost."""

_KNOCK_S = 5.0
"""Longest wait for the cluster's head to accept a connection."""


@contextmanager
def ray_pool(address: str) -> Iterator[Executor]:
    """Connects to a Ray cluster. If the block ends with an exception, running jobs are killed.

    The cluster's machines need this version of gripper-force, and the same files at the same paths: a relative path
    counts from this process's folder. A job on a machine that is lost runs again on another one.

    A program that is connected to Ray already keeps its connection: the jobs run there, whatever the address, and only
    they end with the pool.

    Args:
        address: ``HOST:PORT`` of the head, or ``auto`` for the cluster that this machine belongs to.

    Yields:
        An executor. Ray decides how many jobs run at a time: one for each CPU of the cluster.

    Raises:
        ConfigError: Ray is not installed, or no cluster answers there.
    """
    with importing("--ray", ", or use --jobs"):
        import ray
    is_ours = not ray.is_initialized()
    if is_ours:
        _connect(ray, address)
    pool = _RayPool(ray)
    try:
        yield pool
        pool.shutdown()
    finally:
        pool.end()
        if is_ours:
            ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    handler = signal.getsignal(signal.SIGTERM)
    try:
        _knock(address)
        ray.init(address, log_to_driver=False, logging_level="error")
    except (OSError, ValueError, OverflowError, RuntimeError) as error:  # OverflowError: a port above 65535
        reason = str(error).splitlines()[0]
        raise ConfigError(
            f"no Ray cluster answers at {address} ({reason}); start one with `ray start --head`, or leave out --ray"
        ) from error
    with suppress(ValueError):  # not in the main thread, where Ray sets none
        signal.signal(signal.SIGTERM, handler)  # ours stops the run as configured, Ray's leaves at once


def _knock(address: str) -> None:
    """Raises `OSError` if nothing listens at an address: Ray would try for minutes."""
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        raise ConfigError(f"--ray {address} is no address; give HOST:PORT of the cluster's head, or auto")
    create_connection((host.strip("[]"), int(port)), _KNOCK_S).close()


class _RayPool(Executor):
    def __init__(self, ray: Any) -> None:
        self._ray = ray
        self._run = ray.remote(_run).options(max_retries=_TRIES)
        self._lock = Lock()
        self._running: dict[Future[Any], Any] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Sends a job to the cluster, and returns its future."""
        call = bytes(ForkingPickler.dumps((fn, args, kwargs)))
        reference = self._run.remote(call, allowed_options(), str(Path.cwd()))
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()
        with self._lock:
            self._running[future] = reference
        reference.future().add_done_callback(lambda done: self._finish(future, done))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Waits for the jobs that were submitted."""
        with self._lock:
            running = list(self._running)
        for future in running:
            future.exception()

    def end(self) -> None:
        """Kills the jobs that still run."""
        with self._lock:
            running = list(self._running.values())
        for reference in running:
            with suppress(self._ray.exceptions.RayError, ValueError):
                self._ray.cancel(reference, force=True)

    def _finish(self, future: "Future[Any]", done: "Future[bytes]") -> None:
        with self._lock:
            self._running.pop(future, None)
        try:
            succeeded, result = ForkingPickler.loads(done.result())
        except Exception as error:
            reason = (str(error) or type(error).__name__).splitlines()[0]
            future.set_exception(
                GripperError(f"Ray lost a job: {reason}; see `ray status`, and run it again")
            )
            return
        if succeeded:
            future.set_result(result)
        else:
            future.set_exception(result)


def _run(call: bytes, options: ProcessOptions, folder: str) -> bytes:
    """Runs a pickled job in a process of the cluster, as in this process's folder if that exists there."""
    use_settings(options)
    with suppress(OSError):
        os.chdir(folder)
    return bytes(answer(call))
