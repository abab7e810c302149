from dataclasses import replace

import pytest

from gripper_force.qualification.paper import paper_tables as tables
from gripper_force.qualification.paper.experiment import Test as Estimates
from gripper_force.qualification.paper.models import Scale
from gripper_force.qualification.paper.paper_tables import COMPARISONS, Table


@pytest.mark.parametrize("name", COMPARISONS)
def test_a_comparison_has_the_papers_numbers_and_ours(name: str, estimates: Estimates) -> None:
    table = tables.comparison(estimates, name)
    first, *others = table.rows
    assert first[:4] == ("baseline", "0.10313", "0.04051", "100 %")
    assert first[5:] == ("0.400 ± 0.000", "3", "100 %", None, None)
    for row in others:
        assert len(row) == len(table.columns)
        if row[0] not in ("two plain networks", "ResNet, baseline"):
            assert row[5].startswith("0.200")  # type: ignore[union-attr]
            assert row[6:] == ("3", "200 %", "3", "0.008")


def test_rows_without_networks_are_not_measured(estimates: Estimates) -> None:
    for net in ("plain", "ssam-0"):
        del estimates.estimates_n[net, 2]
        for seed in (0, 1) if net == "ssam-0" else ():
            del estimates.estimates_n[net, seed]
    rows = {row[0]: row[4:] for row in tables.comparison(estimates, "3").rows}
    assert rows["single frame, spatial"] == rows["single frame, ensemble"] == ("not measured", *(None,) * 5)
    assert rows["baseline"][2:] == ("2 of 3", "100 %", None, None)
    assert rows["proposed, spatial"][2:] == ("3", "200 %", "2", "0.008")
    claims = {row[0]: row[1:] for row in tables.claims(estimates).rows}
    assert claims["spatial: several frames beat one"] == ("not measured", None, None, None)
    assert claims["spatial attention beats none"][2] == "2 of 2"
    objects = {row[:2]: row[4:] for row in tables.objects(estimates).rows}
    assert objects["tube", "single frame, ensemble"] == ("not measured", None, None)
    assert objects["tube", "proposed, ensemble"][1] == "3"


def test_objects_have_a_row_for_each_model(estimates: Estimates) -> None:
    table = tables.objects(estimates)
    assert [row[:2] for row in table.rows[:3]] == [
        ("sponge", "baseline"),
        ("sponge", "single frame, ensemble"),
        ("sponge", "proposed, ensemble"),
    ]
    assert table.rows[2][2:4] == ("0.01734", "122 %")
    assert float(str(table.rows[2][4]).split()[0]) == pytest.approx(0.2, abs=0.02)


def test_claims_are_tested_by_set_and_by_seed(estimates: Estimates) -> None:
    rows = {row[0]: row[1:] for row in tables.claims(estimates).rows}
    less, sets, seeds, p = rows["the ensemble beats the baseline"]
    assert (sets, seeds, p) == ("8 of 8", "3 of 3", "0.008")
    assert less == "+50.0 %"


def test_times_of_window_and_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_RUNS", 1)
    monkeypatch.setattr(tables, "_WARM_UP", 1)
    turns: list[str] = []

    def progress(text: str, steps: int = 1) -> None:
        turns.append(text)

    table = tables.times(progress)
    assert [row[:3] for row in table.rows] == [
        ("plain", "308", "1.00"),
        ("ssam-1", "342", "1.11"),
        ("scam-1", "338", "1.10"),
    ]
    assert table.rows[0][4] == table.rows[0][6] == "1.00"
    assert len(turns) == 2


def test_markdown_of_a_table() -> None:
    table = Table("T", ("a", "b"), (("x", 0.12345), ("y", None), ("z", float("nan"))), "A note.")
    assert (
        table.markdown() == "**T**\n\n| a | b |\n|---|---|\n| x | 0.123 |\n| y | – |\n| z | – |\n\nA note.\n"
    )


def test_the_spread_is_that_of_a_sample_of_seeds(estimates: Estimates) -> None:
    for seed in range(3):
        estimates.estimates_n["plain", seed] = estimates.measured_n + 0.4 + 0.1 * seed
    assert tables.comparison(estimates, "3").rows[0][5] == "0.500 ± 0.100"


def test_one_seed_has_no_spread(estimates: Estimates) -> None:
    one = replace(estimates, scale=Scale(seeds=1))
    assert tables.comparison(one, "3").rows[0][5] == "0.400"
