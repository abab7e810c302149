"""The export of a checkpoint in a separate process."""

import subprocess
import sys
from pathlib import Path

import pytest

from gripper_force.errors import CheckpointError
from gripper_force.vision.export_process import export_apart
from gripper_force.vision.header import Model
from gripper_force.vision.model_files import cache_folder, exported_file, exported_name, read_model


@pytest.fixture
def model(tiny_checkpoint: Path) -> Model:
    return read_model(tiny_checkpoint)


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program in place of Python, which a test writes."""
    path = tmp_path / "python"
    path.touch(0o755)
    monkeypatch.setattr(sys, "executable", str(path))
    return path


def test_the_file_of_an_engine_is_made_in_the_cache(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("openvino")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = exported_file(model, ".xml")
    assert path == cache_folder() / exported_name(model, ".xml")
    again = read_model(path)
    assert (again.header, again.digest) == (model.header, model.digest)


def test_the_process_runs_once_and_has_no_effect_on_this_one(
    model: Model,
    program: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    program.write_text(
        '#!/bin/sh\necho step 1\necho a warning >&2\nfor last; do :; done\necho "$*" >> "$last"'
    )
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "gripper-force").mkdir()
    path = exported_file(model, ".onnx")
    assert exported_file(model, ".onnx") == path
    assert path.read_text() == f"-P -m gripper_force.vision.export_process {model.path} {path}\n"
    assert capfd.readouterr() == ("", "")


def test_an_error_of_the_process_is_raised_with_its_type(tiny_checkpoint: Path, tmp_path: Path) -> None:
    copy = tmp_path / "own.safetensors"
    copy.write_bytes(tiny_checkpoint.read_bytes())
    model = read_model(copy)
    copy.unlink()
    with pytest.raises(CheckpointError, match=r"^no checkpoint at .*own\.safetensors"):
        export_apart(model, tmp_path / "force.onnx")


@pytest.mark.parametrize(
    ("script", "found"),
    [
        (
            "echo Traceback >&2\necho 'ValueError: no such operator' >&2\nexit 1",
            "code 1: ValueError: no such",
        ),
        ("kill -9 $$", "code -9: it said nothing, perhaps for lack of memory"),
    ],
)
def test_an_unknown_failure_says_what_to_do(model: Model, program: Path, script: str, found: str) -> None:
    program.write_text(f"#!/bin/sh\n{script}")
    with pytest.raises(
        CheckpointError, match=f"can't export .*{found}.*; run `gripper-force export network`"
    ):
        export_apart(model, program.with_name("force.onnx"))


def test_a_program_without_an_interpreter_gets_a_typed_error(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(
        CheckpointError, match=r"can't start sys\.executable, '/nowhere/python': No such file"
    ):
        export_apart(model, tmp_path / "force.onnx")


def test_the_process_ends_with_its_caller_and_leaves_nothing(model: Model, tmp_path: Path) -> None:
    command = ["-m", "gripper_force.vision.export_process", str(model.path), str(tmp_path / "force.onnx")]
    done = subprocess.run(
        [sys.executable, *command], stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    assert done.returncode != 0
    assert b"KeyboardInterrupt" in done.stderr
    assert not list(tmp_path.iterdir())
