"""Scripts that measure figures of the documentation, run as a user runs them."""

import re
import subprocess
import sys
from pathlib import Path

SCRIPTS = Path(__file__).parents[2] / "scripts"


def run(name: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, str(SCRIPTS / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_lower_force_prints_a_row_per_object_and_feedback() -> None:
    arguments = ["--feedback", "current", "--object", "tube", "--friction", "1", "--seeds", "1"]
    shown = run("lower_force.py", *arguments).stdout.splitlines()
    assert len(shown) == 3
    assert shown[2].startswith("| current | tube | 1 of 1 |")
    assert shown[2].endswith("| 0 |")


def test_lost_object_prints_the_time_to_slip() -> None:
    arguments = ["--feedback", "current", "--object", "tube", "--target-n", "3", "--seeds", "1"]
    shown = run("lost_object.py", *arguments).stdout.splitlines()
    assert len(shown) == 3
    assert re.fullmatch(r"\| current \| 3 N \| 1 of 1 \| (\d+), \1 \| [01] \| 0 \|", shown[2])


def test_a_loss_is_reported_although_friction_holds_the_jaws_and_the_view_seems_covered() -> None:
    arguments = ["--feedback", "fused", "--object", "paper_cup", "--target-n", "1", "--seeds", "1"]
    shown = run("lost_object.py", *arguments).stdout.splitlines()
    assert re.fullmatch(r"\| fused \| 1 N \| 1 of 1 \| (\d+), \1 \| [01] \| 0 \|", shown[2])
