"""Pages of the site, which Python-Markdown renders: it needs more than GitHub does."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
FIRST = re.compile(r"- |\d+\. |\| ")
"""Begin of an item of a list, or of a row of a table."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_lists_and_tables_begin_after_an_empty_line(page: Path) -> None:
    """Without it they become a part of the paragraph before."""
    text = re.sub(r"^```.*?^```", "code", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for block in re.split(r"\n\s*\n", text):
        first, *lines = [line for line in block.splitlines() if not line.startswith(("<!--", "#"))] or [""]
        joined = [line for line in lines if FIRST.match(line)] if not FIRST.match(first.lstrip()) else []
        assert not joined, f"add an empty line before: {joined[0]}"
