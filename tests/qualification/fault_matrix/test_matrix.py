from pathlib import Path

import pytest

from gripper_force.config import load_config
from gripper_force.errors import DataError
from gripper_force.fault_config import FAULTS
from gripper_force.qualification.fault_matrix import matrix as faults
from gripper_force.qualification.fault_matrix.cases import ROWS, Expected, FaultCase
from gripper_force.qualification.fault_matrix.judge import Sound
from gripper_force.qualification.fault_matrix.matrix import count_grasps, markdown, run_matrix
from gripper_force.qualification.markdown_blocks import write_between

SIMULATED = [row for row in ROWS if row.unit != "process"]
SHORT = ["object=stapler", "sim.detail=coarse", "control.settle_s=0.4", "control.hold_s=0.4", "seed=5"]
BLIND = ["camera.backend=none", "vision.checkpoint=none", "control.feedback=current"]
FAST = load_config(None, [*SHORT, *BLIND])
TWO_ROWS = [row for row in ROWS if (row.unit, row.kind) in (("bus", "off"), ("disk", "off"))]


def needs_eyes(row: FaultCase) -> bool:
    return row.unit in ("camera", "estimator")


@pytest.fixture(scope="session")
def without_fault() -> dict[bool, tuple[dict[str, object], Sound]]:
    """A grasp that goes well, with eyes and without."""

    def tree(overrides: list[str]) -> dict[str, object]:
        return faults._draw(load_config(None, overrides), 0).model_dump(mode="json")

    trees = {True: tree(SHORT), False: tree([*SHORT, *BLIND])}
    return {eyes: (t, faults._sound(t)) for eyes, t in trees.items()}


def test_every_fault_that_can_be_injected_has_a_row() -> None:
    rows = {(row.unit, row.kind) for row in SIMULATED}
    left_out = {("estimator", "intermittent"), ("clock", "slow")}
    assert rows | left_out == {(unit, kind) for unit, kinds in FAULTS.items() for kind in kinds}


@pytest.mark.parametrize("row", SIMULATED, ids=lambda row: f"{row.unit}-{row.kind}")
def test_a_row_ends_as_expected(
    row: FaultCase, without_fault: dict[bool, tuple[dict[str, object], Sound]]
) -> None:
    tree, sound = without_fault[needs_eyes(row)]
    outcome = faults._broken(tree, sound, row)
    assert outcome["why_not"] == ""
    assert outcome["over"] <= faults.TOLERANCE


@pytest.mark.parametrize(("unit", "kind"), [("estimator", "intermittent"), ("clock", "slow")])
def test_what_is_merely_a_nuisance_is_lived_with(
    unit: str, kind: str, without_fault: dict[bool, tuple[dict[str, object], Sound]]
) -> None:
    row = FaultCase("nuisance", unit, kind, Expected.CAP, None)
    tree, sound = without_fault[needs_eyes(row)]
    outcome = faults._broken(tree, sound, row)
    assert outcome["why_not"] == ""


def test_a_row_that_does_not_end_as_expected_is_told(
    without_fault: dict[bool, tuple[dict[str, object], Sound]],
) -> None:
    tree, sound = without_fault[False]
    harmless = FaultCase("harmless", "clock", "wrong", Expected.STOP, 20.0)
    assert faults._broken(tree, sound, harmless)["why_not"] == "it went on: held"
    too_slow = FaultCase("too slow", "bus", "off", Expected.STOP, -1.0)
    assert faults._broken(tree, sound, too_slow)["why_not"].startswith("it took")


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("matrix") / "faults.jsonl"


@pytest.fixture(scope="module")
def matrix(kept: Path) -> list[faults.Summary]:
    steps: list[str] = []
    summaries = list(run_matrix(FAST, 1, 1, 1, kept, rows=TWO_ROWS, advance=steps.append))
    assert len(steps) == count_grasps(1, 1, TWO_ROWS)
    return summaries


def test_a_matrix_that_was_broken_off_goes_on(matrix: list[faults.Summary], kept: Path) -> None:
    lines = kept.read_text().splitlines()
    kept.write_text("\n".join(lines[:-1]) + "\n")
    again = list(run_matrix(FAST, 1, 1, 1, kept, resume=True, rows=TWO_ROWS))
    assert again[0] == matrix[0]
    assert kept.read_text().splitlines()[:-1] == lines[:-1]
    assert len(kept.read_text().splitlines()) == len(lines)


def test_outcomes_of_another_configuration_are_not_mixed_in(matrix: list[faults.Summary], kept: Path) -> None:
    other = FAST.model_copy(update={"seed": 6})
    with pytest.raises(DataError, match="is of another configuration; run without --resume"):
        list(run_matrix(other, 1, 1, 1, kept, resume=True, rows=TWO_ROWS))


@pytest.mark.parametrize("damage", ["{", "[1, 2]", "7"])
def test_outcomes_that_are_damaged_are_refused(damage: str, tmp_path: Path) -> None:
    kept = tmp_path / "faults.jsonl"
    kept.write_text(damage)
    with pytest.raises(DataError, match="run without --resume"):
        list(run_matrix(FAST, 1, 1, 1, kept, resume=True, rows=TWO_ROWS))


def test_the_matrix_sums_up_each_row(matrix: list[faults.Summary]) -> None:
    bus, disk = matrix
    assert (bus["row"], bus["runs"], bus["ok"]) == ("bus: adapter unplugged", 1, 1)
    assert bus["results"] == {"DeviceLostError": 1}
    assert bus["worst_ms"] <= 20.0
    assert disk["lost_records"] > 100
    assert disk["results"] == {"held": 1}


def test_the_matrix_becomes_a_table(matrix: list[faults.Summary]) -> None:
    text = markdown(matrix)
    assert text.count("| bus: adapter unplugged | stop, latched | 20 ms | 1 of 1 | DeviceLostError 1 |") == 1


def test_the_shipped_page_has_a_place_for_the_matrix(tmp_path: Path) -> None:
    shipped = Path(__file__).parents[3] / "docs" / "reliability.md"
    text = shipped.read_text(encoding="utf-8")
    assert all(row.name in text for row in ROWS)
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    write_between(page, "matrix", "")
    assert not any(f"| {row.name} |" in page.read_text(encoding="utf-8") for row in ROWS)
