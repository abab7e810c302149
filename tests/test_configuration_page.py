"""docs/configuration.md lists every key; ``python tests/test_configuration_page.py`` writes it."""

from pathlib import Path
from typing import Any

from gripper_force.config import Config
from gripper_force.fault_config import FAULTS
from gripper_force.schema import keys

PAGE = Path(__file__).parents[1] / "docs" / "configuration.md"
HEAD = """# Configuration

All keys and their defaults. A default of `null` means no value. A `--config` file is YAML (`control: {force_limit_n: 8}`);
`--set control.force_limit_n=8` overrides it. Units are part of the names. A relative path is
relative to the folder of the command, not to that of the file. An unknown key is an error. `gripper-force config schema` prints the JSON schema for editors.
"""
SECTION = """
## {}
| key | default | meaning |
|---|---|---|
"""
FAULTS_HEAD = """
## Faults
`faults` is a list: `--set "faults=[{unit: camera, kind: stuck, at_s: 2, for_s: 1}]"`.
[Reliability](reliability.md) shows the result of each.

| unit | kind | meaning |
|---|---|---|
"""


def shown(value: Any) -> str:
    if value is None:
        return "null"
    if value == {}:
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value) or "-"


def page() -> str:
    sections: dict[str, str] = {}
    for key, field in keys(Config):
        name = key.partition(".")[0] if "." in key else "The run"
        default = "-" if key == "faults" else shown(field.default)
        row = f"| `{key}` | {default} | {field.description} |\n"
        sections[name] = sections.get(name, SECTION.format(name)) + row
    faults = [
        f"| {unit} | {kind} | {what} |" for unit, kinds in FAULTS.items() for kind, what in kinds.items()
    ]
    return HEAD + "".join(sections.values()) + FAULTS_HEAD + "\n".join(faults) + "\n"


def test_the_page_is_up_to_date() -> None:
    assert PAGE.read_text() == page()


def test_every_key_has_a_description() -> None:
    assert [key for key, field in keys(Config) if not field.description] == []


if __name__ == "__main__":
    PAGE.write_text(page())
