"""The README: its length, its links, its figures, and its lines of Python."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from gripper_force.config import dump_config, load_config

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
PYTHON = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
LINKS = [link for link in re.findall(r"\]\(([^)]+)\)", README) if not link.startswith("https://")]


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 120


def test_the_python_of_the_readme_is_short() -> None:
    (block,) = PYTHON
    assert len(block.splitlines()) <= 10


def test_the_python_of_the_readme_runs(quick: list[str], tmp_path: Path) -> None:
    (block,) = PYTHON
    (tmp_path / "my.yaml").write_text(dump_config(load_config(None, quick)))
    done = subprocess.run(
        [sys.executable, "-c", block], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("hold\n")  # the phase, after force and width
    assert (tmp_path / "run.mcap").exists()


@pytest.mark.parametrize("link", LINKS)
def test_a_link_leads_to_a_file(link: str) -> None:
    path, _, anchor = link.partition("#")
    assert (ROOT / path).exists()
    if anchor:
        headings = re.findall(r"^#+ (.+)$", (ROOT / path).read_text(), re.MULTILINE)
        assert anchor in {
            re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings
        }


def test_its_figures_are_those_of_the_results() -> None:
    results = (ROOT / "docs" / "results.md").read_text()
    rows = [line for line in README.splitlines() if line.startswith("|")]
    assert len(rows) > 5
    assert all(row in results for row in rows)


def test_the_animation_is_small() -> None:
    (animation,) = re.findall(r"!\[[^]]*\]\(([^)]+)\)", README)
    assert (ROOT / animation).stat().st_size < 1_500_000
