"""Terminal behaviour: escape codes only on a terminal that wants them, progress that a log file can hold, exit codes."""

import fcntl
import json
import os
import re
import select
import shlex
import signal
import subprocess
import sys
import termios
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from gripper_force.cli import console

COMMAND = [sys.executable, "-c", "from gripper_force.cli import main; main()"]
IMPORT = "import database db --out logs"
_AGAIN_S = 2.0
"""Silence after which keys are pressed again: Python misses an interrupt just before it begins to read the terminal."""

ESCAPE = re.compile(r"\x1b")
COLOUR = re.compile(r"\x1b\[[0-9;]*\b([349]|10)[0-8](;[0-9;]*)?m")
SHOWING = {
    "a bar": IMPORT,
    "a table": "config file",
    "an error": "config show --set no.such=1",
    "help": "--help",
}
EACH = """
import sys
from gripper_force.cli import main
for line in sys.argv[1:]:
    sys.argv[1:] = line.split()
    try:
        main()
    except SystemExit as end:
        print(f"code {end.code}", flush=True)
"""
"""Runs several commands: to start a process for each would take most of the time."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a database of one environment."""
    environment = tmp_path / "db" / "sponge_30_100"
    environment.mkdir(parents=True)
    (environment / "test.txt").write_text("".join(f"{number},0.0,0\n" for number in range(1, 5)))
    for number in range(1, 5):
        cv2.imwrite(str(environment / f"{number}.jpg"), np.zeros((16, 16, 3), np.uint8))
    return tmp_path


def on_terminal(
    command: list[str], folder: Path, keys: Mapping[str, bytes] | None = None, **variables: str
) -> tuple[int, str]:
    """Runs a command in a terminal, and presses keys once it shows a text. Returns exit code and what it showed."""
    left, pressed = dict(keys or {}), b""
    env = {key: value for key, value in os.environ.items() if key not in ("NO_COLOR", "FORCE_COLOR", "TERM")}
    master, slave = os.openpty()
    with subprocess.Popen(
        command,
        cwd=folder,
        env=env | variables,
        stdin=slave,
        stdout=slave,
        stderr=slave,
        preexec_fn=_own_terminal if keys else None,
    ) as child:
        os.close(slave)
        parts = []
        while True:
            if pressed and not select.select([master], [], [], _AGAIN_S)[0]:
                os.write(master, pressed)
                continue
            if not (part := _read(master)):
                break
            parts.append(part)
            for text in [one for one in left if one.encode() in b"".join(parts)]:
                pressed = left.pop(text)
                os.write(master, pressed)
    os.close(master)
    return child.returncode, b"".join(parts).decode()


def _own_terminal() -> None:
    """Makes stdin the terminal that sends Ctrl-C to this process."""
    os.setsid()
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


def _read(master: int) -> bytes:
    try:
        return os.read(master, 65536)
    except OSError:  # EIO: the other end was closed
        return b""


def each_on_terminal(folder: Path, **variables: str) -> dict[str, str]:
    """Runs the commands of `SHOWING` in a terminal, and returns what they showed."""
    _, shown = on_terminal([sys.executable, "-c", EACH, *SHOWING.values()], folder, None, **variables)
    *parts, rest = re.split(r"code (\d)\r?\n", shown)
    assert (parts[1::2], rest) == (["0", "0", "2", "0"], ""), shown
    return dict(zip(SHOWING, parts[::2], strict=True))


def test_a_dumb_terminal_gets_no_escape_codes(folder: Path) -> None:
    for name, shown in each_on_terminal(folder, TERM="dumb").items():
        assert shown, name
        assert not ESCAPE.search(shown), name


def test_there_is_colour_unless_no_color_is_set(folder: Path) -> None:
    def coloured(**variables: str) -> list[str]:
        shown = each_on_terminal(folder, TERM="xterm-256color", **variables)
        return [name for name, text in shown.items() if COLOUR.search(text)]

    assert coloured() == ["a bar", "an error", "help"]
    assert coloured(NO_COLOR="1") == []


