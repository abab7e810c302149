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

# Written again by hand from the manual's pages: a slip in one place does not pass in the other.
VENDOR = [
    ("XM430-W350", 1020, 2.69e-3, 1193, 1.78, (10.0, 14.8), 800),
    ("XM430-W210", 1030, 2.69e-3, 1193, 1.30, (10.0, 14.8), 800),
    ("XM540-W150", 1130, 2.69e-3, 2047, 1.659, (10.0, 14.8), 800),
    ("XM540-W270", 1120, 2.69e-3, 2047, 2.409, (10.0, 14.8), 800),
    ("XH430-W210", 1010, 2.69e-3, 648, 1.92, (10.0, 14.8), 900),
    ("XH430-W350", 1000, 2.69e-3, 648, 2.62, (10.0, 14.8), 900),
    ("XH430-V210", 1050, 1.34e-3, 689, 3.71, (11.0, 30.0), 800),
    ("XH430-V350", 1040, 1.34e-3, 689, 4.71, (11.0, 30.0), 800),
    ("XH540-W150", 1110, 2.69e-3, 2047, 1.45, (10.0, 14.8), 800),
    ("XH540-W270", 1100, 2.69e-3, 2047, 2.02, (10.0, 14.8), 800),
    ("XH540-V150", 1150, 2.69e-3, 1188, 2.667, (11.0, 30.0), 800),
    ("XH540-V270", 1140, 2.69e-3, 1188, 3.833, (11.0, 30.0), 800),
    ("XD430-T210", 1011, 2.69e-3, 648, 1.92, (10.0, 14.8), 900),
    ("XD430-T350", 1001, 2.69e-3, 648, 2.62, (10.0, 14.8), 900),
    ("XD540-T150", 1111, 2.69e-3, 2047, 1.45, (10.0, 14.8), 800),
    ("XD540-T270", 1101, 2.69e-3, 2047, 2.02, (10.0, 14.8), 800),
    ("XM335-T323", 1710, 1e-3, 910, 1.29, (6.5, 12.0), 2000),
    ("XW430-T200", 1280, 2.69e-3, 2047, 1.39, (10.0, 14.8), 900),
    ("XW430-T333", 1270, 2.69e-3, 2047, 2.38, (10.0, 14.8), 900),
    ("XW540-H260", 1310, 2.69e-3, 1188, 3.667, (11.0, 30.0), 800),
    ("XW540-T140", 1180, 2.69e-3, 2047, 1.408, (10.0, 14.8), 800),
    ("XW540-T260", 1170, 2.69e-3, 2047, 1.939, (10.0, 14.8), 800),
    ("XC330-M181", 1230, 1e-3, 2352, 0.33, (3.7, 6.0), 1200),
    ("XC330-M288", 1240, 1e-3, 2352, 0.52, (3.7, 6.0), 1100),
    ("XC330-T181", 1210, 1e-3, 910, 0.95, (6.5, 12.0), 900),
    ("XC330-T288", 1220, 1e-3, 910, 1.15, (6.5, 12.0), 900),
    ("XL330-M077", 1190, 1e-3, 1750, 0.146, (3.7, 6.0), 400),
    ("XL330-M288", 1200, 1e-3, 1750, 0.35, (3.7, 6.0), 400),
]


@pytest.mark.parametrize(("name", "number", "unit_a", "limit", "nm_per_a", "range_v", "gain"), VENDOR)
def test_models_match_the_vendors_tables(name, number, unit_a, limit, nm_per_a, range_v, gain):
    model = load_model(name)
    assert (model.name, model.number, model.current_unit_a) == (name, number, unit_a)
    assert model.max_current_a == pytest.approx(limit * unit_a)
    assert model.nm_per_a == pytest.approx(nm_per_a, abs=0.006)
    assert {0, 3, 5, 16} <= set(model.operating_modes)
    assert (model.voltage_range_v, model.setting("position_p_gain")) == (range_v, gain)
    assert range_v[0] < model.nominal_voltage_v < range_v[1]
    assert model.setting("min_voltage_limit") <= 10 * range_v[0]
    assert 10 * range_v[1] <= model.setting("max_voltage_limit")


def test_every_model_is_checked_and_has_its_own_number():
    assert sorted(row[0] for row in VENDOR) == list(model_names())
    assert len({row[1] for row in VENDOR}) == len(VENDOR)


@pytest.mark.parametrize(
    "name", ["XM430-W350-T", "XM430-W350-R", "XW430-T200-R", "XC330-T288-T", "XC330-T288"]
)
def test_connector_suffix_is_ignored(name):
    assert load_model(name) == load_model(name.removesuffix("-T").removesuffix("-R"))


def test_model_of_ones_own_states_only_what_differs(tmp_path):
    path = tmp_path / "geared.yaml"
    path.write_text("like: XM430-W350-R\nstall_torque_nm: 8.2\ninitial: {position_p_gain: 400}\n")
    base, model = load_model("XM430-W350"), load_model(str(path))
    assert (model.name, model.nm_per_a) == ("geared", 2 * base.nm_per_a)
    assert model.setting("position_p_gain") == 400
    assert model.indirect == base.indirect
    assert model.initial == base.initial | {"position_p_gain": 400}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("number: 1", r"servo model key 'current_unit_a'.*required"),
        ("like: XM430\nnumber: 1", "unknown servo.model 'XM430'"),
        ("like: XL430-W250", "no current control"),
        ("like: XM430-W350\nstall_torque: 3", "did you mean 'stall_torque_nm'"),
        ("like: XM430-W350\nstall_current_a: 0", "stall_current_a.*greater than"),
        ("like: XM430-W350\noperating_modes: [3]", "current-based position mode"),
        ("like: XM430-W350\nvoltage_range_v: [12, 10]", "lowest and the highest"),
        ("like: XM430-W350\ninitial: {gain: 3}", "unknown register 'gain'"),
        ("like: XM430-W350\ninitial: {current_limit: 70000}", "does not fit"),
        ("like: XM430-W350\ninitial: {position_p_gain: null}", "position_p_gain is missing"),
        ("like: XM430-W350\nindirect: {0: []}", "at least one window"),
        ("like: XM430-W350\nindirect: {0: [[168, 224, 19]]}", "must have 20 bytes"),
        ("[]", "must hold a mapping"),
    ],
)
def test_wrong_file_of_ones_own_is_named(tmp_path, text, message):
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_model(str(path))


def test_missing_file_of_ones_own_is_named():
    with pytest.raises(ConfigError, match=r"can't read the servo model nowhere/own.yml"):
        load_model("nowhere/own.yml")


def test_unknown_model_error_lists_the_known_ones():
    with pytest.raises(ConfigError) as caught:
        load_model("AX-12")
    assert all(name in str(caught.value) for name in model_names())
    assert "YAML file" in str(caught.value)


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
