from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gripper_force.config import load_config
from gripper_force.fault_config import FAULTS
from gripper_force.qualification.fault_matrix import judge as judge_module
from gripper_force.qualification.fault_matrix import matrix as faults
from gripper_force.qualification.fault_matrix.cases import ROWS, Expected, FaultCase
from gripper_force.qualification.fault_matrix.judge import FaultFreeGrasp
from gripper_force.qualification.fault_matrix.kill_process import KillTrial
from gripper_force.qualification.fault_matrix.matrix import count_grasps, markdown, run_matrix
from gripper_force.qualification.markdown_blocks import write_between
from gripper_force.schema import Tree
from gripper_force.types import FusedForce, ServoCommand

SIMULATED = [row for row in ROWS if row.unit != "process"]
SPONGE, STAPLER = 0, 3
"""Numbers of grasps of these objects."""

WithoutFault = tuple[dict[str, object], FaultFreeGrasp]
SHORT = [
    "sim.detail=coarse",
    "control.settle_s=0.3",
    "control.hold_s=0.3",
    "seed=5",
    "vision.checkpoint=small",
]
NO_VISION = ["camera.backend=none", "vision.checkpoint=none", "control.feedback=current"]
FAST = load_config(None, [*SHORT, *NO_VISION])
TWO_ROWS = [row for row in ROWS if (row.unit, row.kind) in (("bus", "off"), ("disk", "off"))]


def needs_vision(row: FaultCase) -> bool:
    return row.unit in ("camera", "estimator")


@pytest.fixture(scope="session")
def without_fault() -> Callable[[FaultCase], WithoutFault]:
    """Returns the grasp of a row without a fault."""
    made: dict[tuple[bool, int], WithoutFault] = {}

    def grasp(row: FaultCase) -> WithoutFault:
        # The grasp of the cheapest object; that of a softer one where the motor gets stronger than its limit.
        vision, index = needs_vision(row), SPONGE if row.unit == "plant" else STAPLER
        if (vision, index) not in made:
            config = faults._draw(load_config(None, SHORT if vision else [*SHORT, *NO_VISION]), index)
            tree = config.model_dump(mode="json")
            made[vision, index] = tree, faults._run_without_fault(tree)
        return made[vision, index]

    return grasp


def test_every_fault_has_a_row() -> None:
    rows = {(row.unit, row.kind) for row in SIMULATED}
    left_out = {("estimator", "intermittent"), ("clock", "slow"), ("plant", "off")}  # wrong_configurations
    assert rows | left_out == {(unit, kind) for unit, kinds in FAULTS.items() for kind in kinds}


@pytest.mark.parametrize("row", SIMULATED, ids=lambda row: f"{row.unit}-{row.kind}")
def test_the_reaction_to_each_fault_is_as_expected(
    row: FaultCase, without_fault: Callable[[FaultCase], WithoutFault]
) -> None:
    tree, fault_free = without_fault(row)
    outcome = faults._run_with_fault(tree, fault_free, row)
    assert outcome["failure"] == ""
    assert outcome["peak_over_limit"] <= faults.TOLERANCE
    if row.name == "disk full":
        assert outcome["lost_records"] > 100


@pytest.mark.parametrize(("unit", "kind"), [("estimator", "intermittent"), ("clock", "slow")])
def test_minor_faults_do_not_end_the_grasp(
    unit: str, kind: str, without_fault: Callable[[FaultCase], WithoutFault]
) -> None:
    row = FaultCase("nuisance", unit, kind, Expected.CURRENT_LIMIT, None)
    tree, fault_free = without_fault(row)
    outcome = faults._run_with_fault(tree, fault_free, row)
    assert outcome["failure"] == ""


def test_an_unexpected_reaction_is_reported(
    without_fault: Callable[[FaultCase], WithoutFault],
) -> None:
    harmless = FaultCase("harmless", "clock", "wrong", Expected.STOP, 20.0)
    tree, fault_free = without_fault(harmless)
    assert faults._run_with_fault(tree, fault_free, harmless)["failure"] == "the grasp was not stopped: held"
    too_slow = FaultCase("too slow", "bus", "off", Expected.STOP, -1.0)
    assert faults._run_with_fault(tree, fault_free, too_slow)["failure"].startswith("the reaction took")


