from pathlib import Path

import pytest

from gripper_force.config import load_config
from gripper_force.errors import DataError
from gripper_force.qualification.fault_matrix.outcome_file import OutcomeFile

CONFIG = load_config()


def test_outcomes_are_read_back_only_to_resume(tmp_path: Path) -> None:
    path = tmp_path / "new" / "outcomes.jsonl"
    assert OutcomeFile[int](path, CONFIG, resume=True).add("a", 1) == 1
    assert OutcomeFile[int](path, CONFIG, resume=True).outcomes == {"a": 1}
    assert OutcomeFile[int](path, CONFIG, resume=False).outcomes == {}
    assert path.read_text() == ""


def test_outcomes_of_another_configuration_raise(tmp_path: Path) -> None:
    path = tmp_path / "outcomes.jsonl"
    OutcomeFile[int](path, CONFIG, resume=False).add("a", 1)
    with pytest.raises(DataError, match="with another configuration or version; run without --resume"):
        OutcomeFile[int](path, CONFIG.with_values(seed=6), resume=True)


def test_a_last_line_that_an_interruption_cut_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "outcomes.jsonl"
    OutcomeFile[int](path, CONFIG, resume=False).add("a", 1)
    line = path.read_text()
    path.write_text(line + line[:40])
    again = OutcomeFile[int](path, CONFIG, resume=True)
    assert again.outcomes == {"a": 1}
    again.add("b", 2)
    assert OutcomeFile[int](path, CONFIG, resume=True).outcomes == {"a": 1, "b": 2}


@pytest.mark.parametrize("damage", ["{\n", "[1, 2]\n", "7\n"])
def test_damaged_outcomes_raise(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "outcomes.jsonl"
    path.write_text(damage)
    with pytest.raises(DataError, match="run without --resume"):
        OutcomeFile[int](path, CONFIG, resume=True)


def test_folder_that_cannot_be_written_raises(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="can't continue with"):
        OutcomeFile[int](tmp_path / "file" / "outcomes.jsonl", CONFIG, resume=False)
