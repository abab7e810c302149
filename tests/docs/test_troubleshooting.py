"""The messages on the page of errors are those of the source."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "troubleshooting.md"
SOURCES = [
    path
    for folder in ("gripper_force", "hw/gripper_hw", "calibration/gripper_calibration")
    for path in sorted((ROOT / folder).rglob("*.py"))
]


def template(node: ast.expr) -> str | None:
    """Returns a text of the source with … for each value; None for what is no text."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else None
    if isinstance(node, ast.JoinedStr):
        return "".join(template(part) or "…" for part in node.values)
    return None


@cache
def templates() -> list[str]:
    texts = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.expr) and (text := template(node)) is not None:
                texts.append(text)
    return texts


MESSAGES = re.findall(r"^\| `([^`]+(?:`[^`|]*`[^`|]*)*)` \|", PAGE.read_text(), re.MULTILINE)


def test_the_page_has_messages() -> None:
    assert len(MESSAGES) > 40
    assert len(set(MESSAGES)) == len(MESSAGES)


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_is_in_the_source(message: str) -> None:
    parts = [part for part in message.split("…") if part.strip(" .")]
    assert sum(map(len, parts)) >= 10, "too short to be found"
    pattern = re.compile(".*".join(map(re.escape, parts)), re.DOTALL)
    assert any(pattern.search(text) for text in templates())
