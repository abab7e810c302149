import errno
import gc
import os
import signal
import struct
import subprocess
import sys
import time
from concurrent.futures import Future
from multiprocessing import active_children
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

import pytest

from gripper_force.errors import ConfigError, DataError, GripperError, UnfamiliarFrameError
from gripper_force.jobs.processes import Workers, process_pool
from gripper_force.progress import no_progress


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


def raise_error() -> None:
    raise DataError("no such log")


def test_an_error_is_raised_with_the_place_where_it_happened() -> None:
    with process_pool(1) as pool:
        with pytest.raises(DataError, match="no such log") as caught:
            pool.submit(raise_error).result()
        assert "in raise_error" in caught.value.__notes__[0]
        assert pool.submit(os.getpid).result() != os.getpid()


def meet_something_unfamiliar() -> None:
    raise UnfamiliarFrameError("no known object", 1.5)


def test_an_error_with_attributes_arrives_whole() -> None:
    with process_pool(1) as pool, pytest.raises(UnfamiliarFrameError, match="no known object") as caught:
        pool.submit(meet_something_unfamiliar).result()
    assert caught.value.force_n == 1.5


def test_results_are_in_order_and_the_processes_end() -> None:
    with process_pool(2) as pool:
        assert list(pool.map(abs, range(-20, 0))) == list(range(20, 0, -1))
        assert 1 <= len(active_children()) <= 2
    assert active_children() == []


def test_a_process_that_dies_is_an_error_and_is_replaced() -> None:
    with process_pool(1) as pool:
        for job in (kill_itself, send_half_a_result_and_die):
            with pytest.raises(GripperError, match="was killed, perhaps for lack of memory"):
                pool.submit(job).result()
            assert pool.submit(abs, -3).result() == 3
        with pytest.raises(GripperError, match="ended with code 7"):
            pool.submit(os._exit, 7).result()


def test_a_program_without_a_guard_is_told_what_it_needs(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    call = "with process_pool(1) as pool: pool.submit(abs, -1).result()"
    program.write_text(f"from gripper_force.jobs.processes import process_pool\n{call}\n")
    done = subprocess.run([sys.executable, program], capture_output=True, text=True)
    assert done.returncode == 1
    errors = [
        line for line in done.stderr.splitlines() if line.startswith("gripper_force.errors.GripperError")
    ]
    assert len(errors) == 2, "of the worker, and of the program"
    assert all("needs `if __name__ == '__main__':` before its calls" in line for line in errors)


def kill_itself() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def send_half_a_result_and_die() -> None:
    (connection,) = (found for found in gc.get_objects() if isinstance(found, Connection))
    os.write(connection.fileno(), struct.pack("!i", 1000) + b"half")  # multiprocessing's header: the length
    kill_itself()


def large_result() -> bytes:
    return bytes(1 << 28)


def test_a_process_that_cannot_start_is_an_error_and_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: object) -> None:
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    with process_pool(1) as pool:
        with monkeypatch.context() as full:
            full.setattr(SpawnProcess, "start", refuse)
            with pytest.raises(
                GripperError, match=r"can't be started: Resource temporarily unavailable; use fewer"
            ):
                pool.submit(abs, -1).result()
        assert pool.submit(abs, -1).result() == 1


def test_an_interruption_while_results_are_sent_ends_at_once() -> None:
    def interrupted() -> None:
        with process_pool(2) as pool:
            assert len(list(pool.map(abs, range(2)))) == 2
            for _ in range(20):
                pool.submit(large_result)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert active_children() == []


FORGETFUL = """
import os, sys, time
from gripper_force.errors import DataError, GripperError
from gripper_force.progress import no_progress
from gripper_force.jobs.processes import Workers, process_pool

def jobs():
    with process_pool(1) as pool:
        yield pool.submit(os.getpid).result()
        pool.submit(time.sleep, 3600).result()

running = jobs()
print(next(running), flush=True)
if sys.argv[1] == "killed":
    os.kill(os.getpid(), 9)
if sys.argv[1] == "exit":
    sys.modules["kept"] = running  # the generator is never closed
"""


@pytest.mark.parametrize("ending", ["killed", "exit"])
def test_no_process_outlives_its_parent(ending: str) -> None:
    command = [sys.executable, "-c", FORGETFUL, ending]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (-9 if ending == "killed" else 0, "")
    while is_running(int(done.stdout)):
        time.sleep(0.01)


def is_running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


class UnsendableError(Exception):
    """An exception that another process can't read: its arguments are not those of its constructor."""

    def __init__(self, first: int, second: int) -> None:
        super().__init__(f"{first} and {second}\nmore")


def read_or_fail(log: Path) -> str:
    match log.stem:
        case "foreseen":
            raise DataError("the frame is dark")
        case "unforeseen":
            raise KeyError("gone")
        case "unsendable":
            raise UnsendableError(1, 2)
    return log.stem


@pytest.mark.parametrize("count", [0, -1, 1.0, True, "2"])
def test_a_number_that_is_none_of_processes_is_refused(count: int) -> None:
    with pytest.raises(ConfigError, match=r"workers of .* is not a whole number from 1 on; pass an int"):
        Workers(count)


@pytest.mark.parametrize("count", [1, 2])
def test_a_log_that_fails_unforeseen_is_named_and_the_others_are_read(count: int) -> None:
    logs = [Path(f"{name}.mcap") for name in ("unforeseen", "a", "unsendable", "b", "foreseen")]
    found, failed = Workers(count).read_logs(read_or_fail, logs, "read", no_progress)
    assert found == {1: "a", 3: "b"}
    assert {
        number: str(error).partition(" at test_processes.py:")[0] for number, error in failed.items()
    } == {
        0: "unforeseen.mcap failed with KeyError",
        2: "unsendable.mcap failed with UnsendableError",
        4: "the frame is dark",
    }
    assert all(isinstance(error, DataError) and "\n" not in str(error) for error in failed.values())
    assert ": 1 and 2; leave this log out" in str(failed[2])
    if count == 1:
        assert isinstance(failed[0].__cause__, KeyError)
    else:
        assert "in read_or_fail" in failed[0].__notes__[0]
