"""The table in docs/servos.md lists every model; ``python tests/hw/dynamixel/test_servos_page.py`` writes it."""

from pathlib import Path

from gripper_hw.dynamixel.control_table import load_model, model_names

PAGE = Path(__file__).parents[3] / "docs" / "servos.md"
START, END = "<!-- models -->\n", "<!-- end of models -->"
HEAD = """| model | number | Nm/A | stall torque | largest current limit | current unit | supply | fast sync read |
|---|---|---|---|---|---|---|---|
"""


def table() -> str:
    rows = []
    for name in model_names():
        model = load_model(name)
        low_v, high_v = model.voltage_range_v
        rows.append(
            f"| [{name}](https://emanual.robotis.com/docs/en/dxl/x/{name.lower()}/) | {model.number} "
            f"| {model.nm_per_a:.2f} | {model.stall_torque_nm:g} Nm at {model.nominal_voltage_v:g} V "
            f"| {model.max_current_a:.2f} A | {1e3 * model.current_unit_a:g} mA | {low_v:g} to {high_v:g} V "
            f"| firmware {model.fast_sync_read_firmware} |\n"
        )
    return HEAD + "".join(rows)


def page() -> str:
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(START)
    return before + START + "\n" + table() + "\n" + END + rest.partition(END)[2]


def test_the_page_is_up_to_date() -> None:
    assert PAGE.read_text(encoding="utf-8") == page()


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