@pytest.mark.parametrize("arguments", ["config show --json", "config file"])
def test_an_output_on_a_full_disk_is_one_sentence(arguments: str, tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, *arguments.split()], cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True
        )
    sentence = "error: can't write the output: No space left on device; make space, or send it elsewhere\n"
    assert (done.returncode, done.stderr) == (2, sentence)


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_messages_on_a_full_disk_do_not_hide_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unbuffered: str
) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    command = [*COMMAND, "grasp", "--set", "no_such_key=1", "--json"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=full, text=True)
    assert done.returncode == 2
    assert list(json.loads(done.stdout)) == ["error"]


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_standard_streams_are_no_error(closed: str, tmp_path: Path) -> None:
    shown = 'from pathlib import Path; Path("found").write_text(str(os.open("log", os.O_CREAT)))'
    program = f"import os; from gripper_force import cli; cli._open_standard_streams(); {shown}"
    for words in ([*COMMAND, "config", "show"], [sys.executable, "-c", program]):
        done = subprocess.run(
            f"{shlex.join(words)} {closed}", shell=True, cwd=tmp_path, capture_output=True, text=True
        )
        assert (done.returncode, done.stderr) == (0, "")
    assert int((tmp_path / "found").read_text()) > 2, "what is written to a closed stream would be in the log"


def test_a_path_that_the_locale_lacks_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("log: {directory: läufe}", encoding="utf-8")
    variables = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [*COMMAND, "grasp", "--config", "mine.yaml", "--json", "--set", "vision.checkpoint=none"]
    done = subprocess.run(
        [*command, "--set", "control.feedback=current"],
        cwd=tmp_path,
        env=variables,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2, done.stderr
    assert "can't use 'läufe': ascii lacks some of its letters" in json.loads(done.stdout)["error"]


def test_an_output_that_nobody_reads_is_no_error(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [*COMMAND, "config", "show"], cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE, text=True
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "")


def test_a_wrong_input_leaves_no_bar_beside_its_sentence(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_text("no log")
    command = [*COMMAND, "replay", "a.mcap", "b.mcap", "--jobs", "1"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stderr == "error: a.mcap is not an MCAP file; pass a log that gripper-force wrote\n"
    shown = on_terminal(command, tmp_path, TERM="xterm-256color")[1]
    line_up_and_erased = r"\x1b\[1A\x1b\[2K"
    assert re.search(rf"b\.mcap\s+(\x1b\[\?25h)?\r?{line_up_and_erased}\x1b\[1;31merror:", shown), shown


def test_a_bar_without_a_step_is_not_beside_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ZeroDivisionError), console.bar("simulating", 3) as progress:
        progress("", 0)
        raise ZeroDivisionError
    assert capsys.readouterr().err == ""


def test_ctrl_c_while_the_command_line_is_imported_ends_without_a_word(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("import signal; signal.raise_signal(signal.SIGINT)")
    path = os.pathsep.join([str(tmp_path), *sys.path])
    command = [sys.executable, "-m", "gripper_force", "config", "show"]
    env = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_a_warning_of_the_library_is_one_line() -> None:
    program = (
        "import warnings; from gripper_force import cli; "
        "cli.app = lambda **_: warnings.warn('it is [gone]', RuntimeWarning); cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stderr == "warning: it is [gone]\n"


def test_without_a_terminal_a_bar_is_printed_once(folder: Path) -> None:
    done = subprocess.run([*COMMAND, *IMPORT.split()], cwd=folder, capture_output=True, text=True, check=True)
    assert "\r" not in done.stdout + done.stderr
    assert not ESCAPE.search(done.stdout + done.stderr)
    assert done.stderr.count("importing ") == 1
    assert " 1/1 " in done.stderr
    assert done.stderr.splitlines()[-1] == "next: gripper-force evaluate logs"
    assert "sponge_30_100" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "question"),
    [
        ("setup", "Write it (EEPROM)? "),
        ("doctor --setup", "Write these to servo 1? "),
    ],
    ids=["setup", "doctor"],
)
def test_ctrl_c_at_a_question_ends_with_130(arguments: str, question: str, tmp_path: Path) -> None:
    options = "--set servo.port=virtual:asked --set load_cell.backend=none --set camera.backend=none"
    command = [*COMMAND, *arguments.split(), *options.split()]
    code, shown = on_terminal(command, tmp_path, keys={question: b"\x03"}, TERM="dumb")
    assert code == 130
    assert shown.splitlines()[-1].split(";")[0] == "interrupted"
    assert ("what was found so far is in rig.yaml" in shown) == (arguments == "setup")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_ctrl_c_is_the_way_to_end_a_virtual_servo(number: int, code: int, tmp_path: Path) -> None:
    command = [*COMMAND, "virtual-servo", "--json"]
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as child:
        try:
            assert child.stdout is not None
            assert "/dev/" in child.stdout.readline()
            child.send_signal(number)
            out, err = child.communicate(timeout=60)
        finally:
            child.kill()
    assert (child.returncode, out) == (code, "")
    assert ("interrupted" in err.splitlines()) == bool(code)
    assert "the run was stopped" not in err
