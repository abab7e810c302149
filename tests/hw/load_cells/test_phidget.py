"""Without a bridge: what is said when something is missing, and what the vendor's library is asked for."""

import importlib.util
import math
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from gripper_force.config import LoadCellConfig
from gripper_force.errors import ConfigError, DeviceError, DeviceNotFoundError
from gripper_force.runtime.backends import MonotonicClock
from gripper_hw.load_cells.phidget import PhidgetLoadCell

INSTALLED = importlib.util.find_spec("Phidget22") is not None


def make_cell(**values: object) -> PhidgetLoadCell:
    section = {"backend": "phidget", "rate_hz": 100, "channel": 2, "n_per_raw": 1000.0}
    return PhidgetLoadCell(LoadCellConfig.model_validate(section | values), MonotonicClock())


class RefusalError(Exception):
    def __init__(self, code: int) -> None:
        self.code, self.description = code, "Timed Out" if code == 3 else "Invalid Argument"


class Channel:
    """Takes the place of the vendor's VoltageRatioInput, which needs a bridge: keeps what it is told."""

    attach_error: RefusalError | None = None
    made: list["Channel"]

    def __init__(self) -> None:
        self.told: dict[str, Any] = {}
        self.closed = 0
        self.made.append(self)

    def __getattr__(self, name: str) -> Any:
        return lambda value: self.told.update({name.removeprefix("set"): value})

    def openWaitForAttachment(self, timeout_ms: int) -> None:  # noqa: N802
        if self.attach_error is not None:
            raise self.attach_error

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    class Fresh(Channel):
        made: list[Channel] = []  # noqa: RUF012

    library = SimpleNamespace(
        VoltageRatioInput=Fresh,
        PhidgetException=RefusalError,
        BridgeGain=SimpleNamespace(BRIDGE_GAIN_128=8),
        Phidget=SimpleNamespace(getLibraryVersion=lambda: "1.26"),
    )
    monkeypatch.setitem(sys.modules, "Phidget22.Devices.VoltageRatioInput", library)
    return library


def test_the_bridge_is_set_up_now_and_each_time_it_comes_back(library: SimpleNamespace) -> None:
    cell = make_cell()
    cell.start()
    cell.start()
    (channel,) = library.VoltageRatioInput.made
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
    library: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gripper_hw.load_cells.screening.MAX_WAIT_NS", 0)
    cell = make_cell()
    cell.start()
    (channel,) = library.VoltageRatioInput.made
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


@pytest.mark.parametrize(
    ("code", "error", "sentence"),
    [
        (3, DeviceNotFoundError, r"no Phidget bridge answers for load_cell\.channel=2"),
        (21, DeviceError, r"could not configure the Phidget bridge \(Invalid Argument\)"),
    ],
)
def test_what_the_bridge_refuses_is_one_sentence(
    library: SimpleNamespace, code: int, error: type[DeviceError], sentence: str
) -> None:
    library.VoltageRatioInput.attach_error = RefusalError(code)
    cell = make_cell()
    with pytest.raises(error, match=sentence) as caught:
        cell.start()
    assert "\n" not in str(caught.value)
    assert library.VoltageRatioInput.made[0].closed == 1
    assert cell.drain() == []
    cell.close()


def test_a_missing_native_library_is_named(library: SimpleNamespace) -> None:
    def missing() -> str:
        raise OSError("libusb-1.0.so.0: cannot open shared object file")

    library.Phidget.getLibraryVersion = missing
    with pytest.raises(
        DeviceError,
        match=r"Phidget[\d.]+ cannot load a system library \(libusb-[\d.]+\.so\.[\d.]+: cannot open shared",
    ):
        make_cell().start()


@pytest.mark.skipif(INSTALLED, reason="Phidget22 is installed")
def test_a_missing_package_is_named() -> None:
    with pytest.raises(DeviceError, match=r"pip install 'gripper-force\[phidget\]'"):
        make_cell().start()


@pytest.mark.skipif(not INSTALLED, reason="needs the package Phidget22")
def test_the_vendors_own_library_finds_no_bridge_where_none_is() -> None:
    with pytest.raises(DeviceError, match=r"can't load a library|no Phidget bridge answers"):
        make_cell().start()


@pytest.mark.parametrize("rate_hz", [0.5, 123, 200])
def test_the_bridge_can_not_sample_at_any_rate(rate_hz: float) -> None:
    with pytest.raises(ConfigError, match=r"load_cell\.rate_hz=[\d.]+ is out of a Phidget bridge's range"):
        make_cell(rate_hz=rate_hz)
