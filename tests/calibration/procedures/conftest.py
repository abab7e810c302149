"""Calibrations without what costs most of their time."""

import pytest

from gripper_calibration.procedures import calibrate_object, teach


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves out the figure of an object, which takes as long as its fit."""
    for module in (calibrate_object, teach):
        monkeypatch.setattr(module, "draw", lambda *_: None)
