"""Shared fixtures."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_grasps() -> Path:
    """The folder of real recordings, which is no part of the project."""
    folder = Path(__file__).parents[2] / "shared" / "real_grasps"
    if not folder.is_dir():
        pytest.skip(f"needs the real recordings, and {folder} is absent")
    return folder
