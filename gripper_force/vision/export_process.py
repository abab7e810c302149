"""Export of a checkpoint in a separate process: exporters print, warn, log, and set PyTorch's threads.

The process runs this module, with the paths of checkpoint and file.
"""

import _thread
import os
import signal
import sys
import threading
from importlib import import_module
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen

from gripper_force import errors
from gripper_force.errors import CheckpointError, GripperError
from gripper_force.plugins import require
from gripper_force.vision.header import EXPORTED, Model
from gripper_force.vision.model_files import read_model


def export_apart(model: Model, path: Path) -> None:
    """Writes an ensemble's streaming step as `gripper_force.vision.export.export` does, in a separate process.

    Args:
        model: The checkpoint.
        path: File to write; its suffix selects the format.

    Raises:
        ConfigError: A package is not installed.
        CheckpointError: The checkpoint can't be read, the file can't be written, or the exporter failed.
    """
    elsewhere = "run `gripper-force export network` on another machine and set vision.checkpoint to its file"
    require("torch", f"exporting {model.path.name} for {EXPORTED[path.suffix]}", f", or {elsewhere}")
    try:
        code, output = _run(str(model.path.absolute()), str(path.absolute()))
    except OSError as error:
        raise CheckpointError(
            f"can't export {model.path}: can't start sys.executable, {sys.executable!r}: {error.strerror}; {elsewhere}"
        ) from error
    if code == 0:
        return
    last_line = output.strip().rpartition("\n")[2]
    name, _, message = last_line.partition(": ")
    kind = getattr(errors, name, None)
    if isinstance(kind, type) and issubclass(kind, GripperError):
        raise kind(message)
    cause = last_line or "it said nothing, perhaps for lack of memory"
    raise CheckpointError(
        f"can't export {model.path}: the process ended with code {code}: {cause}; {elsewhere}"
    )


def _run(*arguments: str) -> tuple[int, str]:
    """Runs this module. Returns the exit code, and what it has said. The process ends with this one, or with the call.

    It runs in its own session, because the terminal's Ctrl-C is meant for this process.
    """
    command = [sys.executable, "-P", "-m", __name__, *arguments]
    paths = {"PYTHONPATH": os.pathsep.join(map(str, sys.path))}
    with Popen(
        command,
        stdin=PIPE,
        stdout=DEVNULL,
        stderr=PIPE,
        env=os.environ | paths,
        encoding="utf-8",
        errors="replace",
        start_new_session=True,
    ) as process:
        assert process.stderr is not None
        output = process.stderr.read()
    return process.returncode, output


def _main() -> None:
    checkpoint, path = map(Path, sys.argv[1:])
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the caller may ignore it
    threading.Thread(target=_end_with_caller, daemon=True).start()
    try:
        model = read_model(checkpoint)  # first: PyTorch takes seconds to load
        import_module("gripper_force.vision.export").export(model, path)  # the caller does not need PyTorch
    except GripperError as error:
        sys.exit(f"{type(error).__name__}: {' '.join(str(error).split())}")


def _end_with_caller() -> None:
    os.read(0, 1)  # nothing is ever written, so this is the end of the pipe
    _thread.interrupt_main()


if __name__ == "__main__":
    _main()
