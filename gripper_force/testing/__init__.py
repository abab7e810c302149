"""Contract suites for devices and engines, to be run with pytest on your own classes."""

import pytest

# Gives failures of the suites the same detailed messages as failures in a test module.
pytest.register_assert_rewrite(
    f"{__name__}.camera_contract",
    f"{__name__}.engine_contract",
    f"{__name__}.load_cell_contract",
    f"{__name__}.sensor_contract",
    f"{__name__}.servo_contract",
)
