import pytest
from hypothesis import given
from hypothesis import strategies as st

from gripper_force.errors import ConfigError
from gripper_hw.dynamixel.control_table import (
    REGISTERS,
    check_model_number,
    load_model,
    model_names,
    rad_from_ticks,
    ticks_from_rad,
)


@pytest.mark.parametrize(
    ("name", "number", "unit_a", "limit", "nm_per_a", "range_v"),
    [
        ("XM430-W350", 1020, 2.69e-3, 1193, 1.78, (10.0, 14.8)),
        ("XM430-W210", 1030, 2.69e-3, 1193, 1.30, (10.0, 14.8)),
        ("XL330-M288", 1200, 1e-3, 1750, 0.35, (3.7, 6.0)),
        ("XC330-T288", 1220, 1e-3, 910, 1.15, (6.5, 12.0)),
    ],
)
def test_models_match_the_vendors_tables(name, number, unit_a, limit, nm_per_a, range_v):
    model = load_model(name)
    assert (model.name, model.number, model.current_unit_a) == (name, number, unit_a)
    assert model.max_current_a == pytest.approx(limit * unit_a)
    assert model.nm_per_a == pytest.approx(nm_per_a, abs=0.006)
    assert {0, 3, 5, 16} <= set(model.operating_modes)
    assert model.voltage_range_v == range_v
    assert range_v[0] < model.nominal_voltage_v < range_v[1]


def test_unknown_model_error_lists_the_known_ones():
    with pytest.raises(ConfigError) as caught:
        load_model("AX-12")
    assert all(name in str(caught.value) for name in model_names())
    assert len(model_names()) == 4


@pytest.mark.parametrize("name", ["XL430-W250", "XC430-W150", "XC430-W240"])
def test_model_without_current_control_error_gives_the_reason(name):
    with pytest.raises(ConfigError, match=r"no current control.*Present Load"):
        load_model(name)


def test_check_model_number():
    model = load_model("XM430-W350")
    check_model_number(model, 1020, "it")
    with pytest.raises(ConfigError, match=r"XM430-W210.*1030.*not the configured XM430-W350"):
        check_model_number(model, 1030, "it")
    with pytest.raises(ConfigError, match=r"XL430-W250.*Present Load"):
        check_model_number(model, 1060, "it")
    with pytest.raises(ConfigError, match=r"unknown model.*4711"):
        check_model_number(model, 4711, "it")


@pytest.mark.parametrize(
    ("name", "firmware", "windows"),
    [
        ("XM430-W350", 45, [(168, 224, 28), (578, 634, 28)]),
        ("XM430-W350", 52, [(168, 224, 28), (578, 634, 28)]),
        ("XL330-M288", 51, [(168, 224, 28)]),
        ("XL330-M288", 52, [(168, 208, 20)]),
        ("XC330-T288", 53, [(168, 208, 20)]),
    ],
)
def test_indirect_windows_depend_on_firmware(name, firmware, windows):
    assert list(load_model(name).indirect_windows(firmware)) == windows


def test_registers_do_not_overlap():
    ends = 0
    for register in REGISTERS.values():
        assert register.address >= ends
        ends = register.address + register.size
    assert REGISTERS["shutdown"].eeprom
    assert not REGISTERS["torque_enable"].eeprom
    assert [REGISTERS[f"present_{name}"].address for name in ("current", "velocity", "position")] == [
        126,
        128,
        132,
    ]


@given(st.sampled_from(sorted(REGISTERS)), st.data())
def test_register_encode_decode_round_trip(name, data):
    register = REGISTERS[name]
    bits = 8 * register.size
    least, greatest = (-(1 << bits - 1), (1 << bits - 1) - 1) if register.signed else (0, (1 << bits) - 1)
    value = data.draw(st.integers(least, greatest))
    assert register.decode(register.encode(value)) == value


@given(st.integers(-1_048_575, 1_048_575))
def test_ticks_radians_round_trip(ticks):
    assert ticks_from_rad(rad_from_ticks(ticks)) == ticks
    assert rad_from_ticks(2048) == 0.0
