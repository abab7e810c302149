"""The Phidget driver without a bridge: errors of missing parts, and calls of the vendor's library."""

import importlib.util
import math
from types import SimpleNamespace

import pytest

from gripper_force.config import LoadCellConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceNotFoundError
from gripper_force.runtime.backends import MonotonicClock
from gripper_hw.load_cells.phidget import PhidgetLoadCell

INSTALLED = importlib.util.find_spec("Phidget22") is not None


def make_cell(**values: object) -> PhidgetLoadCell:
    section = {"backend": "phidget", "rate_hz": 100, "channel": 2, "n_per_raw": 1000.0}
    return PhidgetLoadCell(LoadCellConfig.model_validate(section | values), MonotonicClock())


def test_bridge_is_configured_at_start_and_after_each_reconnection(phidget_library: SimpleNamespace) -> None:
    cell = make_cell()
    cell.start()
    cell.start()
    (channel,) = phidget_library.VoltageRatioInput.made
    settings = {"BridgeGain": 8, "DataInterval": 10, "VoltageRatioChangeTrigger": 0.0, "BridgeEnabled": True}
    assert channel.told.items() >= ({"Channel": 2} | settings).items()
    for name in settings:
        del channel.told[name]
    channel.told["OnDetachHandler"](channel)
    channel.told["OnAttachHandler"](channel)
    assert channel.told.items() >= settings.items()
    assert cell.stats.losses == 1
    cell.close()
    cell.close()
    assert channel.closed == 1


def test_ratios_become_samples_and_out_of_range_is_saturation(
    phidget_library: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gripper_hw.load_cells.screening.MAX_WAIT_NS", 0)
    cell = make_cell()
    cell.start()
    (channel,) = phidget_library.VoltageRatioInput.made
    for i in range(10):
        channel.told["OnVoltageRatioChangeHandler"](channel, i * 1e-5)
    channel.told["OnErrorHandler"](channel, 4103, "Overrange")
    channel.told["OnErrorHandler"](channel, 4098, "Overrun")
    samples = cell.drain()
    assert [s.force_n for s in samples[:10]] == pytest.approx([0.01 * i for i in range(10)])
    assert [s.valid for s in samples] == [True] * 10 + [False]
    assert math.isnan(samples[10].raw)
    assert cell.stats.saturated == 1
    cell.close()


def test_an_error_and_the_ratio_that_follows_it_are_one_reading(phidget_library: SimpleNamespace) -> None:
    cell = make_cell()
    cell.start()
    (channel,) = phidget_library.VoltageRatioInput.made
    saturated = []
    for ratio in (None, 1 / 128, 1 / 128, None, 1 / 128, None, None, 0.0, 1 / 128):  # None: an error
        if ratio is None:
            channel.told["OnErrorHandler"](channel, 4103, "Overrange")
        else:
            channel.told["OnVoltageRatioChangeHandler"](channel, ratio)
        saturated.append(cell.stats.saturated)
    assert saturated == [1, 1, 2, 3, 3, 4, 5, 5, 6]
    cell.close()


@pytest.mark.parametrize("code", [4103, 4105, 4114, 4115])
def test_each_error_for_a_reading_out_of_range_is_saturation(
    phidget_library: SimpleNamespace, code: int
) -> None:
    cell = make_cell()
    cell.start()
    (channel,) = phidget_library.VoltageRatioInput.made
    channel.told["OnErrorHandler"](
        channel, code, "The sensor reading is too high for the selected gain mode."
    )
    assert cell.stats.saturated == 1
    cell.close()


@pytest.mark.parametrize("ratio", [1 / 128, -1 / 128, 0.05, math.inf, math.nan])
def test_ratio_beyond_the_range_of_the_gain_is_saturation(
    phidget_library: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, ratio: float
) -> None:
    monkeypatch.setattr("gripper_hw.load_cells.screening.MAX_WAIT_NS", 0)
    cell = make_cell()
    cell.start()
    (channel,) = phidget_library.VoltageRatioInput.made
    channel.told["OnVoltageRatioChangeHandler"](channel, ratio)
    channel.told["OnVoltageRatioChangeHandler"](channel, 0.0077)
    assert [s.valid for s in cell.drain()] == [False, True]
    assert cell.stats.saturated == 1
    cell.close()


@pytest.mark.parametrize(
    ("code", "error", "message"),
    [
        (3, DeviceNotFoundError, "no Phidget bridge answers for load_cell.channel=2; check"),
        (21, DeviceError, r"could not configure the Phidget bridge \(Invalid Argument\);"),
    ],
)
def test_refusal_of_bridge_is_one_line(
    phidget_library: SimpleNamespace, code: int, error: type[DeviceError], message: str
) -> None:
    phidget_library.VoltageRatioInput.attach_error = phidget_library.PhidgetException(code)
    cell = make_cell()
    with pytest.raises(error, match=message) as caught:
        cell.start()
    assert "\n" not in str(caught.value)
    assert phidget_library.VoltageRatioInput.made[0].closed == 1
    assert cell.drain() == []
    cell.close()


def test_missing_native_library_is_named(phidget_library: SimpleNamespace) -> None:
    def missing() -> str:
        raise OSError("libusb-1.0.so.0: cannot open shared object file")

    phidget_library.Phidget.getLibraryVersion = missing
    with pytest.raises(DeviceError, match=r"\(libusb-1\.0\.so\.0: .*\); install it"):
        make_cell().start()


@pytest.mark.skipif(INSTALLED, reason="Phidget22 is installed")
def test_missing_package_is_named() -> None:
    with pytest.raises(DeviceError, match=r"pip install 'gripper-force\[phidget\]'"):
        make_cell().start()


@pytest.mark.skipif(not INSTALLED, reason="needs the package Phidget22")
def test_vendor_library_finds_no_bridge() -> None:
    with pytest.raises(DeviceError, match=r"cannot load a system library|no Phidget bridge answers"):
        make_cell().start()


@pytest.mark.parametrize("rate_hz", [0.5, 123, 200])
def test_rate_out_of_range_is_refused(rate_hz: float) -> None:
    with pytest.raises(ConfigError, match=r"rate_hz=.* set it to 1 to 122 samples/s"):
        make_cell(rate_hz=rate_hz)
