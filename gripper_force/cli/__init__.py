"""The command line: each command parses its options, calls a job, and prints the result.

Every command takes ``--set key.path=value`` and ``--json``. With ``--json`` one JSON object goes to stdout;
progress and messages always go to stderr. Exit code 2: bad input or a failed run, with a one-line message on
stderr. Exit code 1: the command ran, but the result is bad. Exit code 128 + n: signal n ended it, e.g. 130 for
Ctrl-C.

A command imports what it needs when it runs, so that ``gripper-force --help`` answers at once.
"""

import errno
import gc
import json
import os
import signal
import sys
import warnings
from contextlib import suppress
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.markup import escape

from gripper_force import __version__
from gripper_force.cli import (
    bench,
    calibrate,
    configuration,
    console,
    data,
    exports,
    learning,
    runs,
    setup,
    stability,
    viewing,
)
from gripper_force.errors import GripperError
from gripper_force.plugins import importing
from gripper_force.runtime import process

app = typer.Typer(
    help="Gripper force control from camera images: run, calibrate, replay.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

app.command()(setup.setup)
app.command(cls=viewing.ViewCommand)(runs.grasp)
for _command in (  # in the order of --help
    runs.replay,
    viewing.view,
    data.record,
    data.simulate,
    calibrate.teach,
    learning.train,
    learning.evaluate,
    learning.reproduce,
    runs.doctor,
    runs.virtual_servo,
):
    app.command()(_command)
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(data.import_app, name="import")
app.add_typer(exports.app, name="export")
app.add_typer(configuration.app, name="config")
app.add_typer(bench.app, name="bench")
app.add_typer(stability.app, name="stability")

_INTERRUPTED = 130


def main() -> NoReturn:
    """Runs a command, and turns every foreseen failure into a one-line message and an exit code."""
    _open_standard_streams()
    try:
        process.own_process()
        warnings.showwarning = _show_warning
        if isinstance(sys.stdout, TextIOWrapper):  # a file's name may be no text
            sys.stdout.reconfigure(errors="backslashreplace")
        for number in process.SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup sets it
                signal.signal(number, process.raise_interrupt)
        with importing("this command"):
            try:
                app(prog_name="gripper-force")
            finally:
                sys.stdout.flush()  # at the end of Python it would be too late for a message and an exit code
    except GripperError as error:
        _fail(str(error))
    except OSError as error:
        if error.filename is None:
            _fail_without_file(error)
        no_folder = isinstance(error, FileExistsError | NotADirectoryError)
        reason = "a file is where a folder must be" if no_folder else error.strerror
        _fail(f"can't use {error.filename}: {reason}; check the path, and who may read and write there")
    except UnicodeEncodeError as error:
        # Of a path that a file names; one of the command line can be passed on.
        _fail(f"can't use {error.object!r}: {error.encoding} lacks some of its letters; set LC_ALL=C.UTF-8")
    except BaseException as end:
        if isinstance(end, SystemExit):
            interrupted = end.code == _INTERRUPTED  # typer's code after an interrupt
            usage = getattr(
                end.__context__, "format_message", None
            )  # of a wrong option; typer has printed it
            if usage is not None:
                _print_json_error(usage())
        else:  # native code, such as pydantic's, can turn an interrupt into an exception of its own
            interrupted = isinstance(end, KeyboardInterrupt) or process.is_interrupted()
        if interrupted:
            stopped = "; the run was stopped as configured" if process.has_stopped_run() else ""
            console.err.print(f"interrupted{stopped}", soft_wrap=True)
            gc.freeze()  # Python would search all of PyTorch's objects for garbage, up to 2 s long
            sys.exit(process.interrupt_exit_code())
        raise
    sys.exit(0)


def _open_standard_streams() -> None:
    """Opens the standard streams that are closed: otherwise a log could get the number of one, and its text."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            number = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, mode))


def _fail_without_file(error: OSError) -> NoReturn:
    """Ends the command after an error that names no file; one of another kind than those of an output is raised."""
    if error.errno not in (errno.EPIPE, errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        raise error
    _drop_unwritten_output()
    if error.errno == errno.EPIPE:  # of `gripper-force ... | head`
        sys.exit(1)
    _fail(f"can't write the output: {error.strerror}; make space, or send it elsewhere")


def _drop_unwritten_output() -> None:
    """Drops what a standard stream can't write: Python would write it at its end, fail again, and exit with 120."""
    for name in ("stdout", "stderr"):
        try:
            getattr(sys, name).flush()
        except OSError:
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115


def _fail(message: str) -> NoReturn:
    with suppress(OSError):
        console.err.print(f"[bold red]error:[/] {escape(message)}", soft_wrap=True)
    with suppress(OSError):
        _print_json_error(message)
    _drop_unwritten_output()
    # An interrupt can appear as an error of what it met, such as an import.
    sys.exit(process.interrupt_exit_code() if process.is_interrupted() else 2)


def _print_json_error(message: str) -> None:
    if "--json" in sys.argv:
        sys.stdout.write(json.dumps({"error": message}) + "\n")


def _show_warning(message: Warning | str, *_place: object, **_named: object) -> None:
    console.warn(str(message))


def _print_version(value: bool) -> None:
    if value:
        sys.stdout.write(f"gripper-force {__version__}\n")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Gripper force control from camera images: run, calibrate, replay."""
