"""docs/configuration.md lists every key; ``python tests/core/test_configuration_page.py`` writes it anew."""

from pathlib import Path
from typing import Any

from gripper_force.config import FAULTS, Config
from gripper_force.schema import keys

PAGE = Path(__file__).parents[1] / "docs" / "configuration.md"
HEAD = """# Configuration

Every key, with what it is where nothing is said; `-` is none, `null` in YAML. A file for `--config` is YAML
(`control: {force_limit_n: 8}`), and `--set control.force_limit_n=8` wins over it. Units stand in the names.
An unknown key is refused, with those that are known.

| key | default | what it is |
|---|---|---|
"""
FAULTS_HEAD = """
## Faults
`faults` takes a list: `--set "faults=[{unit: camera, kind: stuck, at_s: 2, for_s: 1}]"`. What became of each
is in [Reliability](reliability.md).

| unit | kind | what it means |
|---|---|---|
"""


def shown(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value) or "-"


def page() -> str:
    rows = [
        f"| `{key}` | {'-' if key == 'faults' else shown(field.default)} | {field.description} |"
        for key, field in keys(Config)
    ]
    faults = [
        f"| {unit} | {kind} | {what} |" for unit, kinds in FAULTS.items() for kind, what in kinds.items()
    ]
    return HEAD + "\n".join(rows) + "\n" + FAULTS_HEAD + "\n".join(faults) + "\n"


def test_the_page_is_of_today() -> None:
    assert PAGE.read_text() == page()


def test_every_key_is_told() -> None:
    assert [key for key, field in keys(Config) if not field.description] == []


if __name__ == "__main__":
    PAGE.write_text(page())