@pytest.mark.parametrize(
    ("trial", "failure"),
    [
        (KillTrial(tripped_ms=41.0, peak_n=1.0, lost_ms=90.0), ""),
        (KillTrial(tripped_ms=None, peak_n=1.0, lost_ms=90.0), "the watchdog did not trip"),
        (KillTrial(tripped_ms=900.0, peak_n=1.0, lost_ms=90.0), "the watchdog took 900 ms"),
        (KillTrial(tripped_ms=41.0, peak_n=99.0, lost_ms=90.0), "over the limit"),
        (KillTrial(tripped_ms=41.0, peak_n=1.0, lost_ms=300.0), "the log lacks the last 300 ms"),
    ],
)
def test_a_killed_process_is_judged_by_time_force_and_log(
    trial: KillTrial, failure: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(faults, "kill_trial", lambda *_: trial)
    (row,) = [row for row in ROWS if row.name == "process killed"]
    found = faults._run_process_row(FAST.model_dump(mode="json"), row)["failure"]
    assert found == failure if not failure else failure in found


def test_a_failure_in_real_time_counts() -> None:
    (row,) = [row for row in ROWS if row.name == "bus: adapter unplugged"]

    def outcome(failure: str) -> faults.FaultRunResult:
        return {
            "seed": 3,
            "result": "held",
            "peak_over_limit": -0.1,
            "took_ms": 1.0,
            "lost_records": 0,
            "failure": failure,
        }

    summary = faults._summary(row, [outcome("")], [outcome("the grasp was not stopped: held")])
    assert (summary["ok"], summary["live_ok"]) == (1, 0)
    assert summary["failures"] == {"3 in real time": "the grasp was not stopped: held"}
    assert "| 1 of 1, 0 of 1 |" in markdown([summary])


@dataclass
class Commanded:
    """The forces and goal currents of a run."""

    forces_n: list[float]
    currents_a: list[float]

    def records(self, kind: type) -> list[object]:
        if kind is FusedForce:
            return [SimpleNamespace(t_ns=i * 5_000_000, force_n=f) for i, f in enumerate(self.forces_n)]
        return [ServoCommand(i * 5_000_000, 0.0, a) for i, a in enumerate(self.currents_a)]


@pytest.mark.parametrize(
    ("forces_n", "currents_a", "result"),
    [
        ([1, 6, 6, 6], [1, 1, 0.5, 0.4], (5.0, "")),
        ([1, 6, 6, 6], [1, 1, 1, 1], (None, "the goal current was not lowered")),
        ([1, 6, 1, 1], [1, 1, 1, 1], (None, "")),
        ([1, 1, 1, 1], [1, 1, 1, 1], (None, "")),
    ],
    ids=["lowered", "never lowered", "fell by itself", "never over"],
)
def test_a_current_that_is_not_lowered_is_found(
    forces_n: list[float], currents_a: list[float], result: tuple[float | None, str]
) -> None:
    run: Any = Commanded(forces_n, currents_a)
    assert judge_module._judge_lowering(run, 5.0) == result


def run_without_grasp(tree: Tree) -> FaultFreeGrasp:
    return FaultFreeGrasp(0.0, 1.0, 200, 3.0, ())


def run_with_result_of_its_clock(
    tree: Tree, fault_free: FaultFreeGrasp, row: FaultCase, clock: str
) -> faults.FaultRunResult:
    return {
        "seed": 5,
        "result": f"{row.kind} in {clock}",
        "peak_over_limit": -0.1,
        "took_ms": 12.0,
        "lost_records": 200 if row.unit == "disk" else 0,
        "failure": "",
    }


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thread_pool: object) -> Path:
    """File of the outcomes of a matrix whose grasps are not run: other tests run those of each row."""
    monkeypatch.setattr(faults, "process_pool", thread_pool)
    monkeypatch.setattr(faults, "_run_without_fault", run_without_grasp)
    monkeypatch.setattr(faults, "_run_with_fault", run_with_result_of_its_clock)
    return tmp_path / "faults.jsonl"


def test_an_interrupted_matrix_continues(kept: Path) -> None:
    list(run_matrix(FAST, 1, 1, 1, kept, rows=TWO_ROWS))
    *lines, _ = before = kept.read_text().splitlines()
    kept.write_text("\n".join(lines).replace("12.0", "13.0") + "\n")
    again = list(run_matrix(FAST, 1, 1, 1, kept, resume=True, rows=TWO_ROWS))
    assert [(row["worst_ms"], row["live_worst_ms"]) for row in again] == [(13.0, 13.0), (13.0, 12.0)]
    assert len(kept.read_text().splitlines()) == len(before)


def test_the_matrix_summarises_each_row_in_both_clocks(kept: Path) -> None:
    names: list[str] = []

    def progress(text: str, steps: int = 1) -> None:
        names.append(text)

    bus, disk = run_matrix(FAST, 2, 1, 1, kept, rows=TWO_ROWS, progress=progress)
    assert len(names) == count_grasps(2, 1, TWO_ROWS) == 8
    assert (bus["row"], bus["runs"], bus["ok"]) == ("bus: adapter unplugged", 2, 2)
    assert (bus["results"], bus["live_results"]) == ({"off in lockstep": 2}, {"off in realtime": 1})
    assert (bus["worst_ms"], bus["lost_records"], disk["lost_records"]) == (12.0, 0, 200)
    line = "| bus: adapter unplugged | stop, latched | 20 ms | 2 of 2, 1 of 1 | off in lockstep 2 |"
    assert markdown([bus, disk]).count(line) == 1


def test_a_fault_in_real_time_is_judged(without_fault: Callable[[FaultCase], WithoutFault]) -> None:
    row, _ = TWO_ROWS
    outcome = faults._run_with_fault(*without_fault(row), row, "realtime")
    assert outcome["result"] == "DeviceLostError"
    assert not outcome["failure"] or outcome["failure"].startswith("the reaction took"), (
        "a loaded machine may be late"
    )


def test_the_shipped_page_shows_every_row(tmp_path: Path) -> None:
    shipped = Path(__file__).parents[3] / "docs" / "reliability.md"
    text = shipped.read_text(encoding="utf-8")
    assert all(row.name in text for row in ROWS)
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    write_between(page, "matrix", "")
    assert not any(f"| {row.name} |" in page.read_text(encoding="utf-8") for row in ROWS)
